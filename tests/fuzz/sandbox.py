"""The folder of a campaign: its files, what a command changed in it, and its restoration."""

from __future__ import annotations

import os
import shutil
import stat
from pathlib import Path

import numpy as np

from ..examples import GALLERY
from .families.documents import add_documents
from .family import BASE, RUN, SCENE, escaped
from .file_types import EVERYTHING

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
    add_documents(folder)
    (folder / "spectrum.csv").write_text("wavelength,value\n500,1\n600,1\n", encoding="ascii")


class Sandbox:
    """Remembers every file of a folder, and restores it."""

    def __init__(self, folder: Path) -> None:
        """Remember the files of the folder as they are."""
        self._folder = folder
        self._entries = self.entries()
        self._contents = {path: path.read_bytes() for path, entry in self._entries.items() if stat.S_ISREG(entry[0])}

    def entries(self) -> dict[Path, Entry]:
        """Return what there is now, by path."""
        found: dict[Path, Entry] = {}
        for parent, folders, files in os.walk(self._folder):
            for path in (Path(parent, name) for name in (*folders, *files)):
                status = path.lstat()
                target = str(path.readlink()) if path.is_symlink() else ""
                size, time = (0, 0) if stat.S_ISDIR(status.st_mode) else (status.st_size, status.st_mtime_ns)
                found[path] = status.st_mode, size, time, status.st_ino, target
        return found

    def changes(self, before: dict[Path, Entry]) -> list[str]:
        """Name what was added, removed or replaced since `before`."""
        now = self.entries()
        changed = sorted(path for path in {**before, **now} if before.get(path) != now.get(path))
        return [escaped(str(path.relative_to(self._folder))) for path in changed]

    def restore(self) -> None:
        """Make the folder what it was."""
        now = self.entries()
        if now == self._entries:
            return
        for path in sorted(now, reverse=True):  # contents before their folder
            if path not in self._entries or stat.S_IFMT(now[path][0]) != stat.S_IFMT(self._entries[path][0]):
                (path.rmdir if stat.S_ISDIR(now.pop(path)[0]) else path.unlink)()
        for path, entry in sorted(self._entries.items()):
            if now.get(path) != entry and path not in self._contents:
                path.mkdir(exist_ok=True)
                path.chmod(stat.S_IMODE(entry[0]))
            elif now.get(path) != entry:
                path.unlink(missing_ok=True)
                path.write_bytes(self._contents[path])
        self._entries = self.entries()
