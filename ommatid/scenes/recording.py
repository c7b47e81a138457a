"""Recordings of a real sensor and their conversion to values of f (EMVA Standard 1288, release 4, linear model).

A reading is K (electrons of light + of the dark + noise) + black level, rounded, in digital numbers (DN), with the
system gain K in DN per electron. Every pixel has its own dark signal and response; the means of dark and of flat
frames, taken with the same exposure, remove both. Vectors are (M,), in the order of measurements.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray

from .camera import Camera
from .tables.sensor import SensorTable

ROUNDING = 1 / 12  # DN^2, variance of rounding to whole numbers
DETECTION_LIMIT = 5.0  # standard deviations by which the flat of a live pixel exceeds its dark
CLIPPING_LIMIT = 3.0  # standard deviations between a mean reading and an end of the range, below which noise is clipped
FLAT_LEVEL = 0.5  # of saturation: exposure of a lens type's brightest pixel in flat frames


@dataclass(frozen=True)
class Recording:
    """One exposure, and the means of `sensor.frames` dark frames and of as many flat frames: (M,) DN each.

    flat_value : (M,) units of f, value of the uniform target of the flat frames, one per lens type
    """

    sensor: SensorTable
    digital: FloatArray
    dark: FloatArray
    flat: FloatArray
    flat_value: FloatArray

    @cached_property
    def slope(self) -> FloatArray:
        """DN per unit of f; NaN for dead pixels, whose flat does not exceed the dark by its noise or is clipped."""
        signal = self.flat - self.dark
        variance = self._mean_variance(signal) + self._mean_variance(np.zeros_like(signal))
        unclipped = self.flat + CLIPPING_LIMIT * np.sqrt(self._reading_variance(signal)) <= self.sensor.full
        alive = (signal > DETECTION_LIMIT * np.sqrt(variance)) & unclipped
        return np.divide(signal, self.flat_value, out=np.full_like(signal, np.nan), where=alive)

    @cached_property
    def values(self) -> FloatArray:
        """The exposure in units of f; NaN for dead pixels."""
        return (self.digital - self.dark) / self.slope

    @property
    def saturated(self) -> BoolArray:
        """True for pixels at saturation."""
        return self.digital >= self.sensor.full

    def noise(self, values: FloatArray) -> dict[str, FloatArray]:
        """Variances of the pixels' values, in squared units of f, under light of `values`, clipped at 0.

        noise : shot noise and read noise;  quantisation : rounding of the exposure
        frames : noise and rounding of the finite numbers of dark and flat frames, the same in every exposure
        A value is V (g - d) / (F - d) of a reading g, the dark d and the flat F at V, so that the flat contributes
        (value / V)^2 and the dark (1 - value / V)^2 of its variance.
        """
        light = np.maximum(values, 0.0)
        share = light / self.flat_value
        frames = share**2 * self._mean_variance(self.flat - self.dark) + (1 - share) ** 2 * self._mean_variance(
            0 * light
        )
        reading = self._reading_variance(self.slope * light)
        variances = {"noise": reading, "quantisation": ROUNDING, "frames": frames}
        return {name: variance / self.slope**2 for name, variance in variances.items()}

    def noise_variance(self, values: FloatArray) -> FloatArray:
        """The sum of the variances of `noise`."""
        return np.sum(list(self.noise(values).values()), axis=0)

    def smoothed_light(self, camera: Camera) -> FloatArray:
        """A first estimate of the light on each pixel, in units of f: the mean over 3 x 3 pixels, always above 0.

        The noise that a single reading implies would be too small wherever the reading happens to be small. For n
        pixels with N electrons in all the estimate is (N + 1) / n, the posterior mean of a Poisson rate under a flat
        prior.
        """
        from scipy import ndimage

        light = np.empty_like(self.digital)
        electrons = (self.digital - self.dark) / self.sensor.gain
        known = np.isfinite(self.values)
        kernel = np.ones((3, 3))
        for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
            alive = known[pixels].reshape(sub.type.pixels)
            counted = np.where(alive, electrons[pixels].reshape(sub.type.pixels), 0.0)
            total = ndimage.convolve(counted, kernel, mode="constant")
            number = np.maximum(ndimage.convolve(alive.astype(np.float64), kernel, mode="constant"), 1.0)
            light[pixels] = ((np.maximum(total, 0.0) + 1) / number).ravel()
        return light * self.sensor.gain / self.slope

    def restrict(self, mask: BoolArray) -> Recording:
        """The recording of only the pixels in `mask`, (M,)."""
        return replace(
            self,
            digital=self.digital[mask],
            dark=self.dark[mask],
            flat=self.flat[mask],
            flat_value=self.flat_value[mask],
        )

    def _reading_variance(self, signal: FloatArray) -> FloatArray:
        """Variance of a reading before rounding, DN^2, for light that adds `signal` DN to the dark."""
        sensor = self.sensor
        return sensor.gain * np.maximum(signal, 0.0) + sensor.gain**2 * (dark_electrons(sensor) + sensor.read_noise**2)

    def _mean_variance(self, signal: FloatArray) -> FloatArray:
        """Variance of the mean of all dark or flat frames, DN^2, for light that adds `signal` DN to the dark.

        Where noise is small compared to 1 DN, rounding has the same error in all frames; averaged over the fractional
        part its square is at most 1/12 exp(-4 pi^2 variance) (Widrow and Kollar 2008, ch. 5).
        """
        reading = self._reading_variance(signal)
        common = ROUNDING * np.exp(-4 * np.pi**2 * reading)
        return (reading + ROUNDING) / self.sensor.frames + common


def dark_electrons(sensor: SensorTable) -> float:
    """Electrons of the dark current in an exposure."""
    return sensor.dark_current * sensor.exposure


def saturation_electrons(sensor: SensorTable) -> float:
    """Electrons of light that saturate a pixel."""
    return max((sensor.full - sensor.black_level) / sensor.gain - dark_electrons(sensor), 0.0)


def clips_dark_noise(sensor: SensorTable) -> bool:
    """True if noise of the dark is cut off at 0 DN, which raises the mean dark most and so lowers dim values."""
    deviation = (dark_electrons(sensor) + sensor.read_noise**2 + sensor.dsnu**2) ** 0.5
    can_be_negative = sensor.read_noise > 0 or sensor.dsnu > 0
    lowest = sensor.black_level + sensor.gain * (dark_electrons(sensor) - CLIPPING_LIMIT * deviation)
    return can_be_negative and lowest < -0.5


def flat_values(sensor: SensorTable, camera: Camera, response: FloatArray) -> FloatArray:
    """Value of the uniform target, in units of f, that half saturates the brightest pixel of each lens type: (M,).

    response : (M,) electrons per unit of f
    """
    values = np.empty(camera.measurements)
    for pixels in camera.type_slices():
        charge, brightest = FLAT_LEVEL * saturation_electrons(sensor), float(response[pixels].max(initial=0.0))
        values[pixels] = charge / brightest if charge > 0 and brightest > 0 else 1.0  # all pixels are dead either way
    return values


def expected_recording(sensor: SensorTable, camera: Camera, response: FloatArray, values: FloatArray) -> Recording:
    """The expected recording of light of `values`, (M,), by pixels of equal dark signal and response."""
    return expected_recording_of(sensor, flat_values(sensor, camera, response), response, values)


def expected_recording_of(
    sensor: SensorTable, level: FloatArray, response: FloatArray, values: FloatArray
) -> Recording:
    """The expected recording of light of `values` by some pixels, whose flat frames show a target of value `level`."""
    dark = np.full(values.size, sensor.gain * dark_electrons(sensor) + sensor.black_level)
    digital, flat = (dark + sensor.gain * response * light for light in (values, level))
    return Recording(sensor, digital, dark, flat, level)
