"""What frames of one camera share: computed for the first of them, and again only where a frame's noise differs.

With the same H and prior, factorisations and error bars depend on the noise alone. Where every variance of a frame's
noise is between 1 / (1 + d) and 1 + d times that of another one, so is Eq. 5 of the minimum-variance estimate, since it
grows with Rv and is linear in its scale. Of an estimator whose assumed noise stays the same, Eq. 5 is linear in the
actual noise, and the same holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import inf
from typing import Any, TypeVar, cast

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.scenes.model import Model

Value = TypeVar("Value")

SAME_NOISE = 1e-2  # largest relative difference of noise variances whose error bars are reused: that of a map's pixels
EXPECTED = 1e-9  # relative difference of the actual from the assumed noise where the estimate is that of least variance


@dataclass(frozen=True, eq=False)
class Conditions:
    """Everything but H that factorisations and error bars depend on.

    settings : the tables of the prior and of the estimator;  used : (M,) True for measurements that are used
    assumed : (measurements used,) the estimator's noise;  actual : by cause, likewise; empty where it has no effect
    """

    settings: tuple[object, ...]
    used: BoolArray
    assumed: FloatArray
    actual: dict[str, FloatArray] = field(default_factory=dict[str, FloatArray])

    def difference(self, other: Conditions) -> float:
        """Return the largest relative difference d of the noise; infinite where Eq. 5 is not within 1 + d for it."""
        comparable = self.settings == other.settings and self.actual.keys() == other.actual.keys()
        if not comparable or not np.array_equal(self.used, other.used):
            return inf
        assumed = relative_difference(self.assumed, other.assumed)
        if not self.actual:
            return assumed
        actual = relative_difference(self._total, other._total)
        if assumed > EXPECTED and not (self._optimal and other._optimal):
            return inf
        return max(assumed, actual)

    @property
    def _total(self) -> FloatArray:
        parts = list(self.actual.values())
        return sum(parts[1:], parts[0])

    @property
    def _optimal(self) -> bool:
        return relative_difference(self.assumed, self._total) <= EXPECTED


def relative_difference(values: FloatArray, others: FloatArray) -> float:
    """Return the least d with which all values are between 1 / (1 + d) and 1 + d times the others; all 0 or more."""
    if values.shape != others.shape:
        return inf
    if values.strides == others.strides == (0,):
        values, others = values[:1], others[:1]
    if np.array_equal(values, others):
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(values == others, 1.0, values / others)
    least, largest = float(ratio.min()), float(ratio.max())
    return inf if not least > 0 else max(largest, 1 / least) - 1


class Prepared:
    """Results that the frames of one model share, by name; of each, that of the last conditions for which it was made.

    Serves one frame at a time.
    """

    def __init__(self, model: Model) -> None:
        """Nothing is prepared before the first frame."""
        self.model = model
        self._kept: dict[str, tuple[Conditions, Any]] = {}

    def shared(
        self, name: str, conditions: Conditions, make: Callable[[], Value], tolerance: float = 0.0
    ) -> tuple[Value, float | None]:
        """Return a result and the difference of the noise for which it was made, None if `make` had to make it.

        tolerance : largest difference of the noise at which a result serves
        """
        if name in self._kept:
            kept, value = self._kept[name]
            difference = conditions.difference(kept)
            if difference <= tolerance:
                return cast(Value, value), difference
        value = make()
        self._kept[name] = conditions, value
        return value, None

    def contents(self, *names: str) -> dict[str, tuple[Conditions, Any]]:
        """Return the results of these kinds for another process; a kind is the end of a name."""
        return {name: kept for name, kept in self._kept.items() if name.endswith(names)}

    def with_contents(self, contents: dict[str, tuple[Conditions, Any]]) -> Prepared:
        """Return a copy that holds the results of another process, for the same model."""
        copy = Prepared(self.model)
        copy._kept |= contents
        return copy
