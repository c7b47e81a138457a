"""Families of hostile inputs: a type of file that is read, with its valid originals and their damage; command lines."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ommatid.runtime.files import digest

from ..modules import tracked

SCENE = "tiny.toml"  # an undamaged scene in the folder
BASE = "base.toml"  # the scene to which --set options apply
RUN = "out/tiny"  # a finished run of the scene
PARTIAL = f"{RUN}/.stack.exr.partial.npz"  # an interrupted rendering
Originals = Callable[[Path], list[bytes]]


@dataclass(frozen=True)
class FileType:
    """A type of file.

    file : its name in the folder;  originals : valid contents, from the files of that folder
    damaged : returns damaged contents;  read : returns what is read, with the same `fingerprint` for equal contents
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


@dataclass(frozen=True)
class CommandCase:
    """A command line, run in the folder of the campaign.

    refused : True if it must be refused, False if it must work, None if either is right
    outputs : beginnings of the names of files that it may write if it is not refused
    finished : beginnings of the names of files that may have changed before it is refused: what is finished stays
    kept : name of a file that is not to be replaced by a command that is refused
    """

    words: tuple[str, ...]
    refused: bool | None = None
    outputs: tuple[str, ...] = ("new",)
    finished: tuple[str, ...] = ()
    kept: str = ""


@dataclass(frozen=True)
class CommandFamily:
    """Hostile command lines.

    case : makes one, and the files that it needs in a folder
    harmless : command lines that work and import what the hostile ones need
    share : number of inputs relative to other families
    """

    name: str
    case: Callable[[Random, Path], CommandCase]
    harmless: tuple[tuple[str, ...], ...] = ()
    share: float = 1.0


def fingerprint(content: Any) -> str:
    """Return a hash of an array, of another value, or of several in a list or tuple."""
    if isinstance(content, list | tuple):
        return hashlib.sha256("".join(map(fingerprint, content)).encode()).hexdigest()
    return digest(content) if isinstance(content, np.ndarray) else repr(content)


def escaped(name: str) -> str:
    """Return a name, which need not be UTF-8, in ASCII."""
    return name.encode("unicode_escape").decode()


def gallery_files(pattern: str, *more: bytes) -> Originals:
    """The files of the gallery that match, and further contents."""
    return lambda _: [*more, *(path.read_bytes() for path in tracked(f"ommatid/scenes/{pattern}"))]


def from_folder(name: str) -> Originals:
    """A file of the folder, made by a finished run."""
    return lambda folder: [(folder / name).read_bytes()]
