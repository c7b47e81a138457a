"""From a recorded stack and a model to the image, its error bars, and where its error comes from.

The noise that the estimator expects holds everything known: the sensor's, quantisation, the rendering's own variance,
and what the uncertainty of H adds at a first estimate of the image. Dead and saturated pixels are left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from scenes.errors import InputError
from scenes.model import Model
from scenes.stack import Stack

from .accuracy import Error, compare, trimmed
from .estimator import Estimate, Solver, estimate
from .expected import ExpectedError, Interval, expected_error, expected_given, variance_of_sum
from .fit import Fit, fit
from .likelihood import Evidence
from .prior import Prior, exponential, independent, prior_of
from .problem import Problem

Vector = NDArray[np.float64]

MOST_FEIGNED = 0.1  # of what is believed of a pixel: above it the expected error is too small to be trusted
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration")
KEPT = ("rendering", "calibration")  # noise that stays known when the rest of it is to be found


@dataclass(frozen=True)
class Usable:
    """Which of the M sensor pixels are used, and how many are not, and why."""

    used: NDArray[np.bool_]
    dead: int
    saturated: int


@dataclass(frozen=True)
class Residual:
    """Squares of what the estimate leaves of the measurements, in units of the expected noise, against expectation.

    expected : M - trace(A H) for images drawn from the prior;  deviation : of the sum by chance, at most
    """

    chi_squared: float
    expected: float
    deviation: float


@dataclass(frozen=True)
class Restoration:
    """An estimate, (N,), its expected error (Eq. 5), and how it compares where the truth is known.

    noise : what is known of it by name, (pixels used,) each
    feigned : the largest share of what is believed of a pixel that the noise of H may have feigned
    """

    estimated: Estimate
    expected: ExpectedError
    trimmed_mse: float | None
    residual: Residual | None
    shape: tuple[int, int]
    usable: Usable
    noise: dict[str, Vector]
    fit: Fit | None
    feigned: float
    seconds: float
    truth: Vector | None
    error: Error | None
    interval: Interval | None

    @property
    def estimate(self) -> Vector:
        """f^, (N,)."""
        return self.estimated.image

    @property
    def solver(self) -> Solver:
        """Which form ran, why, and how right it is."""
        return self.estimated.solver

    def budget(self) -> dict[str, float]:
        """Parts of the expected squared error by their cause; they add up to it, an absent effect brings 0."""
        parts = {"null_space": self.expected.missing, **self.expected.parts}
        return {name: parts.get(name, 0.0) for name in BUDGET}

    def region(self, corner: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
        """Mean of the estimate in a region and its expected deviation (Eq. 5). Raises InputError if it lies outside."""
        refuse_outside(corner, size, self.shape)
        weights = np.zeros(self.shape)
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / (size[0] * size[1])
        variance = variance_of_sum(self.estimated.form, weights.ravel(), _sum(self.noise))
        return float(weights.ravel() @ self.estimate), variance**0.5


def refuse_outside(corner: tuple[int, int], size: tuple[int, int], shape: tuple[int, int]) -> None:
    """Raise InputError unless a region of `size` at `corner` lies inside an image of `shape`."""
    ends = corner[0] + size[0], corner[1] + size[1]
    if min(*corner) < 0 or min(*size) < 1 or ends[0] > shape[0] or ends[1] > shape[1]:
        raise InputError(
            f"a region of {size[0]} x {size[1]} pixels at row {corner[0]}, column {corner[1]} does not lie inside"
            f" an image of {shape[0]} x {shape[1]}"
        )


def refuse_strangers(stack: Stack, model: Model, names: tuple[Path | str, Path | str]) -> None:
    """Raise InputError, naming the first difference, unless a stack and a model are of one camera and target grid."""
    recorded, calibrated = stack.camera.describe(), model.camera.describe()
    for key in [*recorded, *(key for key in calibrated if key not in recorded)]:
        if recorded.get(key) != calibrated.get(key):
            raise InputError(
                f"{names[0]} and {names[1]} do not belong together: {key} is {recorded.get(key, 'absent')} in the"
                f" stack and {calibrated.get(key, 'absent')} in the model; calibrate with the stack's scene"
            )


def usable_pixels(stack: Stack) -> Usable:
    """Which pixels tell something: not those that are no number (dead), nor those at the level of saturation."""
    alive = np.isfinite(stack.values) & np.isfinite(stack.variance)
    noise = stack.scene.noise
    full = np.zeros_like(alive)
    if noise is not None and noise.saturation is not None:
        full = alive & (stack.values >= np.float32(noise.saturation))  # the stack holds float32
    return Usable(alive & ~full, int(np.sum(~alive)), int(np.sum(full)))


def restore(stack: Stack, model: Model, truth: Vector | None = None) -> Restoration:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or None;  Raises InputError if memory does not suffice, or if no form is right to the tolerance.
    """
    start = perf_counter()
    usable = usable_pixels(stack)
    noise = {name: variances[usable.used] for name, variances in known_noise(stack).items()}
    prior, estimated = _first_prior(stack, model), None
    uncertain, told = bool(model.variance.any()), stack.scene.estimator.noise_variance
    if uncertain:
        noise["calibration"] = model.prior_spread(prior.variance)[usable.used]
        estimated = _estimated(stack, model, usable, prior, noise)
        noise["calibration"] = model.spread(estimated.image)[usable.used]
    found = _fitted(stack, model, usable, prior, noise)
    if found is not None and uncertain:
        # What the uncertainty of H adds was taken at an image that the first prior had left noisy.
        told_prior, told_noise = _with_fit(stack, model, prior, noise, found)
        better = _estimated(stack, model, usable, told_prior, told_noise)
        noise["calibration"] = model.spread(better.image)[usable.used]
        found = _fitted(stack, model, usable, prior, noise)
    if found is not None:
        prior, noise = _with_fit(stack, model, prior, noise, found)
    if estimated is None or found is not None or told is None:
        estimated = _estimated(stack, model, usable, prior, noise)
    return _described(model, usable, noise, estimated, found, truth, start)


def _described(
    model: Model,
    usable: Usable,
    noise: dict[str, Vector],
    estimated: Estimate,
    found: Fit | None,
    truth: Vector | None,
    start: float,
) -> Restoration:
    expected = expected_error(estimated.form, noise)
    shape = (model.camera.rows, model.camera.columns)
    return Restoration(
        estimated=estimated,
        expected=expected,
        trimmed_mse=trimmed(expected.variance, shape),
        residual=_residual(estimated, expected),
        shape=shape,
        usable=usable,
        noise=noise,
        fit=found,
        feigned=_feigned(model, usable, estimated, expected),
        seconds=perf_counter() - start,
        truth=truth,
        error=None if truth is None else compare(estimated.image, truth, shape),
        interval=None if truth is None else expected_given(estimated.form, truth, _sum(noise)),
    )


def known_noise(stack: Stack) -> dict[str, Vector]:
    """Variances, (M,), of what is known of the noise before anything is estimated; absent effects have no entry."""
    noise = {"rendering": stack.variance}
    described = stack.scene.noise
    if described is not None and described.variance > 0:
        noise["noise"] = np.full(stack.values.size, described.variance)
    if described is not None and described.bits is not None:
        noise["quantisation"] = np.full(stack.values.size, described.quantisation_variance)
    return noise


def _first_prior(stack: Stack, model: Model) -> Prior:
    described = stack.scene.prior
    if described.kind == "fit":
        return independent(described.mean, described.variance, model.unknowns)
    return prior_of(described, (model.camera.rows, model.camera.columns), stack.camera.target_pitch)


def _expected_noise(stack: Stack, usable: Usable, noise: dict[str, Vector]) -> Vector:
    told = stack.scene.estimator.noise_variance
    return np.full(int(usable.used.sum()), told) if isinstance(told, float) else _sum(noise)


def _estimated(stack: Stack, model: Model, usable: Usable, prior: Prior, noise: dict[str, Vector]) -> Estimate:
    problem = Problem(model.matrix[usable.used], prior, _expected_noise(stack, usable, noise))
    told = stack.scene.estimator
    return estimate(problem, stack.values[usable.used], told.method, told.tolerance)


def _fitted(stack: Stack, model: Model, usable: Usable, prior: Prior, noise: dict[str, Vector]) -> Fit | None:
    """The prior, and the noise if that is asked for, of largest marginal likelihood; None where nothing is asked."""
    described, used = stack.scene.prior, usable.used
    asked = stack.scene.estimator.noise_variance == "fit"
    if not used.any() or not (asked or described.kind == "fit"):
        return None
    known = (
        _sum({name: noise[name] for name in KEPT if name in noise}) if asked else _expected_noise(stack, usable, noise)
    )
    matrix = model.matrix[used]
    residual = stack.values[used] - matrix @ prior.mean
    shape = (model.camera.rows, model.camera.columns)
    return fit(Evidence(matrix, residual, known, shape, None if described.kind == "fit" else prior, not asked))


def _with_fit(
    stack: Stack, model: Model, prior: Prior, noise: dict[str, Vector], found: Fit
) -> tuple[Prior, dict[str, Vector]]:
    """The prior and the noise once they are found; what was found stands for the noise that the scene describes."""
    if found.variance is not None and found.length is not None:
        shape = (model.camera.rows, model.camera.columns)
        prior = exponential(stack.scene.prior.mean, found.variance, shape, found.length)
    if found.noise_variance is not None:
        kept = {name: noise[name] for name in KEPT if name in noise}
        noise = {**kept, "noise": np.full(noise["rendering"].size, found.noise_variance)}
    return prior, noise


def _sum(noise: dict[str, Vector]) -> Vector:
    return np.sum(list(noise.values()), axis=0)


def _feigned(model: Model, usable: Usable, estimated: Estimate, expected: ExpectedError) -> float:
    noise = np.full(model.measurements, np.inf)
    noise[usable.used] = estimated.form.problem.noise_variance
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise and without uncertainty of H
        return float(np.nan_to_num(model.feigned(noise) * expected.variance).max(initial=0.0))


def _residual(estimated: Estimate, expected: ExpectedError) -> Residual | None:
    """None where a measurement is said to have no noise: then there is no unit for what is left of it."""
    noise = estimated.form.problem.noise_variance
    if not noise.size or not estimated.form.problem.noisy:
        return None
    freedoms = max(noise.size - expected.degrees_of_freedom, 0.0)
    return Residual(float(noise @ np.square(estimated.multipliers)), freedoms, (2 * freedoms) ** 0.5)
