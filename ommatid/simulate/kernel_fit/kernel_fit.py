"""H of a blurred lens type from learnt kernels instead of noisy entries.

The entries of a chart of sensor pixels determine how the kernels of `ommatid.scenes.fitted.kernels` deviate from the
design: each cell is fitted by a polynomial of the field, of the degree of the least expected error, and the variation
over the field is reduced to its principal components. Where the rays show no deviation, H is that of the design, with
the errors of the simplest deviation. The explanation is rejected if the residuals scatter more than the batches say: by
more than three times the noise in a picture, or a tenth of the entries' own variance. What is less, and shows in a
picture, is added to the errors.

The directions in which the kernels are uncertain follow from fits to errors drawn from the scatter of the batches. A
draw gives every pixel of the chart a random combination of its batches' deviations, which has the covariance of the
pixel's errors; the fit to it is a draw of the kernels' error. Kept are the directions that change images most, of a
typical picture, whose values are correlated over a few pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, probe
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernels import KernelFootprints, basis, terms
from ommatid.scenes.lens_type import LensType

from ..calibration.responses import Responses
from ..ideal import designed_kernels
from .deviations import Chart, chart_of
from .selection import Candidate, Components, choose, components

DRAWS = 64
SHARE = 0.99  # of the expected variance of H f that the directions describe; they are scaled to all of it
KERNELS = 0.999  # of that variance that the common kernels of the directions describe
MOST_DIRECTIONS, MOST_KERNELS = 16, 32
MOST_SHOWN = 3.0  # of the variance that noise has in a picture: less is added to the errors
MOST_UNEXPLAINED = 0.1  # of the entries' variance, with which kernels are still far better than entries


def error_directions(chart: Chart, candidate: Candidate, parts: Components) -> tuple[FloatArray, FloatArray]:
    """Return the kernels, (E, C), and the coefficients, (q, E, P), of errors of variance 1 each."""
    errors = _projected(chart, _draws(chart, candidate) @ parts.triangle, parts)
    draws, cells, count = errors.shape
    shown = chart.seen(errors.swapaxes(1, 2) * chart.share**0.5).reshape(draws, -1)
    values, vectors = np.linalg.eigh(shown @ shown.T)
    total = float(values.sum())
    if total <= 0:
        return np.zeros((0, cells)), np.zeros((0, 0, count))
    kept = _needed(values, SHARE, MOST_DIRECTIONS)
    scale = ((1 + candidate.shown) * total / values[-kept:].sum() / draws) ** 0.5
    directions = np.asarray(np.tensordot(vectors[:, -kept:].T * scale, errors, axes=1), dtype=np.float64)
    terms = directions.swapaxes(1, 2).reshape(-1, cells)
    shown = chart.seen(terms * chart.share**0.5)
    values, vectors = np.linalg.eigh(shown @ shown.T)
    vectors = vectors[:, -_needed(values, KERNELS, MOST_KERNELS) :]
    shares = vectors.reshape(kept, count, -1).swapaxes(1, 2)
    kernels: FloatArray = np.asarray(vectors.T @ terms, dtype=np.float64)
    return kernels, np.asarray(shares @ np.linalg.inv(parts.triangle), dtype=np.float64)


def _draws(chart: Chart, candidate: Candidate) -> FloatArray:
    """Return coefficients of the kernels' errors: (draws, C, P)."""
    rng, count = probe(Purpose.KERNEL_ERRORS), len(chart.batches)
    x = basis(chart.field, candidate.degree)
    entries = np.zeros((DRAWS, chart.inside.shape[1], x.shape[1]))
    for batch in chart.batches:
        for draw in entries:
            weights = rng.normal(size=len(x))[:, None] / (count * (count - 1)) ** 0.5
            draw += ((x * weights).T @ (batch * chart.inside)).T
    own = replace(candidate.sums, entries=entries)
    return replace(own, entries=own.symmetric.entries).fitted() if candidate.symmetric else own.fitted()


def _projected(chart: Chart, errors: FloatArray, parts: Components) -> FloatArray:
    """Return the part of errors, (draws, C, P) of orthonormal terms, that changes the mean or the components."""
    root = np.sqrt(chart.weights * chart.share)
    varying = errors[..., 1:].swapaxes(1, 2) * root
    rest = varying - parts.field @ (parts.field.T @ varying)
    rest = rest - (rest @ parts.cells.T) @ parts.cells
    changed = np.divide(varying - rest, root, out=np.zeros_like(varying), where=root > 0)
    return np.concatenate([errors[..., :1], changed.swapaxes(1, 2)], axis=2)


def _needed(values: FloatArray, share: float, most: int) -> int:
    """Return how many of the largest of rising values add up to a share of their sum."""
    left: FloatArray = np.cumsum(values[::-1], dtype=np.float64)
    return min(int(np.searchsorted(left, share * float(left[-1]))) + 1, most)


@dataclass(frozen=True, eq=False)
class KernelFit:
    """Kernels of a lens type, if they explain the entries; `reason` names what they do not explain."""

    accepted: bool
    reason: str
    footprints: KernelFootprints | None = None
    details: dict[str, Any] = field(default_factory=dict[str, Any])

    def record(self) -> dict[str, Any]:
        """Return the entry of a model's record, in JSON's types."""
        return {"kind": "kernels", "accepted": self.accepted, "reason": self.reason, **self.details}


def fit_kernels(responses: Responses, camera: Camera, lens_type: LensType, pixels: IntArray | None = None) -> KernelFit:
    """Learn the kernels of a lens type from the rows of H of some of its pixels.

    pixels : of the type, (n,), whose rows were measured; None: those that have entries
    """
    obstacle = refusal(camera, lens_type)
    if obstacle:
        return KernelFit(False, obstacle)
    try:
        designed = designed_kernels(camera, lens_type).times(1 / float(lens_type.light))
    except InputError as error:
        return KernelFit(False, str(error))
    chart = chart_of(responses, designed, pixels)
    if chart is None:
        return KernelFit(False, "some pixels of the chart are dark")
    candidate = choose(chart)
    details, reason = _details(chart, candidate), ""
    if candidate.rejected:
        reason = f"the entries scatter more about the kernels than rays do ({', '.join(candidate.rejected)})"
    if candidate.shown > MOST_SHOWN or (candidate.rejected and candidate.unexplained > MOST_UNEXPLAINED):
        return KernelFit(False, reason, details=details)
    parts = components(chart, candidate)
    details["components"] = {
        "count": len(parts.strengths),
        "strengths": [float(each) for each in parts.strengths],
    }
    return KernelFit(True, reason, _footprints(chart, candidate, parts).times(float(lens_type.light)), details)


def refusal(camera: Camera, lens_type: LensType) -> str:
    """Return why kernels cannot describe a lens type, empty if they can."""
    if not camera.walls:
        return "without walls, light of other lenses reaches its pixels"
    if lens_type.optics.distortion is not None:
        return "its images are distorted"
    if camera.tolerance is not None:
        return "its sub-imagers are misaligned"
    if lens_type.steered:
        return "some of its sub-imagers are off the grid"
    if not lens_type.is_aligned:
        return "its footprints cut pixels of f in different ways"
    return ""


def _details(chart: Chart, candidate: Candidate) -> dict[str, Any]:
    return {
        "lens": chart.places.lens_type.name,
        "pixels": len(chart.pixels),
        "rays_per_pixel": chart.rays,
        "width": chart.places.width,
        "core": chart.core,
        "as_designed": candidate.as_designed,
        "degree": candidate.degree,
        "symmetric": candidate.symmetric,
        "chances": candidate.chances,
        "unexplained": candidate.unexplained,
    }


def _footprints(chart: Chart, candidate: Candidate, parts: Components) -> KernelFootprints:
    """Return H from the kernels of the design, the mean deviation and its components."""
    designed, root = chart.designed, np.sqrt(chart.weights * chart.share)
    orthonormal = candidate.coefficients[0] @ parts.triangle
    back = np.linalg.inv(parts.triangle)
    varying = np.divide(parts.cells, root, out=np.zeros_like(parts.cells), where=root > 0)
    shares = np.concatenate(
        [np.zeros((1, len(parts.strengths))), parts.field * (parts.strengths / len(chart.pixels) ** 0.5)]
    )
    learnt = np.concatenate([orthonormal[None, :, 0], varying])
    coefficients = np.concatenate([np.eye(1, len(back)), shares.T]) @ back
    if candidate.as_designed:
        learnt, coefficients = learnt[:0], coefficients[:0]
    errors, error_coefficients = error_directions(chart, candidate, parts)
    (core, rings), (error_core, error_rings) = (np.split(each, [chart.core**2], axis=1) for each in (learnt, errors))
    square = -1, chart.core, chart.core
    shapes = replace(
        designed.shapes,
        core=core.reshape(square),
        rings=rings,
        error_core=error_core.reshape(square),
        error_rings=error_rings,
    )
    degree = max(designed.degree, candidate.degree)
    count = len(terms(degree))  # in the order of their degrees
    known, learnt_terms, error_terms = (
        np.pad(each, [(0, 0)] * (each.ndim - 1) + [(0, count - each.shape[-1])])
        for each in (designed.coefficients, coefficients, error_coefficients)
    )
    coefficients = np.concatenate([known, learnt_terms])
    return KernelFootprints(designed.places, degree, shapes.rounded, coefficients, error_terms)
