"""The folder of a campaign: its files, what a command changed in it, and its restoration."""

# Names are bytes, which need not be UTF-8.
# ruff: noqa: PTH101, PTH103, PTH106, PTH108, PTH112, PTH114, PTH115, PTH118, PTH123
from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

import numpy as np

from ..examples import GALLERY
from .families.documents import add_documents
from .family import BASE, RUN, SCENE
from .file_types import EVERYTHING

SMALL = 1 << 20  # bytes
Entry = tuple[int, int, int, int, str]  # type, size, time of change, inode, target of a link


def prepare(folder: Path, finished: Path) -> None:
    """Write the files that inputs refer to; `finished` is the folder of a finished run of the tiny scene."""
    (folder / SCENE).write_bytes((finished.parent.parent / SCENE).read_bytes())
    for name in ("lenses", "worlds"):
        shutil.copytree(GALLERY / name, folder / name)
    (folder / BASE).write_text(EVERYTHING, encoding="utf-8")
    for name in ("stack.exr", "model.npz"):
        shutil.copy(finished / name, folder / f"sound{Path(name).suffix}")
    shutil.copytree(finished, folder / RUN)
    np.save(folder / "mosaic.npy", np.full((400, 400), 100, np.uint16))
    np.save(folder / "picture.npy", np.arange(400, dtype=np.uint8).reshape(20, 20) % 251)
    add_documents(folder)
    (folder / "spectrum.csv").write_text("wavelength,value\n500,1\n600,1\n", encoding="ascii")


class Sandbox:
    """Remembers every file of a folder, and restores it."""

    def __init__(self, folder: Path) -> None:
        """Remember the files of the folder as they are."""
        self.folder = os.fsencode(folder)
        self._contents: dict[bytes, bytes] = {}
        self._entries = _entries(self.folder)
        for name, entry in self._entries.items():
            if stat.S_ISREG(entry[0]):
                self._contents[name] = _read(os.path.join(self.folder, name))

    def entries(self) -> dict[bytes, Entry]:
        """Return what there is now, by name."""
        return _entries(self.folder)

    def contents(self) -> dict[bytes, bytes]:
        """Return the contents of all regular files of less than a megabyte, by name."""
        return {
            name: _read(os.path.join(self.folder, name))
            for name, entry in self.entries().items()
            if stat.S_ISREG(entry[0]) and entry[1] < SMALL
        }

    def changes(self, before: dict[bytes, Entry]) -> list[str]:
        """Name what was added, removed or replaced since `before`."""
        now = self.entries()
        names = [name for name in {**before, **now} if before.get(name) != now.get(name)]
        return [os.fsdecode(name).encode("unicode_escape").decode() for name in sorted(names)]

    def restore(self) -> None:
        """Make the folder what it was."""
        now = self.entries()
        if now == self._entries:
            return
        for name in sorted(now, reverse=True):  # contents before their folder
            if name not in self._entries or stat.S_IFMT(now[name][0]) != stat.S_IFMT(self._entries[name][0]):
                _remove(os.path.join(self.folder, name))
                del now[name]
        for name, entry in sorted(self._entries.items()):
            if now.get(name) == entry:
                continue
            path = os.path.join(self.folder, name)
            if stat.S_ISDIR(entry[0]):
                os.makedirs(path, exist_ok=True)
                os.chmod(path, stat.S_IMODE(entry[0]))
            elif name in self._contents:
                _write(path, self._contents[name])
        self._entries = self.entries()


def _entries(folder: bytes) -> dict[bytes, Entry]:
    entries: dict[bytes, Entry] = {}
    waiting = [b""]
    while waiting:
        inner = waiting.pop()
        for found in os.scandir(os.path.join(folder, inner)):
            name = os.path.join(inner, found.name)
            status = found.stat(follow_symlinks=False)
            if stat.S_ISDIR(status.st_mode):
                entries[name] = status.st_mode, 0, 0, status.st_ino, ""
                waiting.append(name)
                continue
            target = os.fsdecode(os.readlink(found.path)) if stat.S_ISLNK(status.st_mode) else ""
            entries[name] = status.st_mode, status.st_size, status.st_mtime_ns, status.st_ino, target
    return entries


def _remove(path: bytes) -> None:
    if os.path.isdir(path) and not os.path.islink(path):
        os.rmdir(path)
    else:
        os.unlink(path)


def _read(path: bytes) -> bytes:
    with open(path, "rb") as stream:
        return stream.read()


def _write(path: bytes, content: bytes) -> None:
    if os.path.lexists(path):
        os.unlink(path)
    with open(path, "wb") as stream:
        stream.write(content)
