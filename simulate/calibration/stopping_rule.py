"""Who is asked, between rounds of a calibration, whether to go on: whoever will reconstruct with what it finds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ommatid.scenes.model import Model


@dataclass(frozen=True)
class StoppingRule:
    """Who says of a model whether its H is known well enough.

    adds : what the uncertainty of H adds to the expected error of a reconstruction, relative to all the rest of it
    by : fingerprint of what is reconstructed;  words : the same for people
    """

    added_error: Callable[[Model], float]
    fingerprint: str
    description: str
