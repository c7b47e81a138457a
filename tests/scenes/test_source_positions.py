"""Files of the positions of point sources that were made to mislead."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.hardware.point_sources import read_positions

from ..examples import camera

FILES = [Path("a.png"), Path("b.png")]
NINES = "9" * 5000


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (f"0,{NINES},1", "line 2: expected a whole number as its row"),
        (f"0,1,-{NINES}", "line 2: expected a whole number as its column"),
        (f"{NINES},1,1", "line 2: expected an image"),
        ("0,1,1\n1,1,1\n0,1,1", "line 4: row 1, column 1 is given twice"),
        ("0,1e400,1", "line 2: expected a whole number"),
        ("0,\u0661\u0662,100", "lies outside f"),
        ("0,1", "line 2: expected an image, a row and a column, got fewer"),
        ('0,"1,1\n' * 100_000, "could not be read as a CSV file|expected a whole number|got fewer"),
        ("\0,1,1", "."),
    ],
    ids=["row", "column", "image", "twice", "exponent", "digits", "fewer", "quote", "NUL"],
)
def test_misleading_lines_are_refused_in_a_short_sentence(text: str, match: str, tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text(f"\ufeffimage,row,column\n{text}\n", encoding="utf-8")
    with pytest.raises(InputError, match=match) as refusal:
        read_positions(path, camera(), FILES)
    assert len(str(refusal.value).replace(str(path), "")) <= 300


def test_files_without_an_end_are_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    with (tmp_path / "sparse").open("wb") as stream:
        stream.truncate(2**40)
    (tmp_path / "header").write_text("image,row,column" + ",x" * 60_000, encoding="utf-8")
    (tmp_path / "bytes").write_bytes(b"image,row,column\n\xff,1,1\n")
    for name in ("fifo", "sparse", "header", "bytes", "none"):
        with pytest.raises(InputError) as refusal:
            read_positions(tmp_path / name, camera(), FILES)
        assert len(str(refusal.value).replace(str(tmp_path), "")) <= 300


def test_many_positions_take_no_longer_each(tmp_path: Path) -> None:
    places = camera()
    cells = [(row, column) for row in range(places.rows) for column in range(places.columns)]
    lines = [f"{image},{row},{column}" for image in range(2) for row, column in cells]
    (tmp_path / "p.csv").write_text("\n".join(["image,row,column", *lines]), encoding="utf-8")
    positions = read_positions(tmp_path / "p.csv", places, FILES)
    assert [each.tolist() for each in positions] == [[[*cell] for cell in cells]] * 2
