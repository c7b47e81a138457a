"""The axis of a key of the scene file: numbers and quantities by their size, names side by side.

Quantities are shown in the unit in which most of them are written. An axis whose values span a decade is logarithmic.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, exp, floor, isfinite, log, log10
from typing import Any

from ommatid.runtime.printable import printable_label
from ommatid.scenes.tables.units import in_unit

DECADE = 10.0  # ratio of the largest to the smallest value from which an axis is logarithmic
MOST_TICKS = 12
SLACK = 1e-9  # of a digit, by which rounding errors may move a limit
GREY_LEVELS = "grey levels"
UNITS = {  # of keys that are plain numbers, by the last part of the key
    "variance": f"{GREY_LEVELS} squared",
    "noise_variance": f"{GREY_LEVELS} squared",
    "prior_variance": f"{GREY_LEVELS} squared",
    "mean": GREY_LEVELS,
    "samples": "rays per sensor pixel",
    "bits": "bits",
    "magnification": "sensor pixels per target pixel",
    "step": "target pixels",
    "focal_length": "relative",
    "full_well": "electrons",
    "dark_current": "electrons per second",
    "read_noise": "electrons",
    "dsnu": "electrons",
    "prnu": "relative",
    "gain": "DN per electron",
    "black_level": "DN",
}
_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_WHOLE = re.compile(r"[-+]?\d+")
_RATIO = re.compile(r"\d+/[1-9]\d*")
_QUANTITY = re.compile(rf"{_NUMBER.pattern}\s*([^\W\d]+|°)")


@dataclass(frozen=True)
class QuantityAxis:
    """The axis of a key: the position of each value as it was written, its tick labels, and its unit.

    categories : True for names, which are one step apart
    """

    key: str
    positions: dict[str, float]
    labels: dict[str, str]
    unit: str
    logarithmic: bool
    categories: bool

    @property
    def title(self) -> str:
        """The key with its unit."""
        return f"{self.key} ({self.unit})" if self.unit else self.key

    def limit(self, position: float, good: float) -> str:
        """Return which values are on the good side of a position, with their unit, such as "from 13 bits".

        The limit has two digits, rounded towards the good side, and is whole if all values were written so.

        good : the next value on that side, which the limit does not pass
        """
        whole = all(_WHOLE.fullmatch(text) for text in self.labels.values())
        step = 10.0 ** (floor(log10(abs(position))) - 1) if position else 1.0
        step = max(step, 1.0) if whole else step
        if good > position:
            number = min(ceil(position / step - SLACK) * step, good)
        else:
            number = max(floor(position / step + SLACK) * step, good)
        unit = self.unit if " " not in self.unit and self.unit != "relative" else ""
        return f"{'from' if good > position else 'up to'} {float(f'{number:.6g}'):g} {unit}".strip()

    def between(self, below: float, above: float, share: float) -> float:
        """Return the position at a share of the way between two others."""
        if self.logarithmic:
            return exp(log(below) + share * (log(above) - log(below)))
        return below + share * (above - below)

    def draw(self, axis: Any) -> None:
        """Set scale, ticks and label of a Matplotlib x axis."""
        from matplotlib.ticker import LogLocator, NullFormatter

        panel = axis.axes
        panel.set_xlabel(printable_label(self.title))
        if self.logarithmic:
            panel.set_xscale("log")
            axis.set_major_formatter("{x:g}")
            locator: Any = LogLocator(subs=range(2, 10))
            axis.set_minor_locator(locator)
            axis.set_minor_formatter(NullFormatter())
        if self.categories or len(self.positions) <= MOST_TICKS:
            labels = [printable_label(self.labels[value]) for value in self.positions]
            panel.set_xticks(list(self.positions.values()), labels)
        if self.categories and sum(map(len, self.labels.values())) > 8 * MOST_TICKS:
            panel.tick_params(axis="x", labelrotation=30)


def quantity_axis(key: str, values: Sequence[str]) -> QuantityAxis:
    """Return the axis for the values of a key, as they were written."""
    texts = {value: value.strip().strip("\"'") for value in values}
    for read in (_numbers, _quantities):
        found = read(key, list(texts.values()))
        if found is not None:
            numbers, labels, unit = found
            positions = dict(zip(values, numbers, strict=True))
            return QuantityAxis(
                key, positions, dict(zip(values, labels, strict=True)), unit, spans_decade(numbers), False
            )
    return QuantityAxis(key, {value: float(index) for index, value in enumerate(values)}, texts, "", False, True)


def spans_decade(numbers: Sequence[float]) -> bool:
    """Return True for positive numbers of which the largest is ten times the smallest or more."""
    return bool(numbers) and min(numbers) > 0 and max(numbers) >= DECADE * min(numbers) * (1 - 1e-9)


def _numbers(key: str, texts: Sequence[str]) -> tuple[list[float], list[str], str] | None:
    """Read plain numbers and ratios, whose labels are the values as written."""
    if not all(_NUMBER.fullmatch(text) or _RATIO.fullmatch(text) for text in texts):
        return None
    numbers = [float(Fraction(text)) if "/" in text else float(text) for text in texts]
    if not all(map(isfinite, numbers)):
        return None
    return numbers, list(texts), UNITS.get(key.rsplit(".", 1)[-1], "")


def _quantities(key: str, texts: Sequence[str]) -> tuple[list[float], list[str], str] | None:
    """Read quantities of one kind; their labels are numbers of the commonest unit."""
    del key
    matches = [_QUANTITY.fullmatch(text) for text in texts]
    units = Counter(match[1] for match in matches if match is not None)
    if not units or None in matches:
        return None
    unit = units.most_common(1)[0][0]
    try:
        numbers = [in_unit(text, unit) for text in texts]
    except ValueError:
        return None
    return numbers, [f"{number:g}" for number in numbers], "µm" if unit == "um" else unit
