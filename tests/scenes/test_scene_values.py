"""Values of a scene file: extreme ones, dots in lists, and the table [world]."""

from __future__ import annotations

import inspect
import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import PlainSerializer

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene, parse, read, with_changes, write
from ommatid.scenes.tables import toml
from ommatid.scenes.tables.series import continued
from ommatid.scenes.tables.world import Transform, WorldTable

from ..conftest import TINY
from ..examples import scene

SENSOR = """
[sensor]
illuminance = "500 lux"
exposure = "10 ms"
[light]
spectrum = "555 nm"
"""
REAL = TINY.replace("[noise]\nvariance = 1e-2\n", SENSOR).replace(
    "pixels = [3, 3]", 'pixels = [3, 3]\naperture = "1 um"'
)
BASES = {name: toml.loads(text) for name, text in (("noise", TINY), ("sensor", REAL))}


@pytest.mark.parametrize("text", ["\udcff", "a\udcffb.png"])
@pytest.mark.parametrize("key", ["title", "target.image", "camera.lens.I.surfaces", "camera.lens.\udcff.step"])
def test_text_that_is_not_utf_8_is_refused(key: str, text: str) -> None:
    with pytest.raises(InputError, match="UTF-8"):
        with_changes(BASES["noise"], Path("s.toml"), [f"{key}={text}"], ())


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[" + ".".join("a" * 20_000) + "]", "deeper"),
        ("[" + " . ".join(['"b"'] * 20_000) + "]", "deeper"),
        ("x = " + "[" * 5000, "deeper"),
        ("x = " + "{a=" * 5000, "deeper"),
        ("x = " + "9" * 5000, "digits"),
        ("x = 0x" + "f" * 100_000, "64 bits"),
        ("x = [" + "1," * 250_000 + "]", "more than 200000 values"),
        ('x = "' + '\\"' * 50_000, "Unterminated"),
    ],
    ids=["dots", "quoted dots", "brackets", "braces", "digits", "hexadecimal", "values", "quotes"],
)
def test_toml_that_would_take_minutes_is_refused(text: str, match: str) -> None:
    with pytest.raises(ValueError, match=match) as refusal:
        toml.loads(text)
    assert len(str(refusal.value)) <= 120


def test_dots_that_are_no_keys_are_read() -> None:
    text = "curve = [" + "[400.5, 1.5], " * 3000 + ']\nprose = "' + "A. B.c. " * 3000 + '" # ' + "a." * 3000
    assert len(toml.loads("\ufeff" + text)["curve"]) == 3000


@pytest.mark.parametrize("kind", ["lens types", "sub_imager tables", "surfaces"])
def test_lists_have_a_length(kind: str) -> None:
    lens: dict[str, Any] = {**BASES["noise"]["camera"]["lens"][0]}
    lenses = [lens]
    if kind == "lens types":
        lenses = [{**lens, "name": f"L{number}", "focal_length": "1 mm"} for number in range(5000)]
    elif kind == "surfaces":
        lens["surfaces"] = [{"semi_diameter": "1 mm"}] * 5000
    else:
        lens["sub_imager"] = [{"at": [0, 0], "rotation": "1 deg"}] * 5000
    data = {**BASES["noise"], "camera": {**BASES["noise"]["camera"], "lens": lenses}}
    with pytest.raises(InputError, match=f"expected at most .* {kind}, got 5000"):
        with_changes(data, Path("s.toml"), (), ())


# --- dots in lists of values


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


# --- the table [world]


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
