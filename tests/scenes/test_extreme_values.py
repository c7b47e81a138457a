"""Extreme values of every key of the scene file: each is taken, or refused by one short sentence."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, with_changes
from ommatid.scenes.tables import toml
from ommatid.scenes.tables.messages import known_keys

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
LONGEST = 300  # characters of a refusal
EXTREME = {
    "zero": "0",
    "negative": "-1",
    "largest float": "1e308",
    "beyond floats": "1e400",
    "infinite": "inf",
    "not a number": "nan",
    "63 bits": str(2**63),
    "negative 64 bits": str(-(2**64)),
    "most digits": str(2**63 - 1),
    "5000 digits": "9" * 5000,
    "text of nothing": '""',
    "NUL": r'"\u0000"',
    "escape": r'"\u001b[2J"',
    "long text": "x" * 10_000,
    "long length": '"' + "9" * 3000 + ' mm"',
    "huge length": '"1e300 mm"',
    "tiny length": '"1e-300 mm"',
    "power": '"9**9**9 mm"',
    "ratio": '"1/99999999999999999999"',
    "nested": "[" * 30 + "]" * 30,
    "unclosed": "[" * 4000,
    "table": "{a = {b = 1}}",
    "date": "1979-05-27T07:32:00Z",
    "huge pair": f"[{2**62}, {2**62}]",
    "long list": str([1] * 1000),
    "long pairs": str([[1, 1]] * 500),
    "true": "true",
}


def keys() -> list[str]:
    """Every key of the scene file, as --set names it, but for those inside lists of surfaces and of sub-imagers."""
    dotted = [key for key in known_keys(Scene) if not re.search(r"\.(surfaces|sub_imager)\.", key)]
    return [key.replace("camera.lens.", "camera.lens.I.") for key in dotted]


@pytest.mark.parametrize("value", EXTREME.values(), ids=EXTREME.keys())
def test_every_key_takes_a_value_or_refuses_it_in_a_short_sentence(value: str) -> None:
    source = Path("s.toml")
    for key in keys():
        base = BASES["sensor" if key.startswith(("sensor", "light")) else "noise"]
        try:
            derive(with_changes(base, source, [f"{key}={value}"], ()))
        except InputError as error:
            sentence = str(error)
            assert sentence.startswith(("s.toml: ", str(Path.cwd()))), sentence  # those of files name the file
            assert len(sentence) <= LONGEST, sentence


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
