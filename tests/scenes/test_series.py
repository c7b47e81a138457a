"""Dots in lists of values: equal steps, steps of the inverse, equal ratios, and what has none of them."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.scenes.tables.series import continued


@given(st.integers(-50, 50), st.integers(-9, 9).filter(bool), st.integers(4, 30))
def test_dots_are_the_numbers_that_are_left_out(first: int, step: int, count: int) -> None:
    numbers = [str(first + step * number) for number in range(count)]
    assert continued([*numbers[:2], "...", numbers[-1]]) == numbers
    if abs(step) == 1:
        assert continued([numbers[0], "...", numbers[-1]]) == numbers


@pytest.mark.parametrize(
    ("written", "means"),
    [
        ("1/3,1/4,...,1/7", "1/3,1/4,1/5,1/6,1/7"),
        ("1/2,...,1/5", "1/2,1/3,1/4,1/5"),
        ("1,...,1/3", "1,1/2,1/3"),
        ("1/2,2/5,...,1/4", "1/2,2/5,1/3,2/7,1/4"),
        ("1e-4,1e-3,…,1e-1", "1e-4,1e-3,0.01,1e-1"),
        ("1e-1,2e-1,...,5e-1", "1e-1,2e-1,0.3,0.4,5e-1"),
        ("0.1,0.2,...,0.5", "0.1,0.2,0.3,0.4,0.5"),
        ("1 mm,...,3 mm", "1 mm,2 mm,3 mm"),
        ("1,...,3,8", "1,2,3,8"),
        ("8,...,8", "no equal steps lead from 8 to 8"),
        ("1,3,...,6", "no equal steps lead from 1 and 3 to 6"),
        ("1e-4,1e-3,...,2", "no equal steps"),
        ("...,3", "dots need a value before and one after"),
        ("1,2,...", "dots need a value before and one after"),
        ("1 mm,...,3 um", "numbers of one unit, got 1 mm, 3 um"),
        ("a,...,c", "numbers of one unit"),
        ("1,...,1000000000", "at most 1000 values"),
        ("1/0,...,1/3", "a denominator is 0"),
    ],
)
def test_dots_continue_the_values_before_them(written: str, means: str) -> None:
    if means[0].isdigit():
        assert continued(written.split(",")) == means.split(",")
        return
    with pytest.raises(ValueError, match=means):
        continued(written.split(","))
