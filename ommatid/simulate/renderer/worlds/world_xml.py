"""The XML of Mitsuba scene files: read with limits, before Mitsuba sees it.

Document types and entities are refused, so that a file cannot grow or name other files while it is parsed.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.sax import SAXParseException, handler

from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import LARGEST_TEXT, read_bytes
from ommatid.runtime.printable import printable

DEEPEST = 64  # levels of nested elements; Mitsuba and its plugins recurse into them
MOST_ELEMENTS = 300_000  # of a world, those of included files counted as often as they are included
SHOWN = 80  # characters of a name in messages


@dataclass
class WorldElement:
    """An element of a Mitsuba file and the line of its start."""

    tag: str
    attributes: dict[str, str]
    line: int
    children: list[WorldElement] = field(default_factory=lambda: list[WorldElement]())


class _TreeBuilder(handler.ContentHandler):
    """Builds the elements of a file and stops at its limits."""

    def __init__(self) -> None:
        super().__init__()
        self.root: WorldElement | None = None
        self._open: list[WorldElement] = []
        self._count = 0
        self._where: Any = None

    @property
    def line(self) -> int:
        return int(self._where.getLineNumber() or 0)

    def setDocumentLocator(self, locator: Any) -> None:
        self._where = locator

    def startElement(self, name: str, attrs: Any) -> None:
        element = WorldElement(name, dict(attrs.items()), self.line)
        self._count += 1
        if len(self._open) >= DEEPEST:
            raise InputError(f"elements are nested in more than {DEEPEST} levels; expected at most {DEEPEST}")
        if self._count > MOST_ELEMENTS:
            raise InputError(f"there are more than {MOST_ELEMENTS} elements; expected fewer")
        if self._open:
            self._open[-1].children.append(element)
        else:
            self.root = element
        self._open.append(element)

    def endElement(self, name: str) -> None:
        del name
        self._open.pop()


def read_xml(path: Path) -> WorldElement:
    """Read the elements of a Mitsuba file. Raises InputError that does not name the file, OSError if it is missing."""
    from defusedxml.common import DefusedXmlException
    from defusedxml.sax import parse

    content = io.BytesIO(read_bytes(path, LARGEST_TEXT))
    tree = _TreeBuilder()
    try:
        parse(content, tree, handler.ErrorHandler(), forbid_dtd=True)
    except DefusedXmlException as error:
        raise InputError("has a document type or entities (<!DOCTYPE>); remove them") from error
    except SAXParseException as error:
        line, reason = error.getLineNumber(), printable(error.getMessage(), SHOWN)
        raise InputError(f"is not valid XML (line {line}): {reason}; correct it there") from error
    except (ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise InputError(f"line {tree.line}: {error}") from error
        raise InputError(f"is not valid XML: {printable(error, SHOWN)}; correct it there") from error
    if tree.root is None:
        raise InputError("is not valid XML: no element found; correct it there")
    return tree.root
