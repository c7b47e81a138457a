"""Streams of random numbers: one for each purpose, sub-imager and pass, the same for any number of threads.

All random numbers come from here. A stream follows from a seed, a purpose, and the indices of what it belongs to, such
as a sub-imager; streams that differ in any of them are independent (NumPy's SeedSequence). The seed is `render.seed`
for a scene's own draws, that of `camera.tolerance` for what is the camera's, and PROBES for the random vectors with
which the program checks results or averages over the prior.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from enum import IntEnum, unique
from typing import Literal, get_args

import numpy as np

Rays = Literal["data", "calibration", "truth", "white"]

PROBES = 20260401


@unique
class Purpose(IntEnum):
    """What random numbers are for. The values belong to the streams: they stay, and new purposes get new ones."""

    # of a scene's seed
    RAYS = 0  # of renderings and calibrations, see `sampler_seeds`
    NOISE = 1  # of the ideal sensor
    EXPOSURE = 2  # of the physical sensor
    DARK_FRAMES = 3
    FLAT_FRAMES = 4
    PILOT = 5  # a scene with a seed of its own
    PREDICTION = 6  # a scene with a seed of its own
    PREDICTED_IMAGE = 7
    PREDICTED_LIGHT = 8
    REPEAT = 10  # of a measurement: a scene with a seed of its own
    PAPER = 11  # noise on the tiles of a photograph
    FRACTIONS = 12  # of the photograph's pixels
    OBSERVATION = 13  # of one of several given images: a scene with a seed of its own
    # of a sampler's seed
    BLOCK = 20  # of pixels whose rays start together
    DRAW = 21  # by a ray
    # of the seed of a camera's tolerance
    TOLERANCE = 30
    DARK_SIGNAL = 31
    RESPONSE = 32
    # of PROBES
    CHECKED_PIXELS = 40  # of a dense solution
    VARIANCE_SIGNS = 41
    ROUNDING_SIGNS = 42
    REPRODUCTION = 43
    NOISE_FREE = 44  # measurements
    PRIOR_ROUNDING = 45
    ERROR_MAP = 50  # of a frame
    ERROR_PARTS = 51
    ERROR_INTERVAL = 52
    PRECONDITIONER = 54  # trial of one
    RESIDUAL = 60
    CONTRAST = 61
    ATTENUATION = 62
    SHARED_ERRORS = 63  # of few numbers of H
    SHARED_PRODUCTS = 64
    SHARED_PRIOR = 66
    DETAIL = 67
    KERNEL_ERRORS = 70
    GOAL = 71  # of a calibration
    GOAL_BOUND = 72
    RECORDED_ERRORS = 73  # of entries of H from recorded points
    STABILITY_RECORDED = 80
    STABILITY_MATRICES = 81


def stream(seed: int, purpose: Purpose, *indices: int | str) -> np.random.Generator:
    """Return the stream of a purpose; the indices, numbers or names, say what it belongs to."""
    return np.random.Generator(np.random.PCG64DXSM(_sequence(seed, purpose, *indices)))


def probe(purpose: Purpose) -> np.random.Generator:
    """Return the stream of random vectors of a check or average, which depends on no scene."""
    return stream(PROBES, purpose)


def derived_seed(seed: int, purpose: Purpose, *indices: int | str) -> int:
    """Return a seed of 63 bits for a scene of its own, none of whose streams is one of `seed`."""
    return int(_sequence(seed, purpose, *indices).generate_state(1, np.uint64)[0] >> np.uint64(1))


def sampler_seeds(seed: int, rays: Rays, number: int, passes: int) -> Callable[[int], int]:
    """Return the function from a sensor's index in the camera to its 32-bit sampler seed in pass `number` of `passes`.

    Scalar variants multiply a seed by the film's area to number their streams, so hashed seeds would collide on films
    of many pixels. Seeds counted from a start that the scene's seed draws do not; each kind of rays has every fourth.
    """
    kinds = get_args(Rays)
    start = _word(seed, Purpose.RAYS) + kinds.index(rays)
    return lambda sensor: (start + len(kinds) * (sensor * passes + number)) % 2**32


def block_seed(seed: int, start: int) -> int:
    """Return the sampler seed of the block of rays that begins at pixel `start`, unrelated to all others.

    Mitsuba numbers the streams of rays that start together by their seed plus samples times pixel: seeds a few apart
    would give a pixel the stream that its neighbour had in an earlier pass.
    """
    return _word(seed, Purpose.BLOCK, start)


def draw_seed(seed: int, draw: int) -> int:
    """Return the sampler seed of draw number `draw` of rays that began with `seed`, unrelated to all others."""
    return _word(seed, Purpose.DRAW, draw)


def _word(seed: int, purpose: Purpose, *indices: int | str) -> int:
    return int(_sequence(seed, purpose, *indices).generate_state(1)[0])


def _sequence(seed: int, purpose: Purpose, *indices: int | str) -> np.random.SeedSequence:
    """Return the sequence of a purpose; a name counts by its checksum, which is the same everywhere."""
    numbers = [zlib.crc32(index.encode()) if isinstance(index, str) else index for index in indices]
    return np.random.SeedSequence(seed, spawn_key=(int(purpose), *numbers))
