"""The pages of the documentation taken apart: blocks, links, headings, tables."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
_SAVED = re.compile(r"Save this as `([^`]+)`:\s*\Z")


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


@dataclass(frozen=True)
class Block:
    """What stands between two fences. `saved` is the file that the words before it tell the reader to save it as."""

    language: str
    text: str
    saved: str | None

    def lines(self) -> list[tuple[str, str]]:
        """Of a block of shell commands: each command and the comment behind it, which blanks set apart."""
        lines = [line.strip() for line in self.text.splitlines() if line.strip()]
        found = [re.split(r"\s+# ", line, maxsplit=1) for line in lines]
        return [(parts[0], parts[1] if len(parts) > 1 else "") for parts in found]


def blocks(page: Path) -> list[Block]:
    text = text_of(page)
    found: list[Block] = []
    for match in _BLOCK.finditer(text):
        saved = _SAVED.search(text[: match.start()])
        found.append(Block(match[1], match[2], saved[1] if saved else None))
    return found


def prose(page: Path) -> str:
    """The page without its blocks."""
    return _BLOCK.sub("", text_of(page))


def links(page: Path) -> list[tuple[str, str]]:
    """Path and anchor of every link that stays in the project."""
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [tuple((target + "#").split("#")[:2]) for target in targets if "://" not in target]  # type: ignore[misc]


def headings(page: Path) -> list[str]:
    return re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """What a link may name after #: headings in small letters, without marks, blanks as hyphens."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(page)}


def sections(page: Path, level: int = 2) -> Iterator[tuple[str, str]]:
    """Heading and text of every section of a level."""
    parts = re.split(rf"^{'#' * level} (.+)$", text_of(page), flags=re.MULTILINE)
    yield from zip(parts[1::2], parts[2::2], strict=True)


def section(page: Path, heading: str) -> str:
    return next(text for name, text in sections(page) if name == heading)


def rows(text: str) -> list[list[str]]:
    """The cells of all tables, without what heads them."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    below = [place for place, line in enumerate(cells) if set("".join(line)) <= {"-", ":"}]
    return [line for place, line in enumerate(cells) if place not in below and place + 1 not in below]


def marked(text: str) -> list[str]:
    """What stands in backticks."""
    return re.findall(r"`([^`]+)`", text)
