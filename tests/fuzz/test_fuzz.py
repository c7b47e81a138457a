"""A short campaign of damaged inputs of every kind, always the same; `python -m tests.fuzz` runs a long one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError

from .campaign import ANOTHER, REFUSED, UNCHANGED, again, campaign, damaged, judged, prepare
from .kinds import KINDS

SEED = 0
INPUTS = 100
OF_FEWER = {name: 40 for name in KINDS if "anew" in name}  # of which many are valid, and reconstructed
FAMILIES = (("scene", "settings"), ("lens", "places", "world"), ("stack", "model"), ("picture", "frames"))


@pytest.mark.parametrize("family", FAMILIES, ids="-".join)
def test_damaged_inputs_are_refused_in_a_sentence_or_read_for_what_they_hold(
    family: tuple[str, ...], finished: Path
) -> None:
    wanted = {name: range(OF_FEWER.get(name, INPUTS)) for name in KINDS if name.startswith(family)}
    results = campaign(wanted, SEED, finished)
    assert not [f"{again(one, SEED)}: {one.verdict}" for one in results if one.wrong]
    for name, numbers in wanted.items():
        mine = [one for one in results if one.kind == name]
        assert [one.number for one in mine] == list(numbers)
        assert {REFUSED} < {one.verdict for one in mine}
        if KINDS[name].sealed:
            assert {one.verdict for one in mine} == {REFUSED, UNCHANGED}


def test_every_kind_is_in_the_short_campaign() -> None:
    assert all(name.startswith(sum(FAMILIES, ())) for name in KINDS)


def test_an_input_is_known_by_its_seed_and_number(finished: Path, tmp_path: Path) -> None:
    prepare(tmp_path, finished)
    for name, kind in KINDS.items():
        originals = kind.originals(tmp_path)
        if "anew" not in name:  # whose containers hold the time of day
            assert [damaged(kind, 7, n, originals) for n in range(9)] == [
                damaged(kind, 7, n, originals) for n in range(9)
            ]
        assert [damaged(kind, 7, n, originals) for n in range(3)] != [damaged(kind, 8, n, originals) for n in range(3)]


def test_a_process_that_dies_counts_against_its_input(finished: Path) -> None:
    results = campaign({"no such kind": range(2)}, SEED, finished)
    assert [one.number for one in results] == [0, 1]
    assert all(one.wrong and "no such kind" in one.verdict for one in results)


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
def test_the_campaign_notices_what_it_looks_for(read: Callable[[Path], object], tmp_path: Path) -> None:
    kind = replace(KINDS["stack"], read=read, command=())
    assert judged(kind, tmp_path / "d.exr", b"damaged", b"sound", 1) not in (REFUSED, UNCHANGED, ANOTHER)
    fine = replace(kind, read=lambda _: b"sound")
    assert judged(fine, tmp_path / "d.exr", b"damaged", b"sound", 1) == UNCHANGED
