"""Lists of values with dots, such as "8,...,12", "1/3,1/4,...,1/9" or "1 mm,2 mm,...,5 mm".

Dots continue the step of the two values before them up to the one after them; after a single value the step is 1.
Ratios written with a stroke step by 1/value, as magnifications do, and numbers written with an exponent by their
ratio, as in 1e-6,1e-5,...,1e-2. Other numbers, and those that such steps do not lead to, step by their difference.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from fractions import Fraction

from ommatid.runtime.errors import shortened

DOTS = ("...", "…")
MOST = 1000  # values that dots stand for
LONGEST = 40  # characters of a value beside dots
VALUE = re.compile(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d{1,2})?(?:/\d+)?)\s*([^\d\s/].*)?", re.IGNORECASE)


def continued(values: Sequence[str]) -> list[str]:
    """Return values with those that dots stand for. Raises ValueError that says what is wrong with the dots."""
    found: list[str] = []
    for index, value in enumerate(values):
        if value not in DOTS:
            found.append(value)
            continue
        if not found or index + 1 == len(values):
            raise ValueError("dots need a value before and one after them, as in 8,...,12 or 1/3,1/4,...,1/9")
        before = [each for each in values[max(index - 2, 0) : index] if each not in DOTS]
        found += _between(before, values[index + 1])
    return found


def _between(before: Sequence[str], end: str) -> list[str]:
    """Return the texts of the values between the last of one or two and another one."""
    texts = [*before, end]
    matches = [VALUE.fullmatch(text) if len(text) <= LONGEST else None for text in texts]
    parts = [(match[1], match[2] or "") for match in matches if match is not None]
    if len(parts) < len(texts) or len({unit for _, unit in parts}) > 1:
        raise ValueError(f"dots stand between numbers of one unit, got {shortened(', '.join(texts))}")
    try:
        numbers = [Fraction(number) for number, _ in parts]
    except ZeroDivisionError as error:
        raise ValueError(f"{shortened(', '.join(texts))}: a denominator is 0") from error
    *known, last = numbers
    inverse = all(numbers) and any("/" in number for number, _ in parts)
    between = _inverse_steps(known, last) if inverse else None
    if any("e" in number.lower() for number, _ in parts):
        between = _ratios(known, last)
    if between is None:
        inverse, between = False, _steps(known, last)
    if between is None:
        raise ValueError(f"no equal steps lead from {' and '.join(before)} to {shortened(end)}")
    unit = f" {parts[-1][1]}" if parts[-1][1] else ""
    return [f"{each if inverse else _written(each)}{unit}" for each in between]


def _steps(known: Sequence[Fraction], end: Fraction) -> list[Fraction] | None:
    """Return the numbers between, of equal differences; None if they do not lead to the end."""
    last = known[-1]
    step = last - known[0] if len(known) == 2 else Fraction(1 if end > last else -1)
    count = (end - last) / step if step else Fraction(0)
    if count <= 0 or count.denominator != 1:
        return None
    if count > MOST:
        raise ValueError(f"dots stand for at most {MOST} values, got {count}")
    return [last + step * number for number in range(1, int(count))]


def _inverse_steps(known: Sequence[Fraction], end: Fraction) -> list[Fraction] | None:
    between = _steps([1 / each for each in known], 1 / end)
    return None if between is None else [1 / each for each in between]


def _ratios(known: Sequence[Fraction], end: Fraction) -> list[Fraction] | None:
    """Return the numbers between, of equal ratios; None if they do not lead to the end."""
    if len(known) < 2 or not all(known) or known[0] == known[1]:
        return None
    ratio, between = known[1] / known[0], list[Fraction]()
    if ratio <= 0 or (end / known[1] > 1) != (ratio > 1):
        return None
    number = known[1] * ratio
    while (number < end) == (end > known[1]) and number != end and len(between) < MOST:
        between.append(number)
        number *= ratio
    return between if number == end else None


def _written(number: Fraction) -> str:
    return str(int(number)) if number.denominator == 1 else f"{float(number):.12g}"
