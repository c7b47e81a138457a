"""Extreme values of every key of the scene file: each is taken, or refused by one short sentence."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import with_changes
from ommatid.scenes.tables import toml

from ..conftest import TINY

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
