"""Simulated reconstructions of six tiles of a photograph against noise and against bits (Wood et al., Fig. 7).

A photograph of whole numbers shines on a grid of its own, on which rounding errs a third less than elsewhere, and
equally where pixels are equal. So each pixel gets back a fraction such as storing it took away: -1/2 to 1/2, by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.forms.form import Matrix, Vector
from ommatid.runtime.errors import InputError
from ommatid.scenes import scene
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats import picture
from ommatid.scenes.tables.sensor import NoiseTable

from .tile_errors import GALLERY, PaperTile

# From the light, (M,), of a camera to what its sensor records, with the seed of its noise.
Record = Callable[[Camera, Vector, NoiseTable, int], Vector]

PHOTOGRAPH = "photo:camera"
COUNT = 6
LAYOUTS = ((2, 3), (3, 2), (1, 6), (6, 1))  # of the regions that hold a tile each; some suits any picture that does
CHOICES = 9  # places tried along either axis of a region
VARIANCES = tuple(10.0 ** (power / 2) for power in range(-12, 5))
BITS = tuple(range(2, 17))
WHOLE = 12  # bits from which on whole-numbered pictures are known to err less


@dataclass(frozen=True)
class TileCrops:
    """Tiles of a picture: (T, N) `images`, and the row and column where each begins."""

    images: Matrix
    places: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Trials:
    """Reconstructions of T images at Q levels of noise, as mean squared errors over the pixels.

    measured, predicted : (Q, T) of the estimates, and (Q,) from Eq. 5
    from_noise, noise_part : the same of A v alone, the noise's part in the estimate
    spread : (Q,), relative standard deviation of `from_noise`, were the noise Gaussian
    """

    noises: tuple[NoiseTable, ...]
    measured: Matrix
    predicted: Vector
    from_noise: Matrix
    noise_part: Vector
    spread: Vector

    @property
    def mean(self) -> Vector:
        """Over the images: (Q,)."""
        return self.measured.mean(axis=1)


@dataclass(frozen=True)
class Photograph:
    """What Fig. 7 shows: a photograph's tiles with noise, with quantisation, and as whole numbers with the latter."""

    name: str
    cut: TileCrops
    noisy: Trials
    quantised: Trials
    whole: Trials


def load(image: str) -> picture.Image:
    """A whole picture by its file name, or `photo:NAME` for one of scikit-image. Raises InputError."""
    tables = scene.read(GALLERY / "tile35.toml").plain()
    kept = {key: value for key, value in tables["target"].items() if key not in ("origin", "shape")}
    return picture.load(scene.parse({**tables, "target": {**kept, "image": image}}, Path("--image")))


def cut(pixels: picture.Image, side: int, name: str, rng: np.random.Generator) -> TileCrops:
    """Six tiles, one in each sixth of a picture: of some places tried there, the one with the most contrast.

    rng : of the fractions that are added to the pixels
    Raises InputError for a picture that does not hold six.
    """
    rows, columns = pixels.shape
    fitting = [(down, across) for down, across in LAYOUTS if rows // down >= side and columns // across >= side]
    if not fitting:
        raise InputError(
            f"--image: expected a picture that holds {COUNT} tiles of {side} x {side} pixels, such as one of"
            f" {2 * side} x {3 * side}, got {rows} x {columns} in {name}; choose a larger one"
        )
    down, across = max(fitting, key=lambda layout: min(rows / layout[0], columns / layout[1]))
    starts, lefts = _places(rows, down, side), _places(columns, across, side)
    places = tuple(_busiest(pixels, side, some, others) for some in starts for others in lefts)
    images = np.array([pixels[row : row + side, column : column + side].ravel() for row, column in places])
    return TileCrops(images + rng.uniform(-0.5, 0.5, images.shape), places)


def _places(size: int, parts: int, side: int) -> list[NDArray[np.int64]]:
    regions = pairwise(size * part // parts for part in range(parts + 1))
    return [np.unique(np.linspace(low, high - side, CHOICES).round().astype(np.int64)) for low, high in regions]


def _busiest(pixels: picture.Image, side: int, rows: NDArray[np.int64], columns: NDArray[np.int64]) -> tuple[int, int]:
    places = [(int(row), int(column)) for row in rows for column in columns]
    return max(places, key=lambda place: float(pixels[place[0] : place[0] + side, place[1] : place[1] + side].std()))


def simulate_trials(tile: PaperTile, name: str, cut: TileCrops, record: Record, seed: int) -> Photograph:
    """Reconstruct the tiles of a photograph under noise, and under quantisation."""
    fine = tuple(NoiseTable(bits=bits) for bits in BITS)
    return Photograph(
        name,
        cut,
        measure(tile, cut.images, tuple(NoiseTable(variance=one) for one in VARIANCES), record, seeds(seed, 0)),
        measure(tile, cut.images, fine, record, seeds(seed, 1)),
        measure(tile, cut.images.round(), fine[BITS.index(WHOLE) :], record, seeds(seed, 2)),
    )


def measure(
    tile: PaperTile, images: Matrix, noises: tuple[NoiseTable, ...], record: Record, stream: Callable[[int, int], int]
) -> Trials:
    """Record (T, N) images at every level of noise, and reconstruct them by an estimator that expects that noise.

    stream : the seed of a level and an image, by their numbers
    """
    matrix, mean = tile.form.problem.matrix, tile.form.problem.prior.mean
    light: Matrix = np.asarray(matrix @ images.T)
    before = np.asarray(matrix @ mean)[:, None]
    found: list[tuple[Any, ...]] = []
    for level, noise in enumerate(noises):
        variance = noise.variance + noise.quantisation_variance
        form = tile.form.with_noise_scaled(variance)
        recorded = np.stack(
            [record(tile.camera, light[:, number], noise, stream(level, number)) for number in range(len(images))], 1
        )
        error = mean[:, None] + form.gain(recorded - before) - images.T
        from_noise = form.gain(recorded - light)
        prior = tile.form.expected_variance(variance, 0.0).mean()
        predicted = tile.mse(variance)
        squares = [np.square(values).mean(axis=0) for values in (error, from_noise)]
        found.append((squares[0], predicted, squares[1], predicted - prior, _spread(form.values)))
    columns = [np.array(column) for column in zip(*found, strict=True)]
    return Trials(noises, *columns)


def _spread(values: Vector) -> float:
    # |A v|^2 is a sum of independent squares with the weights (s / (1 + s^2))^2 = w: mean sum w, variance 2 sum w^2.
    weights = np.square(values / (1 + values**2))
    return float(np.sqrt(2 * np.square(weights).sum()) / weights.sum())


def seeds(seed: int, experiment: int) -> Callable[[int, int], int]:
    """A seed of its own for every level of noise and every tile of an experiment."""

    def stream(level: int, number: int) -> int:
        sequence = np.random.SeedSequence(seed, spawn_key=(experiment, level, number))
        return int(sequence.generate_state(1, np.uint64)[0])

    return stream
