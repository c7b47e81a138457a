"""Which lens type to add: the list of candidates as it is typed, and the ranking."""

from __future__ import annotations

from fractions import Fraction

import pytest

from ommatid.analysis.design import magnifications, with_lens
from ommatid.reconstruct.prediction import predict
from ommatid.reconstruct.prior import independent
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.tables.estimation import EstimatorTable
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import GALLERY, scene
from ..runs import document


def test_candidates_are_read_as_the_usage_shows_them() -> None:
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
def test_what_is_no_list_of_candidates_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="--candidates"):
        magnifications(text)


def test_the_added_type_sees_what_it_can() -> None:
    camera = derive(with_lens(scene(), Fraction(1, 4)))
    assert [kind.name for kind in camera.types] == ["A", "added"]
    assert (camera.types[1].array, camera.types[1].pixels) == ((4, 4), (4, 4))
    twice = with_lens(with_lens(scene(), Fraction(1, 4)), Fraction(1, 5))
    assert [lens.name for lens in twice.camera.lens] == ["A", "added", "added-2"]


def test_the_ranking_is_that_of_the_predictions(ommatid: Command) -> None:
    """After one third: a fourth, then a fifth; another third and a sixth, which divide it or add little, last."""
    told = ("--lens", "I", "--set", "noise.variance=1e-2", "--candidates", "1/3,1/4,...,1/6,1/30")
    found = document(ommatid("design", GALLERY / "tile19.toml", *told, "--json"))
    names = [one["magnification"] for one in found["candidates"]]
    assert names == ["1/4", "1/5", "1/3", "1/6", "1/30"]
    assert found["candidates"][-1]["expected"] is None
    assert found["candidates"][-1]["reason"]
    both = derive(scene(lenses=(("1/3", [3, 3], [5, 5]), ("1/4", [4, 4], [4, 4]))))
    alone = predict(ideal_matrix(both), independent(127.5, 5461.25, 361), 1e-2, EstimatorTable(), (19, 19))
    assert found["candidates"][0]["expected"]["mse"] == pytest.approx(alone.mse, rel=1e-9)
    assert found["before"]["mse"] > found["candidates"][0]["expected"]["mse"]
    table = ommatid("design", GALLERY / "tile19.toml", *told)
    assert table.code == 0
    assert table.out.index("+ 1/4") < table.out.index("+ 1/5") < table.out.index("+ 1/30")
