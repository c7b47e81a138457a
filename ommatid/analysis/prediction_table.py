"""A prediction as JSON, and the table that `predict` prints: of one scene, or of several beside each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.output.verdict_words import cause
from ommatid.reconstruct.prediction import Prediction

DIGITS = 6  # of an expected error
OPTIONAL = ("misalignment", "prior_variance", "mse_for_picture", "interval", "budget", "as_designed", "calibrated")

Document = Mapping[str, Any]  # of `json_of`


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


def rows(predictions: Sequence[Document]) -> list[tuple[str, ...]]:
    """Return names of quantities and their values for each prediction, without quantities that none of them has."""
    named = dict.fromkeys(name for each in predictions for name, part in each.get("budget", {}).items() if part)
    parts = [(f"  from {cause(name)}", partial(_part, name)) for name in named]
    lines = [(name, *map(words, predictions)) for name, words in (*ERRORS, *parts, *OTHERS)]
    return [line for line in lines if any(line[1:])]


def _number(value: float | None, digits: int = 4) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _part(name: str, of: Document) -> str:
    part = of.get("budget", {}).get(name)
    return f"{part:.3g} ({100 * part / of['mse']:.1f} %)" if part else ""


def _for_picture(of: Document) -> str:
    interval = of.get("interval")
    ends = "" if interval is None else f" (99 %: {interval['low']:.4g} to {interval['high']:.4g})"
    return _number(of.get("mse_for_picture"), DIGITS) + ends


def _nothing(of: Document) -> str:
    return "the error is that of the prior, whatever the camera records" if of["recovers_nothing"] else ""


Quantities = tuple[tuple[str, Callable[[Document], str]], ...]
ERRORS: Quantities = (
    ("assumes", lambda of: "; ".join(of["assumes"])),
    ("nothing is recovered", _nothing),
    ("RMS error, grey levels", lambda of: f"{of['mse'] ** 0.5:.4g}"),
    ("squared error (Eq. 5)", lambda of: f"{of['mse']:.{DIGITS}g}"),
)
OTHERS: Quantities = (
    (f"  without a border of {TRIM} pixels", lambda of: _number(of["trimmed_mse"], DIGITS)),
    ("  expected for this picture", _for_picture),
    ("  with H as designed", lambda of: _number(of.get("as_designed", {}).get("mse"), DIGITS)),
    ("  with a calibrated H", lambda of: _number(of.get("calibrated", {}).get("mse"), DIGITS)),
    ("measurements", lambda of: str(of["measurements"])),
    ("unknowns", lambda of: str(of["unknowns"])),
    ("rank of H", lambda of: "" if of["rank"] is None else str(of["rank"])),
    ("null space, dimensions", lambda of: "" if of["null_space"] is None else str(of["null_space"])),
    ("condition of H", lambda of: _number(of["condition"])),
    ("degrees of freedom", lambda of: f"{of['degrees_of_freedom']:.6g}"),
    ("resolution, pixels of f", lambda of: _number(of["resolution"], 3) or "nothing is resolved"),
    ("form of the estimator", lambda of: of["method"]),
)
