"""Which lens type to add: the expected error after each (Wood et al., section 6), from Eq. 5 alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

from ommatid.reconstruct.prediction import Prediction
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.scene import Scene

from .candidates import with_lens
from .predict import predict_scene


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


@dataclass(frozen=True)
class DesignComparison:
    """The expected error of a scene, and the candidates ranked by the expected error with each."""

    before: Prediction
    candidates: list[DesignCandidate]

    def describe(self) -> dict[str, Any]:
        """Describe the comparison in JSON's types."""
        return {
            "before": self.before.describe(),
            "candidates": [candidate.describe() for candidate in self.candidates],
        }

    def rows(self) -> list[tuple[str, str]]:
        """Tabulate magnification, expected error, and the factor by which it falls."""
        return rows(self.before, self.candidates)


def compare(scene: Scene, wanted: Sequence[Fraction], progress: Progress = no_progress) -> DesignComparison:
    """Predict the error of the scene with one more lens type of each magnification."""
    before = predict_scene(scene)
    candidates: list[DesignCandidate] = []
    for index, magnification in enumerate(wanted):
        try:
            expected = predict_scene(with_lens(scene, magnification))
            candidates.append(DesignCandidate(str(magnification), expected))
        except InputError as error:
            reason = str(error).removeprefix(f"{scene.source}: ")
            candidates.append(DesignCandidate(str(magnification), None, reason))
        progress((index + 1) / len(wanted))
    return DesignComparison(before, ranked(candidates))


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
