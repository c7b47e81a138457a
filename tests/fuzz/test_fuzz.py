"""A share of the campaign of damaged inputs, always the same; `python -m tests.fuzz` runs the whole of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError

from .campaign import REFUSED, UNCHANGED, VERDICTS, campaign, command_for, damaged, prepare, verdict_on
from .file_types import FILE_TYPES

SEED = 0
INPUTS = 100  # of each type, but of those in containers written anew, many of which are valid and reconstructed:
RESEALED_INPUTS = 40
FAMILIES = (
    ("scene", "settings"),
    ("lens, ZMX",),
    ("lens, TOML", "lens, keys", "lens, rows", "glasses", "places", "world", "curve"),
    ("stack", "model"),
    ("picture", "frames"),
)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: re.sub(r"\W+", "-", "-".join(family)))
def test_damaged_inputs_are_refused_with_a_message_or_read_for_what_they_hold(
    family: tuple[str, ...], finished: Path
) -> None:
    names = [name for name in FILE_TYPES if name.startswith(family)]
    numbers = {name: range(RESEALED_INPUTS if "resealed" in name else INPUTS) for name in names}
    results = campaign(numbers, SEED, finished)
    assert not [f"{command_for(result, SEED)}: {result.verdict}" for result in results if result.wrong]
    for name in names:
        group = [result for result in results if result.kind == name]
        verdicts = {result.verdict for result in group}
        assert [result.number for result in group] == list(numbers[name])
        assert {REFUSED} < verdicts, "some damage is detected, some is harmless"
        if FILE_TYPES[name].sealed:
            assert verdicts == {REFUSED, UNCHANGED}


def test_every_file_type_is_in_a_family() -> None:
    assert all(name.startswith(sum(FAMILIES, ())) for name in FILE_TYPES)


def test_an_input_is_determined_by_seed_and_number(finished: Path, tmp_path: Path) -> None:
    prepare(tmp_path, finished)
    for name, file_type in FILE_TYPES.items():
        originals = file_type.originals(tmp_path)
        first, again, other = (
            [damaged(file_type, seed, number, originals) for number in range(3)] for seed in (7, 7, 8)
        )
        assert first != other
        if "resealed" not in name:  # containers written anew hold the time of day
            assert first == again


def test_a_process_that_dies_counts_against_its_input(finished: Path) -> None:
    results = campaign({"no such type": range(2)}, SEED, finished)
    assert [result.number for result in results] == [0, 1]
    assert all(result.wrong and "no such type" in result.verdict for result in results)


def _fails(path: Path) -> object:
    raise KeyError(path)


def _refuses_at_length(path: Path) -> object:
    raise InputError(f"{path} " + "x" * 5000)


def _leaves_a_file(path: Path) -> object:
    path.with_name("left.part").touch()
    raise InputError("no")


def _warns(path: Path) -> object:
    raise RuntimeWarning(path)


def _alters(path: Path) -> object:
    return path.read_bytes() + b"x"


@pytest.mark.parametrize("read", [_fails, _refuses_at_length, _leaves_a_file, _warns, _alters])
def test_the_campaign_detects_errors_of_the_program(read: Callable[[Path], object], tmp_path: Path) -> None:
    file_type = replace(FILE_TYPES["stack"], read=read, command=())
    assert verdict_on(file_type, tmp_path / "d.exr", b"damaged", b"sound", 1) not in VERDICTS
    sound = replace(file_type, read=lambda _: b"sound")
    assert verdict_on(sound, tmp_path / "d.exr", b"damaged", b"sound", 1) == UNCHANGED
