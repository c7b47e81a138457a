"""Rank lens types that might be added to a camera by the expected error after each (Wood et al., section 6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ommatid.reconstruct.prediction import Prediction

from .prediction_table import json_of


@dataclass(frozen=True)
class DesignCandidate:
    """A magnification and the prediction with it; None and `reason` where it is impossible."""

    magnification: str
    expected: Prediction | None
    reason: str = ""

    def describe(self) -> dict[str, Any]:
        """Return the candidate in JSON's types."""
        expected = None if self.expected is None else json_of(self.expected)
        return {"magnification": self.magnification, "expected": expected, "reason": self.reason}


def ranked(candidates: list[DesignCandidate]) -> list[DesignCandidate]:
    """Sort by expected error, the least first; impossible candidates come last."""
    return sorted(candidates, key=lambda candidate: np.inf if candidate.expected is None else candidate.expected.mse)


def rows(before: Prediction, candidates: list[DesignCandidate]) -> list[tuple[str, str]]:
    """Return magnification and expected error, one row per candidate after that of the camera itself."""
    lines = [("unchanged", f"{before.mse:.6g} per pixel, {before.null_space} dimensions unseen")]
    for candidate in candidates:
        after, name = candidate.expected, f"+ {candidate.magnification}"
        if after is None:
            lines.append((name, candidate.reason))
            continue
        gain = f"{before.mse / after.mse:.3g} times less" if after.mse > 0 else "no error is left"
        added = after.measurements - before.measurements
        unseen = f"{after.null_space} dimensions unseen, {added} measurements more"
        lines.append((name, f"{after.mse:.6g} per pixel, {gain}; {unseen}"))
    return lines
