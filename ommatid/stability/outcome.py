"""Results of the stability survey."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StabilityOutcome:
    """Result of one form for one case.

    alone, refined, variance : correct digits of u from the form alone, of the refined u, of the worst variance
    bound, variance_bound : relative error bounds stated by the estimator;  reason : why the case was refused
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
    """An outcome of the noise sweep: the name of H, the noise variance and the result."""

    lenses: str
    noise: float
    outcome: StabilityOutcome
