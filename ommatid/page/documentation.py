"""Links from the sections of a page to the documentation of a checkout, on the machine that wrote the page."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class DocumentationLink(NamedTuple):
    """Title and address of a page of the documentation; the address is empty where it is not on this machine."""

    title: str
    url: str


PAGES = {
    "grounds": ("Accuracy: the verdict", "trust", "the-verdict"),
    "baselines": ("The report: other methods", "report", "other-methods"),
    "groups": ("The report: measured and predicted error", "report", "how-to-read-measured-and-predicted-error"),
    "held-out": ("Accuracy: the held-out check", "trust", "the-held-out-check"),
    "sensor": ("Units and axes", "units", ""),
    "response": ("Calibration", "calibration", ""),
    "time": ("Error against run time", "time", ""),
    "plan": ("Light as waves", "diffraction", ""),
    "Depth": ("Your own Mitsuba scene", "worlds", ""),
    "Study": ("Scene file: [study]", "scene-file", "study"),
    "camera": ("Your own camera", "camera", ""),
    "numbers": ("Glossary", "glossary", ""),
    "origin": ("Scene file", "scene-file", ""),
}  # of a section: title, page and heading


def documentation(section: str) -> DocumentationLink:
    """Return the link of a section: to the built site, or else to its source."""
    title, page, heading = PAGES[section]
    files = ROOT / "build" / "site" / f"{page}.html", ROOT / "docs" / f"{page}.md"
    found = [path.as_uri() for path in files if (ROOT / "mkdocs.yml").is_file() and path.is_file()]
    return DocumentationLink(title, f"{found[0]}{'#' if heading else ''}{heading}" if found else "")
