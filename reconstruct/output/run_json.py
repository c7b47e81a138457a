"""What a run says of itself: run.json and estimate.exr.

The keys of run.json are a contract: stages, error, solver, model, skipped, versions, seeds.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.files import write_text
from ommatid.runtime.versions import versions
from ommatid.scenes.formats import exr
from ommatid.scenes.model import Model
from ommatid.scenes.optics.negligible import SkippedEffect
from ommatid.scenes.scene import Scene
from ommatid.scenes.skipped import skipped_effects
from ommatid.scenes.stack import STRAIGHT, Stack

from ..estimator.estimate import Solver
from ..fitting.prior_fit import PriorFit
from ..restore import Reconstruction
from . import time_spent


def write_estimate(path: Path, restoration: Reconstruction, record: dict[str, Any]) -> None:
    """Write channels `estimate`, `variance` (diagonal of Eq. 5) and, where it is known, `truth`, as float32."""
    shape = restoration.shape
    channels = {
        "estimate": restoration.estimate.reshape(shape).astype(np.float32),
        "variance": restoration.expected.variance.reshape(shape).astype(np.float32),
    }
    if restoration.truth is not None:
        channels["truth"] = restoration.truth.reshape(shape).astype(np.float32)
    exr.write(path, [exr.Part("estimate", channels, record)])


def describe(stack: Stack, model: Model, restoration: Reconstruction) -> dict[str, Any]:
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
        "solver": {"way": restoration.choice.method, **_solver(restoration.solver)},
        "diagnostics": _diagnostics(restoration),
        "model": {
            **model.record.get("agreement", _unknown(model)),
            "feigned_information": restoration.spurious_information,
            **({"fit": model.record["fit"]} if "fit" in model.record else {}),
        },
        "skipped": [
            left.describe() for left in (*skipped_effects(_as_run(stack, model), model.camera), *_of_world(stack))
        ],
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
    return {**described, "spent": time_spent.spent(described, calibrated=model.record["method"] != "ideal")}


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


def _diagnostics(restoration: Reconstruction) -> dict[str, Any]:
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


def _numbers(fit: PriorFit) -> tuple[float | None, ...]:
    return fit.variance, fit.length, fit.noise_variance


def _unknown(model: Model) -> dict[str, float | None]:
    known = 0.0 if model.record["method"] == "ideal" else None
    return {"rms_difference_from_ideal": known, "max_z": None, "p_value": None}


def _of_world(stack: Stack) -> tuple[SkippedEffect, ...]:
    """What rendering left out once it had seen the world."""
    if not stack.record.get(STRAIGHT):
        return ()
    return (SkippedEffect("interreflection", "nothing in the world reflects any: paths have one segment"),)


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
