"""What a result says, as a list of facts: lines, tables, pages, notebooks and figures print these."""

from __future__ import annotations

from math import exp, sqrt
from pathlib import Path
from typing import Literal, NamedTuple

from ommatid.runtime.errors import named

from .run_json import (
    DiagnosticsReport,
    ErrorReport,
    ModelReport,
    RegionReport,
    RunReport,
    SolverReport,
    StageReport,
)
from .verdict_words import causes, grounds, heading, limit

UNDETERMINED = 5.0  # deviation of the logarithm of a fitted number that may be anything
METHODS = {
    "single": "best single sub-image",
    "rearranged": "pixel rearrangement",
    "shift_and_add": "shift-and-add",
    "total_variation": "total variation",
}  # of `--baselines`

Topic = Literal["verdict", "error", "quality", "limit", "time", "stage", "caution", "region"]
LINES: tuple[Topic, ...] = "error", "quality", "limit", "time"  # of a summary, below the verdict


class Fact(NamedTuple):
    """A quantity of a result.

    beside : what the value is compared with, or how it came about
    topic : of the facts that sum up a result
    """

    name: str
    value: str
    beside: str = ""
    topic: Topic | None = None

    @property
    def words(self) -> str:
        """The value, and in brackets what stands beside it."""
        return f"{self.value} ({self.beside})" if self.beside else self.value

    @property
    def row(self) -> tuple[str, str]:
        """The fact as a row of a table."""
        return self.name, self.words


def facts(report: RunReport) -> list[Fact]:
    """Return all facts of a result, the verdict and what it assumes first."""
    return [
        *_verdict(report),
        *_stages(report),
        *_error(report.error),
        *map(region, report.regions),
        *_quality(report),
        *(Fact(f"MSE by {name}", mse, f"PSNR {psnr}, {time}") for name, mse, psnr, _, time in _compared(report)),
        Fact("limit", limit(report), topic="limit"),
        *_solver(report.solver),
        *_diagnostics(report.diagnostics),
        *_model(report.model),
        *(Fact(f"left out: {each.what}", skipped_words(each.why, each.bound)) for each in report.skipped),
        *_time(report),
    ]


def on_topic(report: RunReport, *topics: Topic) -> list[Fact]:
    """Return the facts of a result on some topics."""
    return [fact for fact in facts(report) if fact.topic in topics]


def rows(report: RunReport) -> list[tuple[str, str]]:
    """Return all facts as the rows of a table."""
    return [fact.row for fact in facts(report)]


def verdict_line(name: str, report: RunReport) -> str:
    """Return the name of a result and its verdict."""
    return f"{name}: {_verdict(report)[0].value}"


def summary_lines(name: str, report: RunReport, page: Path | None) -> list[str]:
    """Return six lines: verdict, error, quality, what limits the error, time, and page; then one for each region."""
    where = "none is written with the estimate alone; name a folder with -o" if page is None else str(page)
    every, lines = facts(report), [verdict_line(name, report)]
    for topic in LINES:
        found = (fact for fact in every if fact.topic == topic)
        words = ", ".join(fact.words if fact.name == topic else f"{fact.name} {fact.words}" for fact in found)
        lines.append(f"  {topic:8} {words}")
    lines.append(f"  {'page':8} {where}")
    return lines + [f"  {fact.topic:8} {fact.name} is {fact.value}" for fact in every if fact.topic == "region"]


def frame_row(name: str, report: RunReport) -> tuple[str, str]:
    """Return the name of a frame of many, and its verdict, error and time in words."""
    shared = [fact.words for fact in _diagnostics(report.diagnostics) if fact.name == "error bars"]
    return name, ", ".join(
        [heading(report), headline(report), f"{report.stages['reconstruct'].seconds:.2f} s", *shared]
    )


def agreement(error: ErrorReport) -> Literal["agrees", "worse", "better", "unknown"]:
    """Return how the measured error compares with the interval that is expected for this image."""
    given = error.expected_given_truth
    if given is None or error.mse is None:
        return "unknown"
    if error.mse > given.high:
        return "worse"
    return "agrees" if error.mse >= given.low else "better"


def headline(report: RunReport) -> str:
    """Return the error of a result in one line, and its gain over the best single sub-image."""
    first, *_ = on_topic(report, "error")
    gain = [fact for fact in on_topic(report, "quality") if fact.name == "gain"]
    return ", ".join(f"{fact.name} {fact.words}" for fact in (first, *gain))


def baseline_rows(report: RunReport) -> list[tuple[str, str, str, str, str]]:
    """Return method, mean squared error, PSNR, SSIM and time of the estimate and of the baselines, the best first."""
    error = report.error
    ours = _method_row("this estimate", error.mse or 0.0, error.psnr, error.ssim, report.stages["reconstruct"].seconds)
    pairs = [(error.mse or 0.0, ours)]
    pairs += [(each.mse, row) for each, row in zip(report.baselines, _compared(report), strict=True)]
    return [row for _, row in sorted(pairs, key=lambda pair: pair[0])]


def _compared(report: RunReport) -> list[tuple[str, str, str, str, str]]:
    """Return the rows of the baselines, none without `--baselines`, where there is at most the single sub-image."""
    single = report.single
    if len(report.baselines) < 2:
        return []
    names = {"single": f"{METHODS['single']}, {single.sub_imager}"} if single is not None else {}
    return [
        _method_row((METHODS | names)[each.method], each.mse, each.psnr, each.ssim, each.seconds)
        for each in report.baselines
    ]


def _method_row(
    name: str, mse: float, psnr: float | None, ssim: float | None, seconds: float | None
) -> tuple[str, str, str, str, str]:
    quality = "exact" if psnr is None else f"{psnr:.1f} dB"
    return name, f"{mse:.4g}", quality, "" if ssim is None else f"{ssim:.4f}", f"{seconds or 0.0:.2g} s"


def samples_of(stage: StageReport) -> str:
    """Return the number of samples of a stage in words."""
    if stage.fewest_samples is None:
        return f"{stage.samples} samples per pixel in {stage.passes} passes"
    words = f"{stage.fewest_samples} to {stage.samples} samples per pixel, as many as were needed"
    missed = list(stage.not_reached)
    if missed:
        return f"{words}; too few for {named(missed)}: {stage.not_reached[missed[0]]}"
    return words if stage.auto.get("reached", True) else f"{words}; too few, no more are taken"


def skipped_words(why: str, bound: float | None) -> str:
    """Return the reason for skipping an effect, with the bound on its effect."""
    return why if bound is None else f"{why}; no measurement changes by more than {bound:.2g}"


def region(report: RegionReport) -> Fact:
    """Return the mean of the estimate in a region with its standard deviation."""
    (row, column), (height, width) = report.corner, report.size
    mean = f"{report.mean:.4f} +/- {report.deviation:.2g}"
    return Fact(f"mean of {height} x {width} pixels at {row}, {column}", mean, topic="region")


def _verdict(report: RunReport) -> list[Fact]:
    return [
        Fact("verdict", f"{heading(report)}: {grounds(report)}", topic="verdict"),
        *(Fact("  note", note) for note in report.verdict.notes),
        *(Fact("assumed", assumption) for assumption in report.assumes),
    ]


def _stages(report: RunReport) -> list[Fact]:
    found: list[Fact] = []
    for name, stage in report.stages.items():
        details = [] if stage.method in (None, "imported") else [str(stage.method)]
        details += [] if stage.samples is None else [samples_of(stage)]
        details += [each for each in (stage.sampler, stage.variant) if each is not None]
        if name == "reconstruct":
            details.append(f"{_method(report.solver)}, {report.unknowns} unknowns")
        named = "import" if stage.method == "imported" else name
        found.append(Fact(named, f"{stage.seconds:.2f} s", ", ".join(details), "stage"))
    if report.spent.start_up is not None:
        found.append(Fact("start-up", f"{report.spent.start_up:.2f} s", topic="stage"))
    return found


def _method(solver: SolverReport) -> str:
    if solver.way == "frame":
        return f"whole frame, {solver.refinements} steps of conjugate gradients"
    return f"{solver.method} form"


def _error(error: ErrorReport) -> list[Fact]:
    given, total = error.expected_given_truth, error.predicted_mse
    parts = [
        Fact(f"  from {name}", f"{part:.3g}", f"{share:.1f} %") for name, part, share in causes(error.budget, total)
    ]
    predicted = [Fact("predicted MSE (Eq. 5)", f"{total:.4g}", "for images of the prior"), *parts]
    if error.mse is None:
        alike = error.expected_given_estimate
        words = "" if alike is None else f"{sqrt(alike):.3g} if the image is the estimate; "
        words += "the truth is not known"
        return [Fact("expected RMS error", f"{sqrt(total):.3g} grey levels", words, "error"), *predicted]
    expected = total if given is None else given.mse
    interval = "" if given is None else f", 99 %: {given.low:.4g} to {given.high:.4g}"
    return [
        Fact("RMS error", f"{sqrt(error.mse):.3g} grey levels", f"expected {sqrt(expected):.3g}", "error"),
        Fact("MSE", f"{error.mse:.4g}", f"expected {expected:.4g}{interval}", "error"),
        *predicted,
    ]


def _quality(report: RunReport) -> list[Fact]:
    error, diagnostics = report.error, report.diagnostics
    width = "nothing is resolved" if diagnostics.resolution is None else _pixels(diagnostics.resolution)
    freedom = f"{diagnostics.degrees_of_freedom:.4g} of {report.unknowns}"
    of_image: Topic | None = "quality" if error.mse is None else None
    found = [Fact("resolution", width, "median", of_image), Fact("degrees of freedom", freedom, topic=of_image)]
    if error.mse is None:
        return found
    single = report.single
    psnr = "exact" if error.psnr is None else f"{error.psnr:.1f} dB"
    beside = "" if single is None or single.psnr is None else f"single sub-image: {single.psnr:.1f} dB"
    quality = [Fact("PSNR", psnr, beside, "quality")]
    if error.ssim is not None:
        beside = "" if single is None or single.ssim is None else f"single sub-image: {single.ssim:.4f}"
        quality.append(Fact("SSIM", f"{error.ssim:.4f}", beside, "quality"))
    if single is not None and error.gain is not None:
        quality.append(Fact("gain", f"{error.gain:.1f} dB", f"over the best sub-image, {single.sub_imager}", "quality"))
    return [*quality, *found]


def _solver(solver: SolverReport) -> list[Fact]:
    if solver.way == "frame":
        bound = f"below {solver.bound or 0.0:.1g} posterior standard deviations in every pixel"
        found = [
            Fact("error of the computation", bound),
            Fact("  of the variances", f"{solver.variance_bound:.1g}, relative, by exact solutions for some pixels"),
        ]
    else:
        bounds = f"error below {solver.bound or 0.0:.0e}, of variances {solver.variance_bound:.0e}, relative"
        found = [Fact("correct digits", f"{solver.digits:.1f}", bounds)]
    if solver.way == "tiles":
        found.append(Fact("  in tiles", solver.why))
    return found + [Fact(f"  not by the {form.method} form", form.why_not) for form in solver.tried]


def _diagnostics(diagnostics: DiagnosticsReport) -> list[Fact]:
    found: list[Fact] = []
    if diagnostics.pixels_dead:
        found.append(Fact("sensor pixels left out", f"{diagnostics.pixels_dead} dead", topic="caution"))
    if diagnostics.pixels_saturated:
        reach = f"{diagnostics.pixels_saturated}, known to reach the limit"
        found.append(Fact("saturated sensor pixels", reach, topic="caution"))
    if diagnostics.noise_difference is not None:
        within = f"noise within {diagnostics.noise_difference:.1g}" if diagnostics.noise_difference else ""
        found.append(Fact("error bars", "error bars of an earlier frame", within))
    residual = diagnostics.chi_squared
    if residual is not None:
        expected = f"expected {residual.expected:.4g} +/- {residual.deviation:.2g}"
        found.append(Fact("chi-squared of the residual", f"{residual.chi_squared:.4g}", expected))
    for name, number in diagnostics.fit.items():
        value = _pixels(number.value) if name == "correlation_length" else f"{number.value:.4g}"
        found.append(Fact(f"fitted {name.replace('_', ' ')}", value, _precision(number.log_deviation)))
    return found


def _pixels(length: float) -> str:
    return "1 pixel of f" if f"{length:.3g}" == "1" else f"{length:.3g} pixels of f"


def _precision(log_deviation: float) -> str:
    """Return how well a fitted number is known; empty for one that was not fitted."""
    if log_deviation >= UNDETERMINED:
        return "which the stack leaves open"
    percent = f"{100 * log_deviation:.2g}"
    if log_deviation >= 0.1:
        return f"within a factor of {exp(log_deviation):.3g}"
    return "" if percent == "0" else f"within {percent} %"


def _model(model: ModelReport) -> list[Fact]:
    found: list[Fact] = []
    if None not in (model.max_z, model.rms_difference_from_ideal, model.p_value):
        difference = f"{model.rms_difference_from_ideal:.2g} rms, largest z {model.max_z:.1f}, p {model.p_value:.2g}"
        found.append(Fact("H against the ideal one", difference))
    if model.fit is not None:
        refused = model.fit["refused"]
        rest = f"; as measured, since the fit is not good there: {named(refused)}" if refused else ""
        found.append(Fact("H by a fit of its geometry", f"{model.fit['accepted']} sub-imagers{rest}"))
    return found


def _time(report: RunReport) -> list[Fact]:
    spent, more = report.spent, report.more_samples
    stages = ", ".join(f"{name} {stage.seconds:.1f} s" for name, stage in report.stages.items())
    found = [Fact("time", f"{report.seconds:.1f} s", stages, "time")]
    if spent.within is not None:
        chosen = ", ".join(f"{key} {value}" for key, value in spent.chosen.items())
        limit = f"{spent.seconds or 0.0:.1f} s of {spent.within:g} s, all trials together"
        found.append(Fact("  of the time limit", limit, chosen, "stage"))
    if more and report.verdict.trusted:
        found += [
            Fact(f"MSE with {each.times} times the samples", f"at most {each.predicted_mse:.4g}", time, "stage")
            for each in more
            for time in [f"in {each.seconds:.3g} s"]
        ]
        found.append(Fact("MSE with noise alone", f"{report.noise_alone:.4g}", topic="stage"))
    return found
