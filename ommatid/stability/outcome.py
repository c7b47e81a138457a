"""What a form of the estimator made of a stiff or extreme case."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StabilityOutcome:
    """What one form made of one case.

    alone, refined, variance : right digits of u as the form solves for it, of u once refined, of the worst variance
    bound, variance_bound : relative errors that were promised;  reason : why it was refused
    """

    case: str
    measurements: int
    unknowns: int
    asked: str
    ran: str
    verdict: str
    alone: float | None = None
    refined: float | None = None
    variance: float | None = None
    bound: float | None = None
    variance_bound: float | None = None
    reason: str = ""


@dataclass(frozen=True)
class SweepOutcome:
    """An outcome of the sweep over noise: of which H, at which noise variance."""

    lenses: str
    noise: float
    outcome: StabilityOutcome
