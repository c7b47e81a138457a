"""Streams of random numbers, all derived from the scene's seed: one for each purpose, sensor, pass and sub-imager."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Literal

import numpy as np

Purpose = Literal["data", "calibration"]


def sampler_seeds(seed: int, purpose: Purpose, number: int, passes: int) -> Callable[[int], int]:
    """Return the function from a sensor's index in the camera to its 32-bit sampler seed in pass `number` of `passes`.

    Scalar variants multiply a seed by the film's area to number their streams, so hashed seeds would collide on films
    of many pixels. Seeds counted from a start that the scene's seed draws do not; data are even, calibration odd.
    """
    start = int(np.random.SeedSequence(seed).generate_state(1)[0]) & ~1
    odd = int(purpose == "calibration")
    return lambda sensor: (start + 2 * (sensor * passes + number) + odd) % 2**32


def repeat_seed(seed: int, name: str, repeat: int) -> int:
    """Return a seed for a repeat of the measurement `name`, whose streams are independent of the scene's own."""
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(b"bench"), zlib.crc32(name.encode()), repeat))
    return int(sequence.generate_state(1, np.uint64)[0] >> np.uint64(1))


def seed_of(seed: int, start: int) -> int:
    """Return the seed of the block of rays that begins at pixel `start`: the first block has `seed` itself."""
    return seed if start == 0 else int(np.random.SeedSequence([seed, start]).generate_state(1)[0])


def seed_of_draw(seed: int, draw: int) -> int:
    """Return the seed of draw number `draw`, from 1, of rays that began with `seed`, unrelated to all others."""
    return int(np.random.SeedSequence(seed, spawn_key=(draw,)).generate_state(1)[0])


def noise_generator(seed: int, name: str, k: int, l: int) -> np.random.Generator:  # noqa: E741
    """Return the generator of sub-imager (k, l) of the lens type `name`, which no other sub-imager shares."""
    sequence = np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()), k, l))
    return np.random.Generator(np.random.PCG64DXSM(sequence))
