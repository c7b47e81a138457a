"""run.json as the rows of the table that is printed."""

from __future__ import annotations

from math import exp
from typing import Any

from ommatid.reconstruct.restore import MOST_FEIGNED

from .summary import skipped_words

MOST_NAMED = 5  # sub-imagers, in a line of the table
WARNING = (
    "the lens types leave pixels open on which the noise of H feigns information:"
    " raise calibration.samples, or take calibration.method = 'ideal' if the camera is"
)


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
    lines += [(f"left out: {skip['what']}", skipped_words(skip)) for skip in description["skipped"]]
    return lines + _time_rows(description["spent"])


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


def _time_rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    stages = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in found["stages"].items())
    lines: list[tuple[str, str]] = []
    if "within" in found:
        chosen = ", ".join(f"{key} {value}" for key, value in found["chosen"].items())
        lines.append(("time", f"{found['seconds']:.1f} s of {found['within']:g} s: {stages}; chosen: {chosen}"))
    if found.get("more"):
        more = [f"{one['seconds']:.3g} s: {one['predicted_mse']:.4g}" for one in found["more"][:2]]
        lines.append(("error at most, in more time", f"{', '.join(more)}; by noise alone: {found['noise_alone']:.4g}"))
    return lines
