"""Assemble the content of run.json from a stack, a model and their reconstruction."""

from __future__ import annotations

from dataclasses import asdict
from time import perf_counter
from typing import Any

from ommatid.runtime.versions import versions
from ommatid.scenes.model import Model
from ommatid.scenes.optics.negligible import SkippedEffect, assumptions, skipped_effects
from ommatid.scenes.stack import STRAIGHT, Stack

from ..held_out.check import quick_check, with_fitted_prior
from ..measured_error import best_single_sub_image
from ..restore import Reconstruction
from ..verdict.verdict import with_gain
from .run_json import (
    DiagnosticsReport,
    ErrorReport,
    FittedNumber,
    IntervalReport,
    MethodReport,
    ModelReport,
    RunReport,
    SeedReport,
    SkippedReport,
    StageReport,
)


def report_of(stack: Stack, model: Model, restoration: Reconstruction) -> RunReport:
    """Return the content of run.json, without a fingerprint."""
    start = perf_counter()
    held_out, best = _held_out(restoration, stack), _single(restoration, stack)
    single: dict[str, Any] = {} if best is None else {"baselines": (best,)}
    error = _error(restoration, best)
    stages = {
        "render": _stage(stack.record),
        "calibrate": _stage(model.record),
        "reconstruct": StageReport(seconds=restoration.seconds + perf_counter() - start),
    }
    as_run = stack.scene.model_copy(update={"calibration": model.scene.calibration})
    return RunReport(
        title=stack.scene.title,
        verdict=with_gain(restoration.verdict, error.gain, stack.scene.prior.kind),
        measurements=model.measurements,
        unknowns=stack.camera.unknowns,
        stages=stages,
        error=error,
        solver=restoration.solver.model_copy(update={"way": restoration.choice.method}),
        diagnostics=_diagnostics(restoration),
        model=_model(model, restoration.spurious_information),
        skipped=tuple(
            SkippedReport(**skipped.describe())
            for skipped in (
                *skipped_effects(as_run, stack.camera),
                *_skipped_in_world(stack),
                *_skipped_fit(restoration),
                *_skipped_errors(restoration),
            )
        ),
        assumes=assumptions(as_run, stack.camera),
        versions={
            **model.record.get("versions", {}),
            **stack.record.get("versions", {}),
            **versions("scipy", "scikit-image"),
        },
        seeds=SeedReport(
            scene=stack.record.get("seed"),  # recorded frames have none
            data=stack.record.get("first_seed"),
            calibration=model.record.get("first_seed"),
        ),
        **held_out,
        **single,
    )


def _held_out(restoration: Reconstruction, stack: Stack) -> dict[str, Any]:
    report = quick_check(stack, restoration.task, restoration.choice.method)
    if report is None:
        return {}
    fitted = restoration.fit is not None and restoration.fit.prior is not None
    return {"held_out": with_fitted_prior(report) if fitted else report}


def _stage(record: dict[str, Any]) -> StageReport:
    return StageReport(**{key: record[key] for key in StageReport.model_fields if key in record})


def _single(restoration: Reconstruction, stack: Stack) -> MethodReport | None:
    """Return the error of the best single sub-image, None where the truth is not known."""
    single = best_single_sub_image(stack, restoration.truth)
    if single is None or restoration.error is None:
        return None
    return MethodReport(method="single", sub_imager=single.name, mse=single.mse, psnr=single.psnr, ssim=single.ssim)


def _error(restoration: Reconstruction, single: MethodReport | None) -> ErrorReport:
    measured: dict[str, Any] = {} if restoration.error is None else asdict(restoration.error)
    if single is not None and restoration.error is not None:
        psnr = restoration.error.psnr
        measured["gain"] = None if psnr is None or single.psnr is None else psnr - single.psnr
    if restoration.interval is not None:
        measured["expected_given_truth"] = IntervalReport.model_validate(restoration.interval)
    given = restoration.given_estimate() if restoration.error is None else None
    if given is not None:
        measured["expected_given_estimate"] = given
    return ErrorReport(
        **measured,
        predicted_mse=restoration.expected.mse,
        predicted_trimmed_mse=restoration.trimmed_mse,
        budget=restoration.budget(),
    )


def _diagnostics(restoration: Reconstruction) -> DiagnosticsReport:
    fit = restoration.fit
    fitted: dict[str, Any] = {}
    if fit is not None:
        fitted = {
            "fit": {
                name: FittedNumber(value=value, log_deviation=deviation)
                for name, (value, deviation) in fit.numbers.items()
            },
            "fit_terms": () if fit.prior is None else fit.prior.terms,
            "fit_measurements": fit.measurements,
            "fit_doubtful": fit.doubtful,
        }
    if restoration.result.noise_difference is not None:
        fitted["noise_difference"] = restoration.result.noise_difference
    return DiagnosticsReport(
        pixels_used=int(restoration.usable.used.sum()),
        pixels_dead=restoration.usable.dead,
        pixels_saturated=restoration.usable.saturated,
        degrees_of_freedom=restoration.expected.degrees_of_freedom,
        resolution=restoration.expected.median_width,
        chi_squared=restoration.residual,
        **fitted,
    )


def _model(model: Model, spurious_information: float) -> ModelReport:
    known = 0.0 if model.record["method"] == "ideal" else None
    unknown = {"rms_difference_from_ideal": known, "max_z": None, "p_value": None}
    fit = {"fit": model.record["fit"]} if "fit" in model.record else {}
    return ModelReport(**model.record.get("agreement", unknown), spurious_information=spurious_information, **fit)


def _skipped_in_world(stack: Stack) -> tuple[SkippedEffect, ...]:
    """Return the effects that rendering skipped after it had examined the world."""
    if not stack.record.get(STRAIGHT):
        return ()
    return (SkippedEffect("interreflection", "nothing in the world reflects light: paths have one segment"),)


def _skipped_fit(restoration: Reconstruction) -> tuple[SkippedEffect, ...]:
    """Return the correlation of pixels where a prior was to be fitted, and the measurements show too little."""
    fit = restoration.fit
    if fit is None or fit.numbers:
        return ()
    why = f"{fit.measurements} measurements show too little to fit a prior to: pixels are independent"
    return (SkippedEffect("covariances between pixels of the prior", why),)


def _skipped_errors(restoration: Reconstruction) -> tuple[SkippedEffect, ...]:
    """Return the errors of few numbers of H if Eq. 5 is without them, with a bound on what they add to it."""
    most = restoration.result.left_out
    if most is None:
        return ()
    why = (
        "they are a thousandth of the other noise or less, and add at most"
        f" {100 * most / restoration.expected.mse:.2g} % to the expected error"
    )
    return (SkippedEffect("errors of the fitted numbers of H", why),)
