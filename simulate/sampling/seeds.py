"""Streams of random numbers, one for every purpose, sensor, pass and sub-imager, all from the scene's seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Literal

import numpy as np

Purpose = Literal["data", "calibration"]


def sampler_seeds(seed: int, purpose: Purpose, number: int, passes: int) -> Callable[[int], int]:
    """The sampler's 32 bits in pass `number` of `passes` for each sensor, by its place in the camera.

    Scalar variants multiply a seed by the film's area to number their streams, so hashed seeds would collide on films
    of many pixels. Counted on from a start that the scene's seed draws they cannot; data are even, calibration odd.
    """
    start = int(np.random.SeedSequence(seed).generate_state(1)[0]) & ~1
    odd = int(purpose == "calibration")
    return lambda sensor: (start + 2 * (sensor * passes + number) + odd) % 2**32


def repeat_seed(seed: int, what: str, repeat: int) -> int:
    """A seed as a scene's for repeat `repeat` of a measurement called `what`: its streams are none of the scene's."""
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(b"bench"), zlib.crc32(what.encode()), repeat))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of(seed: int, start: int) -> int:
    """Of a block: the first has the seed itself, the others what it makes of where they begin."""
    return seed if start == 0 else int(np.random.SeedSequence([seed, start]).generate_state(1)[0])


def noise_generator(seed: int, name: str, k: int, l: int) -> np.random.Generator:  # noqa: E741
    """The generator of sub-imager (k, l) of the lens type `name`, which no other shares."""
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()), k, l))
    return np.random.Generator(np.random.PCG64DXSM(sequence))
