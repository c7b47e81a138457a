"""The noise of a stack before and after a first estimate, for each sensor pixel and by its causes.

The noise of a real sensor depends on the light. It is first taken from the readings near a pixel and then, as the
uncertainty of H is, from the light that the first estimate predicts.

Saturated pixels are censored measurements: their reading says only that the light and its noise reached a limit.
Without them, the readings that remain just below the limit are those whose noise happened to be low, and are biased: by
0.6 standard deviations one deviation below the limit. With the limit a deviations above the expected light, noise of
standard deviation s, and the inverse Mills ratio r = phi(a) / (1 - Phi(a)), a saturated pixel contributes log(1 - Phi)
to the log likelihood, with slope r / s and curvature -i / s^2, i = r (r - a) between 0 and 1. So it acts as a
measurement of (expected light) + s r / i with variance s^2 / i, and since the log likelihood is concave, a few
repetitions find its maximum (Newton). Kept readings stay as they are (Tobin 1958).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import special

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.model import Model
from ommatid.scenes.observation import Observation
from ommatid.scenes.optics.negligible import negligible_shot_noise
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

from .coarse_model import model_of_f
from .methods.method import EstimationTask, total_variance
from .prior import coloured, spectrum_of
from .prior_fit import PriorFit

Noise = dict[str, FloatArray]  # variances by cause

SATURATION = "saturation"  # in the error budget
SHARED = "shared calibration"  # by errors of few numbers of H, which many measurements share; "calibration" in budgets
SHARED_NOTABLE = 1e-3  # of the other noise of a measurement, below which SHARED is left out
CERTAIN = (
    "rendering",
    "calibration",
    SHARED,
    SATURATION,
)  # noise that stays known when the rest of it is to be fitted
ROUNDS = 6
UNCHANGED = 0.05  # standard deviations of its noise: change of the light expected on a saturated pixel
BEFORE_ROUNDING = ("noise", "rendering")  # by cause
DITHER = 0.4  # noise over the quantisation step from which rounding errors are independent of the signal
HARMONICS = 20  # of the mean error of rounding; those beyond are 3 % of its variance without noise
LEAST_EXPOSED = 1e-3  # of the light that a pixel sends to saturated sensor pixels, below which others do not see it
OVEREXPOSED = 1e-3  # share of an image that only saturated pixels see, from which it matters
LEAST_INFORMATION = 0.01  # of an unsaturated pixel: a saturated one with less is left out


@dataclass(frozen=True)
class UsablePixels:
    """The sensor pixels that are used, (M,), the number of dead ones, and the saturated ones, (M,).

    censoring : (M,) variance that a saturated pixel's value has in addition to its noise; None: none is used
    """

    used: BoolArray
    dead: int
    full: BoolArray
    censoring: FloatArray | None = None

    @property
    def saturated(self) -> int:
        """Number of saturated pixels."""
        return int(np.sum(self.full))


def usable_pixels(stack: Stack, model: Model | None = None) -> UsablePixels:
    """Find the sensor pixels that are neither dead (no finite value) nor saturated.

    With a model, pixels whose row of H is empty count as dead too.
    """
    alive = np.isfinite(stack.values) & np.isfinite(stack.rendering_variance)
    if model is not None and model.stored is not None:
        alive &= np.diff(model.stored.indptr) > 0
    noise = stack.scene.noise
    full = np.zeros_like(alive)
    if stack.recording is not None:
        full = alive & stack.recording.saturated
    elif noise is not None and noise.saturation is not None:
        # A stack that was stored holds float32.
        full = alive & (stack.values >= min(noise.saturation, float(np.float32(noise.saturation))))
    return UsablePixels(alive & ~full, int(np.sum(~alive)), full)


def overexposed(model: Model, usable: UsablePixels) -> float:
    """Return the share of the pixels of H's images that saturated sensor pixels see and no others."""
    if not usable.saturated:
        return 0.0
    exposed, seen = (model.adjoint(each.astype(np.float64)) for each in (usable.used & ~usable.full, usable.full))
    return float(np.mean(exposed < LEAST_EXPOSED * seen))


def known_noise(stack: Stack, light: FloatArray | None = None) -> Noise:
    """Return the variances, (M,), of rendering and sensor; absent effects have no entry.

    light : (M,) that an estimate predicts, absent: the readings near each pixel
    """
    return {"rendering": stack.rendering_variance} | stack.sensor_noise(light)


def noise_at(stack: Stack, model: Model, image: FloatArray) -> Noise:
    """Return the variances, (M,), at an estimate, (N,), with that by the uncertainty of H."""
    noise = known_noise(stack, None if stack.recording is None else model.forward(image))
    return noise | {"calibration": model.variance_from_model(image)} if model.variance.any() else noise


def fitted_noise(noise: Noise, fit: PriorFit | None) -> Noise:
    """Return the noise whose part that is not CERTAIN is replaced by the fitted one, if one was fitted."""
    if fit is None or fit.noise_variance is None:
        return noise
    return {**certain(noise), "noise": np.full(noise["rendering"].size, fit.noise_variance)}


def certain(noise: Noise) -> Noise:
    """Return the noise that stays known when the rest of it is to be fitted."""
    return {name: noise[name] for name in CERTAIN if name in noise}


def has_shared_errors(model: Model) -> bool:
    """Return True if entries of H follow from few numbers with errors."""
    return model.errors(np.zeros(model.unknowns)) is not None


@dataclass(frozen=True)
class ObservedStack:
    """A stack with the prior of f, and the model that this prior makes of H where the world is finer than f."""

    stack: Stack
    model: Model
    usable: UsablePixels
    prior: PriorTable

    def with_prior(self, prior: PriorTable, model: Model) -> ObservedStack:
        """Return the same stack under another prior; model : as calibrated."""
        return replace(self, prior=prior, model=model_of_f(model, self.stack.camera, prior))

    def noise(self, image: FloatArray | None = None, *, shared: bool = True) -> Noise:
        """Return the variances, (pixels used,), at an estimate, (N,), or for images of the prior before there is one.

        shared : False leaves the errors of few numbers of H out
        """
        model, prior = self.model, self.prior
        noise = known_noise(self.stack) if image is None else noise_at(self.stack, model, image)
        if image is None and model.variance.any():
            variances = np.full(model.unknowns, prior.variance)
            noise["calibration"] = model.prior_variance_from_model(variances, prior.mean)
        if self.usable.censoring is not None:
            noise[SATURATION] = self.usable.censoring
        noise = {name: variances[self.usable.used] for name, variances in noise.items()}
        return self.with_shared(noise, image) if shared else noise

    def with_shared(self, noise: Noise, image: FloatArray | None) -> Noise:
        """Return the noise with the variance by errors of few numbers of H, unless it is a thousandth of it or less.

        The estimator takes these errors for independent; `model_error.shared_errors` computes what they do together.

        image : (N,), or None for one drawn from the prior, and the variance averaged over each sub-imager
        """
        others, model = {name: values for name, values in noise.items() if name != SHARED}, self.model
        errors = model.errors(self._drawn() if image is None else image) if has_shared_errors(model) else None
        if errors is None:
            return others
        variance = errors.variance
        if image is None:
            parts = model.camera.slices()
            variance = np.concatenate([np.full(part.stop - part.start, variance[part].mean()) for part in parts])
        variance, rest = variance[self.usable.used], total_variance(others)
        share = np.divide(variance, rest, out=np.where(variance > 0, np.inf, 0.0), where=rest > 0)
        return others | {SHARED: variance} if share.size and float(share.mean()) > SHARED_NOTABLE else others

    def _drawn(self) -> FloatArray:
        """Draw an image from the prior: (N,)."""
        camera = self.model.camera
        spectrum = spectrum_of(self.prior, camera.shape, camera.target_pitch, camera.detail)
        return self.prior.mean + coloured(spectrum, probe(Purpose.SHARED_PRIOR).normal(size=camera.shape)).ravel()

    def expected_noise(self, noise: Noise) -> FloatArray:
        """Return the variance that the estimator assumes, (pixels used,)."""
        setting = self.stack.scene.estimator.noise_variance
        if not isinstance(setting, float):
            return total_variance(noise)
        return np.full(int(self.usable.used.sum()), setting) + noise.get(SATURATION, 0.0)

    @property
    def expects_fixed_noise(self) -> bool:
        """True if the scene fixes the expected noise to a number."""
        return isinstance(self.stack.scene.estimator.noise_variance, float)

    def task(self, expected_noise: FloatArray, shared_image: FloatArray | None = None) -> EstimationTask:
        """Return the task of an estimation method.

        shared_image : (N,) whose errors by few numbers of H are part of the expected noise; None: they are not
        """
        scene, model = self.stack.scene, self.model
        return EstimationTask(
            model,
            self.stack.values,
            self.usable.used,
            expected_noise,
            self.prior,
            scene.estimator,
            scene.tiles,
            scene.prior_ratio,
            shared_image,
            model.camera.rows // self.stack.camera.rows,
        )


def depends_on_light(stack: Stack, model: Model) -> bool:
    """Return True if some of the noise is only known once there is an estimate."""
    counted = stack.recording is not None and negligible_shot_noise(stack.scene, stack.camera) is None
    return counted or bool(model.variance.any())  # SHARED in the initial noise needs an estimate, too


def check_noise_fit(stack: Stack) -> None:
    """Raise InputError where one variance is to be fitted to a sensor whose pixels have different ones."""
    if stack.recording is not None and stack.scene.estimator.noise_variance == "fit":
        raise InputError(
            "estimator.noise_variance 'fit' finds one number for all pixels, but the noise of a [sensor] is known, and"
            " differs from pixel to pixel with the light; remove the key"
        )


def undithered(noise: Noise) -> float | None:
    """Return the noise over the quantisation step where it is below DITHER, None elsewhere; noise : by cause."""
    rounding = noise.get("quantisation")
    if rounding is None or not rounding.any():
        return None
    noisy = float(np.mean(noise["noise"])) if "noise" in noise else 0.0
    share = (noisy / (12 * float(np.mean(rounding)))) ** 0.5
    return share if round(share, 9) < DITHER else None


def common_rounding(noise: Noise, light: FloatArray) -> FloatArray:
    """Return errors of rounding that measurements of like light share: (2, measurements used).

    Rounding with a step q and noise of standard deviation s errs on average by a sine of the light, of frequency k / q
    and amplitude q / (k pi) exp(-2 (k pi s / q)^2), k = 1, 2, ... (Widrow and Kollar 2008). The light is not known to
    a fraction of a step, and where the picture is smooth that is one phase for many measurements: the errors are a
    cosine and a sine of the estimate's light, each times a random number of variance 1. All harmonics together are
    taken for the first.

    noise : by cause, (measurements used,) each;  light : (measurements used,) that the estimate predicts
    """
    step = np.sqrt(12 * noise["quantisation"])
    before = total_variance({name: noise[name] for name in BEFORE_ROUNDING if name in noise}) / step**2
    squares = np.zeros(light.size)
    for order in np.pi * np.arange(1, HARMONICS + 1):
        squares += np.exp(-4 * order**2 * before) / (2 * order**2)
    phase = 2 * np.pi * light / step
    return step * np.sqrt(squares) * np.stack([np.cos(phase), np.sin(phase)])


def of_smooth_parts(values: FloatArray, observation: Observation) -> FloatArray:
    """Return values of measurements, (M,), where all that see a pixel agree, and less where they do not: (M,).

    An image of their means over the measurements that see each pixel is observed again.
    """
    seen, total = observation.adjoint(np.ones(values.size)), observation.adjoint(values)
    return observation.forward(np.divide(total, seen, out=np.zeros_like(seen), where=seen > 0))


def censored(
    stack: Stack, model: Model, usable: UsablePixels, image: FloatArray, fit: PriorFit | None
) -> tuple[Stack, UsablePixels]:
    """Return the stack with values for saturated pixels at an estimate, (N,), and the pixels to use with it.

    usable : of the stack as recorded;  fit : of its noise, if any
    """
    noise, shared = noise_at(stack, model, image), model.errors(image)
    variance = total_variance(fitted_noise(noise if shared is None else noise | {SHARED: shared.variance}, fit))
    light, deviation = model.forward(image), np.sqrt(variance)
    with np.errstate(invalid="ignore", divide="ignore"):
        below = (_limit(stack) - light) / deviation
    ratio = np.exp(-0.5 * below**2 - special.log_ndtr(-below)) / (2 * np.pi) ** 0.5
    information = np.clip(ratio * (ratio - below), 0.0, 1.0)
    taken = usable.full & (information >= LEAST_INFORMATION)
    information = np.where(taken, information, 1.0)
    values = np.where(taken, light + deviation * ratio / information, stack.values)
    added = np.where(taken, variance * (1 / information - 1), 0.0)
    return replace(stack, values=values), replace(usable, used=usable.used | taken, censoring=added)


def has_converged(before: FloatArray, after: FloatArray, stack: Stack, usable: UsablePixels) -> bool:
    """Return True if the light on saturated pixels, (M,), changed by little of the noise."""
    change, noise = np.abs(after - before)[usable.full], total_variance(known_noise(stack))[usable.full]
    return bool((change <= UNCHANGED * np.sqrt(noise)).all())


def _limit(stack: Stack) -> FloatArray | float:
    """Return the value from which on a reading is saturated, before it is rounded: (M,) or one for all."""
    recording, table = stack.recording, stack.scene.noise
    if recording is not None:
        return (recording.sensor.full - 0.5 - recording.dark) / recording.slope
    if table is None or table.saturation is None:
        return np.inf
    return table.saturation if table.bits is None else table.level * (np.ceil(table.saturation / table.level) - 0.5)
