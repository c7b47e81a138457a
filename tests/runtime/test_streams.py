"""Streams of random numbers: none is drawn from twice, and they are the same everywhere."""

from __future__ import annotations

from itertools import combinations
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from ommatid.runtime.streams import Purpose, Rays, block_seed, derived_seed, draw_seed, probe, sampler_seeds, stream

from ..examples import familywise

Indices = tuple[int | str, ...]
OWNERS: tuple[Indices, ...] = ((), ("I", 0, 1), ("II", 0, 1), ("I", 1, 0), ("I", 0, 2**16))


def first(seed: int, purpose: Purpose, *indices: int | str) -> int:
    """The first 64 bits of a stream."""
    return int(stream(seed, purpose, *indices).bit_generator.random_raw())


def test_streams_differ_in_seed_purpose_and_every_index() -> None:
    seeds = (0, 1, 2**32, 2**63 - 1)
    drawn = [first(seed, purpose, *owner) for seed in seeds for purpose in Purpose for owner in OWNERS]
    drawn += [int(probe(purpose).bit_generator.random_raw()) for purpose in Purpose]
    assert len(set(drawn)) == len(drawn)
    assert first(3, Purpose.NOISE, "I", 0, 1) == first(3, Purpose.NOISE, "I", 0, 1)


def test_streams_are_the_same_with_every_version_and_on_every_machine() -> None:
    """SeedSequence and the bits of its generators are promised by NumPy; names and purposes count by fixed numbers."""
    assert first(0, Purpose.NOISE, "I", 0, 1) == 6610329780133982695
    assert derived_seed(5, Purpose.REPEAT, "right", 2) == 628045271490658983
    assert sampler_seeds(7, "calibration", 2, 16)(3) == 1201125663


def test_streams_are_not_correlated() -> None:
    """Products of normal numbers of any two streams add up to no more than chance."""
    drawn = [stream(0, purpose).normal(size=10_000) for purpose in Purpose]
    largest = max(abs(float(one @ other)) / one.size**0.5 for one, other in combinations(drawn, 2))
    assert largest < stats.norm.isf(familywise(len(drawn) * (len(drawn) - 1) // 2) / 2)


@pytest.mark.parametrize("area", [1, 25, 64 * 64])
def test_samplers_never_share_a_seed(area: int) -> None:
    """Within a scene by construction; and not after a scalar variant has multiplied them by a film's area either."""
    passes = {"data": 16, "calibration": 24, "truth": 17, "white": 1}
    kinds: tuple[Rays, ...] = get_args(Rays)
    seeds = [
        sampler_seeds(3, kind, number, passes[kind])(sensor) * area % 2**32
        for kind in kinds
        for number in range(passes[kind])
        for sensor in range(50)
    ]
    assert len(set(seeds)) == len(seeds)
    assert sampler_seeds(3, "data", 0, 16)(0) != sampler_seeds(4, "data", 0, 16)(0)


def test_seeds_of_samplers_end_within_32_bits_and_stay_apart() -> None:
    """Also where counting goes beyond 32 bits."""
    kinds: tuple[Rays, ...] = get_args(Rays)
    remainders = [{sampler_seeds(9, kind, 0, 1)(sensor) % 4 for sensor in range(0, 2**31, 2**20)} for kind in kinds]
    assert all(len(found) == 1 for found in remainders)
    assert len(set[int]().union(*remainders)) == len(kinds)
    assert max(sampler_seeds(9, "data", 0, 1)(sensor) for sensor in range(0, 2**31, 2**20)) < 2**32


def test_blocks_and_draws_have_seeds_of_their_own() -> None:
    seeds = [11, *(block_seed(11, start) for start in range(100)), *(draw_seed(11, draw) for draw in range(1, 100))]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**32 for seed in seeds)
    assert np.ptp(seeds) > 2**31, "all over the 32 bits"
