"""A prediction as JSON, and as the rows of the tables that `predict` prints: of one scene, and of several compared."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from typing import Any

from ommatid.reconstruct.measured_error import TRIM
from ommatid.reconstruct.output.verdict_words import cause, error_words
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


def prediction_of(document: Mapping[str, Any]) -> Prediction:
    """Return the prediction that `json_of` described."""
    values = {field.name: document[field.name] for field in fields(Prediction) if field.name in document}
    values |= {name: values[name]["mse"] for name in ("as_designed", "calibrated") if name in values}
    if "interval" in values:
        values["interval"] = (values["interval"]["low"], values["interval"]["high"])
    return Prediction(**{**values, "assumes": tuple(values["assumes"])})


def compared(predictions: Sequence[Prediction]) -> list[tuple[str, ...]]:
    """Return names of quantities and their values for each prediction, without quantities that none of them has."""
    named = dict.fromkeys(name for each in predictions for name in each.budget or {})
    parts = [(f"  from {cause(name)}", _part(name)) for name in named]
    lines = [(name, *map(words, predictions)) for name, words in (*ERRORS, *parts, *OTHERS)]
    return [line for line in lines if any(line[1:])]


def _if_known(value: float | None, digits: int = 4) -> str:
    return "" if value is None else f"{value:.{digits}g}"


def _part(name: str) -> Callable[[Prediction], str]:
    return lambda of: _if_known((of.budget or {}).get(name) or None, 3)


Quantities = tuple[tuple[str, Callable[[Prediction], str]], ...]
ERRORS: Quantities = (
    ("RMS error, grey levels", lambda of: f"{of.mse**0.5:.4g}"),
    ("squared error (MSE)", lambda of: f"{of.mse:.{DIGITS}g}"),
)
OTHERS: Quantities = (
    ("  of the prior's variance, %", lambda of: _if_known(of.prior_variance and 100 * of.mse / of.prior_variance, 3)),
    (f"  without a border of {TRIM} pixels", lambda of: _if_known(of.trimmed_mse, DIGITS)),
    ("  expected for this picture", lambda of: _if_known(of.mse_for_picture, DIGITS)),
    ("measurements", lambda of: str(of.measurements)),
    ("unknowns", lambda of: str(of.unknowns)),
    ("null space, dimensions", lambda of: "" if of.null_space is None else str(of.null_space)),
    ("condition of H", lambda of: _if_known(of.condition)),
    ("degrees of freedom", lambda of: f"{of.degrees_of_freedom:.6g}"),
    ("resolution, pixels of f", lambda of: _if_known(of.resolution, 3)),
    ("form of the estimator", lambda of: of.method),
    ("assumes", lambda of: "; ".join(of.assumes)),
)


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
