"""Simulated reconstructions of six tiles of a photograph against noise and against bits (Wood et al., Fig. 7).

Pixels of a photograph are whole numbers, and measurements of whole numbers lie on a grid of their own, on which
rounding errs a third less than elsewhere, and equally where pixels are equal. So a random fraction, -1/2 to 1/2, such
as storing took away, is added to each pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.runtime.study import Row
from ommatid.scenes import scene
from ommatid.scenes.formats import picture
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.scenes.tables.sensor import NoiseTable
from ommatid.simulate.sensors import expose, generators

from .tile_errors import PaperTile

PHOTOGRAPH = "photo:camera"
TILES = 6
LAYOUTS = ((2, 3), (3, 2), (1, 6), (6, 1))  # of regions that hold a tile each
POSITIONS = 9  # tried along either axis of a region
VARIANCES = tuple(10.0 ** (power / 2) for power in range(-12, 5))
BITS = tuple(range(2, 17))
RECONSTRUCTED = 3  # the experiment of Fig. 6; those of Fig. 7 are 0 to 2
WHOLE_BITS = 12  # from which on images of whole numbers are known to err less


@dataclass(frozen=True)
class TileCrops:
    """Tiles of an image: (T, N) `images`, and the row and column of the first pixel of each."""

    images: FloatArray
    corners: tuple[tuple[int, int], ...]

    @property
    def columns(self) -> list[str]:
        """Names of the tiles as columns of tables."""
        return [f"tile_{row}_{column}" for row, column in self.corners]

    def named(self, errors: FloatArray) -> Row:
        """Return the errors of the tiles, (T,), by these names."""
        return dict(zip(self.columns, map(float, errors), strict=True))


@dataclass(frozen=True)
class Trials:
    """Reconstructions of T images at Q levels of noise, as mean squared errors over the pixels.

    measured, predicted : (Q, T) of the estimates, and (Q,) from Eq. 5
    from_noise, noise_part : the same of A v alone, the part of the error that noise causes
    spread : (Q,), relative standard deviation of `from_noise`, if the noise were Gaussian
    """

    noises: tuple[NoiseTable, ...]
    measured: FloatArray
    predicted: FloatArray
    from_noise: FloatArray
    noise_part: FloatArray
    spread: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Measured error averaged over the images: (Q,)."""
        return self.measured.mean(axis=1)

    def rows(self, crops: TileCrops) -> list[Row]:
        """Return a row per level: bits, None for noise, and the variance that the estimator expects."""
        return [
            {"bits": noise.bits, "noise_variance": noise.variance + noise.quantisation_variance}
            | {"predicted": float(self.predicted[level]), "mean": float(self.mean[level])}
            | crops.named(self.measured[level])
            for level, noise in enumerate(self.noises)
        ]


@dataclass(frozen=True)
class Photograph:
    """The content of Fig. 7: tiles with noise, with quantisation, and as whole numbers with quantisation."""

    name: str
    crops: TileCrops
    noisy: Trials
    quantised: Trials
    whole: Trials


def load(image: str) -> FloatArray:
    """Load a whole image by its file name, or `photo:NAME` for one of scikit-image. Raises InputError."""
    tables = scene.read(GALLERY / "tile35.toml").plain()
    target = {key: value for key, value in tables["target"].items() if key not in ("origin", "shape")}
    return picture.load(scene.parse({**tables, "target": {**target, "image": image}}, Path("--image")))


def crop_tiles(pixels: FloatArray, side: int, name: str, rng: np.random.Generator) -> TileCrops:
    """Crop six tiles, one in each sixth of an image: of several positions there, the one with the most contrast.

    rng : of the fractions that are added to the pixels
    Raises InputError for an image that does not hold six tiles.
    """
    rows, columns = pixels.shape
    fitting = [(down, across) for down, across in LAYOUTS if rows // down >= side and columns // across >= side]
    if not fitting:
        raise InputError(
            f"--image: expected a picture that holds {TILES} tiles of {side} x {side} pixels, such as one of"
            f" {2 * side} x {3 * side}, got {rows} x {columns} in {name}; choose a larger one"
        )
    down, across = max(fitting, key=lambda layout: min(rows / layout[0], columns / layout[1]))
    tops, lefts = _positions(rows, down, side), _positions(columns, across, side)
    corners = tuple(_most_contrast(pixels, side, top, left) for top in tops for left in lefts)
    images = np.array([pixels[row : row + side, column : column + side].ravel() for row, column in corners])
    return TileCrops(images + rng.uniform(-0.5, 0.5, images.shape), corners)


def _positions(size: int, parts: int, side: int) -> list[IntArray]:
    regions = pairwise(size * part // parts for part in range(parts + 1))
    return [np.unique(np.linspace(low, high - side, POSITIONS).round().astype(np.int64)) for low, high in regions]


def _most_contrast(pixels: FloatArray, side: int, rows: IntArray, columns: IntArray) -> tuple[int, int]:
    corners = [(int(row), int(column)) for row in rows for column in columns]
    return max(corners, key=lambda corner: float(pixels[corner[0] :, corner[1] :][:side, :side].std()))


def simulate_trials(tile: PaperTile, name: str, crops: TileCrops, seed: int) -> Photograph:
    """Reconstruct the tiles of a photograph under noise, and under quantisation."""
    noisy = tuple(NoiseTable(variance=variance) for variance in VARIANCES)
    fine = tuple(NoiseTable(bits=bits) for bits in BITS)
    return Photograph(
        name,
        crops,
        measure(tile, crops.images, noisy, seed, 0),
        measure(tile, crops.images, fine, seed, 1),
        measure(tile, crops.images.round(), fine[BITS.index(WHOLE_BITS) :], seed, 2),
    )


def measure(tile: PaperTile, images: FloatArray, noises: tuple[NoiseTable, ...], seed: int, experiment: int) -> Trials:
    """Record (T, N) images at every level of noise, and reconstruct them by an estimator that expects that noise.

    seed, experiment : from which the noise of every level and image follows
    """
    light: FloatArray = np.asarray(tile.problem.matrix @ images.T)
    rows: list[tuple[FloatArray, float, FloatArray, float, float]] = []
    for level, noise in enumerate(noises):
        variance = noise.variance + noise.quantisation_variance
        values = _recorded(tile, light, noise, (seed, experiment, level))
        error = tile.estimate(values, variance) - images.T
        from_noise = tile.update(values - light, variance)
        line = tile.line(variance)
        prior, predicted = float(line.prior.mean()), float(line.at(variance).mean())
        squares = [np.square(values).mean(axis=0) for values in (error, from_noise)]
        rows.append((squares[0], predicted, squares[1], predicted - prior, _spread(np.sqrt(tile.squares / variance))))
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    return Trials(noises, *columns)


def _recorded(tile: PaperTile, light: FloatArray, noise: NoiseTable, seed: tuple[int, int, int]) -> FloatArray:
    """Return the recorded values of images, (M, T), as `light` is; seed : and numbers of experiment and level."""
    camera = tile.camera
    seeds = (derived_seed(seed[0], Purpose.PAPER, *seed[1:], image) for image in range(light.shape[1]))
    rngs = (generators(camera, own) for own in seeds)
    return np.stack([expose(each, noise, rng, camera.slices()) for each, rng in zip(light.T, rngs, strict=True)], 1)


def reconstructed(tile: PaperTile, images: FloatArray, variance: float, seed: int) -> FloatArray:
    """Return the estimates of (T, N) images from measurements with noise of this variance: (T, N)."""
    light: FloatArray = np.asarray(tile.problem.matrix @ images.T)
    values = _recorded(tile, light, NoiseTable(variance=variance), (seed, RECONSTRUCTED, 0))
    return tile.estimate(values, variance).T


def _spread(values: FloatArray) -> float:
    # |A v|^2 is a sum of independent squares with the weights (s / (1 + s^2))^2 = w: mean sum w, variance 2 sum w^2.
    weights = np.square(values / (1 + values**2))
    return float(np.sqrt(2 * np.square(weights).sum()) / weights.sum())
