"""The held-out check: which sub-imagers the others contradict, and by how much.

Every sub-imager is predicted from all others (`block_errors`). Over draws of prior and noise the sum of the squares of
its b whitened errors is a chi-squared variate of b degrees of freedom. Sums of different sub-imagers are correlated, so
each is judged by itself, at a significance for all together (Sidak), which correlation makes a little too strict.

A wrong sub-imager spoils the predictions of its neighbours. Therefore the one whose removal takes away the most excess
is named and left out, and the rest is judged again, until the others agree.
"""

from __future__ import annotations

from dataclasses import replace
from math import log

import numpy as np
from scipy import special

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.errors import InputError, named
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from ..assumptions import assumptions_for, with_fallback
from ..method_choice import METHODS, MethodChoice
from ..methods.method import EstimationTask, Execution, Method
from ..output.run_json import HeldOutEntry, HeldOutPrior, HeldOutReport, HeldOutVerdict, HeldOutWindows
from ..prior import FittedPrior
from ..prior_fit import fit_prior
from ..verdict.causes import likely_cause
from .windows import held_out_sums, windows

SIGNIFICANCE = 1e-4  # of all sub-imagers together
LEAST_EXCESS = 0.1  # of the sum of squares over its expectation
LEAST_PROGRESS = 0.1  # by which leaving out a sub-imager must reduce the excess of all
MOST_QUICK = 4000  # measurements of a check that takes a second or less
MOST_QUICK_DETAILED = 1500  # where the world is finer than f, so that S is that of all measurements
MOST_NAMED = 10  # sub-imagers left out one after the other
LEAST_DEVIATE = -37.0  # z of a probability of 1 in float64
TERMS = 200  # of a continued fraction


def log_survival(chi_squared: FloatArray, freedoms: FloatArray) -> FloatArray:
    """Return the logarithm of the probability that a chi-squared variate is larger, where that underflows, too.

    freedoms : above 0, of the same shape
    """
    shape, value = np.asarray(freedoms) / 2, np.asarray(chi_squared) / 2
    probability = special.gammaincc(shape, value)
    with np.errstate(divide="ignore", invalid="ignore"):
        # The upper incomplete gamma function as a continued fraction (Abramowitz and Stegun, 6.5.31).
        fraction = np.zeros_like(value)
        for term in range(TERMS, 0, -1):
            fraction = term * (shape - term) / (value + 2 * term + 1 - shape + fraction)
        tail = -value + shape * np.log(value) - special.gammaln(shape) - np.log(value + 1 - shape + fraction)
        return np.where(probability > 1e-290, np.log(probability), tail)


@one_thread()
def check_held_out(
    stack: Stack, model: Model, *, fitted: bool = True, progress: Progress = no_progress
) -> HeldOutReport:
    """Predict every sub-imager of a stack from all others, and name those that disagree.

    fitted : True replaces an independent prior by one fitted to the stack, since a photograph is no draw of it; then
        sub-imagers disagree only if they do so with either prior
    Raises InputError without noise, for H fitted to the stack itself, and where `restore` does.
    """
    execution = Execution(progress=progress)

    def checked(choice: MethodChoice) -> HeldOutReport:
        assumed = assumptions_for(stack, model, choice, execution)
        found = check_task(stack, assumed.method.task, choice.method, fitted=fitted, execution=execution)
        return with_fitted_prior(found) if stack.scene.prior.kind == "fit" else found

    return with_fallback(stack, model, checked)


@one_thread()
def check_task(
    stack: Stack, task: EstimationTask, method: str, *, fitted: bool, execution: Execution | None = None
) -> HeldOutReport:
    """Check a task whose noise is known; `method` is that of the estimate. Arguments and errors: `check_held_out`."""
    if method == "fit":
        raise InputError(
            "estimator.misalignment 'fit' fits H to all sub-imagers at once, so that none is held out; take 'trust'"
        )
    to_fit = fitted and task.prior.kind == "independent" and len(task.model.camera.sub_imagers) > 1
    prior = _fitted(task) if to_fit else None
    execution = execution or Execution()
    # Parts of a picture differ more from one another than the fitted prior knows; the scene's is wide enough for all.
    tasks = [task] if prior is None else [replace(task, prior=prior), task]
    found: list[HeldOutReport] = []
    for each in tasks:
        found.append(_check(each, execution, fitted=each is not task))
        if found[-1].verdict.trusted is not False:
            return found[-1]
    return _with_cause(found[0], stack, METHODS[method](tasks[0], execution))


def _with_cause(report: HeldOutReport, stack: Stack, method: Method) -> HeldOutReport:
    """Return the report of sub-imagers that disagree with the likely cause."""
    worst = np.array([entry.disagrees or entry.named for entry in report.sub_imagers])

    def excess(recorded: FloatArray, _: FloatArray) -> float:
        sums = held_out_sums(replace(method.task, recorded=recorded), method.execution)
        return float(np.maximum(_excess(sums)[worst], 0.0).sum())

    index = {entry.name: number for number, entry in enumerate(report.sub_imagers)}
    named = [index[entry.name] for entry in report.worst() if entry.named]
    reason = f"{report.verdict.reasons[0]}: {likely_cause(method, stack, excess, named)}"
    return report.model_copy(update={"verdict": HeldOutVerdict(trusted=False, reasons=(reason,))})


def _fitted(task: EstimationTask) -> FittedPrior | None:
    """Return a prior of natural pictures, None where the measurements are too few or show nothing.

    The errors of predictions hardly depend on it, since other sub-imagers see most of what one sees. It matters in
    components of the image that one sub-imager alone sees.
    """
    try:
        return fit_prior(task).prior
    except InputError:
        return None


def _check(task: EstimationTask, execution: Execution, *, fitted: bool) -> HeldOutReport:
    shown, total = windows(task)
    first = held_out_sums(task, execution)
    disagreeing = _disagreeing(first)
    named, sums = _culprits(task, execution, first)
    for index, before in named.items():
        sums[:, index] = before[:, index]
    subs = tuple(
        _sub_imager(sub, index, sums, bool(disagreeing[index]), index in named)
        for index, sub in enumerate(task.model.camera.sub_imagers)
    )
    explained = bool(named) or not disagreeing.any()
    prior = HeldOutPrior(
        kind=task.prior.kind,
        mean=task.prior.mean,
        variance=task.prior.variance,
        correlation_length=task.prior.correlation_length,
        fitted=fitted,
    )
    report = HeldOutReport(
        verdict=HeldOutVerdict(trusted=None, reasons=()),
        p_value=_familywise(first),
        explained=explained,
        prior=prior,
        windows=HeldOutWindows(checked=len(shown), total=total),
        sub_imagers=subs,
    )
    return report.model_copy(update={"verdict": _verdict(report)})


def with_fitted_prior(report: HeldOutReport) -> HeldOutReport:
    """Return the report of a prior that was fitted to the stack before."""
    return report.model_copy(update={"prior": report.prior.model_copy(update={"fitted": True})})


@one_thread()
def quick_check(stack: Stack, task: EstimationTask, method: str) -> HeldOutReport | None:
    """Check a task with its own prior as a part of a run; None where it is not possible, or would take long."""
    possible = method != "fit" and task.used.any() and bool((task.expected_noise > 0).all())
    most = MOST_QUICK if task.finer == 1 else MOST_QUICK_DETAILED
    if not possible or task.expected_noise.size > most or len(windows(task)[0]) > 1:
        return None
    try:
        return check_task(stack, task, method, fitted=False)
    except InputError:  # the noise is too small
        return None


def _culprits(
    task: EstimationTask, execution: Execution, first: FloatArray
) -> tuple[dict[int, FloatArray], FloatArray]:
    """Return the sub-imagers after whose removal all others agree, none if there are no such, and the others' sums.

    Of each that is removed, the sums are those before its removal.
    """
    named: dict[int, FloatArray] = {}
    last = first
    while (disagreeing := _disagreeing(last)).any():
        if len(named) == MOST_NAMED:
            return {}, first
        excess = _excess(last)
        named[int(np.argmax(np.where(disagreeing, excess, -np.inf)))] = last
        last = held_out_sums(_without(task, tuple(named)), execution)
        remaining = _excess(last)[_disagreeing(last)].sum()
        if remaining > (1 - LEAST_PROGRESS) * excess[disagreeing].sum():
            return {}, first
    return named, last


def _without(task: EstimationTask, left_out: tuple[int, ...]) -> EstimationTask:
    kept: BoolArray = task.used.copy()
    slices = task.model.camera.slices()
    for index in left_out:
        kept[slices[index]] = False
    return replace(task, used=kept, expected_noise=task.expected_noise[kept[task.used]])


def _excess(sums: FloatArray) -> FloatArray:
    """Sums of squares above their expectation: (sub-imagers,)."""
    return sums[1] - sums[0]


def _log_p(sums: FloatArray) -> FloatArray:
    """Logarithm of the probability of a larger sum of squares: (sub-imagers,), NaN without pixels."""
    result, (pixels, chi_squared, _) = np.full(sums.shape[1], np.nan), sums
    judged = pixels > 0
    result[judged] = log_survival(chi_squared[judged], pixels[judged])
    return result


def _disagreeing(sums: FloatArray) -> BoolArray:
    count = int(np.sum(sums[0] > 0))
    limit = np.log(-np.expm1(np.log1p(-SIGNIFICANCE) / max(count, 1)))
    with np.errstate(invalid="ignore"):  # NaN without pixels
        return (_log_p(sums) < limit) & (_excess(sums) > LEAST_EXCESS * sums[0])


def _familywise(sums: FloatArray) -> float | None:
    """Probability that the largest deviation of all is larger by chance (Sidak)."""
    count = int(np.sum(sums[0] > 0))
    if not count:
        return None
    least = float(np.exp(np.nanmin(_log_p(sums))))
    return 1.0 if least >= 1 else float(-np.expm1(count * np.log1p(-least)))


def _deviate(log_p: float, chi_squared: float, freedoms: int) -> float:
    """Return the normal deviate that is exceeded as rarely as `chi_squared`."""
    if log_p < log(0.5):
        return -float(special.ndtri_exp(log_p))
    return max(float(special.ndtri(special.gammainc(freedoms / 2, chi_squared / 2))), LEAST_DEVIATE)


def _sub_imager(sub: SubImager, index: int, sums: FloatArray, disagrees: bool, named: bool) -> HeldOutEntry:
    of_pixels, chi_squared, precision = sums[:, index].tolist()
    pixels = int(of_pixels)
    numbers: dict[str, float | None] = dict.fromkeys(("z", "p_value", "rms_error", "expected_rms"))
    if pixels:
        log_p = float(_log_p(sums)[index])
        numbers = {
            "z": _deviate(log_p, chi_squared, pixels),
            "p_value": float(np.exp(log_p)),
            "rms_error": (chi_squared / precision) ** 0.5,
            "expected_rms": (pixels / precision) ** 0.5,
        }
    return HeldOutEntry(
        name=sub.name,
        type=sub.type.name,
        k=sub.k,
        l=sub.l,
        pixels=pixels,
        chi_squared=chi_squared if pixels else 0.0,
        expected=float(pixels),
        **numbers,
        disagrees=disagrees,
        named=named,
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
        subject = f"sub-imager {_listed(named)} contradicts" if one else f"sub-imagers {_listed(named)} contradict"
        reason = f"{subject} the others, which agree; {_size(named[0])}"
    else:
        reason = (
            f"{len(disagreeing)} of {report.judged} sub-imagers contradict one another, most {_listed(disagreeing)}:"
            f" {_size(disagreeing[0])}"
        )
    return HeldOutVerdict(trusted=False, reasons=(reason,))


def _size(entry: HeldOutEntry) -> str:
    return f"{entry.name} errs by {entry.rms_error:.3g} grey levels where {entry.expected_rms:.3g} are expected"


def _listed(entries: list[HeldOutEntry]) -> str:
    return named(entry.name for entry in entries)
