"""A type of file that is read: its valid originals, how these are damaged, and what is read from them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ommatid.runtime.files import digest

from ..examples import GALLERY

SCENE = "tiny.toml"  # an undamaged scene in the folder
BASE = "base.toml"  # the scene to which --set options apply
RUN = "out/tiny"  # a finished run of the scene
Originals = Callable[[Path], list[bytes]]


@dataclass(frozen=True)
class FileType:
    """A type of file.

    file : its name in the folder;  originals : valid contents, from the files of that folder
    damaged : returns damaged contents;  read : returns a value that is equal for equal contents
    command : the command line that reads the file, if any
    sealed : True if a checksum reveals every change
    expected : the value that `read` must return for contents that an independent decoder understands, else None
    share : number of inputs relative to other types
    """

    name: str
    file: str
    originals: Originals
    damaged: Callable[[Random, bytes], bytes]
    read: Callable[[Path], object]
    command: tuple[str, ...]
    sealed: bool = False
    expected: Callable[[bytes], object] | None = None
    share: float = 1.0

    def input(self, seed: int, number: int, originals: list[bytes]) -> tuple[int, bytes]:
        """Return the index of the original and its damaged content."""
        rng = Random(f"{self.name} {seed} {number}")
        index = rng.randrange(len(originals))
        return index, self.damaged(rng, originals[index])


def fingerprint(*parts: Any) -> str:
    """Return a hash of arrays and other values."""
    total = hashlib.sha256()
    for part in parts:
        total.update((digest(part) if isinstance(part, np.ndarray) else repr(part)).encode())
    return total.hexdigest()


def gallery_files(pattern: str, *more: bytes) -> Originals:
    """The files of the gallery that match, and further contents."""
    return lambda _: [*more, *(path.read_bytes() for path in sorted(GALLERY.glob(pattern)))]


def from_folder(name: str) -> Originals:
    """A file of the folder, made by a finished run."""
    return lambda folder: [(folder / name).read_bytes()]
