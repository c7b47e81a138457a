"""Stiff and extreme cases of Eq. 4: what the estimator must get right to many digits, and what it must refuse.

Every case is a problem with measurements of an image drawn from the prior. H comes from whoever calls, by name: `three`
lens types leave no null space, `two` leave one though measurements are more than pixels, `one` sees fewer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Matrices = Mapping[str, sparse.csr_array]
Kind = Literal["regular", "beyond", "hopeless"]

MEAN, VARIANCE = 127.5, 5461.25  # the paper's prior
NOISES = (1e-30, 1e-24, 1e-20, 1e-16, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0, 1e4, 1e8, 1e12)
FEW = (0.0, 1e-30, 1e-12, 1e-4, 1.0)
PAIRS = ((1e-30, 1e-6), (1e-30, 1e-30), (1e-30, 0.0), (1e30, 1e-30), (1e30, 1e-6), (1e30, 1e12), (1e30, 0.0))
SIDE = 9
# The paper's tile made so small that exact arithmetic is quick: what to change in scenes/tile19.toml.
CHANGES = (
    f"target.shape=[{SIDE},{SIDE}]",
    "camera.lens.I.magnification=1/2",
    "camera.lens.I.array=[2,2]",
    "camera.lens.III.magnification=1/3",
    "camera.lens.III.array=[3,3]",
    *(f"camera.lens.{name}.pixels=fit" for name in ("I", "II", "III")),
)
LENSES = {"three": ("I", "II", "III"), "two": ("I", "III"), "one": ("I",)}


@dataclass(frozen=True)
class StabilityCase:
    """H, the prior, the noise and the measurements of a case, and what may be asked of it.

    kind : "regular", must be right; "beyond" what float64 may hold: right or refused; "hopeless": must be refused
    """

    name: str
    matrix: sparse.csr_array
    prior: Prior
    noise_variance: Vector
    recorded: Vector
    kind: Kind = "regular"

    @property
    def problem(self) -> Problem:
        """The case as a problem. Raises InputError where it is none."""
        return Problem(self.matrix, self.prior, self.noise_variance)


def sweep(matrices: Matrices) -> Iterator[tuple[str, float, StabilityCase]]:
    """Noise of one size after the other, for a full-rank H and one with a null space: which, noise variance, case."""
    for name in ("three", "two"):
        for noise in NOISES:
            yield name, noise, _case(f"{name} types, noise {noise:g}", matrices[name], _paper(), noise)


def cases(matrices: Matrices) -> Iterator[StabilityCase]:
    """Everything else: priors, matrices, noises, sizes, and what cannot be solved."""
    yield from _priors(matrices)
    yield from _matrices(matrices)
    yield from _noises(matrices)
    yield from _small(matrices)
    yield from _hopeless(matrices)


def recorded(matrix: sparse.csr_array, prior: Prior, noise_variance: Vector, seed: int = 0) -> Vector:
    """Measurements, (M,), of an image drawn from the prior, with the noise that is expected."""
    rng = np.random.default_rng(seed)
    image = prior.mean + prior.spread(rng.normal(size=prior.freedoms))
    return matrix @ image + np.sqrt(noise_variance) * rng.normal(size=matrix.shape[0])


def _case(
    name: str, matrix: sparse.csr_array | Matrix, prior: Prior, noise: float | Vector, kind: Kind = "regular"
) -> StabilityCase:
    sparse_matrix = sparse.csr_array(matrix)
    variance = np.broadcast_to(np.asarray(noise, dtype=np.float64), (sparse_matrix.shape[0],)).copy()
    return StabilityCase(name, sparse_matrix, prior, variance, recorded(sparse_matrix, prior, variance), kind)


def _paper(variance: float = VARIANCE, unknowns: int = SIDE**2) -> Prior:
    return independent(MEAN, variance, unknowns)


def _priors(matrices: Matrices) -> Iterator[StabilityCase]:
    count = SIDE**2
    known = np.full(count, VARIANCE**0.5)
    known[::3] = 0.0
    wild = np.full(count, VARIANCE**0.5)
    wild[::5], wild[1::5] = 1e-30, 1e15
    centred = VARIANCE**0.5 * (np.eye(count) - 1 / count)
    mean = np.full(count, MEAN)
    for name, matrix in matrices.items():
        for variance, noise in PAIRS:
            # 60 decades and a null space; a mean that float64 holds less finely than the prior allows.
            far = name != "three" and variance > 1e50 * noise if noise else name != "one" and variance < 1
            kind: Kind = "beyond" if far else "regular"
            yield _case(f"{name}, P0 {variance:g}, noise {noise:g}", matrix, _paper(variance), noise, kind)
        for noise in (0.0, 1e-12, 1.0):
            yield _case(f"{name}, every third pixel known, noise {noise:g}", matrix, Prior(mean, known), noise)
            kind = "beyond" if noise < 1 else "regular"
            yield _case(f"{name}, P0 from 1e-60 to 1e30, noise {noise:g}", matrix, Prior(mean, wild), noise, kind)
            # Without noise its variances are zeros that rounding of the root hides.
            kind = "beyond" if noise == 0 and name == "three" else "regular"
            yield _case(f"{name}, the image's mean known, noise {noise:g}", matrix, Prior(mean, centred), noise, kind)
            yield _case(f"{name}, P0 exactly 0, noise {noise:g}", matrix, _paper(0.0), noise)
    for noise in FEW:
        prior = exponential(MEAN, VARIANCE, (SIDE, SIDE), 3.0)
        yield _case(f"two, exponential prior, noise {noise:g}", matrices["two"], prior, noise)


def _matrices(matrices: Matrices) -> Iterator[StabilityCase]:
    three, two = matrices["three"], matrices["two"]
    rng = np.random.default_rng(5)
    rows, columns = 10 ** rng.uniform(-12, 12, three.shape[0]), 10 ** rng.uniform(-12, 12, SIDE**2)
    scattered = 10 ** rng.uniform(-12, 12, three.shape)
    zero_rows, unseen = two.toarray(), three.toarray()
    zero_rows[::7] = 0.0
    unseen[:, [5, 40]] = 0.0
    for noise in FEW:
        twice = sparse.vstack([three, three[:40], three[:40]])
        yield _case(f"rows of H three times, noise {noise:g}", sparse.csr_array(twice), _paper(), noise)
        yield _case(f"zero rows, noise {noise:g}", zero_rows, _paper(), noise)
        yield _case(f"pixels nobody sees, noise {noise:g}", unseen, _paper(), noise)
        yield _case(f"rows of 1e-12 to 1e12, noise {noise:g}", rows[:, None] * three.toarray(), _paper(), noise)
        kind: Kind = "beyond" if noise <= 1e-12 else "regular"
        yield _case(f"columns of 1e-12 to 1e12, noise {noise:g}", three.toarray() * columns, _paper(), noise, kind)
        yield _case(f"entries of 1e-12 to 1e12, noise {noise:g}", three.toarray() * scattered, _paper(), noise, kind)
        both = rows[: two.shape[0], None] * two.toarray()
        kind = "beyond" if noise == 1e-30 else "regular"
        yield _case(f"two, rows of 1e-12 to 1e12, noise {noise:g}", both, _paper(), noise, kind)


def _noises(matrices: Matrices) -> Iterator[StabilityCase]:
    for name, matrix in matrices.items():
        count = matrix.shape[0]
        wild = np.where(np.arange(count) % 2, 1e-12, 1e6)
        yield _case(f"{name}, noise 1e-12 beside 1e6", matrix, _paper(), wild)
        with_zeros = wild.copy()
        with_zeros[::5] = 0.0
        yield _case(f"{name}, noise 0 beside 1e-12 beside 1e6", matrix, _paper(), with_zeros)
        yield _case(f"{name}, no noise", matrix, _paper(), 0.0)
        yield _case(f"{name}, noise 1e-6", matrix, _paper(), 1e-6)


def _small(matrices: Matrices) -> Iterator[StabilityCase]:
    for noise in (0.0, 1e-30, 1.0, 1e12):
        yield _case(f"no lens at all, noise {noise:g}", np.zeros((0, SIDE**2)), _paper(), noise)
        yield _case(f"one pixel, noise {noise:g}", np.ones((1, 1)), _paper(unknowns=1), noise)
        yield _case(f"one pixel three times, noise {noise:g}", np.ones((3, 1)), _paper(unknowns=1), max(noise, 1e-6))
    for noise in (0.0, 1e-6, 1.0):
        exact = _case("", matrices["three"], _paper(), noise)
        single = sparse.csr_array(exact.matrix.astype(np.float32).astype(np.float64))
        values = exact.recorded.astype(np.float32).astype(np.float64)
        kind: Kind = "regular" if noise else "beyond"  # it contradicts itself by the rounding of float32
        yield StabilityCase(f"float32 input, noise {noise:g}", single, _paper(), exact.noise_variance, values, kind)


def _hopeless(matrices: Matrices) -> Iterator[StabilityCase]:
    good = _case("", matrices["three"], _paper(), 1e-4)
    values, noise, entries = good.recorded.copy(), good.noise_variance.copy(), good.matrix.copy()
    values[3], noise[3], entries.data[3] = np.nan, np.inf, np.nan
    yield StabilityCase("NaN in g", good.matrix, good.prior, good.noise_variance, values, kind="hopeless")
    yield StabilityCase("infinite noise", good.matrix, good.prior, noise, good.recorded, kind="hopeless")
    yield StabilityCase("NaN in H", entries, good.prior, good.noise_variance, good.recorded, kind="hopeless")
    silent = _case("", matrices["three"], _paper(), 0.0)
    values = silent.recorded.copy()
    values[7] *= 1.001
    name = "one of a camera's measurements without noise is a thousandth off"
    yield StabilityCase(name, silent.matrix, silent.prior, silent.noise_variance, values, kind="hopeless")
    ones = sparse.csr_array(np.ones((2, 1)))
    apart = np.array([1.0, 2.0])
    name = "two measurements without noise that contradict each other"
    yield StabilityCase(name, ones, _paper(unknowns=1), np.zeros(2), apart, kind="hopeless")
    name = "a measurement without noise that contradicts what is known"
    yield StabilityCase(name, ones[:1], _paper(0.0, 1), np.zeros(1), apart[:1], kind="hopeless")
