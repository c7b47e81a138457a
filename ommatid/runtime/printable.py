"""Texts that came from outside, as they may be printed: escaped, on one line, and shortened.

Titles, keys, names and messages of libraries may hold escape sequences of terminals, characters that reorder or hide
text, and millions of characters. What is printed, drawn or written into a page passes one of these functions.
"""

from __future__ import annotations

import re
import unicodedata

LONGEST = 200  # characters of a text that came from outside
LONGEST_SENTENCE = 500  # characters of the message of an error
LONGEST_MESSAGE = 600  # characters of a line on stderr
LONGEST_LABEL = 100  # characters of a text in a figure
LONGEST_WORD = 60  # characters of a word in a message that is too long
GAP = " ... "

# control, format (which reorders text), surrogate, private use, unassigned, and line and paragraph separators
_ESCAPED = frozenset({"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"})
_FILLERS = frozenset("\u115f\u1160\u2800\u3164\uffa0")  # letters and symbols that are drawn as nothing
_MARKS = frozenset({"Mn", "Me"})  # which are drawn over the character before them
MOST_MARKS = 3  # in a row
_SPACE = re.compile(r" *[^\S ]\s*")  # white space other than blanks alone
_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")


def printable(text: object, longest: int = LONGEST) -> str:
    """Return a text on one line, without control characters, and shortened in its middle to `longest` characters.

    White space becomes a blank; other characters that do not print are written as escapes such as \\x1b. Printable text
    is returned as it is.
    """
    words = _cut(text if isinstance(text, str) else str(text), 4 * longest)
    if not (words.isascii() and words.isprintable()):
        words = _escaped(_SPACE.sub(" ", words.strip("\t\n\v\f\r")))
    return _cut(words, longest)


def printable_sentence(text: object, longest: int = LONGEST_SENTENCE) -> str:
    """Return a message on one line, without control characters, and shortened to `longest` characters.

    Long words are shortened first: these are names of files, keys and values, and the rest of the sentence stays.
    """
    words = text if isinstance(text, str) else str(text)
    if len(words) > longest:
        words = _LONG_WORD.sub(lambda word: _cut(word[0], LONGEST_WORD, "..."), words)
    return printable(words, longest)


def printable_label(text: object) -> str:
    """Return a text as a figure can draw it: dollar signs are signs, and begin no mathematics."""
    return printable(text, LONGEST_LABEL).replace("$", r"\$")


def printable_lines(text: str) -> str:
    """Return a document of any length without control characters, except for line ends and tabs."""
    return _escaped(text.replace("\r\n", "\n"), kept="\n\t")


def _cut(text: str, longest: int, gap: str = GAP) -> str:
    """Return a text without its middle, if it has more than `longest` characters."""
    if len(text) <= longest:
        return text
    half = (longest - len(gap)) // 2
    return f"{text[:half]}{gap}{text[-half:]}"


def _escaped(text: str, kept: str = "") -> str:
    """Return a text with escapes in place of characters that do not print, and of marks that are drawn over others."""
    kinds = {character: unicodedata.category(character) for character in set(text) - set(kept)}
    wrong = {
        ord(character): _escape(character)
        for character, kind in kinds.items()
        if kind in _ESCAPED or character in _FILLERS
    }
    marks = "".join(character for character, kind in kinds.items() if kind in _MARKS and ord(character) not in wrong)
    if marks:
        flood = re.compile(f"(?<=[{marks}]{{{MOST_MARKS}}})[{marks}]")
        text = flood.sub(lambda mark: _escape(mark[0]), text)
    return text.translate(wrong) if wrong else text


def _escape(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")
