"""Expected errors of the paper's tiles (Wood et al., Eq. 5) for every expected and every actual noise variance.

    error covariance = (I - A H) P0 (I - A H)^T + actual A A^T                    (Eq. 5)

A depends on the expected noise variance alone, so the error of one estimator is a straight line in the actual noise
variance. One singular value decomposition per tile gives all of them. Errors are in squared units of f, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product
from time import process_time

import numpy as np

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.prior import independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.study import Row
from ommatid.scenes import scene
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix

SIDES = (19, 35, 41)
COMPLETE_SIDES = (19, 35)  # of tiles that are computed with every combination of lens types
TWICE, TWO, THREE = ("I", "I"), ("I", "II"), ("I", "II", "III")
COMBINATIONS = (TWICE, TWO, THREE)
SIZES = (11, 14, 19, 23, 29, 35)  # sides of tiles in which three types leave no null space, and so can be compared
EXPECTED = (1e-6, 1e-4, 1e-2, 1.0)
ACTUAL: FloatArray = np.logspace(-6, 2, 33)
LEAST = 1e-6
WAVES = 2000  # along either axis: finer than the lines of waves that one type hardly sees
TRUNCATION = 4  # times eps, the longer side and the largest singular value: smaller ones are set to 0
STRAIGHT = ("camera.lens.I.distortion=",)


@dataclass(frozen=True)
class TileError:
    """The diagonal of Eq. 5 for one estimator: (N,) `prior` + actual noise variance times (N,) `noise`."""

    prior: FloatArray
    noise: FloatArray

    def at(self, actual: float) -> FloatArray:
        """Return the expected squared error of every pixel: (N,)."""
        return self.prior + actual * self.noise

    def crossing(self, better: TileError) -> float:
        """Return the actual noise variance at which a line that starts below this one reaches it; infinite if never."""
        ahead = float(self.prior.mean() - better.prior.mean())
        steeper = float(better.noise.mean() - self.noise.mean())
        return ahead / steeper if steeper > 0 else float("inf")

    @property
    def knee(self) -> float:
        """The actual noise variance at which noise and prior contribute equal parts of the mean error."""
        return float(self.prior.mean() / self.noise.mean())


@dataclass(frozen=True)
class PaperTile:
    """A tile of the paper with some of its lens types: H P0^1/2 = U diag(s) V^T, with the paper's prior P0.

    problem : for noise of variance 1;  rank : of H
    squares : (N,) s^2, 0 beyond the rank;  modes : (N, N) P0^1/2 V
    seconds : of the processor, for the decomposition, which serves all noise and all images
    """

    lenses: tuple[str, ...]
    camera: Camera
    problem: Problem
    rank: int
    squares: FloatArray
    modes: FloatArray
    seconds: float

    @property
    def name(self) -> str:
        """Its lens types, as in I+II."""
        return "+".join(self.lenses)

    @property
    def side(self) -> int:
        """Rows of the tile, and columns."""
        return self.camera.rows

    @property
    def floor(self) -> float:
        """The mean error that no measurement can lower: the prior's variance times the null space's share of f."""
        variance = float(self.problem.prior.variance.mean())
        return variance * (self.camera.unknowns - self.rank) / self.camera.unknowns

    def update(self, residual: FloatArray, expected: float) -> FloatArray:
        """Return A (g - H f0), (N, q), of the estimator that expects this noise variance; residual : (M, q)."""
        seen = self.modes.T @ (self.problem.matrix.T @ residual)
        return self.modes @ (seen / (expected + self.squares)[:, None])

    def estimate(self, recorded: FloatArray, expected: float) -> FloatArray:
        """Return the estimates, (N, q), from recorded values, (M, q), by the estimator that expects this variance."""
        mean = self.problem.prior.mean
        return mean[:, None] + self.update(recorded - np.asarray(self.problem.matrix @ mean)[:, None], expected)

    def line(self, expected: float) -> TileError:
        """Return Eq. 5 for the estimator that expects noise of this variance."""
        prior = np.square(self.modes) @ np.square(expected / (expected + self.squares))
        noise = np.square(self.modes) @ (self.squares / np.square(expected + self.squares))
        return TileError(prior, noise)

    def matched(self, variance: float) -> FloatArray:
        """Return Eq. 5, (N,), for the estimator that expects the actual noise."""
        return self.line(variance).at(variance)

    def mse(self, variance: float) -> float:
        """Return its mean over the pixels."""
        return float(self.matched(variance).mean())


Tiles = dict[tuple[int, tuple[str, ...]], PaperTile]  # by side and lens types


def tile(side: int, lenses: tuple[str, ...]) -> PaperTile:
    """Decompose a tile of the gallery with the named lens types; one named twice counts twice."""
    return decomposed(lenses, gallery(side, lenses))


def distortion() -> tuple[PaperTile, PaperTile]:
    """Decompose the gallery's single lens type with distortion, and without."""
    bent, straight = (derive(scene.read(GALLERY / "distorted.toml", changes)) for changes in ((), STRAIGHT))
    return decomposed(("one type, distorted",), bent), decomposed(("one type",), straight)


def decomposed(lenses: tuple[str, ...], camera: Camera) -> PaperTile:
    """Decompose H of a camera, with the paper's prior."""
    started, paper = process_time(), PriorTable()
    prior = independent(paper.mean, paper.variance, camera.unknowns)
    problem = Problem(ideal_matrix(camera), prior, np.ones(camera.measurements))
    dense = problem.dense_matrix()
    if len(dense) > camera.unknowns:
        dense = np.linalg.qr(dense, mode="r")
    _, singular, right = np.linalg.svd(dense)
    least = (
        TRUNCATION
        * np.finfo(np.float64).eps
        * max(camera.measurements, camera.unknowns)
        * float(singular.max(initial=0.0))
    )
    rank = int(np.sum(singular > least))
    squares = np.zeros(camera.unknowns)
    squares[:rank] = np.square(singular[:rank])
    modes = prior.apply_root(right.T)
    return PaperTile(lenses, camera, problem, rank, squares, modes, process_time() - started)


def tiles() -> Tiles:
    """Decompose all tiles of the figures: those of SIZES with every combination of lens types, 41 with three."""
    keys = [*product(SIZES, COMBINATIONS), (41, THREE)]
    return {(side, lenses): tile(side, lenses) for side, lenses in keys}


def whole_frame(lenses: tuple[str, ...], variance: float) -> float:
    """Return the mean error of a frame far from its edges; noise of this variance, as the estimator expects.

    There a lens type of magnification 1/m takes the mean of m x m pixels at every place. It multiplies a wave of f
    periods per pixel by sin(pi m f) / (m sin(pi f)) along either axis, and waves are estimated one by one.
    """
    waves = (np.arange(WAVES) + 0.5) / (2 * WAVES)
    ratios = [int(lens_type.ratio) for lens_type in gallery(COMPLETE_SIDES[0], lenses).types]
    powers = [np.square(np.sin(np.pi * m * waves) / (m * np.sin(np.pi * waves))) for m in ratios]
    seen: FloatArray = np.sum([np.multiply.outer(power, power) for power in powers], axis=0)
    return float(np.mean(1 / (1 / PriorTable().variance + seen / variance)))


@cache
def gallery(side: int, lenses: tuple[str, ...]) -> Camera:
    """Return the camera of a tile with the named lens types: that of the gallery, or of tile19 of another size."""
    if side in SIDES:
        return derive(scene.read(GALLERY / f"tile{side}.toml", (), lenses))
    fitted = (f"camera.lens.{name}.pixels=fit" for name in THREE)
    return derive(scene.read(GALLERY / "tile19.toml", (f"target.shape=[{side},{side}]", *fitted), lenses))


def inner(error: FloatArray, side: int, trim: int = TRIM) -> float:
    """Return the mean of a map, (N,), of a square tile without its border of `trim` pixels."""
    return float(error.reshape(side, side)[trim : side - trim, trim : side - trim].mean())


def sweep(tile: PaperTile) -> list[Row]:
    """Return the rows of Fig. 2 and 4: expected and actual noise variance, mean error, trimmed error."""
    rows: list[Row] = []
    for expected in EXPECTED:
        line = tile.line(expected)
        for actual in map(float, ACTUAL):
            error = line.at(actual)
            noise = {"expected_noise_variance": expected, "actual_noise_variance": actual}
            errors = {"mse": float(error.mean()), "trimmed_mse": inner(error, tile.side)}
            rows.append(noise | errors)
    return rows
