"""Files of the positions of point sources that were made to mislead."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.hardware.point_sources import read_positions

from ..examples import camera

FILES = [Path("a.png"), Path("b.png")]


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
