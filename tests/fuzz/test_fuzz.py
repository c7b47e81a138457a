"""A share of the campaign of hostile inputs, always the same; `python -m tests.fuzz` runs the whole of it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError

from .campaign import campaign, command_for
from .families import FAMILIES, inputs_of
from .families.options import HARMLESS, SLOW, commands
from .family import FileType
from .sandbox import Sandbox
from .verdicts import REFUSED, UNCHANGED, VERDICTS, CommandEnd, command_verdict
from .worker import opened

SEED = 0
INPUTS = 2000  # of all families together
MANY = 10  # inputs of a type of file, of which some are refused and some are not
GROUPS = (
    ("scene", "settings"),
    ("lens", "glasses", "places", "curve"),
    ("stack", "model"),
    ("picture", "frames"),
    ("world",),
    ("results",),
    ("options", "names", "special"),
)


def check(names: list[str], numbers: dict[str, range], finished: Path) -> None:
    """Assert that every input is refused or read for what it holds."""
    results = campaign({name: numbers[name] for name in names}, SEED, finished)
    assert not [f"{command_for(result, SEED)}: {result.verdict}" for result in results if result.wrong]
    for name in names:
        family = FAMILIES[name]
        own = [result for result in results if result.kind == name]
        verdicts = {result.verdict for result in own}
        assert [result.number for result in own] == list(numbers[name])
        if isinstance(family, FileType):
            assert len(own) < MANY or {REFUSED} < verdicts, "some damage is detected, some is harmless"
            assert not family.sealed or verdicts <= {REFUSED, UNCHANGED}


def test_a_few_hostile_inputs_of_every_family_of_files(finished: Path) -> None:
    """Command lines are run by the slow form, which has 2,000 inputs of all families."""
    names = [name for name, family in FAMILIES.items() if isinstance(family, FileType) and "world" not in name]
    check(names, dict.fromkeys(names, range(4)), finished)


@pytest.mark.slow
@pytest.mark.parametrize("group", GROUPS, ids=lambda group: re.sub(r"\W+", "-", "-".join(group)))
def test_hostile_inputs_are_refused_with_a_message_or_read_for_what_they_hold(
    group: tuple[str, ...], finished: Path
) -> None:
    names = [name for name in FAMILIES if name.startswith(group)]
    check(names, inputs_of(names, INPUTS), finished)


def test_every_family_is_in_one_group() -> None:
    assert all(sum(name.startswith(group) for group in GROUPS) == 1 for name in FAMILIES)


def test_every_command_is_tried() -> None:
    assert {*commands()} == {*HARMLESS, *SLOW}


def _fails(path: Path) -> object:
    raise KeyError(path)


def _leaves_a_file(path: Path) -> object:
    path.with_name("left.part").touch()
    raise InputError("no")


def _warns(path: Path) -> object:
    raise RuntimeWarning(path)


def _alters(path: Path) -> object:
    return path.read_bytes() + b"x"


@pytest.mark.parametrize("read", [_fails, _leaves_a_file, _warns, _alters])
def test_the_campaign_detects_errors_of_the_library(read: Callable[[Path], object], tmp_path: Path) -> None:
    (tmp_path / "sound.exr").write_bytes(b"sound")
    stack = FAMILIES["stack"]
    assert isinstance(stack, FileType)
    sound = replace(stack, read=lambda _: b"sound", damaged=lambda _, content: content + b"x", command=())
    reader = opened(sound, Sandbox(tmp_path), tmp_path)
    assert reader.verdict(0, 1) == UNCHANGED
    faulty = iter((lambda _: b"sound", read))
    reader = opened(replace(sound, read=lambda path: next(faulty)(path)), Sandbox(tmp_path), tmp_path)
    assert reader.verdict(0, 1) not in VERDICTS


def test_the_campaign_detects_errors_of_a_command() -> None:
    for code, out, err in (
        (0, "\x1b[31m", ""),
        (0, "", "warning: \u202eabc\n"),
        (2, "", "ommatid: " + "x" * 2000),
        (2, "something", "ommatid: no\n"),
        (2, "", ""),
        (1, "", "ommatid: unexpected KeyError: 'a'; set OMMATID_TRACEBACK=1\n"),
        (1, "", "ommatid: the machine\n"),
        (0, "", "/x/numpy.py:3: RuntimeWarning: overflow\n  a * b\n"),
        (0, "", "2026-01-01 00:00:00 WARN  main  [x.cpp:1] bad\n"),
        (-11, "", ""),
    ):
        assert command_verdict(CommandEnd(code, out, err), ("show",)) not in VERDICTS
