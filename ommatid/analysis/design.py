"""Which lens type to add: the expected error after each (Wood et al., section 6), from Eq. 5 alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.reconstruct.prediction import Prediction


@dataclass(frozen=True)
class DesignCandidate:
    """A magnification, and what is expected once it is there; None and `reason` where it cannot be had."""

    magnification: str
    expected: Prediction | None
    reason: str = ""

    def describe(self) -> dict[str, Any]:
        """In JSON's types."""
        expected = None if self.expected is None else self.expected.describe()
        return {"magnification": self.magnification, "expected": expected, "reason": self.reason}


def ranked(choices: list[DesignCandidate]) -> list[DesignCandidate]:
    """The least expected error first; what cannot be had last."""
    return sorted(choices, key=lambda choice: np.inf if choice.expected is None else choice.expected.mse)


def rows(before: Prediction, choices: list[DesignCandidate]) -> list[tuple[str, str]]:
    """The lines of the printed table: magnification, expected error, and what it is worth."""
    lines = [("as it is", f"{before.mse:.6g} a pixel, {before.null_space} dimensions unseen")]
    for choice in choices:
        found = choice.expected
        if found is None:
            lines.append((f"+ {choice.magnification}", choice.reason))
            continue
        gain = f"{before.mse / found.mse:.3g} times less" if found.mse > 0 else "nothing is left"
        more = found.measurements - before.measurements
        lines.append(
            (
                f"+ {choice.magnification}",
                f"{found.mse:.6g} a pixel, {gain}; {found.null_space} dimensions unseen, {more} measurements more",
            )
        )
    return lines
