"""Expected errors of the paper's tiles (Wood et al., Eq. 5) for every expected and every actual noise variance.

    error covariance = (I - A H) P0 (I - A H)^T + actual A A^T                    (Eq. 5)

A depends on the expected noise variance alone, so the error of one estimator is a straight line in the actual noise
variance. One singular value decomposition per tile gives all of them. Errors are in squared units of f, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.prior import independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes import scene
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.tables.estimation import PriorTable
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix

SIDES = (19, 35, 41)
COMPLETE_SIDES = (19, 35)  # of tiles that are computed with every combination of lens types
TWICE, TWO, THREE = ("I", "I"), ("I", "II"), ("I", "II", "III")
COMBINATIONS = (TWICE, TWO, THREE)
EXPECTED = (1e-6, 1e-4, 1e-2, 1.0)
ACTUAL: FloatArray = np.logspace(-6, 2, 33)
LEAST = 1e-6
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
    """

    lenses: tuple[str, ...]
    camera: Camera
    problem: Problem
    rank: int
    squares: FloatArray
    modes: FloatArray

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
    paper = PriorTable()
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
    return PaperTile(lenses, camera, problem, rank, squares, prior.apply_root(right.T))


def tiles() -> Tiles:
    """Decompose all tiles of the figures: 19 and 35 with every combination of lens types, 41 with three."""
    keys = [(side, lenses) for side in SIDES for lenses in COMBINATIONS if side in COMPLETE_SIDES or lenses == THREE]
    return {(side, lenses): tile(side, lenses) for side, lenses in keys}


@cache
def gallery(side: int, lenses: tuple[str, ...]) -> Camera:
    """Return the camera of a tile of the gallery with the named lens types."""
    return derive(scene.read(GALLERY / f"tile{side}.toml", (), lenses))


def inner(error: FloatArray, side: int, trim: int = TRIM) -> float:
    """Return the mean of a map, (N,), of a square tile without its border of `trim` pixels."""
    return float(error.reshape(side, side)[trim : side - trim, trim : side - trim].mean())


def sweep(tile: PaperTile) -> list[tuple[str, float, float, float, float]]:
    """Return the rows of Fig. 2 and 4: lens types, expected and actual noise variance, mean error, trimmed error."""
    rows: list[tuple[str, float, float, float, float]] = []
    for expected in EXPECTED:
        line = tile.line(expected)
        for actual in map(float, ACTUAL):
            error = line.at(actual)
            rows.append((tile.name, expected, actual, float(error.mean()), inner(error, tile.side)))
    return rows
