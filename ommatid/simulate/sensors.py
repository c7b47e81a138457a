"""Sensors: the ideal one with normal noise, and the physical one, with the dark and flat frames that calibrate it.

The ideal sensor adds normal noise, quantises and saturates in the units of the target's pixel values. The physical one
follows EMVA Standard 1288, release 4: photons are Poisson distributed, each pixel has its own dark signal and response,
reading adds normal noise, wells and numbers are limited. Electrons and digital numbers (DN) are counts. Every
sub-imager draws from its own streams, one per purpose, so that its values depend neither on other lens types nor on
another exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, stream
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.recording import ROUNDING, Recording, dark_electrons, flat_values
from ommatid.scenes.tables.sensor import NoiseTable, SensorTable

MOST_READINGS = 400_000  # of the frames of a sub-imager that are drawn one by one
CHUNK = 2**18  # readings that are drawn at once
ROUNDED = 1e-6  # of the brightest light: how far below 0 a rendering of black may lie


def record(
    light: FloatArray, response: FloatArray, sensor: SensorTable, camera: Camera, seed: int, shot: bool = True
) -> Recording:
    """Expose once to `light`, and record dark and flat frames.

    light : (M,) in units of f;  response : (M,) electrons per unit of f of a typical pixel
    seed : of the exposure and the frames; the fixed pattern of the pixels follows the camera's tolerance seed
    shot : True draws Poisson counts of electrons; False takes their expectation
    Raises InputError for light below 0.
    """
    _check_light(light)
    level = flat_values(sensor, camera, response)
    digital, dark, flat = (np.empty(camera.measurements) for _ in range(3))
    for sub, rows in zip(camera.sub_imagers, camera.slices(), strict=True):
        pixels = _pixels(sensor, camera, sub, response[rows], shot)
        digital[rows] = pixels.readings(light[rows], generator(seed, Purpose.EXPOSURE, sub), 1)[0]
        dark[rows] = pixels.mean_of_frames(np.zeros(response[rows].size), generator(seed, Purpose.DARK_FRAMES, sub))
        flat[rows] = pixels.mean_of_frames(level[rows], generator(seed, Purpose.FLAT_FRAMES, sub))
    # In the precision of the file, so that a stack is the same before and after it was stored.
    dark, flat = (mean.astype(np.float32).astype(np.float64) for mean in (dark, flat))
    return Recording(sensor, digital, dark, flat, level)


def generator(seed: int, purpose: Purpose, sub: SubImager) -> np.random.Generator:
    """Return the stream of a sub-imager for one purpose."""
    return stream(seed, purpose, sub.type.name, sub.k, sub.l)


@dataclass(frozen=True)
class _Pixels:
    """Pixels of one sub-imager: (n,) `offset`, electrons of their dark signals, and `response`, electrons per unit."""

    sensor: SensorTable
    offset: FloatArray
    response: FloatArray
    shot: bool

    def readings(self, light: FloatArray, rng: np.random.Generator, count: int) -> FloatArray:
        """Draw `count` exposures to `light`, (n,) units of f: (count, n) DN."""
        shape = count, light.size
        electrons = self._counted(light, rng, shape) + self.offset
        electrons += rng.normal(0.0, self.sensor.read_noise, shape)
        # The well comes last, so that a full pixel is recognised by its number whatever its read noise.
        return self._in_range(np.round(self._digital(np.minimum(electrons, self.sensor.full_well))))

    def mean_of_frames(self, light: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Draw the mean of all frames, (n,) DN.

        For many pixels the mean itself is drawn: photons and read noise have exactly the same distribution, rounding
        adds normal noise of variance 1/12 per frame, and the range clips the mean instead of every frame.
        """
        sensor, frames = self.sensor, self.sensor.frames
        if frames * light.size <= MOST_READINGS:
            most = max(1, CHUNK // light.size)
            counts = [min(most, frames - first) for first in range(0, frames, most)]
            return sum((self.readings(light, rng, count).sum(axis=0) for count in counts), np.zeros(1)) / frames
        electrons = self._counted(light, rng, light.shape, frames) / frames + self.offset
        electrons += rng.normal(0.0, sensor.read_noise / frames**0.5, light.size)
        mean = self._digital(np.minimum(electrons, sensor.full_well))
        return self._in_range(mean + rng.normal(0.0, (ROUNDING / frames) ** 0.5, light.size))

    def _counted(
        self, light: FloatArray, rng: np.random.Generator, shape: tuple[int, ...], frames: int = 1
    ) -> FloatArray | IntArray:
        """Electrons of `frames` frames together."""
        electrons = np.maximum(light, 0.0) * self.response + dark_electrons(self.sensor)
        # Beyond this a pixel is certainly full, and NumPy's Poisson generator has a limit.
        expected = frames * np.minimum(electrons, 2 * self.sensor.full_well + 1e6)
        return rng.poisson(expected, shape) if self.shot else np.broadcast_to(expected, shape)

    def _digital(self, electrons: FloatArray) -> FloatArray:
        return self.sensor.gain * electrons + self.sensor.black_level

    def _in_range(self, digital: FloatArray) -> FloatArray:
        return np.clip(digital, 0.0, 2.0**self.sensor.bits - 1)


def _pixels(sensor: SensorTable, camera: Camera, sub: SubImager, response: FloatArray, shot: bool) -> _Pixels:
    seed = 0 if camera.tolerance is None else camera.tolerance.seed
    offset = generator(seed, Purpose.DARK_SIGNAL, sub).normal(0.0, sensor.dsnu, response.size)
    relative = generator(seed, Purpose.RESPONSE, sub).normal(0.0, sensor.prnu, response.size)
    return _Pixels(sensor, offset, response * np.maximum(1 + relative, 0.0), shot)


def _check_light(light: FloatArray) -> None:
    least = float(light.min(initial=0.0))
    if least < -ROUNDED * float(light.max(initial=0.0)) or not np.isfinite(light).all():
        count = int(np.sum(~(light >= 0)))
        raise InputError(
            f"a [sensor] counts the electrons of light, got light below 0 (least {least:.4g}) or NaN on {count}"
            " of its pixels; take a target.image without negative values, or an ideal sensor's [noise]"
        )


def quantise(values: FloatArray, level: float) -> FloatArray:
    """Round to the nearest multiple of `level`."""
    return level * np.round(values / level)


def expose(light: FloatArray, noise: NoiseTable, rngs: list[np.random.Generator], slices: list[slice]) -> FloatArray:
    """Return the recorded values of `light`, (M,): noise from each sub-image's generator, quantised, saturated."""
    recorded = light.copy()
    if noise.variance > 0:
        for measurements, rng in zip(slices, rngs, strict=True):
            recorded[measurements] += rng.normal(0.0, noise.variance**0.5, recorded[measurements].shape)
    if noise.bits is not None:
        recorded = quantise(recorded, noise.level)
    # Last, so that a saturated pixel is recognised by its value whatever the levels are.
    return recorded if noise.saturation is None else np.minimum(recorded, noise.saturation)


def generators(camera: Camera, seed: int) -> list[np.random.Generator]:
    """Return one generator per sub-imager, independent of the other lens types of the camera."""
    return [generator(seed, Purpose.NOISE, sub) for sub in camera.sub_imagers]
