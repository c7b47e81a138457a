"""Families of hostile inputs: contents of files, options, names, and files of other kinds."""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil

from ..family import CommandFamily, FileType
from ..file_types import FILE_TYPES
from .documents import DOCUMENTS
from .names import NAMES
from .options import OPTIONS
from .pictures import PICTURES
from .special_files import SPECIAL_FILES
from .worlds import WORLDS

FAMILIES: dict[str, FileType | CommandFamily] = {
    family.name: family for family in (*FILE_TYPES, *PICTURES, *WORLDS, *DOCUMENTS, *OPTIONS, *NAMES, *SPECIAL_FILES)
}


def inputs_of(names: Iterable[str], total: int) -> dict[str, range]:
    """Return the numbers of the inputs of some families, of `total` of all families together."""
    shares = sum(family.share for family in FAMILIES.values())
    return {name: range(ceil(total * FAMILIES[name].share / shares)) for name in names}
