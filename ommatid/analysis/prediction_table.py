"""A prediction as JSON, and as the rows of the table that `predict` prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.reconstruct.prediction import Prediction

DIGITS = 6  # of an expected error
OPTIONAL = ("misalignment", "prior_variance", "mse_for_picture", "interval", "budget", "as_designed", "calibrated")


def json_of(prediction: Prediction) -> dict[str, Any]:
    """Return a prediction in JSON's types; what is only sometimes known only where it is."""
    values = asdict(prediction)
    for name in OPTIONAL:
        if values[name] is None:
            del values[name]
    for name in ("as_designed", "calibrated"):
        if name in values:
            values[name] = {"mse": values[name]}
    if prediction.interval is not None:
        values["interval"] = dict(zip(("low", "high"), prediction.interval, strict=True))
    return values | {"assumes": list(prediction.assumes), "recovers_nothing": prediction.recovers_nothing}


def rows(prediction: Prediction) -> list[tuple[str, str]]:
    """Return names and values, in the order in which they are printed: first what the prediction takes for granted."""
    trimmed = prediction.trimmed_mse
    inner = "the target is too small" if trimmed is None else error_words(trimmed, DIGITS)
    width = "nothing is resolved" if prediction.resolution is None else f"{prediction.resolution:.3g} pixels of f"
    lines = [("assumes", "; ".join(prediction.assumes))] if prediction.assumes else []
    if prediction.recovers_nothing:
        lines.append(("nothing is recovered", "the error is that of the prior, whatever the camera records"))
    lines += [("measurements", str(prediction.measurements)), ("unknowns", str(prediction.unknowns))]
    if prediction.rank is None or prediction.condition is None:
        lines.append(("rank of H", "not computed for a frame, nor where misalignment counts as noise"))
    else:
        condition = f"{prediction.condition:.4g} (largest over smallest singular value above zero)"
        lines += [
            ("rank of H", str(prediction.rank)),
            ("null space", f"{prediction.null_space} dimensions"),
            ("condition of H", condition),
        ]
    lines.append(("expected squared error (Eq. 5)", error_words(prediction.mse, DIGITS)))
    lines += _parts(prediction)
    if prediction.budget is None and prediction.misalignment is not None:
        share = error_words(prediction.misalignment, DIGITS)
        share += ", within camera.tolerance, for an estimator that takes H as designed"
        lines.append(("  of it by misalignment", share))
    return [
        *lines,
        (f"  without a border of {TRIM} pixels", inner),
        ("degrees of freedom", f"{prediction.degrees_of_freedom:.6g} of {prediction.unknowns}"),
        ("resolution, median", width),
        ("form of the estimator", prediction.method),
    ]


def _parts(prediction: Prediction) -> list[tuple[str, str]]:
    """Return the parts of the expected error, and the errors to compare with it."""
    lines = [
        (f"  from {name.replace('_', ' ')}", f"{part:.3g} ({100 * part / prediction.mse:.1f} %)")
        for name, part in (prediction.budget or {}).items()
        if part != 0
    ]
    if prediction.mse_for_picture is not None:
        words = error_words(prediction.mse_for_picture, DIGITS)
        if prediction.interval is None:
            words += ", of which the run's interval knows nothing: it takes H for the camera's"
        else:
            words += f", 99 %: {prediction.interval[0]:.4g} to {prediction.interval[1]:.4g}"
        lines.append(("  expected for this picture", words))
    if prediction.as_designed is not None:
        lines.append(
            ("  with H as designed", f"{error_words(prediction.as_designed, DIGITS)}, within camera.tolerance")
        )
    if prediction.calibrated is not None:
        lines.append(
            ("  with a calibrated H", f"{error_words(prediction.calibrated, DIGITS)}, with calibration.samples")
        )
    return lines
