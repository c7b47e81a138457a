"""The method and form of an estimate in JSON's types: `solver` of run.json."""

from __future__ import annotations

from .record import Record


class RejectedForm(Record):
    """A form of the estimator that was given up, with the reason."""

    method: str
    why_not: str


class SolverReport(Record):
    """The method and form that ran, and the bounds on their numerical error."""

    way: str
    method: str
    why: str
    condition: float | None
    digits: float
    bound: float | None
    unit: str
    variance_bound: float
    refinements: int
    tried: tuple[RejectedForm, ...] = ()
