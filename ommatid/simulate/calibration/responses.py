"""Entries of H as measured over passes, of all sensor pixels or of some: by point sources, or by rays alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array, FloatArray, IntArray
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.setup import Setup

from ..renderer.variant import check_transport_variant, choose
from ..sampling.checkpoint import Checkpoint
from ..sampling.passes import OverPasses, Plans, plan

Subsets = dict[str, IntArray | None]  # pixels of a lens type, None: all, by its name


@dataclass(frozen=True)
class Responses(OverPasses):
    """Measured entries of H, before they become a model.

    matrix : means of the entries;  variance : (nnz,) of these means, from the scatter of the passes
    batches : (batches, nnz) deviations of the means of some passes from those of all
    samples : the most, where the lens types differ
    """

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
        from .ray_transport import rows_from_rays

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
        matrix=sparse.csr_array((data, indices, starts), shape=(counts.size, renderer.camera.unknowns)),
        variance=np.concatenate([part.variance for part in parts]),
        batches=np.concatenate([part.batches for part in parts], axis=1),
        passes=work.passes,
        samples=work.samples,
        variant=variant,
        first_seed=sampler_seeds(seed, "calibration", 0, work.passes)(0),
    )


def same_plans(setup: Setup) -> Plans:
    """Return the samples that the scene asks for, the same for all lens types."""
    work = plan(setup.scene.calibration.sample_count, setup.scene.render.sampler)
    return {lens_type.name: work for lens_type in setup.camera.types}
