"""The held-out check in JSON's types: `held_out` of run.json, and the document of `ommatid check`."""

from __future__ import annotations

from ..held_out.check import HeldOutCheck, HeldOutSubImager
from .record import Index, Record

MOST_LISTED = 5  # sub-imagers in one sentence


class HeldOutVerdict(Record):
    """Whether the sub-imagers agree; None if none could be predicted from others."""

    trusted: bool | None
    reasons: tuple[str, ...]


class HeldOutPrior(Record):
    """The prior that predictions assumed, its length in millimetres, and whether it was fitted to the stack."""

    kind: str
    mean: float
    variance: float
    correlation_length: float | None
    fitted: bool


class HeldOutWindows(Record):
    """Number of the windows that were checked, and of those that cover the target."""

    checked: int
    total: int


class HeldOutEntry(Record):
    """A sub-imager predicted from all others; named ones are left out of the predictions of the others.

    chi_squared : of `pixels` whitened errors, `expected` is its expectation;  z : normal deviate of the same p_value
    rms_error, expected_rms : in grey levels, weighted by the precision of the prediction
    disagrees : before any was left out
    """

    name: str
    type: str
    k: Index
    l: Index  # noqa: E741  (the paper's letter)
    pixels: int
    chi_squared: float
    expected: float
    z: float | None
    p_value: float | None
    rms_error: float | None
    expected_rms: float | None
    disagrees: bool
    named: bool


class HeldOutReport(Record):
    """Every sub-imager predicted from all others.

    p_value : of the largest deviation (Sidak), before any sub-imager was left out
    explained : True if the others agree once the named sub-imagers are left out
    """

    verdict: HeldOutVerdict
    p_value: float | None
    explained: bool
    prior: HeldOutPrior
    windows: HeldOutWindows
    sub_imagers: tuple[HeldOutEntry, ...]

    @property
    def judged(self) -> int:
        """Number of sub-imagers that were predicted."""
        return sum(entry.pixels > 0 for entry in self.sub_imagers)

    def worst(self) -> list[HeldOutEntry]:
        """Return the predicted sub-imagers: those named first, then by z, the largest first."""
        judged = [entry for entry in self.sub_imagers if entry.z is not None]
        return sorted(judged, key=lambda entry: (not entry.named, -(entry.z or 0.0)))


def held_out_report(check: HeldOutCheck) -> HeldOutReport:
    """Return a check in JSON's types, with its verdict."""
    entries = tuple(_entry(sub) for sub in check.sub_imagers)
    prior = HeldOutPrior(
        kind=check.prior.kind,
        mean=check.prior.mean,
        variance=check.prior.variance,
        correlation_length=check.prior.correlation_length,
        fitted=check.fitted,
    )
    report = HeldOutReport(
        verdict=HeldOutVerdict(trusted=None, reasons=()),
        p_value=check.p_value,
        explained=check.explained,
        prior=prior,
        windows=HeldOutWindows(checked=check.windows[0], total=check.windows[1]),
        sub_imagers=entries,
    )
    return report.model_copy(update={"verdict": _verdict(report)})


def _entry(checked: HeldOutSubImager) -> HeldOutEntry:
    return HeldOutEntry(
        name=checked.sub.name,
        type=checked.sub.type.name,
        k=checked.sub.k,
        l=checked.sub.l,
        pixels=checked.pixels,
        chi_squared=checked.chi_squared,
        expected=float(checked.pixels),
        z=checked.z,
        p_value=checked.p_value,
        rms_error=checked.rms_error,
        expected_rms=checked.expected_rms,
        disagrees=checked.disagrees,
        named=checked.named,
    )


def _verdict(report: HeldOutReport) -> HeldOutVerdict:
    if not report.judged:
        reason = "not checked: fewer than two sub-imagers have pixels that can be predicted from one another"
        return HeldOutVerdict(trusted=None, reasons=(reason,))
    disagreeing = [entry for entry in report.worst() if entry.disagrees]
    named = [entry for entry in report.worst() if entry.named]
    if not disagreeing:
        return HeldOutVerdict(trusted=True, reasons=())
    if named:
        one = len(named) == 1
        subject = f"sub-imager {listed(named)} contradicts" if one else f"sub-imagers {listed(named)} contradict"
        reason = (
            f"{subject} the others: {_size(named[0])}; {'its' if one else 'their'} H is not this camera's, or"
            f" {'its' if one else 'their'} pixels are damaged; the others agree"
        )
    else:
        reason = (
            f"{len(disagreeing)} of {report.judged} sub-imagers contradict one another, most {listed(disagreeing)}:"
            f" {_size(disagreeing[0])}; H is not this camera's, the world has depth or detail finer than f, or the"
            " noise is larger than stated"
        )
    return HeldOutVerdict(trusted=False, reasons=(reason,))


def _size(entry: HeldOutEntry) -> str:
    return f"{entry.name} errs by {entry.rms_error:.3g} grey levels where {entry.expected_rms:.3g} are expected"


def listed(entries: list[HeldOutEntry]) -> str:
    """Return "A", "A and B", or the first few names and the number of the others."""
    names = [entry.name for entry in entries[:MOST_LISTED]]
    more = len(entries) - len(names)
    names += [f"{more} more"] if more else []
    return f"{', '.join(names[:-1])} and {names[-1]}" if names[1:] else names[0]
