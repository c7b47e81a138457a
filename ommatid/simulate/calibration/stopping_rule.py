"""The criterion by which a calibration with an open number of samples stops."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ommatid.scenes.model import Model


@dataclass(frozen=True)
class StoppingRule:
    """Decides whether H is known precisely enough for the reconstruction that will use it.

    added_error : maps a model to the expected error due to the uncertainty of its H, relative to all other error
    fingerprint : of the reconstruction;  description : of the same for people
    """

    added_error: Callable[[Model], float]
    fingerprint: str
    description: str
