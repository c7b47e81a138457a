"""Candidate lens types: reading the option, adding a type, and the ranking."""

from __future__ import annotations

from fractions import Fraction

import pytest

from ommatid.analysis.design import magnifications, with_lens
from ommatid.analysis.predict import predict_scene
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive

from ..conftest import Command
from ..examples import GALLERY, scene
from ..runs import document


def test_lists_of_magnifications() -> None:
    assert magnifications("1/2,1/3,...,1/9") == [Fraction(1, m) for m in range(2, 10)]
    assert magnifications("1, 2/5 ,1/4") == [1, Fraction(2, 5), Fraction(1, 4)]
    assert magnifications("1/2,2/5,...,1/4") == [
        Fraction(1, 2),
        Fraction(2, 5),
        Fraction(1, 3),
        Fraction(2, 7),
        Fraction(1, 4),
    ]
    assert magnifications("1/3,1/3") == [Fraction(1, 3)]


@pytest.mark.parametrize(
    "text", ["", "3", "0", "x", "1/0", "1/2,...,1/9", "1/2,1/3,...", "1/3,1/2,...,1/9", "1/2,1/4,...,1/9"]
)
def test_malformed_lists_of_magnifications_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="--candidates"):
        magnifications(text)


def test_the_added_type_is_as_large_as_fits() -> None:
    camera = derive(with_lens(scene(), Fraction(1, 4)))
    assert [lens_type.name for lens_type in camera.types] == ["A", "added"]
    assert (camera.types[1].array, camera.types[1].pixels) == ((4, 4), (4, 4))
    twice = with_lens(with_lens(scene(), Fraction(1, 4)), Fraction(1, 5))
    assert [lens.name for lens in twice.camera.lens] == ["A", "added", "added-2"]


def test_the_ranking_follows_the_predictions(ommatid: Command) -> None:
    """After one third: a fourth, then a fifth; another third and a sixth, which divide it or add little, last."""
    options = ("--lens", "I", "--set", "noise.variance=1e-2", "--candidates", "1/3,1/4,...,1/6,1/30")
    design = document(ommatid("design", GALLERY / "tile19.toml", *options, "--json"))
    names = [candidate["magnification"] for candidate in design["candidates"]]
    assert names == ["1/4", "1/5", "1/3", "1/6", "1/30"]
    assert design["candidates"][-1]["expected"] is None
    assert design["candidates"][-1]["reason"]
    both = scene(
        lenses=(("1/3", [3, 3], [5, 5]), ("1/4", [4, 4], [4, 4])), noise={"variance": 1e-2}, prior={"level": "known"}
    )
    alone = predict_scene(both, rays=False)
    assert design["candidates"][0]["expected"]["mse"] == pytest.approx(alone.mse, rel=1e-9)
    assert design["before"]["mse"] > design["candidates"][0]["expected"]["mse"]
    table = ommatid("design", GALLERY / "tile19.toml", *options)
    assert table.code == 0
    assert table.out.index("+ 1/4") < table.out.index("+ 1/5") < table.out.index("+ 1/30")
