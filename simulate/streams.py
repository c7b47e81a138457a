"""Streams of random numbers, one for every purpose, lens type, pass and sub-imager, all from the scene's seed."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from typing import Literal

import numpy as np

Purpose = Literal["data", "calibration", "noise"]
_PURPOSES: dict[Purpose, int] = {"data": 0, "calibration": 1, "noise": 2}


def _sequence(seed: int, purpose: Purpose, name: str, *place: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(_PURPOSES[purpose], zlib.crc32(name.encode()), *place))


def sampler_seed(seed: int, purpose: Purpose, name: str, number: int) -> int:
    """32 bits for the sampler of pass `number` over the sensors called `name`."""
    return int(_sequence(seed, purpose, name, number).generate_state(1)[0])


def sampler_seeds(seed: int, purpose: Purpose, names: Iterable[str]) -> dict[str, int]:
    """The seeds of the first pass over each of the named sensors, for the record of a run."""
    return {name: sampler_seed(seed, purpose, name, 0) for name in names}


def generator(seed: int, purpose: Purpose, name: str, *place: int) -> np.random.Generator:
    """A generator that no other purpose, name or place shares."""
    return np.random.Generator(np.random.PCG64DXSM(_sequence(seed, purpose, name, *place)))
