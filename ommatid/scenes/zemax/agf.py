"""Glass catalogues of Zemax (AGF), as glass makers publish them.

A glass begins with a line `NM name formula ...`; its line `CD` holds the coefficients of the formula, and `LD` the
shortest and the longest wavelength in micrometres. All other lines are ignored. A glass is checked when it is used, so
that a catalogue may hold glasses that cannot be read.
"""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from ommatid.runtime.errors import InputError, shortened

from ..tables.messages import explain
from .dispersion import COEFFICIENTS, Dispersion
from .text import number, read_text


@dataclass(frozen=True)
class Catalogue:
    """A glass catalogue: for each glass, by its name, the number of its line NM, and the words of NM, CD and LD."""

    path: Path
    entries: dict[str, tuple[int, dict[str, list[str]]]]

    def find(self, name: str) -> str | None:
        """Return the catalogue's own spelling of a name, None if it has no such glass."""
        if name in self.entries:
            return name
        folded = {other.casefold(): other for other in reversed(self.entries)}
        return folded.get(name.casefold())

    def nearest(self, name: str) -> str | None:
        """Return the name of a glass of the catalogue that resembles `name`, None if none does."""
        folded = {other.casefold(): other for other in reversed(self.entries)}
        near = difflib.get_close_matches(name.casefold()[:80], folded, n=1)
        return folded[near[0]] if near else None

    def dispersion(self, name: str) -> Dispersion:
        """Return the dispersion of a glass of the catalogue. Raises InputError for a damaged entry."""
        line, words = self.entries[name]
        where = f"{self.path}, line {line}, glass {shortened(name)}"
        for keyword, fewest in (("NM", 2), ("CD", 1), ("LD", 2)):
            if len(words.get(keyword, [])) < fewest:
                raise InputError(f"{where}: expected a line {keyword} with {fewest} values or more, got fewer")
        formula = number(words["NM"][1], where, "the number of its formula")
        coefficients = [number(word, where, "a coefficient") for word in words["CD"][:COEFFICIENTS]]
        shortest, longest = (number(word, where, "a wavelength in micrometres") for word in words["LD"][:2])
        data = {
            "formula": int(formula),
            "coefficients": coefficients,
            "shortest": f"{shortest!r} um",
            "longest": f"{longest!r} um",
        }
        try:
            return Dispersion.model_validate(data)
        except ValidationError as error:
            raise InputError(f"{where}: {explain(error, data, Dispersion)}") from error


def read_catalogue(path: Path) -> Catalogue:
    """Read a glass catalogue. Raises InputError that names the file."""
    entries: dict[str, tuple[int, dict[str, list[str]]]] = {}
    words: dict[str, list[str]] = {}
    for line, text in enumerate(read_text(path, "glass catalogue").splitlines(), start=1):
        keyword, *rest = text.split(maxsplit=1) or [""]
        if keyword == "NM" and rest:
            words = {"NM": rest[0].split()}
            entries.setdefault(words["NM"][0], (line, words))  # the first of two with the same name
        elif keyword in ("CD", "LD") and rest:
            words.setdefault(keyword, rest[0].split())
    if not entries:
        raise InputError(f"{path}: expected a glass catalogue (AGF) with lines 'NM name formula ...', got none")
    return Catalogue(path, entries)
