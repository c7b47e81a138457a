"""Parser of the documentation's Markdown pages: code blocks, links, headings and tables."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]

_BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
_FILE_NAME = re.compile(r"Save this as `([^`]+)`:\s*\Z")


def text_of(page: Path) -> str:
    """Return the text of a page."""
    return page.read_text(encoding="utf-8")


def page_name(page: Path) -> str:
    """Return the path of a page relative to the repository."""
    return page.relative_to(ROOT).as_posix()


@dataclass(frozen=True)
class Block:
    """A fenced code block.

    file_name : the file that the reader is asked to save the block as, in the paragraph before it; else None
    """

    language: str
    text: str
    file_name: str | None

    def commands(self) -> list[tuple[str, str]]:
        """Return each command of a shell block with the comment behind it."""
        joined = re.sub(r"\s*\\\n\s*", " ", self.text)  # a backslash continues the line
        lines = [line.strip() for line in joined.splitlines() if line.strip()]
        parts = [re.split(r"\s+# ", line, maxsplit=1) for line in lines]
        return [(part[0], part[1] if len(part) > 1 else "") for part in parts]


def blocks(page: Path) -> list[Block]:
    """Return the code blocks of a page in order."""
    text = text_of(page)
    result: list[Block] = []
    for match in _BLOCK.finditer(text):
        file_name = _FILE_NAME.search(text[: match.start()])
        result.append(Block(match[1], match[2], file_name[1] if file_name else None))
    return result


def prose(page: Path) -> str:
    """Return the text of a page without its code blocks."""
    return _BLOCK.sub("", text_of(page))


def links(page: Path) -> list[tuple[str, str]]:
    """Return path and anchor of every link to a file of the repository."""
    targets = re.findall(r"\]\(([^)\s]+)\)", prose(page))
    return [tuple((target + "#").split("#")[:2]) for target in targets if "://" not in target]  # type: ignore[misc]


def headings(page: Path) -> list[str]:
    """Return the headings of all levels."""
    return re.findall(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Return the anchors of all headings: lower case, without punctuation, hyphens for blanks (GitHub's rule)."""
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings(page)}


def sections(page: Path) -> Iterator[tuple[str, str]]:
    """Yield heading and text of every section of level 2."""
    parts = re.split(r"^## (.+)$", text_of(page), flags=re.MULTILINE)
    yield from zip(parts[1::2], parts[2::2], strict=True)


def section(page: Path, heading: str) -> str:
    """Return the text of the section with this heading."""
    return next(text for name, text in sections(page) if name == heading)


def table_rows(text: str) -> list[list[str]]:
    """Return the cells of all tables without their header rows."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    rules = [index for index, line in enumerate(cells) if set("".join(line)) <= {"-", ":"}]
    return [line for index, line in enumerate(cells) if index not in rules and index + 1 not in rules]


def code_spans(text: str) -> list[str]:
    """Return the inline code of a text."""
    return re.findall(r"`([^`]+)`", text)
