"""Texts that came from outside, as they may be printed: escaped and shortened."""

from __future__ import annotations

import unicodedata

LONGEST = 200  # characters

# control, format (which reorders text), surrogate, private use, unassigned, and line and paragraph separators
_ESCAPED = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})


def printable(text: object, longest: int = LONGEST) -> str:
    """Return a text on one line, without control characters, and shortened in its middle to `longest` characters.

    White space becomes a blank; other characters that do not print are written as escapes such as \\x1b.
    """
    words = " ".join(str(text).split()) if not isinstance(text, str) or not text.isprintable() else text
    kept = (longest - len(" ... ")) // 2
    if len(words) > longest:
        return f"{_escaped(words[:kept], kept)} ... {_escaped(words[-kept:], kept)}"
    return _escaped(words, longest)


def _escaped(text: str, longest: int) -> str:
    written = "".join(
        character.encode("unicode_escape").decode("ascii") if unicodedata.category(character) in _ESCAPED else character
        for character in text
    )
    return written if len(written) <= longest else f"{written[: longest - 4]} ..."
