"""A family of hostile command lines, with the files that they need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random


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
