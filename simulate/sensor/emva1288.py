"""The real sensor: light to digital numbers, with the dark and flat frames that calibrate it.

The model of EMVA Standard 1288, release 4: photons are Poisson, a pixel's dark signal and response are its own,
readings add normal noise, wells and numbers end. Electrons and digital numbers (DN) are counts. Every sub-imager draws
from streams of its own, one for each purpose, so that neither other lens types nor another exposure change what it is.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.recording import ROUNDING, Recording, dark_electrons, flat_values
from ommatid.scenes.tables.sensor import SensorTable

Vector = NDArray[np.float64]
Purpose = Literal["dark signal", "response", "exposure", "dark frames", "flat frames"]

MOST_READINGS = 400_000  # of the frames of a sub-imager that are drawn one by one
CHUNK = 2**18  # readings that are drawn at once
ROUNDED = 1e-6  # of the brightest light: what a rendering of black may be below 0


def record(
    light: Vector, response: Vector, sensor: SensorTable, camera: Camera, seed: int, shot: bool = True
) -> Recording:
    """Expose once to `light`, and take dark and flat frames.

    shot : whether electrons are counted one by one; else there are as many as expected

    light : (M,) in units of f;  response : (M,) electrons for each unit of f in a pixel like all others
    seed : of the exposure and the frames; the pixels' own pattern belongs to the camera, as its tolerance does
    Raises InputError for light below 0.
    """
    _refuse_negative(light)
    level = flat_values(sensor, camera, response)
    digital, dark, flat = (np.empty(camera.measurements) for _ in range(3))
    for sub, place in zip(camera.sub_imagers, camera.slices(), strict=True):
        pixels = _pixels(sensor, camera, sub, response[place], shot)
        digital[place] = pixels.readings(light[place], generator(seed, "exposure", sub), 1)[0]
        dark[place] = pixels.mean_of_frames(np.zeros(response[place].size), generator(seed, "dark frames", sub))
        flat[place] = pixels.mean_of_frames(level[place], generator(seed, "flat frames", sub))
    # In the precision of the file, so that a stack is the same before and after it was stored.
    dark, flat = (mean.astype(np.float32).astype(np.float64) for mean in (dark, flat))
    return Recording(sensor, digital, dark, flat, level)


def generator(seed: int, purpose: Purpose, sub: SubImager) -> np.random.Generator:
    """The stream of a sub-imager for one purpose; no lens type's name has a blank, so no noise shares its key."""
    key = zlib.crc32(f"{purpose} {sub.type.name}".encode()), sub.k, sub.l
    return np.random.Generator(np.random.PCG64DXSM(np.random.SeedSequence(seed, spawn_key=key)))


@dataclass(frozen=True)
class _Pixels:
    """Pixels of one sub-imager: (n,) `offset`, electrons of their dark signals, and `response`, electrons a unit."""

    sensor: SensorTable
    offset: Vector
    response: Vector
    shot: bool

    def readings(self, light: Vector, rng: np.random.Generator, count: int) -> Vector:
        """(count, n) DN of as many exposures to `light`, (n,) units of f."""
        shape = count, light.size
        electrons = self._counted(light, rng, shape) + self.offset
        electrons += rng.normal(0.0, self.sensor.read_noise, shape)
        # The well comes last, so that a full pixel is known by its number whatever the noise of reading it.
        return self._in_range(np.round(self._digital(np.minimum(electrons, self.sensor.full_well))))

    def mean_of_frames(self, light: Vector, rng: np.random.Generator) -> Vector:
        """(n,) DN, the mean of all frames.

        Of many pixels the mean itself is drawn: its photons and its noise have the same distribution exactly; rounding
        adds normal noise of 1/12 a frame, and the ends of the range cut off the mean instead of every frame.
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
        self, light: Vector, rng: np.random.Generator, shape: tuple[int, ...], frames: int = 1
    ) -> NDArray[np.float64] | NDArray[np.int64]:
        """Electrons of as many frames together."""
        expected = frames * self._expected(light)
        return rng.poisson(expected, shape) if self.shot else np.broadcast_to(expected, shape)

    def _expected(self, light: Vector) -> Vector:
        electrons = np.maximum(light, 0.0) * self.response + dark_electrons(self.sensor)
        return np.minimum(electrons, 2 * self.sensor.full_well + 1e6)  # certainly full; NumPy's Poisson ends somewhere

    def _digital(self, electrons: Vector) -> Vector:
        return self.sensor.gain * electrons + self.sensor.black_level

    def _in_range(self, digital: Vector) -> Vector:
        return np.clip(digital, 0.0, 2.0**self.sensor.bits - 1)


def _pixels(sensor: SensorTable, camera: Camera, sub: SubImager, response: Vector, shot: bool) -> _Pixels:
    seed = 0 if camera.tolerance is None else camera.tolerance.seed
    offset = generator(seed, "dark signal", sub).normal(0.0, sensor.dsnu, response.size)
    relative = generator(seed, "response", sub).normal(0.0, sensor.prnu, response.size)
    return _Pixels(sensor, offset, response * np.maximum(1 + relative, 0.0), shot)


def _refuse_negative(light: Vector) -> None:
    least = float(light.min(initial=0.0))
    if least < -ROUNDED * float(light.max(initial=0.0)) or not np.isfinite(light).all():
        count = int(np.sum(~(light >= 0)))
        raise InputError(
            f"a [sensor] counts the electrons of light, got light below 0 (least {least:.4g}) or no number on {count}"
            " of its pixels; take a target.image without negative values, or an ideal sensor's [noise]"
        )
