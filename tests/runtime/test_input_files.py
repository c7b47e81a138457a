"""Files that are read: regular ones only, opened without waiting, and of limited size."""

from __future__ import annotations

import ast
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import open_input, parse_json, read_bytes, read_record, read_text

from ..modules import modules

# Modules that open files themselves, and what these are.
OWN = {
    "ommatid.runtime.input_files": "the one that opens inputs",
    "ommatid.runtime.files": "temporary files, which it writes",
    "ommatid.cli.failures": "/dev/null",
    "ommatid.cli.app": "/dev/null",
    "ommatid.runtime.outputs.occupied": "lock files, which it makes",
    "ommatid.page.document": "templates of the installation",
    "ommatid.page.cached": "modules and templates of the installation",
    "ommatid.pipeline.camera_files": "a temporary file, which it writes",
    "ommatid.batch.frames": "a file that it wrote into a folder of its own",
    "ommatid.batch.remote": "results that it wrote, and files of a world, which have been read before",
    "ommatid.bench.cost": "/proc",
    "ommatid.runtime.study": "a journal, which has been read before",
    "ommatid.runtime.machine": "/proc",
    "ommatid.scenes.tables.gallery": "scenes of the installation",
    "ommatid.scenes.formats.npz": "a stream that is open, and members of an archive",
    "ommatid.scenes.formats.picture": "pictures, which are checked before",
    "ommatid.scenes.formats.stored_picture": "/dev/null",
    "ommatid.simulate.renderer.world": "files of a world",
    "ommatid.simulate.sampling.checkpoint": "a temporary file, which it writes",
    "ommatid.reconstruct.output.estimate_formats": "temporary files, which it writes",
}
OPENING = {"read_text", "read_bytes", "load", "fromfile", "loadtxt", "genfromtxt", "memmap", "TiffFile", "copyfile"}


def opening(path: Path) -> Iterator[str]:
    """Names of the calls in a module that open a file by its path."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        if isinstance(node.func, ast.Name) and node.func.id == "open":
            yield "open"
        elif isinstance(node.func, ast.Attribute):
            base = ast.unparse(node.func.value)
            if (node.func.attr in ("read_text", "read_bytes", "open") and base != "self") or (
                node.func.attr in OPENING and base in ("np", "numpy", "json", "pickle", "tomllib")
            ):
                yield f"{base}.{node.func.attr}"


def test_no_other_module_opens_inputs() -> None:
    found = {name: [*opening(path)] for name, path in modules().items()}
    assert {name: calls for name, calls in found.items() if calls and name not in OWN} == {}


def test_other_things_than_files_are_refused_without_waiting() -> None:
    os.mkfifo("fifo")
    Path("folder").mkdir()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
    Path("device").symlink_to("/dev/zero")
    for irregular in map(Path, ("fifo", "folder", "socket", "device")):
        for read in (read_bytes, read_text):
            with pytest.raises((InputError, OSError)):
                read(irregular)
        with pytest.raises((InputError, OSError)), open_input(irregular):
            pass


def test_large_files_are_refused_before_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "large"
    with path.open("wb") as stream:
        stream.truncate(2**40)  # takes no space
    with pytest.raises(InputError, match="at most 64 MB, got a larger one"):
        read_bytes(path)
    path.write_bytes(b"12345")
    assert read_bytes(path, 5) == b"12345"
    with pytest.raises(InputError, match="larger"):
        read_bytes(path, 4)


def test_a_key_that_stands_twice_is_refused() -> None:
    document = '[{"c": 1}, {"b": {"c": 1.5, "d": 2, "c": 1e400}}]'
    with pytest.raises(ValueError, match="expected each key of a table once, got 'c' twice"):
        parse_json(document)
    Path("run.json").write_text(document, encoding="utf-8")
    with pytest.raises(InputError, match=r"^run\.json: expected each key of a table once, got 'c' twice; delete it"):
        read_record(Path("run.json"), list[Any], "a list", "delete it")


def test_a_refused_input_does_not_stay_open(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    before = set(os.listdir("/proc/self/fd"))  # noqa: PTH208
    for path in (tmp_path, tmp_path / "fifo", tmp_path / "missing"):
        with pytest.raises((InputError, OSError)):
            read_bytes(path)
    assert set(os.listdir("/proc/self/fd")) == before  # noqa: PTH208
