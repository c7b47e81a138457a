"""A prediction as JSON, and as the rows of the table that `predict` prints."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.prediction import Prediction


def json_of(prediction: Prediction) -> dict[str, Any]:
    """Return a prediction in JSON's types; the part of misalignment only where it is known."""
    values = asdict(prediction)
    if prediction.misalignment is None:
        del values["misalignment"]
    return values


def rows(prediction: Prediction) -> list[tuple[str, str]]:
    """Return names and values, in the order in which they are printed."""
    deviation = prediction.mse**0.5
    inner = "the target is too small" if prediction.trimmed_mse is None else f"{prediction.trimmed_mse:.6g}"
    width = "nothing is resolved" if prediction.resolution is None else f"{prediction.resolution:.3g} pixels of f"
    lines = [("measurements", str(prediction.measurements)), ("unknowns", str(prediction.unknowns))]
    if prediction.rank is None or prediction.condition is None:
        lines.append(("rank of H", "not computed for a frame, nor where misalignment counts as noise"))
    else:
        condition = f"{prediction.condition:.4g} (largest over smallest singular value above zero)"
        lines += [
            ("rank of H", str(prediction.rank)),
            ("null space", f"{prediction.null_space} dimensions"),
            ("condition of H", condition),
        ]
    expected = f"{prediction.mse:.6g} per pixel, a deviation of {deviation:.3g} of 255"
    lines.append(("expected squared error (Eq. 5)", expected))
    if prediction.misalignment is not None:
        share = f"{prediction.misalignment:.6g}, within camera.tolerance, for an estimator that takes H as designed"
        lines.append(("  of it by misalignment", share))
    return [
        *lines,
        (f"  without a border of {TRIM} pixels", inner),
        ("degrees of freedom", f"{prediction.degrees_of_freedom:.6g} of {prediction.unknowns}"),
        ("resolution, median", width),
        ("form of the estimator", prediction.method),
    ]
