"""The table [world]: transforms as numbers, rows and steps, and what is refused."""

from __future__ import annotations

import inspect
import json
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import PlainSerializer

from ommatid.scenes.scene import Scene, parse, read, write
from ommatid.scenes.tables.world import Transform, WorldTable

from ..examples import scene

QUARTER = [[0, 0, 1, 5], [0, 1, 0, -6], [-1, 0, 0, 7], [0, 0, 0, 1]]


def table(**keys: Any) -> WorldTable:
    return WorldTable.model_validate({"file": "a.xml", **keys})


@pytest.mark.parametrize(
    "transform",
    [
        QUARTER,
        [number for row in QUARTER for number in row],
        [{"rotate": [0, 2, 0], "angle": "90 deg"}, {"translate": [5, -6, 7]}],
        [
            {"scale": 4},
            {"translate": [-7, -6, 5]},
            {"rotate": [0, 1, 0], "angle": "1.5707963267948966 rad"},
            {"scale": 0.25},
        ],
    ],
)
def test_a_transform_is_numbers_rows_or_steps(transform: list[Any]) -> None:
    """Steps apply in their order; the last case moves by a quarter of its numbers, before the rotation."""
    matrix = np.array(table(to_world=transform).to_world).reshape(4, 4)
    expected = np.array(QUARTER, dtype=float)
    if transform[0] == {"scale": 4}:
        expected[:3, 3] = 5 / 4, -6 / 4, 7 / 4
    np.testing.assert_allclose(matrix, expected, atol=1e-12)


def test_a_transform_is_written_by_a_function_with_one_argument() -> None:
    """Python 3.12.3 takes `list[float]` for a function of any arguments, of which pydantic would refuse every scene."""
    (serializer,) = (each for each in get_args(Transform) if isinstance(each, PlainSerializer))
    assert len(inspect.signature(serializer.func).parameters) == 1


def test_a_world_survives_its_files(tmp_path: Any) -> None:
    data = scene().plain()
    steps = [{"rotate": [1, 2, 3], "angle": "30 deg"}, {"translate": [0.1, 0.2, 0.3]}]
    data["world"] = {"file": "/a.xml", "unit": "m", "scale": 2.5, "to_world": steps, "white": "auto"}
    described = parse(data, tmp_path / "a.toml")
    write(tmp_path / "a.toml", described)
    assert read(tmp_path / "a.toml").world == described.world
    assert Scene.model_validate(json.loads(json.dumps(described.plain()))).world == described.world
