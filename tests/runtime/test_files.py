"""Writing files atomically, and results that are made again only where that is needed."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path

import pytest

from ommatid.runtime import files
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, write_csv


def read_number(path: Path) -> tuple[int, str | None]:
    document = json.loads(path.read_text(encoding="utf-8"))
    return document["number"], document["fingerprint"]


def number_for(path: Path, fingerprint: str, make: Callable[[], int]) -> tuple[int, bool]:
    def write(path: Path, number: int) -> None:
        path.write_text(json.dumps({"number": number, "fingerprint": fingerprint}), encoding="utf-8")

    return cached(path, fingerprint, read_number, make, write)


def test_a_result_is_made_once_for_each_fingerprint(tmp_path: Path) -> None:
    path = tmp_path / "number.json"
    assert number_for(path, "a", lambda: 7) == (7, True)
    assert number_for(path, "a", lambda: 8) == (7, False)
    assert number_for(path, "b", lambda: 8) == (8, True)


@pytest.mark.parametrize(
    "content", [b"", b'{"number": 7', b"[]", b"{}", b'{"number": 7, "fingerprint": null}', b"\xff"]
)
def test_a_damaged_result_is_made_again(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "number.json"
    path.write_bytes(content)
    assert number_for(path, "a", lambda: 7) == (7, True)
    assert number_for(path, "a", lambda: 8) == (7, False)


def test_an_error_of_making_is_raised_and_the_old_result_stays(tmp_path: Path) -> None:
    def make() -> int:
        raise InputError("does not work")

    path = tmp_path / "number.json"
    number_for(path, "a", lambda: 7)
    with pytest.raises(InputError, match="does not work"):
        number_for(path, "b", make)
    assert number_for(path, "a", lambda: 8) == (7, False)


def test_csv_keeps_numbers_to_the_last_digit_and_quotes_commas(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_csv(path, ("name", "number", "none"), [("a,b", 0.1 + 0.2, None), ('"', 1e-300, 3)])
    with path.open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header == ["name", "number", "none"]
    assert [(name, float(number), last) for name, number, last in rows] == [
        ("a,b", 0.1 + 0.2, ""),
        ('"', 1e-300, "3"),
    ]
    assert b"\r" not in path.read_bytes()


def test_temporary_files_of_dead_processes_are_removed_and_of_living_ones_are_not(tmp_path: Path) -> None:
    path = tmp_path / "a[1].npz"
    abandoned = tmp_path / f".0123abcd{files.PART}{path.name}"
    other = tmp_path / ".0123abcd.party"
    for left in (abandoned, other):
        left.write_bytes(b"half")

    def write(temporary: Path) -> None:
        assert not abandoned.exists()
        files.clear_abandoned(tmp_path)
        files.clear_abandoned(tmp_path, path.name)
        assert temporary.exists(), "it is being written"
        temporary.write_bytes(b"whole")

    files.write_whole(path, write)
    assert {left.name: left.read_bytes() for left in tmp_path.iterdir()} == {path.name: b"whole", other.name: b"half"}


@pytest.mark.parametrize(
    "name", ["a.npz", "x" * 251 + ".npz", "é" * 125 + ".exr", "a." + "y" * 253, "日" * 85], ids=len
)
def test_names_as_long_as_the_file_system_takes_are_written_and_cleared(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    seen: list[Path] = []

    def write(temporary: Path) -> None:
        assert temporary.name.endswith(name[-5:])
        temporary.write_bytes(b"whole")
        seen.append(temporary)

    files.write_whole(path, write)
    seen[0].write_bytes(b"half")
    (tmp_path / f"{seen[0].name[:-1]}_").write_bytes(b"of another name")
    files.clear_abandoned(tmp_path, name)
    assert len(list(tmp_path.iterdir())) == 2, "that of the same name is removed"
    files.clear_abandoned(tmp_path)
    assert [left.name for left in tmp_path.iterdir()] == [name]
    assert path.read_bytes() == b"whole"
