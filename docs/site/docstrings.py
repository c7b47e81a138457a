"""Docstrings of the house as Markdown: paragraphs of lines `name : meaning` become lists."""

from __future__ import annotations

import re
from typing import Any

import griffe

_ARGUMENT = re.compile(r"^(\w[\w, ]*) : +(.*)$")


def as_markdown(docstring: str) -> str:
    """Return a docstring whose paragraphs of arguments are lists, and whose references name the public functions."""
    return "\n\n".join(_paragraph(text) for text in docstring.split("\n\n"))


def _paragraph(text: str) -> str:
    lines = [part.strip() for line in text.splitlines() for part in re.split(r";  +", line)]
    if not _ARGUMENT.match(lines[0]) or text.startswith(" "):
        return text
    items: list[str] = []
    after = list[str]()
    for line in lines:
        match = _ARGUMENT.match(line)
        if match:
            items.append(f"- `{match[1]}`: {match[2]}")
        elif line.startswith("Raises") or after:
            after.append(line)
        else:
            items[-1] += f" {line}"
    return "\n".join(items) + ("\n\n" + " ".join(after) if after else "")


class MarkdownDocstrings(griffe.Extension):
    """Rewrites every docstring that the reference shows."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Rewrite the docstring of one module, class or function."""
        if obj.docstring is not None:
            obj.docstring.value = as_markdown(obj.docstring.value)
