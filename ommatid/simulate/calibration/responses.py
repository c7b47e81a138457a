"""Entries of H as measured over passes, of all sensor pixels or of some: by point sources, or by rays alone.

Row i of H is the distribution of the rays of pixel i over the target, which point sources measure one after the other.
Rays alone add their weights to the pixels of f that they meet. They are those of the point sources' renderings, with
the same seeds, and are summed in float64, so that both methods give the same H. A ray followed from the sensor carries
the light that travels it in reverse (Veach 1997, section 4.5).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, Float32Array, FloatArray, IntArray
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.model import MeasuredRows
from ommatid.scenes.setup import Setup

from ..renderer.variant import check_transport_variant, choose
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import BATCHES, Plan, Plans, plan

if TYPE_CHECKING:
    from ..renderer.rays import Pixels
    from ..renderer.renderer import Renderer

Subsets = dict[str, IntArray | None]  # pixels of a lens type, None: all, by its name


@dataclass(frozen=True)
class Responses:
    """Measured entries of H, before they become a model.

    matrix : means of the entries;  variance : (nnz,) of these means, from the scatter of the passes
    batches : (batches, nnz) deviations of the means of some passes from those of all
    work : that of the most samples, where the lens types differ;  record : entries for the model's
    """

    work: Plan
    record: dict[str, Any]
    matrix: sparse.csr_array
    variance: FloatArray
    batches: Float32Array


def measured(
    setup: Setup,
    *,
    by_points: bool,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    plans: Plans | None = None,
    subsets: Subsets | None = None,
) -> Responses:
    """Measure H by point sources, of ideal pinholes alone, or by rays.

    plans : of each lens type; None: all as the scene says
    subsets : lens types, and their pixels, that are measured; rows of H of all others are empty; None: all
    Raises InputError if rays are asked for and only Mitsuba's scalar backend works, MachineError for wrong rows.
    """
    scene, variant, seed = setup.scene, choose(setup.scene.render.variant), setup.scene.render.seed
    from ..renderer.renderer import Renderer

    renderer = Renderer(setup.simulated, variant, scene.render.sampler, together=False)  # types are measured apart
    plans = same_plans(setup) if plans is None else plans
    chosen: Subsets = dict.fromkeys(renderer.groups) if subsets is None else subsets
    every = [renderer.pixels(group, chosen[group]) for group in renderer.groups if group in chosen]
    if by_points:
        from .point_sources import rows_from_points

        parts = rows_from_points(renderer, every, plans, seed, progress, checkpoint)
    else:
        check_transport_variant(variant)
        every = [block for pixels in every for block in renderer.blocks(pixels, plans[pixels.group].samples)]
        parts = rows_from_rays(renderer, every, plans, seed, progress)
    counts = np.zeros(renderer.camera.measurements, dtype=np.int64)
    for pixels, part in zip(every, parts, strict=True):
        counts[renderer.rows(pixels.group).start + pixels.numbers] = np.diff(part.matrix.indptr)
    data, indices = (np.concatenate([getattr(part.matrix, name) for part in parts]) for name in ("data", "indices"))
    starts = np.concatenate([[0], np.cumsum(counts)])
    work = max(plans.values(), key=lambda plan: plan.samples)
    return Responses(
        work=work,
        record=work.record(variant, seed, "calibration"),
        matrix=sparse.csr_array((data, indices, starts), shape=(counts.size, renderer.camera.unknowns)),
        variance=np.concatenate([part.variance for part in parts]),
        batches=np.concatenate([part.batches for part in parts], axis=1),
    )


def same_plans(setup: Setup) -> Plans:
    """Return the samples that the scene asks for, the same for all lens types."""
    work = plan(setup.scene.calibration.sample_count, setup.scene.render.sampler)
    return {lens_type.name: work for lens_type in setup.camera.types}


class TracedEntries(NamedTuple):
    """Rows of H from one pass, and (pixels,) True for those without any light."""

    matrix: sparse.csr_array
    dark: BoolArray


def rows_from_rays(
    renderer: Renderer, blocks: list[Pixels], plans: Plans, seed: int, progress: Progress = no_progress
) -> list[MeasuredRows]:
    """Measure the rows of H of some blocks of pixels by tracing all rays of all passes."""
    parts: list[MeasuredRows] = []
    for index, block in enumerate(blocks):
        passes, work = list[TracedEntries](), plans[block.group]
        for number in range(work.passes):
            passes.append(one_pass(renderer, block, work, number, seed))
            progress((index + (number + 1) / work.passes) / len(blocks))
        parts.append(_mean_of(passes, (block.count, renderer.camera.unknowns)))
    return parts


def one_pass(renderer: Renderer, pixels: Pixels, work: Plan, number: int, seed: int) -> TracedEntries:
    """Trace one pass of some pixels whose rays start together."""
    texels, weights = renderer.hits(pixels, work.samples, sampler_seeds(seed, "calibration", number, work.passes))
    weights = np.ones(texels.shape) if weights is None else weights
    total = weights.sum(axis=1)
    matrix = sums_by_texel(texels, weights, renderer.camera.unknowns)
    matrix.data *= np.repeat(renderer.captured(pixels.group) / np.where(total > 0, total, 1.0), np.diff(matrix.indptr))
    return TracedEntries(matrix, total == 0)


def sums_by_texel(texels: IntArray, weights: FloatArray, unknowns: int) -> sparse.csr_array:
    """Sum the weights, (P, S), by texel for every pixel, without texels below 0: (P, unknowns)."""
    hit = (texels >= 0) & (weights != 0)
    starts = np.concatenate([[0], np.cumsum(hit.sum(axis=1))])
    rays = sparse.csr_array((weights[hit], texels[hit], starts), shape=(len(texels), unknowns))
    summed = sparse.csr_array(rays @ sparse.eye_array(unknowns, format="csr"))  # in the order of the rays
    summed.sort_indices()
    return summed


def _mean_of(passes: list[TracedEntries], shape: tuple[int, int]) -> MeasuredRows:
    """Return the mean over the passes, the variance of that mean, and the deviations of batches of passes from it.

    A pixel that gets no light at all in some pass has no entries, since nothing is known of it.
    """
    dark = np.logical_or.reduce([entries.dark for entries in passes])
    matrices = [entries.matrix for entries in passes]
    if dark.any():
        lit = sparse.csr_array(sparse.diags_array(np.where(dark, 0.0, 1.0)))
        lit.eliminate_zeros()
        matrices = [sparse.csr_array(lit @ matrix) for matrix in matrices]
    matrix = sparse.csr_array(shape, dtype=np.float64)
    for of_pass in matrices:
        matrix = sparse.csr_array(matrix + of_pass)
    matrix.data /= len(passes)
    mean: FloatArray = matrix.data
    cells = positions_of(matrix)
    squares = np.zeros(cells.size)
    batches = np.zeros((BATCHES, cells.size))
    for number, of_pass in enumerate(matrices):
        index = np.searchsorted(cells, positions_of(of_pass))
        batches[number % BATCHES, index] += of_pass.data * (BATCHES / len(passes))
        deviation = -mean
        deviation[index] += of_pass.data
        squares += np.square(deviation)
    variance = squares / (len(passes) * (len(passes) - 1))
    return MeasuredRows(matrix, variance, (batches - mean).astype(np.float32))


def positions_of(matrix: sparse.csr_array) -> IntArray:
    """Return the positions of the entries in the flattened matrix, rising."""
    matrix.sort_indices()
    rows = np.repeat(np.arange(matrix.shape[0], dtype=np.int64), np.diff(matrix.indptr))
    return rows * matrix.shape[1] + matrix.indices
