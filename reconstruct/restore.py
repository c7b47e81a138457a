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
from .likelihood import Evidence, Fit, fit
from .prior import Prior, exponential, independent, prior_of
from .problem import Problem

Vector = NDArray[np.float64]

MOST_FEIGNED = 0.1  # of what is believed of a pixel: above it the expected error is too small to be trusted
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration")
FIRST_LENGTH = 5.0  # pixels: where the search for a correlation length starts unless the scene says
FIRST_NOISE = 1e-4  # of the prior's variance: where the search for the noise starts


@dataclass(frozen=True)
class Left:
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
    residual: Residual
    shape: tuple[int, int]
    left: Left
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
        rows, columns = self.shape
        bottom, right = corner[0] + size[0], corner[1] + size[1]
        if min(*corner) < 0 or min(*size) < 1 or bottom > rows or right > columns:
            raise InputError(
                f"a region of {size[0]} x {size[1]} pixels at row {corner[0]}, column {corner[1]} does not lie inside"
                f" an image of {rows} x {columns}"
            )
        weights = np.zeros(self.shape)
        weights[corner[0] : bottom, corner[1] : right] = 1 / (size[0] * size[1])
        total = np.sum(list(self.noise.values()), axis=0)
        variance = variance_of_sum(self.estimated.form, weights.ravel(), total)
        return float(weights.ravel() @ self.estimate), variance**0.5


def refuse_strangers(stack: Stack, model: Model, names: tuple[Path | str, Path | str]) -> None:
    """Raise InputError, naming the first difference, unless a stack and a model are of one camera and target grid."""
    recorded, calibrated = stack.camera.describe(), model.camera.describe()
    for key in [*recorded, *(key for key in calibrated if key not in recorded)]:
        if recorded.get(key) != calibrated.get(key):
            raise InputError(
                f"{names[0]} and {names[1]} do not belong together: {key} is {recorded.get(key, 'absent')} in the"
                f" stack and {calibrated.get(key, 'absent')} in the model; calibrate with the stack's scene"
            )


def usable(stack: Stack) -> Left:
    """Which pixels tell something: not those that are no number (dead), nor those at the level of saturation."""
    alive = np.isfinite(stack.values) & np.isfinite(stack.variance)
    noise = stack.scene.noise
    full = np.zeros_like(alive)
    if noise is not None and noise.saturation is not None:
        full = alive & (stack.values >= np.float32(noise.saturation))  # the stack holds float32
    return Left(alive & ~full, int(np.sum(~alive)), int(np.sum(full)))


def restore(stack: Stack, model: Model, truth: Vector | None = None) -> Restoration:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or None;  Raises InputError if memory does not suffice, or if no form is right to the tolerance.
    """
    start = perf_counter()
    left = usable(stack)
    noise = {name: variances[left.used] for name, variances in known_noise(stack).items()}
    prior, estimated = _first_prior(stack, model), None
    if model.variance.any():
        noise["calibration"] = model.prior_spread(prior.variance)[left.used]
        estimated = _estimated(stack, model, left, prior, noise)
        noise["calibration"] = model.spread(estimated.image)[left.used]
    found = _fitted(stack, model, left, noise)
    if found is not None:
        prior, noise = _with_fit(stack, model, prior, noise, found)
    if estimated is None or found is not None or stack.scene.estimator.noise_variance is None:
        estimated = _estimated(stack, model, left, prior, noise)
    expected = expected_error(estimated.form, noise)
    shape = (model.camera.rows, model.camera.columns)
    return Restoration(
        estimated=estimated,
        expected=expected,
        trimmed_mse=trimmed(expected.variance, shape),
        residual=_residual(estimated, expected),
        shape=shape,
        left=left,
        noise=noise,
        fit=found,
        feigned=_feigned(model, left, estimated, expected),
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


def _estimated(stack: Stack, model: Model, left: Left, prior: Prior, noise: dict[str, Vector]) -> Estimate:
    told = stack.scene.estimator
    number = told.noise_variance if isinstance(told.noise_variance, float) else None
    expected = _sum(noise) if number is None else np.full(int(left.used.sum()), number)
    problem = Problem(model.matrix[left.used], prior, expected)
    return estimate(problem, stack.values[left.used], told.method, told.tolerance)


def _fitted(stack: Stack, model: Model, left: Left, noise: dict[str, Vector]) -> Fit | None:
    """The prior, and the noise if that is asked for, of largest marginal likelihood; None where nothing is asked."""
    described, used = stack.scene.prior, left.used
    asked = stack.scene.estimator.noise_variance == "fit"
    if not used.any() or not (asked or described.kind == "fit"):
        return None
    known = {name: values for name, values in noise.items() if not asked or name in ("rendering", "calibration")}
    matrix = model.matrix[used]
    residual = stack.values[used] - matrix @ np.full(model.unknowns, described.mean)
    length = described.correlation_length
    pixels = FIRST_LENGTH if length is None else length / stack.camera.target_pitch
    evidence = Evidence(matrix, residual, _sum(known), (model.camera.rows, model.camera.columns))
    return fit(evidence, described.variance, pixels, FIRST_NOISE * described.variance if asked else None)


def _with_fit(
    stack: Stack, model: Model, prior: Prior, noise: dict[str, Vector], found: Fit
) -> tuple[Prior, dict[str, Vector]]:
    """The prior and the noise once they are found; what was found stands for the noise that the scene describes."""
    described = stack.scene.prior
    if described.kind == "fit":
        shape = (model.camera.rows, model.camera.columns)
        prior = exponential(described.mean, found.variance, shape, found.length)
    if found.noise_variance is not None:
        kept = {name: values for name, values in noise.items() if name in ("rendering", "calibration")}
        noise = {**kept, "noise": np.full(noise["rendering"].size, found.noise_variance)}
    return prior, noise


def _sum(noise: dict[str, Vector]) -> Vector:
    return np.sum(list(noise.values()), axis=0)


def _feigned(model: Model, left: Left, estimated: Estimate, expected: ExpectedError) -> float:
    noise = np.full(model.measurements, np.inf)
    noise[left.used] = estimated.form.problem.noise_variance
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise and without uncertainty of H
        return float(np.nan_to_num(model.feigned(noise) * expected.variance).max(initial=0.0))


def _residual(estimated: Estimate, expected: ExpectedError) -> Residual:
    noise = estimated.form.problem.noise_variance
    freedoms = noise.size - expected.degrees_of_freedom
    squares = float(noise @ np.square(estimated.multipliers))
    return Residual(squares, freedoms, (2 * max(freedoms, 0.0)) ** 0.5)
