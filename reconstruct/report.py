"""What a run says of itself: run.json, estimate.exr, and the rows of the table that is printed.

The keys of run.json are a contract: stages, error, solver, model, skipped, versions, seeds.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from math import exp, isfinite
from pathlib import Path
from typing import Any

import numpy as np

from scenes import exr
from scenes.files import write_text
from scenes.model import Model
from scenes.needs import LeftOut
from scenes.plan import left_out
from scenes.scene import Scene
from scenes.show import why_left_out
from scenes.stack import STRAIGHT, Stack
from scenes.versions import versions

from . import spent
from .estimator import Solver
from .fit import Fit
from .restore import MOST_FEIGNED, Restoration

MOST_NAMED = 5  # sub-imagers, in a line of the table
WARNING = (
    "the lens types leave pixels open on which the noise of H feigns information:"
    " raise calibration.samples, or take calibration.method = 'ideal' if the camera is"
)


def write_estimate(path: Path, restoration: Restoration, record: dict[str, Any]) -> None:
    """Write channels `estimate`, `variance` (diagonal of Eq. 5) and, where it is known, `truth`, as float32."""
    shape = restoration.shape
    channels = {
        "estimate": restoration.estimate.reshape(shape).astype(np.float32),
        "variance": restoration.expected.variance.reshape(shape).astype(np.float32),
    }
    if restoration.truth is not None:
        channels["truth"] = restoration.truth.reshape(shape).astype(np.float32)
    exr.write(path, [exr.Part("estimate", channels, record)])


def describe(stack: Stack, model: Model, restoration: Restoration) -> dict[str, Any]:
    """Everything that run.json says, in JSON's types."""
    error: dict[str, Any] = {
        "predicted_mse": restoration.expected.mse,
        "predicted_trimmed_mse": restoration.trimmed_mse,
        "budget": restoration.budget(),
    }
    if restoration.error is not None:
        error = {**asdict(restoration.error), **error}
    if restoration.interval is not None:
        error["expected_given_truth"] = asdict(restoration.interval)
    stages = {
        "render": {**_how(stack.record), **_stage(stack.record)},
        "calibrate": {"method": model.record["method"], **_stage(model.record)},
        "reconstruct": {"seconds": restoration.seconds},
    }
    described: dict[str, Any] = {
        "title": stack.scene.title,
        "measurements": model.measurements,
        "unknowns": model.unknowns,
        "stages": stages,
        "error": error,
        "solver": {"way": restoration.choice.way, **_solver(restoration.solver)},
        "diagnostics": _diagnostics(restoration),
        "model": {
            **model.record.get("agreement", _unknown(model)),
            "feigned_information": restoration.feigned,
            **({"fit": model.record["fit"]} if "fit" in model.record else {}),
        },
        "skipped": [left.describe() for left in (*left_out(_as_run(stack, model), model.camera), *_of_world(stack))],
        "versions": {
            **model.record.get("versions", {}),
            **stack.record.get("versions", {}),
            **versions("scipy", "scikit-image"),
        },
        "seeds": {
            "scene": stack.record.get("seed"),  # recorded frames have none
            "data": stack.record.get("first_seed"),
            "calibration": model.record.get("first_seed"),
        },
    }
    return {**described, "spent": spent.spent(described, calibrated=model.record["method"] != "ideal")}


def _solver(solver: Solver) -> dict[str, Any]:
    return {
        "method": solver.method,
        "why": solver.why,
        "condition": solver.condition if isfinite(solver.condition) else None,
        "digits": solver.digits,
        "bound": solver.bound,
        "unit": solver.unit,
        "variance_bound": solver.variance_bound,
        "refinements": solver.refinements,
        "tried": [{"method": name, "why_not": reason} for name, reason in solver.tried],
    }


def _diagnostics(restoration: Restoration) -> dict[str, Any]:
    width = float(np.median(restoration.expected.resolution))
    fit, residual = restoration.fit, restoration.residual
    described: dict[str, Any] = {
        "pixels_used": int(restoration.usable.used.sum()),
        "pixels_dead": restoration.usable.dead,
        "pixels_saturated": restoration.usable.saturated,
        "degrees_of_freedom": restoration.expected.degrees_of_freedom,
        "resolution": width if isfinite(width) else None,
        "chi_squared": None if residual is None else asdict(residual),
    }
    if fit is not None:
        names = ("variance", "correlation_length", "noise_variance")
        found = {name: value for name, value in zip(names, _numbers(fit), strict=True) if value is not None}
        doubts = [value if isfinite(value) else None for value in fit.spread]
        described["fit"] = {
            name: {"value": value, "log_deviation": doubt}
            for (name, value), doubt in zip(found.items(), doubts, strict=True)
        }
        described["fit_measurements"], described["fit_doubtful"] = fit.measurements, fit.doubtful
    return described


def _numbers(fit: Fit) -> tuple[float | None, ...]:
    return fit.variance, fit.length, fit.noise_variance


def _unknown(model: Model) -> dict[str, float | None]:
    known = 0.0 if model.record["method"] == "ideal" else None
    return {"rms_difference_from_ideal": known, "max_z": None, "p_value": None}


def _of_world(stack: Stack) -> tuple[LeftOut, ...]:
    """What rendering left out once it had seen the world."""
    if not stack.record.get(STRAIGHT):
        return ()
    return (LeftOut("light that bounces", "nothing in the world reflects any: paths have one segment"),)


def _as_run(stack: Stack, model: Model) -> Scene:
    return stack.scene.model_copy(update={"calibration": model.scene.calibration})


def write_run(path: Path, description: dict[str, Any]) -> None:
    """Write run.json."""
    write_text(path, json.dumps(description, indent=2, allow_nan=False) + "\n")


def _how(record: dict[str, Any]) -> dict[str, Any]:
    return {"method": record["method"]} if "method" in record else {}


def _stage(record: dict[str, Any]) -> dict[str, Any]:
    keys = (
        "seconds",
        "samples",
        "fewest_samples",
        "passes",
        "sampler",
        "variant",
        "rays",
        "reached",
        "not_reached",
        "auto",
    )
    return {key: record[key] for key in keys if key in record}


def rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """The lines of the printed table: what, and how much."""
    error, stages = description["error"], description["stages"]
    lines: list[tuple[str, str]] = []
    for name, stage in stages.items():
        made = [samples_of(stage)] if "samples" in stage else []
        made += [stage["variant"]] if "variant" in stage else []
        if name == "reconstruct":
            made.append(f"{_way(description['solver'])}, {description['unknowns']} unknowns")
        done = "import" if stage.get("method") == "imported" else name
        lines.append((f"{done}, seconds", ", ".join([f"{stage['seconds']:.2f}", *made])))
    if "mse" in error:
        lines.append(("mean squared error, measured", f"{error['mse']:.4g}"))
    if "expected_given_truth" in error:
        given = error["expected_given_truth"]
        lines.append(
            ("  expected for this picture", f"{given['mse']:.4g} (99 %: {given['low']:.4g} to {given['high']:.4g})")
        )
    lines.append(("  predicted (Eq. 5)", f"{error['predicted_mse']:.4g}"))
    total = error["predicted_mse"]
    for name, part in error["budget"].items():
        if part > 0:
            lines.append((f"    from {name.replace('_', ' ')}", f"{part:.3g} ({100 * part / total:.1f} %)"))
    if "region" in description:
        lines.append(_region_row(description["region"]))
    if "mse" in error:
        psnr = "exact" if error["psnr"] is None else f"{error['psnr']:.2f} dB"
        ssim = "picture too small" if error["ssim"] is None else f"{error['ssim']:.4f}"
        lines += [("PSNR (peak 255)", psnr), ("structural similarity", ssim)]
    lines += _solver_rows(description["solver"]) + _diagnostic_rows(description["diagnostics"], description["unknowns"])
    agreement = description["model"]
    if agreement["max_z"] is not None:
        difference = f"{agreement['rms_difference_from_ideal']:.2g} rms"
        lines.append(
            (
                "H against the ideal one",
                f"{difference}, largest z {agreement['max_z']:.1f}, p {agreement['p_value']:.2g}",
            )
        )
    if "fit" in agreement:
        lines.append(("H by a fit of its geometry", _fitted(agreement["fit"])))
    if agreement["feigned_information"] > MOST_FEIGNED:
        lines.append(("do not trust the predicted error", WARNING))
    lines += [(f"left out: {skip['what']}", why_left_out(skip)) for skip in description["skipped"]]
    return lines + spent.rows(description["spent"])


def samples_of(stage: dict[str, Any]) -> str:
    """How many samples a stage took, in words."""
    if "fewest_samples" not in stage:
        return f"{stage['samples']} samples a pixel in {stage['passes']} passes"
    said = f"{stage['fewest_samples']} to {stage['samples']} samples a pixel, as many as were needed"
    missed = list(stage.get("not_reached", {}))
    if missed:
        return f"{said}; too few for {_named(missed)}: {stage['not_reached'][missed[0]]}"
    return said if stage.get("auto", {}).get("reached", True) else f"{said}; too few, no more are taken"


def _named(names: list[str]) -> str:
    return ", ".join(names[:MOST_NAMED]) + (f" and {len(names) - MOST_NAMED} more" if names[MOST_NAMED:] else "")


def _fitted(fit: dict[str, Any]) -> str:
    refused = fit["refused"]
    told = f"{fit['accepted']} sub-imagers"
    if not refused:
        return told
    return f"{told}; as measured, since the fit is no good there: {_named(refused)}"


def _way(solver: dict[str, Any]) -> str:
    if solver["way"] == "frame":
        return f"whole frame, {solver['refinements']} steps of conjugate gradients"
    return f"{solver['method']} form"


def _solver_rows(solver: dict[str, Any]) -> list[tuple[str, str]]:
    if solver["way"] == "frame":
        lines = [
            ("computation, error", f"below {solver['bound']:.1g} posterior standard deviations in every pixel"),
            ("  of variances", f"{solver['variance_bound']:.1g}, relative, by exact solutions for some pixels"),
        ]
    else:
        bounds = f"error below {solver['bound']:.0e}, of variances {solver['variance_bound']:.0e} (relative)"
        lines = [("right digits", f"{solver['digits']:.1f}: {bounds}")]
    return lines + [(f"  not by the {failed['method']} form", failed["why_not"]) for failed in solver["tried"]]


def _diagnostic_rows(found: dict[str, Any], unknowns: int) -> list[tuple[str, str]]:
    lines: list[tuple[str, str]] = []
    if found["pixels_dead"] or found["pixels_saturated"]:
        lines.append(("sensor pixels left out", f"{found['pixels_dead']} dead, {found['pixels_saturated']} saturated"))
    if not found["pixels_used"]:
        lines.append(("do not look for the image here", "no sensor pixel is left, so this is the prior"))
    width = "nothing is resolved" if found["resolution"] is None else f"{found['resolution']:.3g} pixels of f"
    residual = found["chi_squared"]
    lines += [
        ("degrees of freedom", f"{found['degrees_of_freedom']:.1f} of {unknowns}"),
        ("resolution, median", width),
    ]
    if residual is not None:
        expected = f"{residual['expected']:.4g}, give or take {residual['deviation']:.2g}"
        lines.append(("chi-squared of the residual", f"{residual['chi_squared']:.4g}, expected {expected}"))
    for name, one in found.get("fit", {}).items():
        spread = one["log_deviation"]
        doubt = "how well is not known" if spread is None else f"within a factor of {exp(spread):.3g}"
        unit = " pixels of f" if name == "correlation_length" else ""
        lines.append((f"found: {name.replace('_', ' ')}", f"{one['value']:.4g}{unit}, {doubt}"))
    if found.get("fit_doubtful"):
        lines.append(("do not trust what was found", "the stack does not tell it: it lies where the search ended"))
    return lines


def _region_row(region: dict[str, Any]) -> tuple[str, str]:
    (row, column), (rows, columns) = region["corner"], region["size"]
    where = f"mean of {rows} x {columns} pixels at {row}, {column}"
    return where, f"{region['mean']:.4f}, give or take {region['deviation']:.2g}"
