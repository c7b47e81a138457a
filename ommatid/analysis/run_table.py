"""The rows of the table that `run` and `reconstruct` print, from the content of run.json."""

from __future__ import annotations

from collections.abc import Sequence
from math import exp

from ommatid.reconstruct.output.run_json import (
    DiagnosticsReport,
    ErrorReport,
    ModelReport,
    RegionReport,
    RunReport,
    SolverReport,
    StageReport,
    TimeReport,
)
from ommatid.reconstruct.output.verdict_words import error_words, grounds, heading, is_trusted

from .summary import skipped_words

Row = tuple[str, str]

UNDETERMINED = 5.0  # deviation of the logarithm of a fitted number that may be anything
MAX_NAMES = 5  # sub-imagers named in one row
VERDICT = "verdict"


def rows(report: RunReport) -> list[Row]:
    """Return names and values, in the order in which they are printed; the verdict and what it assumes are first."""
    return [
        *_verdict_rows(report),
        *(("assumed", assumption) for assumption in report.assumes),
        *_stage_rows(report),
        *_error_rows(report.error),
        *(region_row(region) for region in report.regions),
        *_image_quality_rows(report.error),
        *_solver_rows(report.solver),
        *_diagnostic_rows(report.diagnostics, report.unknowns),
        *_model_rows(report.model),
        *((f"left out: {skipped.what}", skipped_words(skipped.why, skipped.bound)) for skipped in report.skipped),
        *_time_rows(report.spent, limits=is_trusted(report)),
    ]


def frame_row(name: str, report: RunReport) -> Row:
    """Return the name of a frame of many, and its verdict, error and time in words."""
    error, difference = report.error, report.diagnostics.noise_difference
    words = [heading(report), f"expected error {error_words(error.predicted_mse)}"]
    words += [] if error.mse is None else [f"measured {error_words(error.mse)}"]
    words.append(f"{report.stages['reconstruct'].seconds:.2f} s")
    if difference is None:
        words.append("error bars computed")
    else:
        words.append("error bars of an earlier frame" + (f", noise within {difference:.1g}" if difference else ""))
    return name, ", ".join(words)


def _verdict_rows(report: RunReport) -> list[Row]:
    notes = () if report.verdict is None else report.verdict.notes
    return [(VERDICT, f"{heading(report)}: {grounds(report)}"), *(("  note", note) for note in notes)]


def samples_of(stage: StageReport) -> str:
    """Return the number of samples of a stage in words."""
    if stage.fewest_samples is None:
        return f"{stage.samples} samples per pixel in {stage.passes} passes"
    words = f"{stage.fewest_samples} to {stage.samples} samples per pixel, as many as were needed"
    missed = list(stage.not_reached)
    if missed:
        return f"{words}; too few for {_named(missed)}: {stage.not_reached[missed[0]]}"
    return words if stage.auto.get("reached", True) else f"{words}; too few, no more are taken"


def _named(names: Sequence[str]) -> str:
    return ", ".join(names[:MAX_NAMES]) + (f" and {len(names) - MAX_NAMES} more" if names[MAX_NAMES:] else "")


def _stage_rows(report: RunReport) -> list[Row]:
    lines: list[Row] = []
    for name, stage in report.stages.items():
        details = [] if stage.samples is None else [samples_of(stage)]
        details += [] if stage.variant is None else [stage.variant]
        if name == "reconstruct":
            details.append(f"{_method(report.solver)}, {report.unknowns} unknowns")
        label = "import" if stage.method == "imported" else name
        lines.append((f"{label}, seconds", ", ".join([f"{stage.seconds:.2f}", *details])))
    if report.spent.start_up is not None:
        lines.append(("start-up, seconds", f"{report.spent.start_up:.2f}"))
    return lines


def _method(solver: SolverReport) -> str:
    if solver.way == "frame":
        return f"whole frame, {solver.refinements} steps of conjugate gradients"
    return f"{solver.method} form"


def _error_rows(error: ErrorReport) -> list[Row]:
    lines: list[Row] = []
    if error.mse is not None:
        lines.append(("mean squared error, measured", error_words(error.mse)))
    given = error.expected_given_truth
    if given is not None:
        lines.append(
            ("  expected for this picture", f"{error_words(given.mse)}, 99 %: {given.low:.4g} to {given.high:.4g}")
        )
    total = error.predicted_mse
    lines.append(("  predicted (Eq. 5)", error_words(total)))
    return lines + [
        (f"    from {name.replace('_', ' ')}", f"{part:.3g} ({100 * part / total:.1f} %)")
        for name, part in error.budget.items()
        if part > 0 and total > 0
    ]


def region_row(region: RegionReport) -> Row:
    """Return the place of a region, and the mean of the estimate in it with its standard deviation."""
    (row, column), (rows, columns) = region.corner, region.size
    return f"mean of {rows} x {columns} pixels at {row}, {column}", f"{region.mean:.4f} +/- {region.deviation:.2g}"


def _image_quality_rows(error: ErrorReport) -> list[Row]:
    if error.mse is None:
        return []
    psnr = "exact" if error.psnr is None else f"{error.psnr:.2f} dB"
    ssim = "image too small" if error.ssim is None else f"{error.ssim:.4f}"
    return [("PSNR (peak 255)", psnr), ("structural similarity", ssim)]


def _solver_rows(solver: SolverReport) -> list[Row]:
    if solver.way == "frame":
        lines = [
            ("computation, error", f"below {solver.bound or 0.0:.1g} posterior standard deviations in every pixel"),
            ("  of variances", f"{solver.variance_bound:.1g}, relative, by exact solutions for some pixels"),
        ]
    else:
        bounds = f"error below {solver.bound or 0.0:.0e}, of variances {solver.variance_bound:.0e} (relative)"
        lines = [("right digits", f"{solver.digits:.1f}: {bounds}")]
    if solver.way == "tiles":
        lines.append(("  in tiles", solver.why))
    return lines + [(f"  not by the {form.method} form", form.why_not) for form in solver.tried]


def _diagnostic_rows(diagnostics: DiagnosticsReport, unknowns: int) -> list[Row]:
    lines: list[Row] = []
    if diagnostics.pixels_dead:
        lines.append(("sensor pixels left out", f"{diagnostics.pixels_dead} dead"))
    if diagnostics.pixels_saturated:
        lines.append(("saturated sensor pixels", f"{diagnostics.pixels_saturated}, known to reach the limit"))
    width = "nothing is resolved" if diagnostics.resolution is None else f"{diagnostics.resolution:.3g} pixels of f"
    lines += [
        ("degrees of freedom", f"{diagnostics.degrees_of_freedom:.1f} of {unknowns}"),
        ("resolution, median", width),
    ]
    residual = diagnostics.chi_squared
    if residual is not None:
        expected = f"expected {residual.expected:.4g} +/- {residual.deviation:.2g}"
        lines.append(("chi-squared of the residual", f"{residual.chi_squared:.4g}, {expected}"))
    for name, number in diagnostics.fit.items():
        unit = " pixels of f" if name == "correlation_length" else ""
        known = number.log_deviation < UNDETERMINED
        precision = f"within a factor of {exp(number.log_deviation):.3g}" if known else "which the stack leaves open"
        lines.append((f"fitted {name.replace('_', ' ')}", f"{number.value:.4g}{unit}, {precision}"))
    return lines


def _model_rows(model: ModelReport) -> list[Row]:
    lines: list[Row] = []
    if None not in (model.max_z, model.rms_difference_from_ideal, model.p_value):
        difference = f"{model.rms_difference_from_ideal:.2g} rms, largest z {model.max_z:.1f}, p {model.p_value:.2g}"
        lines.append(("H against the ideal one", difference))
    if model.fit is not None:
        refused = model.fit["refused"]
        rest = f"; as measured, since the fit is not good there: {_named(refused)}" if refused else ""
        lines.append(("H by a fit of its geometry", f"{model.fit['accepted']} sub-imagers{rest}"))
    return lines


def _time_rows(spent: TimeReport, limits: bool) -> list[Row]:
    """limits : True to state what more time would bring"""
    lines: list[Row] = []
    if spent.within is not None:
        stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in spent.stages.items())
        chosen = ", ".join(f"{key} {value}" for key, value in spent.chosen.items())
        lines.append(("time", f"{spent.seconds:.1f} s of {spent.within:g} s: {stages}; chosen: {chosen}"))
    if spent.more and limits:
        more = ", ".join(f"{more.seconds:.3g} s: {more.predicted_mse:.4g}" for more in spent.more[:2])
        lines.append(("error at most, in more time", f"{more}; by noise alone: {spent.noise_alone:.4g}"))
    return lines
