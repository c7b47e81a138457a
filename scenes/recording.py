"""What a real sensor recorded, and what that tells of the light (EMVA Standard 1288, release 4, linear model).

A reading is K (electrons of light + of the dark + noise) + black level, rounded, in digital numbers (DN), with the
system gain K in DN an electron. Every pixel has a dark signal and a response of its own; the mean of dark frames and
that of flat frames, taken with the same exposure, take both out. Vectors are (M,), in the order of measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .camera import Camera
from .tables.sensor import SensorTable

Vector = NDArray[np.float64]

ROUNDING = 1 / 12  # DN^2, variance of rounding to whole numbers
DETECTED = 5.0  # standard deviations by which a flat has to stand out from the dark, or the pixel is dead
CUT = 3.0  # standard deviations of a reading, within which of its end a range cuts the noise off
FLAT = 0.5  # of a full pixel: what flat frames bring a lens type's brightest pixel to


@dataclass(frozen=True)
class Recording:
    """One exposure, and the means of `sensor.frames` dark and of as many flat frames: (M,) DN each.

    flat_value : (M,) units of f, the uniform target of the flat frames, of each lens type its own
    """

    sensor: SensorTable
    digital: Vector
    dark: Vector
    flat: Vector
    flat_value: Vector

    @cached_property
    def slope(self) -> Vector:
        """DN for each unit of f; NaN for dead pixels, whose flat does not stand out from the dark or is cut off."""
        signal = self.flat - self.dark
        variance = self._of_mean(signal) + self._of_mean(np.zeros_like(signal))
        uncut = self.flat + CUT * np.sqrt(self._of_reading(signal)) <= self.sensor.full
        alive = (signal > DETECTED * np.sqrt(variance)) & uncut
        return np.divide(signal, self.flat_value, out=np.full_like(signal, np.nan), where=alive)

    @cached_property
    def values(self) -> Vector:
        """In units of f; NaN for dead pixels."""
        return (self.digital - self.dark) / self.slope

    @property
    def saturated(self) -> NDArray[np.bool_]:
        """Which pixels are full."""
        return self.digital >= self.sensor.full

    def noise(self, values: Vector) -> dict[str, Vector]:
        """Variances of the pixels' values, in squared units of f, where light of `values` (taken as 0 below) arrives.

        noise : photons' and electrons' (shot) and the reading's, and what the finite dark and flat frames add
        quantisation : of rounding the exposure
        A value is V (g - d) / (F - d) of a reading g, the dark d and the flat F at V, so that the flat counts by
        (value / V)^2 and the dark by (1 - value / V)^2.
        """
        light = np.maximum(values, 0.0)
        share = light / self.flat_value
        frames = share**2 * self._of_mean(self.flat - self.dark) + (1 - share) ** 2 * self._of_mean(0 * light)
        reading = self._of_reading(self.slope * light)
        return {"noise": (reading + frames) / self.slope**2, "quantisation": ROUNDING / self.slope**2}

    def noise_variance(self, values: Vector) -> Vector:
        """The sum of the variances of `noise`."""
        return np.sum(list(self.noise(values).values()), axis=0)

    def light_nearby(self, camera: Camera) -> Vector:
        """A first idea of the light on each pixel, in units of f: the mean of it and its neighbours, never 0.

        Its own reading alone would pass for certain where it happens to be small. Of n pixels that count N electrons
        the expectation is (N + 1) / n: the posterior mean of a Poisson process of which nothing was known.
        """
        from scipy import ndimage

        found = np.empty_like(self.digital)
        electrons = (self.digital - self.dark) / self.sensor.gain
        known = np.isfinite(self.values)
        for sub, place in zip(camera.sub_imagers, camera.slices(), strict=True):
            shape = sub.type.pixels
            kernel = np.ones((3, 3))
            alive = known[place].reshape(shape)
            seen = np.where(alive, electrons[place].reshape(shape), 0.0)
            counted = ndimage.convolve(seen, kernel, mode="constant")
            pixels = np.maximum(ndimage.convolve(alive.astype(np.float64), kernel, mode="constant"), 1.0)
            found[place] = ((np.maximum(counted, 0.0) + 1) / pixels).ravel()
        return found * self.sensor.gain / self.slope

    def restrict(self, kept: NDArray[np.bool_]) -> Recording:
        """Only some of the pixels: `kept`, (M,)."""
        return replace(
            self,
            digital=self.digital[kept],
            dark=self.dark[kept],
            flat=self.flat[kept],
            flat_value=self.flat_value[kept],
        )

    def _of_reading(self, signal: Vector) -> Vector:
        """Variance of a reading before it is rounded, DN^2, where light brings `signal` DN above the dark."""
        sensor = self.sensor
        return sensor.gain * np.maximum(signal, 0.0) + sensor.gain**2 * (dark_level(sensor) + sensor.read_noise**2)

    def _of_mean(self, signal: Vector) -> Vector:
        """Variance of the mean of all frames.

        Where noise is small beside 1 DN, rounding errs the same way in all frames: on average over the places between
        two whole numbers the square of that is at most 1/12 exp(-4 pi^2 variance) (Widrow and Kollar 2008, ch. 5).
        """
        reading = self._of_reading(signal)
        stays = ROUNDING * np.exp(-4 * np.pi**2 * reading)
        return (reading + ROUNDING) / self.sensor.frames + stays


def dark_level(sensor: SensorTable) -> float:
    """Electrons of the dark current in an exposure."""
    return sensor.dark_current * sensor.exposure


def charge_of_full(sensor: SensorTable) -> float:
    """Electrons of light at which a pixel is full."""
    return max((sensor.full - sensor.black_level) / sensor.gain - dark_level(sensor), 0.0)


def reaching_below_zero(sensor: SensorTable) -> bool:
    """Whether the noise of the dark is cut off at 0 DN, which pulls dim readings up and dim values down."""
    spread = (dark_level(sensor) + sensor.read_noise**2 + sensor.dsnu**2) ** 0.5
    random = sensor.read_noise > 0 or sensor.dsnu > 0  # what can be negative
    return random and sensor.black_level + sensor.gain * (dark_level(sensor) - CUT * spread) < -0.5


def flat_values(sensor: SensorTable, camera: Camera, response: Vector) -> Vector:
    """The uniform target, in units of f, that half fills the brightest pixel of each lens type: (M,).

    response : (M,) electrons for each unit of f
    """
    found = np.empty(camera.measurements)
    for place in camera.type_slices():
        charge, brightest = FLAT * charge_of_full(sensor), float(response[place].max(initial=0.0))
        found[place] = charge / brightest if charge > 0 and brightest > 0 else 1.0  # which no pixel will notice
    return found


def expected_recording(sensor: SensorTable, camera: Camera, response: Vector, values: Vector) -> Recording:
    """What is recorded of light of `values`, (M,), on average, by pixels all alike."""
    level = flat_values(sensor, camera, response)
    dark = np.full(camera.measurements, sensor.gain * dark_level(sensor) + sensor.black_level)
    digital, flat = (dark + sensor.gain * response * light for light in (values, level))
    return Recording(sensor, digital, dark, flat, level)
