"""Candidate lens types: reading their magnifications, and adding one to a scene."""

from __future__ import annotations

from fractions import Fraction

import pytest

from ommatid.analysis.design import magnifications, with_lens
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive

from ..examples import scene


def test_lists_of_magnifications() -> None:
    assert magnifications("1/2,1/3,...,1/9") == [Fraction(1, m) for m in range(2, 10)] == magnifications("1/2,...,1/9")
    assert magnifications("1, 2/5 ,1/4") == [1, Fraction(2, 5), Fraction(1, 4)]
    assert magnifications("1/2,2/5,...,1/4") == [1 / Fraction(half, 2) for half in range(4, 9)]
    assert magnifications("1/3,1/3") == [Fraction(1, 3)]


@pytest.mark.parametrize("text", ["", "3", "0", "x", "1/0", "...,1/9", "1/2,1/3,...", "1/2,1/4,...,1/9"])
def test_malformed_lists_of_magnifications_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"design\.magnifications"):
        magnifications(text)


def test_the_added_type_is_as_large_as_fits() -> None:
    camera = derive(with_lens(scene(), Fraction(1, 4)))
    assert [lens_type.name for lens_type in camera.types] == ["A", "added"]
    assert (camera.types[1].array, camera.types[1].pixels) == ((4, 4), (4, 4))
    twice = with_lens(with_lens(scene(), Fraction(1, 4)), Fraction(1, 5))
    assert [lens.name for lens in twice.camera.lens] == ["A", "added", "added-2"]
