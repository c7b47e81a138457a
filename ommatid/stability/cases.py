"""Stiff and extreme cases of Eq. 4, which the estimator has to solve to many digits or to refuse.

Every case is a problem with measurements of an image drawn from the prior. H is passed in by name: `three` lens types
have full rank, `two` a null space although measurements outnumber pixels, `one` has fewer measurements than pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import sparse

from ommatid.reconstruct.prior import Prior, exponential, independent
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Purpose, probe

Matrices = Mapping[str, sparse.csr_array]
Requirement = Literal["solve", "solve or refuse", "refuse"]

MEAN, VARIANCE = 127.5, 5461.25  # the paper's prior
NOISES = (1e-30, 1e-24, 1e-20, 1e-16, 1e-12, 1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0, 1e4, 1e8, 1e12)
FEW_NOISES = (0.0, 1e-30, 1e-12, 1e-4, 1.0)
PRIOR_AND_NOISE = ((1e-30, 1e-6), (1e-30, 1e-30), (1e-30, 0.0), (1e30, 1e-30), (1e30, 1e-6), (1e30, 1e12), (1e30, 0.0))
SIDE = 9
# The paper's tile, small enough for exact arithmetic: changes of scenes/tile19.toml.
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
    """H, prior, noise and measurements of a case, and the result that is required of the estimator.

    required : "solve", "solve or refuse" at the limits of float64, or "refuse"
    curve : name of H, of a case of the noise sweep
    """

    name: str
    matrix: sparse.csr_array
    prior: Prior
    noise_variance: FloatArray
    recorded: FloatArray
    required: Requirement = "solve"
    curve: str = ""

    @property
    def problem(self) -> Problem:
        """The case as a problem. Raises InputError if its values are invalid."""
        return Problem(self.matrix, self.prior, self.noise_variance)


def noise_sweep(matrices: Matrices) -> Iterator[StabilityCase]:
    """Yield cases of every noise variance, with full rank and with a null space."""
    for name in ("three", "two"):
        for noise in NOISES:
            case = _case(f"{name} types, noise {noise:g}", matrices[name], _paper_prior(), noise)
            yield replace(case, curve=name)


def extreme_cases(matrices: Matrices) -> Iterator[StabilityCase]:
    """Yield extreme priors, matrices, noises and sizes, and problems without a solution."""
    yield from _priors(matrices)
    yield from _matrices(matrices)
    yield from _noises(matrices)
    yield from _small(matrices)
    yield from _unsolvable(matrices)


def draw_recorded(matrix: sparse.csr_array, prior: Prior, noise_variance: FloatArray) -> FloatArray:
    """Return measurements, (M,), of an image drawn from the prior, with the expected noise."""
    rng = probe(Purpose.STABILITY_RECORDED)
    image = prior.mean + prior.apply_root(rng.normal(size=prior.dimension))
    return matrix @ image + np.sqrt(noise_variance) * rng.normal(size=matrix.shape[0])


def _case(
    name: str,
    matrix: sparse.csr_array | FloatArray,
    prior: Prior,
    noise: float | FloatArray,
    required: Requirement = "solve",
) -> StabilityCase:
    stored = sparse.csr_array(matrix)
    variance = np.broadcast_to(np.asarray(noise, dtype=np.float64), (stored.shape[0],)).copy()
    return StabilityCase(name, stored, prior, variance, draw_recorded(stored, prior, variance), required)


def _paper_prior(variance: float = VARIANCE, unknowns: int = SIDE**2) -> Prior:
    return independent(MEAN, variance, unknowns)


def _priors(matrices: Matrices) -> Iterator[StabilityCase]:
    count = SIDE**2
    known = np.full(count, VARIANCE**0.5)
    known[::3] = 0.0
    wide = np.full(count, VARIANCE**0.5)
    wide[::5], wide[1::5] = 1e-30, 1e15
    centred = VARIANCE**0.5 * (np.eye(count) - 1 / count)
    mean = np.full(count, MEAN)
    for name, matrix in matrices.items():
        for variance, noise in PRIOR_AND_NOISE:
            # 60 decades and a null space; a mean with less precision in float64 than the prior's deviation.
            limit = name != "three" and variance > 1e50 * noise if noise else name != "one" and variance < 1
            required: Requirement = "solve or refuse" if limit else "solve"
            yield _case(f"{name}, P0 {variance:g}, noise {noise:g}", matrix, _paper_prior(variance), noise, required)
        for noise in (0.0, 1e-12, 1.0):
            yield _case(f"{name}, every third pixel known, noise {noise:g}", matrix, Prior(mean, known), noise)
            required = "solve or refuse" if noise < 1 else "solve"
            yield _case(f"{name}, P0 from 1e-60 to 1e30, noise {noise:g}", matrix, Prior(mean, wide), noise, required)
            # Rows of several types depend on one another, which a dense root hides (`certificate`): whether refinement
            # meets them without noise is decided by the last digit, which differs between processors.
            required = "solve or refuse" if noise == 0 and name != "one" else "solve"
            yield _case(
                f"{name}, the image's mean known, noise {noise:g}", matrix, Prior(mean, centred), noise, required
            )
            yield _case(f"{name}, P0 exactly 0, noise {noise:g}", matrix, _paper_prior(0.0), noise)
    for noise in FEW_NOISES:
        prior = exponential(MEAN, VARIANCE, (SIDE, SIDE), 3.0)
        # H L is rounded, and so is its null space.
        required = "solve or refuse" if noise <= 1e-30 else "solve"
        yield _case(f"two, exponential prior, noise {noise:g}", matrices["two"], prior, noise, required)


def _matrices(matrices: Matrices) -> Iterator[StabilityCase]:
    three, two = matrices["three"], matrices["two"]
    rng = probe(Purpose.STABILITY_MATRICES)
    rows, columns = 10 ** rng.uniform(-12, 12, three.shape[0]), 10 ** rng.uniform(-12, 12, SIDE**2)
    scattered = 10 ** rng.uniform(-12, 12, three.shape)
    zero_rows, unseen = two.toarray(), three.toarray()
    zero_rows[::7] = 0.0
    unseen[:, [5, 40]] = 0.0
    prior = _paper_prior()
    for noise in FEW_NOISES:
        repeated = sparse.csr_array(sparse.vstack([three, three[:40], three[:40]]))
        yield _case(f"rows of H three times, noise {noise:g}", repeated, prior, noise)
        yield _case(f"zero rows, noise {noise:g}", zero_rows, prior, noise)
        yield _case(f"pixels without measurements, noise {noise:g}", unseen, prior, noise)
        yield _case(f"rows of 1e-12 to 1e12, noise {noise:g}", rows[:, None] * three.toarray(), prior, noise)
        required: Requirement = "solve or refuse" if noise <= 1e-12 else "solve"
        yield _case(f"columns of 1e-12 to 1e12, noise {noise:g}", three.toarray() * columns, prior, noise, required)
        yield _case(f"entries of 1e-12 to 1e12, noise {noise:g}", three.toarray() * scattered, prior, noise, required)
        scaled = rows[: two.shape[0], None] * two.toarray()
        required = "solve or refuse" if noise == 1e-30 else "solve"
        yield _case(f"two, rows of 1e-12 to 1e12, noise {noise:g}", scaled, prior, noise, required)


def _noises(matrices: Matrices) -> Iterator[StabilityCase]:
    prior = _paper_prior()
    for name, matrix in matrices.items():
        wide = np.where(np.arange(matrix.shape[0]) % 2, 1e-12, 1e6)
        yield _case(f"{name}, noise 1e-12 beside 1e6", matrix, prior, wide)
        with_zeros = wide.copy()
        with_zeros[::5] = 0.0
        yield _case(f"{name}, noise 0 beside 1e-12 beside 1e6", matrix, prior, with_zeros)
        yield _case(f"{name}, no noise", matrix, prior, 0.0)
        yield _case(f"{name}, noise 1e-6", matrix, prior, 1e-6)


def _small(matrices: Matrices) -> Iterator[StabilityCase]:
    pixel = _paper_prior(unknowns=1)
    for noise in (0.0, 1e-30, 1.0, 1e12):
        yield _case(f"no lens at all, noise {noise:g}", np.zeros((0, SIDE**2)), _paper_prior(), noise)
        yield _case(f"one pixel, noise {noise:g}", np.ones((1, 1)), pixel, noise)
        yield _case(f"one pixel three times, noise {noise:g}", np.ones((3, 1)), pixel, max(noise, 1e-6))
    for noise in (0.0, 1e-6, 1.0):
        double = _case("", matrices["three"], _paper_prior(), noise)
        single = sparse.csr_array(double.matrix.astype(np.float32).astype(np.float64))
        values = double.recorded.astype(np.float32).astype(np.float64)
        # Without noise the measurements contradict one another by the rounding error of float32.
        required: Requirement = "solve" if noise else "solve or refuse"
        name = f"float32 input, noise {noise:g}"
        yield StabilityCase(name, single, double.prior, double.noise_variance, values, required)


def _unsolvable(matrices: Matrices) -> Iterator[StabilityCase]:
    good = _case("", matrices["three"], _paper_prior(), 1e-4)
    values, noise, entries = good.recorded.copy(), good.noise_variance.copy(), good.matrix.copy()
    values[3], noise[3], entries.data[3] = np.nan, np.inf, np.nan
    yield StabilityCase("NaN in g", good.matrix, good.prior, good.noise_variance, values, "refuse")
    yield StabilityCase("infinite noise", good.matrix, good.prior, noise, good.recorded, "refuse")
    yield StabilityCase("NaN in H", entries, good.prior, good.noise_variance, good.recorded, "refuse")
    noise_free = _case("", matrices["three"], _paper_prior(), 0.0)
    values = noise_free.recorded.copy()
    values[7] *= 1.001
    name = "one of a camera's measurements without noise is a thousandth off"
    yield StabilityCase(name, noise_free.matrix, noise_free.prior, noise_free.noise_variance, values, "refuse")
    ones, apart = sparse.csr_array(np.ones((2, 1))), np.array([1.0, 2.0])
    name = "two measurements without noise that contradict each other"
    yield StabilityCase(name, ones, _paper_prior(unknowns=1), np.zeros(2), apart, "refuse")
    name = "a measurement without noise that contradicts known pixels"
    yield StabilityCase(name, ones[:1], _paper_prior(0.0, 1), np.zeros(1), apart[:1], "refuse")
