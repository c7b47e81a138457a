"""Maps of the sub-imagers of each lens type by how well the others predict them, for the page."""

from __future__ import annotations

from dataclasses import dataclass

from ommatid.reconstruct.output.run_json import HeldOutEntry, HeldOutReport

from .table import entry_words

LARGEST = 24  # rows and columns of an array that a map shows
FAINT, FULL = 1.5, 8.0  # z from which a cell is coloured, and of the strongest colour
STRONGEST = 0.7  # so that the text stays legible


@dataclass(frozen=True)
class SubImagerCell:
    """A cell of a map: z as text, the strength of its colour (0 to 1), whether it is named, and all in words."""

    text: str
    strength: float
    named: bool
    words: str


@dataclass(frozen=True)
class LensTypeMap:
    """The cells of a lens type, by rows k and columns l; no rows where the array is too large for a map."""

    name: str
    rows: tuple[tuple[SubImagerCell, ...], ...]


def lens_type_maps(report: HeldOutReport) -> list[LensTypeMap]:
    """Return a map for every lens type, in their order."""
    maps: list[LensTypeMap] = []
    for name in dict.fromkeys(entry.type for entry in report.sub_imagers):
        entries = [entry for entry in report.sub_imagers if entry.type == name]
        lines = max(entry.k for entry in entries) + 1
        columns = len(entries) // lines
        shown = range(lines) if max(lines, columns) <= LARGEST else range(0)
        rows = tuple(tuple(_cell(entry) for entry in entries[k * columns : (k + 1) * columns]) for k in shown)
        maps.append(LensTypeMap(name, rows))
    return maps


def _cell(entry: HeldOutEntry) -> SubImagerCell:
    if entry.z is None:
        return SubImagerCell("\N{EN DASH}", 0.0, False, f"{entry.name}: not predicted")
    z = "0.0" if -0.05 < entry.z < 0 else f"{entry.z:.1f}".replace("-", "\N{MINUS SIGN}")
    strength = STRONGEST * min(max(entry.z - FAINT, 0.0) / (FULL - FAINT), 1.0)
    return SubImagerCell(z, strength, entry.named, f"{entry.name}: {entry_words(entry)}")
