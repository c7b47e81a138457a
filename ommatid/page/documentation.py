"""Links from the sections of a page to the documentation, from pages in a folder of the checkout.

They are relative: a page says nothing of the machine that wrote it, and elsewhere there is no address to link to.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

from ommatid.runtime.input_files import real_path

ROOT = real_path(Path(__file__).parents[2])


class DocumentationLink(NamedTuple):
    """Title and address of a page of the documentation; the address is empty where it is not in the page's checkout."""

    title: str
    url: str


PAGES = {
    "grounds": ("Accuracy: the verdict", "trust", "the-verdict"),
    "baselines": ("The report: other methods", "report", "other-methods"),
    "groups": ("The report: measured and predicted error", "report", "how-to-read-measured-and-predicted-error"),
    "held-out": ("Accuracy: the held-out check", "trust", "the-held-out-check"),
    "time": ("Error against run time", "time", ""),
    "plan": ("Light as waves", "diffraction", ""),
    "Depth": ("Your own Mitsuba scene", "worlds", ""),
    "Study": ("Scene file: [study]", "scene-file", "study"),
    "camera": ("Your own camera", "camera", ""),
    "numbers": ("Glossary", "glossary", ""),
    "origin": ("Scene file", "scene-file", ""),
}  # of a section: title, page and heading


def documentation(section: str, folder: Path) -> DocumentationLink:
    """Return the link of a section of a page in a folder: to the built site, or else to its source."""
    title, page, heading = PAGES[section]
    files = ROOT / "build" / "site" / f"{page}.html", ROOT / "docs" / f"{page}.md"
    found, here = [path for path in files if path.is_file()], real_path(folder)
    if not found or not here.is_relative_to(ROOT):
        return DocumentationLink(title, "")
    return DocumentationLink(title, f"{quote(os.path.relpath(found[0], here))}{'#' if heading else ''}{heading}")
