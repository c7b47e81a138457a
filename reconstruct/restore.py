"""From a recorded stack and a model to the image, its error bars, and where its error comes from.

The noise that the estimator expects holds everything known: the sensor's, quantisation, the rendering's own variance,
and what the uncertainty of H adds at a first estimate of the image. What a real sensor adds depends on the light, so it
too is taken anew at the first estimate. Dead and saturated pixels are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from scenes import estimation
from scenes.errors import InputError
from scenes.model import Model
from scenes.processors import one_thread
from scenes.progress import Progress, no_progress
from scenes.stack import Stack
from scenes.workers import Workers

from .accuracy import Error, compare, trimmed
from .choice import WAYS, Choice, choose
from .estimator import Solver
from .expected import ExpectedError, Interval
from .fit import Fit, evidence, fit
from .frame import NotReachedError
from .noise import (
    Usable,
    depends_on_light,
    everywhere,
    noise_at_first,
    noise_given,
    refuse_fit_of_sensor,
    usable_pixels,
)
from .way import Hands, Outcome, Task, Way, total

Vector = NDArray[np.float64]
Found = TypeVar("Found")

MOST_FEIGNED = 0.05  # of what is believed of a pixel on average: above it the expected error is not to be trusted
BUDGET = ("null_space", "noise", "quantisation", "rendering", "calibration")
KEPT = ("rendering", "calibration")  # noise that stays known when the rest of it is to be found


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
    """An estimate with its expected error (Eq. 5), and how it compares where the truth is known.

    choice : which way to it;  prior : what was believed of the image, found or told
    noise : what is known of it by name, (pixels used,) each
    feigned : the share of what is believed of a pixel, on average, that the noise of H may have feigned
    """

    outcome: Outcome
    choice: Choice
    prior: estimation.Prior
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

    @property
    def estimate(self) -> Vector:
        """f^, (N,)."""
        return self.outcome.image

    @property
    def expected(self) -> ExpectedError:
        """Eq. 5."""
        return self.outcome.expected

    @property
    def interval(self) -> Interval | None:
        """What the error of this very image should be."""
        return self.outcome.interval

    @property
    def solver(self) -> Solver:
        """What computed it, why, and how right it is."""
        return self.outcome.solver

    def budget(self) -> dict[str, float]:
        """Parts of the expected squared error by their cause; they add up to it, an absent effect brings 0."""
        parts = {"null_space": self.expected.missing, **self.expected.parts}
        return {name: parts.get(name, 0.0) for name in BUDGET} | parts

    def region(self, corner: tuple[int, int], size: tuple[int, int]) -> tuple[float, float]:
        """Mean of the estimate in a region and its expected deviation (Eq. 5). Raises InputError if it lies outside."""
        refuse_outside(corner, size, self.shape)
        weights = np.zeros(self.shape)
        weights[corner[0] : corner[0] + size[0], corner[1] : corner[1] + size[1]] = 1 / (size[0] * size[1])
        variance = self.outcome.variance_of_sum(weights.ravel())
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


@one_thread()
def restore(
    stack: Stack,
    model: Model,
    truth: Vector | None = None,
    workers: Workers | None = None,
    progress: Progress = no_progress,
) -> Restoration:
    """Reconstruct a stack with a model as the stack's scene says (Wood et al., Eq. 4 and Eq. 5).

    truth : (N,) or None;  workers : who does tiles, absent: threads of this process
    Raises InputError if memory does not suffice, if no way is right to what the scene asks, or if the noise of a
    [sensor] is to be fitted.
    """
    return _reaching(stack, model, lambda choice: _restored(stack, model, truth, choice, Hands(workers, progress)))


def way_of(stack: Stack, model: Model, progress: Progress = no_progress) -> Way:
    """The way that `restore` goes, its estimate found, but not its error bars, which take most of the time.

    Raises InputError as `restore` does.
    """

    def gone(choice: Choice) -> Way:
        way = _told(stack, model, choice, Hands(progress=progress)).way
        _ = way.image  # only now it shows whether this way reaches what was asked
        return way

    return _reaching(stack, model, gone)


def _reaching(stack: Stack, model: Model, work: Callable[[Choice], Found]) -> Found:
    """Work done in the way that is chosen; by tiles where a frame that nobody asked for does not get there."""
    refuse_fit_of_sensor(stack)
    choice = choose(stack.scene, model.camera, model.exact)
    try:
        return work(choice)
    except NotReachedError as error:
        if stack.scene.estimator.method != "auto":
            raise
        return work(replace(choice, way="tiles", why=str(error)))


@dataclass(frozen=True)
class _Told:
    """What the estimator is told in the end, and the way that it goes with it."""

    way: Way
    usable: Usable
    prior: estimation.Prior
    noise: dict[str, Vector]
    fit: Fit | None


def _told(stack: Stack, model: Model, choice: Choice, hands: Hands) -> _Told:
    usable = usable_pixels(stack, model)
    prior, told = _first_prior(stack), stack.scene.estimator.noise_variance
    noise, way = noise_at_first(stack, model, usable, prior), None
    if depends_on_light(stack, model):
        way = _way(choice, stack, model, usable, prior, noise, hands)
        noise = noise_given(way.image, stack, model, usable, noise)
    found = _fitted(stack, model, usable, prior, noise)
    if found is not None and model.variance.any():
        # What the uncertainty of H adds was taken at an image that the first prior had left noisy.
        told_prior, told_noise = _with_fit(stack, prior, noise, found)
        better = _way(choice, stack, model, usable, told_prior, told_noise, hands)
        noise = noise_given(better.image, stack, model, usable, noise)
        found = _fitted(stack, model, usable, prior, noise)
    if found is not None:
        prior, noise = _with_fit(stack, prior, noise, found)
    if way is None or found is not None or told is None:
        way = _way(choice, stack, model, usable, prior, noise, hands)
    return _Told(way, usable, prior, noise, found)


def _restored(stack: Stack, model: Model, truth: Vector | None, choice: Choice, hands: Hands) -> Restoration:
    start = perf_counter()
    told = _told(stack, model, choice, hands)
    way, usable, noise = told.way, told.usable, told.noise
    outcome = way.outcome(noise, truth)
    shape = (model.camera.rows, model.camera.columns)
    return Restoration(
        outcome=outcome,
        choice=choice,
        prior=told.prior,
        trimmed_mse=trimmed(outcome.expected.variance, shape),
        residual=_residual(outcome, way.task.believed),
        shape=shape,
        usable=usable,
        noise=noise,
        fit=told.fit,
        feigned=_feigned(model, usable, way.task.believed, outcome.expected),
        seconds=perf_counter() - start,
        truth=truth,
        error=None if truth is None else compare(outcome.image, truth, shape),
    )


def _first_prior(stack: Stack) -> estimation.Prior:
    """What is told of the prior; where that is to be found, the paper's."""
    described = stack.scene.prior
    return described.model_copy(update={"kind": "independent"}) if described.kind == "fit" else described


def _expected_noise(stack: Stack, usable: Usable, noise: dict[str, Vector]) -> Vector:
    told = stack.scene.estimator.noise_variance
    return everywhere(told, int(usable.used.sum())) if isinstance(told, float) else total(noise)


def _way(
    choice: Choice,
    stack: Stack,
    model: Model,
    usable: Usable,
    prior: estimation.Prior,
    noise: dict[str, Vector],
    hands: Hands,
) -> Way:
    told = stack.scene
    believed = _expected_noise(stack, usable, noise)
    task = Task(model, stack.values, usable.used, believed, prior, told.estimator, told.tiles)
    return WAYS[choice.way](task, hands)


def _fitted(
    stack: Stack, model: Model, usable: Usable, prior: estimation.Prior, noise: dict[str, Vector]
) -> Fit | None:
    """The prior, and the noise if that is asked for, of largest marginal likelihood; None where nothing is asked."""
    described = stack.scene.prior
    asked = stack.scene.estimator.noise_variance == "fit"
    if not usable.used.any() or not (asked or described.kind == "fit"):
        return None
    kept = {name: noise[name] for name in KEPT if name in noise}
    known = total(kept) if asked else _expected_noise(stack, usable, noise)
    task = Task(model, stack.values, usable.used, known, prior, stack.scene.estimator, stack.scene.tiles)
    return fit(*evidence(task, prior_known=described.kind != "fit", noise_known=not asked))


def _with_fit(
    stack: Stack, prior: estimation.Prior, noise: dict[str, Vector], found: Fit
) -> tuple[estimation.Prior, dict[str, Vector]]:
    """The prior and the noise once they are found; what was found stands for the noise that the scene describes."""
    if found.variance is not None and found.length is not None:
        length = found.length * stack.camera.target_pitch
        update = {"kind": "exponential", "variance": found.variance, "correlation_length": length}
        prior = prior.model_copy(update=update)
    if found.noise_variance is not None:
        kept = {name: noise[name] for name in KEPT if name in noise}
        noise = {**kept, "noise": everywhere(found.noise_variance, noise["rendering"].size)}
    return prior, noise


def _feigned(model: Model, usable: Usable, believed: Vector, expected: ExpectedError) -> float:
    if not model.variance.any():
        return 0.0
    noise = np.full(model.measurements, np.inf)
    noise[usable.used] = believed
    with np.errstate(divide="ignore", invalid="ignore"):  # without noise and without uncertainty of H
        return float(np.nan_to_num(model.feigned(noise) * expected.variance).mean())


def _residual(outcome: Outcome, believed: Vector) -> Residual | None:
    """None where a measurement is said to have no noise: then there is no unit for what is left of it."""
    if not believed.size or not (believed > 0).all():
        return None
    freedoms = max(believed.size - outcome.expected.degrees_of_freedom, 0.0)
    return Residual(float(believed @ np.square(outcome.multipliers)), freedoms, (2 * freedoms) ** 0.5)
