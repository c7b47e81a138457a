"""Figures that a page states, compared with those of the command that prints them.

A test that runs a command of a page passes its numbers to `check_figures`. `test_figures.py` collects these calls and
reports every other decimal number of the pages that is neither checked nor excepted with a reason.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from math import isclose
from pathlib import Path

from .documentation import ROOT, page_name, prose, text_of

NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")
FIGURE = "{}"
_DECIMAL = re.compile(r"(?<![\w.,-])-?\d+\.\d+(?:e-?\d+)?(?!\w|\.\d)")


def last_digit(number: str) -> float:
    """Return one unit of the last digit of a decimal number."""
    mantissa, _, power = number.partition("e")
    return 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))


def rounds_to(value: float, stated: str) -> bool:
    """Return True if `stated` is a value rounded to the digits of `stated`; at halves, either way."""
    return abs(value - float(stated)) <= 0.5 * last_digit(stated) * (1 + 1e-6)


def agree(printed: str, stated: str) -> bool:
    """Return True if two lines have the same text, and `stated` the numbers of `printed`, rounded."""
    if NUMBER.sub("#", printed) != NUMBER.sub("#", stated.rstrip()):
        return False
    pairs = zip(NUMBER.findall(printed), NUMBER.findall(stated), strict=True)
    return all(isclose(float(number), float(seen)) or _rounds_to_decimal(number, seen) for number, seen in pairs)


def _rounds_to_decimal(number: str, stated: str) -> bool:
    return bool(re.search(r"[.e]", stated)) and rounds_to(float(number), stated)


def spaced(text: str) -> str:
    """Return a text with single blanks between its words."""
    return " ".join(text.split())


def check_figures(page: str, sentence: str, *values: float) -> None:
    """Compare the figures of a sentence or of a row of a table, {} in `sentence`, with values computed anew.

    page : path relative to docs/, or "README.md"
    """
    stated = stated_figures(page, sentence)
    assert len(stated) == len(values), f"{page}: {sentence}: {len(values)} values"
    for value, figure in zip(values, stated, strict=True):
        assert rounds_to(value, figure), f"{page} states {figure} in '{sentence}', computed: {value:.6g}"


def stated_figures(page: str, sentence: str) -> tuple[str, ...]:
    """Return the figures of the only sentence of a page that matches."""
    matches = list(re.finditer(_pattern(sentence), spaced(text_of(_path(page)))))
    assert len(matches) == 1, f"{page}: expected '{sentence}' once, found it {len(matches)} times"
    return matches[0].groups()


def _path(page: str) -> Path:
    return ROOT / page if page == "README.md" else ROOT / "docs" / page


def _pattern(sentence: str) -> str:
    return r"(\d+(?:\.\d+)?(?:e-?\d+)?)".join(re.escape(part) for part in spaced(sentence).split(FIGURE))


@cache
def checked_sentences() -> dict[str, list[str]]:
    """Return the sentences that tests pass to `check_figures`, by page."""
    sentences: dict[str, list[str]] = {}
    for path in sorted((ROOT / "tests").rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "check_figures":
                page, sentence = call.args[0], call.args[1]
                if isinstance(page, ast.Constant) and isinstance(sentence, ast.Constant):
                    sentences.setdefault(str(page.value), []).append(str(sentence.value))
    return sentences


def unchecked_decimals(page: Path) -> Iterator[tuple[str, str]]:
    """Yield heading and text of every decimal number of a page's prose that no test checks.

    Code, links, and the numbers of checked sentences are left out.
    """
    name = page_name(page).removeprefix("docs/")
    sentences = [re.compile(_pattern(sentence)) for sentence in checked_sentences().get(name, [])]
    parts = re.split(r"^#+ (.+)$", prose(page), flags=re.MULTILINE)
    for heading, text in zip(parts[1::2], parts[2::2], strict=True):
        rest = spaced(text)
        for sentence in sentences:
            rest = sentence.sub("", rest)
        rest = re.sub(r"`[^`]*`|\]\([^)]*\)", "", rest)
        for number in _DECIMAL.findall(rest):
            yield heading, number


def is_printed(block: str, output: str) -> bool:
    """Return True if every line of a block occurs in the output, in order; times may differ."""
    printed, position = _comparable(output), 0
    for line in block.splitlines():
        words = _comparable(line)
        found = printed.find(words, position)
        if found < 0:
            return False
        position = found + len(words)
    return True


def _comparable(text: str) -> str:
    text = spaced(re.sub(r"[\u2500-\u257f]", " ", text))
    return re.sub(r"\d+(?:\.\d+)? (?:ms|s|min|h)\b", "TIME", text)
