"""The verdict on a run: whether its error bars can be trusted, why not, and what could not be checked.

There are three checks: chi-squared of the residual in all and by part, the interval of the error where the truth is
known, and the bound on the variances. A deviation counts if it is significant and exceeds a tenth of the number that is
stated; what can change a number by less is a note.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from scipy import special

from ommatid.runtime.arrays import BoolArray
from ommatid.scenes.camera import Camera

from ..expected_error import Interval
from ..noise import DITHER, OVEREXPOSED
from ..output.run_json import ResidualPart, VerdictReport
from .causes import MOST_NAMED, listed, named
from .residual import sidak

SIGNIFICANCE = 1e-4  # of the whole run, over all parts of the residual (Sidak)
SIZE = 0.1  # relative deviation from which a number is wrong
ROUGH = 0.05  # relative error of a map of variances from which it is a doubt
STRIKING = 1.5  # ratio to the whole from which a region is worth naming
UNCERTAIN = ": the uncertainty of H is more than a small correction; "
APART = 1.5  # ratio of the RMS error to expect for a picture to the stated one, from which its error bars are doubtful
PEAKED, POINTS = 7.0, 20.0  # kurtosis of an estimate from which it is worth a note, and a doubt
LEAST_HIDDEN = 0.3  # share of the prior's part in the error, below which the picture's contrast hardly matters to it
LEAST_LOSS = 0.05  # dB below the best single sub-image, which round to 0.1
MOST_OVEREXPOSED = 0.02  # share of an image that only saturated pixels see, from which the whole is not to be trusted
SPURIOUS_SHARE = 0.05  # of the information on a pixel, above which the noise of H is worth a note


def without_pixels(camera: Camera, used: BoolArray) -> tuple[str, ...]:
    """Return the names of the sub-imagers none of whose pixels is used."""
    pairs = zip(camera.sub_imagers, camera.slices(), strict=True)
    return tuple(sub.name for sub, part in pairs if not used[part].any())


@dataclass(frozen=True)
class ErrorCheck:
    """Numbers of the other checks.

    mse, interval : measured and expected error of the image, None if not known;  predicted : averaged over the prior
    variance_bound : on the relative error of variances
    spurious : relative error of Eq. 5 by the noise of H beyond what it counts
    spurious_share : of a pixel's information, on average
    calibration_share : of the predicted error that the uncertainty of H causes;  hidden : that the prior leaves open
    kurtosis : of the estimate in units of the prior, 3 for images of the prior
    undithered : noise over the quantisation step, None where it is large enough to make rounding errors independent
    rounding_share : of the noise
    overexposed : share of the image that saturated sensor pixels alone see
    pixels_used : sensor pixels;  left_out : sub-imagers without any usable pixel, by name
    more_samples : how to reduce the uncertainty of H
    """

    mse: float | None
    interval: Interval | None
    predicted: float
    variance_bound: float
    spurious: float
    spurious_share: float
    calibration_share: float
    hidden: float
    kurtosis: float
    fit_doubtful: bool
    fit_flat: bool
    noise_fitted: bool
    undithered: float | None
    rounding_share: float
    overexposed: float
    pixels_used: int
    left_out: tuple[str, ...]
    more_samples: str

    @property
    def most_by_rounding(self) -> float:
        """Largest ratio of a square to its expectation without a fault.

        Readings rounded without dither scatter by step^2 / 4 in place of step^2 / 12 where all are at one edge.
        """
        return 1.0 if self.undithered is None else 1 + 2 * self.rounding_share


@dataclass
class _Findings:
    reasons: list[str]
    passed: list[str]
    notes: list[str]
    doubts: list[str]


def judge(
    parts: list[ResidualPart], check: ErrorCheck, cause: Callable[[Sequence[ResidualPart]], str]
) -> VerdictReport:
    """Return the verdict from the residual by part, none where it was not checked, and the other checks.

    cause : the likely cause of a residual that is larger than expected in some parts
    """
    findings = _Findings([], [], [], [])
    if check.pixels_used:
        _judge_residual(parts, check, cause, findings)
        _judge_error(check, findings)
        _judge_rounding(check, findings)
        _judge_assumptions(check, findings)
    else:
        findings.reasons.append("no sensor pixel could be used, so this is the prior and not an image")
    p_value = sidak([part.p_value for part in parts]) if parts else None
    return VerdictReport(
        trusted=not findings.reasons,
        reasons=tuple(findings.reasons),
        doubts=tuple(findings.doubts),
        passed=tuple(findings.passed),
        notes=tuple(findings.notes),
        p_value=p_value,
        parts=tuple(parts),
    )


def with_gain(verdict: VerdictReport, gain: float | None, prior: str) -> VerdictReport:
    """Return the verdict with a doubt about an estimate that is worse than one sub-image by `gain`, in dB below 0.

    prior : its kind
    """
    if gain is None or gain > -LEAST_LOSS:
        return verdict
    remedy = "less noise, more sub-imagers or other lens types help" if prior == "fit" else "set prior.kind to 'fit'"
    words = f"the estimate is {-gain:.1f} dB worse than the best single sub-image, enlarged; {remedy}"
    return verdict.model_copy(update={"doubts": (*verdict.doubts, words)})


def excesses(parts: list[ResidualPart], largest: float = 1.0) -> list[ResidualPart]:
    """Return the parts whose residual is significantly and by more than a tenth larger than expected.

    largest : ratio to the expectation that is possible without a fault
    """
    most = (1 + SIZE) * largest
    return [part for part in parts if sidak([part.p_value] * len(parts)) < SIGNIFICANCE and part.ratio > most]


def _judge_residual(
    parts: list[ResidualPart], check: ErrorCheck, cause: Callable[[Sequence[ResidualPart]], str], findings: _Findings
) -> None:
    if not parts:
        findings.notes.append("chi-squared was not checked: some measurements are expected to have no noise")
        return
    whole, beyond = parts[0], excesses(parts, check.most_by_rounding)
    if check.noise_fitted:
        findings.notes.append("the noise was fitted to this stack, so chi-squared was checked by part only")
    if beyond:
        findings.reasons.append(f"{_excess_words(whole, beyond)}: {cause(beyond)}")
        return
    findings.passed.append(_residual_words(whole.ratio))
    uncertain = check.calibration_share > SIZE
    shortfall = (whole.prior - whole.chi_squared) / (2 * whole.prior) ** 0.5 if whole.prior else 0.0
    if whole.chi_squared < (1 - SIZE) * whole.prior and float(special.ndtr(-shortfall)) < SIGNIFICANCE:
        findings.notes.append(
            "the residual is smaller than for images drawn from the prior"
            f" ({100 * whole.chi_squared / whole.prior:.3g} % of their chi-squared): the picture is smoother than the"
            f" prior, or the noise{' or the uncertainty of H' if uncertain else ''} is smaller than stated"
        )


def _residual_words(ratio: float) -> str:
    """Say that a residual passed the check; ratio : chi-squared over its expectation."""
    size = "as large as expected"
    if ratio < 1 - SIZE:
        size = "smaller than expected"
    elif ratio > 1 + SIZE:
        size = "larger than expected, but not by more than chance or rounding"
    return f"the residual is {size} (chi-squared ratio {ratio:.3g})"


def _excess_words(whole: ResidualPart, beyond: list[ResidualPart]) -> str:
    """Say by how much the residual exceeds its expectation, and where most."""
    subs = sorted((part for part in beyond if part.kind == "sub-imager"), key=lambda part: -part.ratio)
    types = sorted((part for part in beyond if part.kind == "lens type"), key=lambda part: -part.ratio)
    places = sorted((part for part in beyond if part.kind == "region"), key=lambda part: -part.ratio)
    places = [place for place in places if place.ratio > STRIKING * whole.ratio]
    where: list[str] = []
    if subs:
        where.append(f"in {named([part.name for part in subs[:MOST_NAMED]])}")
    elif types:
        where.append(f"in lens type {types[0].name}")
    if places:
        where.append(f"{'in' if places[0].name == 'middle' else 'at'} the {places[0].name} of the target")
    is_everywhere = beyond[0] is whole
    ratio = whole.ratio if is_everywhere else max(part.ratio for part in beyond)
    places_words = f"{', most' if is_everywhere else ''} {' and '.join(where)}" if where else ""
    return f"the residual is too large{places_words} (chi-squared ratio {ratio:.3g})"


def _judge_error(check: ErrorCheck, findings: _Findings) -> None:
    interval, mse = check.interval, check.mse
    if mse is None:
        findings.notes.append("the error was not checked: the truth is not known")
    elif interval is None:
        findings.notes.append("the error was not checked: this method states no interval for one image")
    else:
        words = f"the error, {mse:.4g}, lies {{}} its 99 % interval, {interval.low:.4g} to {interval.high:.4g}"
        significant, uncertain = error_p_value(mse, interval) < SIGNIFICANCE, check.calibration_share > SIZE
        if mse > (1 + SIZE) * check.most_by_rounding * interval.high and significant:
            findings.reasons.append(words.format("above") + (UNCERTAIN + check.more_samples if uncertain else ""))
        elif mse < (1 - SIZE) * interval.low and significant:
            cause = "rounding, or the noise" if check.undithered is not None else "the noise"
            cause += ", or the uncertainty of H," if uncertain else "," if check.undithered is not None else ""
            findings.notes.append(f"{words.format('below')}: {cause} is smaller than stated")
        elif interval.low <= mse <= interval.high:
            findings.passed.append(words.format("inside"))
        else:
            findings.passed.append(words.format("outside") + ", but not by more than chance and a tenth")
        if interval.mse > APART**2 * check.predicted:
            findings.doubts.append(
                f"an error of {interval.mse**0.5:.3g} grey levels RMS is expected for this picture, and"
                f" {check.predicted**0.5:.3g} on average over the prior's images: it has detail that no lens shows and"
                " the prior does not expect, so that its error bars are too small"
            )
    if check.variance_bound > SIZE:
        findings.reasons.append(
            f"the variances of some pixels are wrong by {100 * check.variance_bound:.2g} % or more: the solver's map of"
            " them is an approximation; crop the target, or for pinholes set estimator.method to 'tiles'"
        )
    elif check.variance_bound > ROUGH:
        findings.doubts.append(
            f"the variances of some pixels are wrong by {100 * check.variance_bound:.2g} %: the solver's map of them is"
            " an approximation"
        )


def _judge_rounding(check: ErrorCheck, findings: _Findings) -> None:
    if check.undithered is not None:
        findings.notes.append(
            f"the noise is {check.undithered:.2g} times the quantisation step: where the picture is smooth,"
            " neighbouring pixels are rounded alike, and their mean may be off by up to half a step; noise of"
            f" {DITHER:g} steps or more makes errors of rounding independent"
        )


def error_p_value(mse: float, interval: Interval) -> float:
    """Return the probability of an error this far on its side of the expected one, as a gamma variate."""
    above = mse > interval.mse
    if not interval.variance > 0:
        return float(mse == interval.mse)
    shape, scaled = interval.mse**2 / interval.variance, mse * interval.mse / interval.variance
    return float(special.gammaincc(shape, scaled) if above else special.gammainc(shape, scaled))


def _judge_assumptions(check: ErrorCheck, findings: _Findings) -> None:
    if check.spurious > SIZE:
        findings.reasons.append(
            "the noise of H adds spurious information about pixels that the lens types determine poorly, more than the"
            f" predicted error can count; {check.more_samples}"
        )
    elif check.spurious_share > SPURIOUS_SHARE:
        findings.notes.append(
            f"the noise of H may have produced {100 * check.spurious_share:.2g} % of the information on a pixel, on"
            f" average; {check.more_samples}"
        )
    if check.fit_doubtful:
        findings.reasons.append(
            "the stack does not determine the fitted prior or noise: a number lies at the end of its range, or"
            " noise alone explains the measurements"
        )
    if check.fit_flat:
        (findings.doubts if check.interval is None else findings.notes).append(
            "noise alone explains the measurements: the image is about grey, and its error bars hold the contrast that"
            " such noise hides in natural pictures on average"
        )
    if check.kurtosis >= PEAKED and check.hidden >= LEAST_HIDDEN:
        (findings.doubts if check.kurtosis >= POINTS else findings.notes).append(
            f"the picture's contrast lies in few places, such as points or edges (kurtosis {check.kurtosis:.2g}, 3 for"
            " the prior's images): error bars are averages, smaller than the errors there and larger elsewhere"
        )
    if check.overexposed > OVEREXPOSED:
        (findings.reasons if check.overexposed > MOST_OVEREXPOSED else findings.doubts).append(
            f"{100 * check.overexposed:.3g} % of the image is seen by saturated sensor pixels alone: it is a lower"
            " bound there, and its error bars are too small; expose less, or raise the limit of saturation"
        )
    if check.left_out:
        findings.notes.append(
            f"{listed(check.left_out)} {'gives' if len(check.left_out) == 1 else 'give'} no usable pixel and"
            f" {'is' if len(check.left_out) == 1 else 'are'} left out"
        )
