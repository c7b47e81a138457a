"""H from rays alone: every ray of a sensor pixel brings its weight to the pixel of f that it meets.

What point sources show one after the other, the rays know at once: row i of H is where the rays of pixel i land. They
are those that point sources are seen by, with the same seeds, and are summed in float64, so that both give the same H.
Light is reversible; what follows a ray from the sensor is the light that comes back on it (Veach 1997, section 4.5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.setup import Setup

from ..renderer.variant import check_transport_variant, choose
from ..sampling.passes import BATCHES, Plan, plan
from ..sampling.seeds import sampler_seeds
from .point_sources import Part, Plans, Responses, responses_of

if TYPE_CHECKING:
    from ..renderer.renderer import Renderer


class TracedEntries(NamedTuple):
    """Of one pass: where in H, pixel * N + texel, rising; what stands there; (pixels,) which get no light at all."""

    where: NDArray[np.int64]
    values: NDArray[np.float64]
    dark: NDArray[np.bool_]


def responses_from_rays(setup: Setup, progress: Progress = no_progress, plans: Plans | None = None) -> Responses:
    """Trace all rays of all passes. Raises InputError where only Mitsuba's slow backend works.

    plans : of each group, absent: all as the scene says
    """
    from ..renderer.renderer import Renderer

    scene, camera, variant = setup.scene, setup.simulated, choose(setup.scene.render.variant)
    check_transport_variant(variant)
    rig = Renderer(camera, variant, scene.render.sampler, together=False)
    parts: list[Part] = []
    if plans is None:
        plans = dict.fromkeys(rig.groups, plan(scene.calibration.sample_count, scene.render.sampler))
    blocks = [(group, block) for group in rig.groups for block in rig.blocks(group, plans[group].samples)]
    for place, (group, block) in enumerate(blocks):
        passes: list[TracedEntries] = []
        work = plans[group]
        for number in range(work.passes):
            passes.append(one_pass(rig, group, block, work, number, scene.render.seed))
            progress((place + (number + 1) / work.passes) / len(blocks))
        parts.append(_joined(passes, (block.stop - block.start, camera.unknowns)))
    return responses_of(parts, plans, variant, scene.render.seed)


def one_pass(rig: Renderer, group: str, block: slice, work: Plan, number: int, seed: int) -> TracedEntries:
    """The entries of H, of the pixels of a block, that the rays of one pass make."""
    from .transport_kernels import collected  # pyright: ignore[reportUnknownVariableType]

    texels, weights = rig.hits(group, work.samples, sampler_seeds(seed, "calibration", number, work.passes), block)
    weights = np.ones(texels.shape) if weights is None else weights
    counts, columns, sums = collected(texels, weights)
    pixel = np.repeat(np.arange(counts.size), counts)
    brought = weights.sum(axis=1)
    return TracedEntries(pixel * rig.camera.unknowns + columns, sums / brought[pixel], brought == 0)


def _joined(passes: list[TracedEntries], shape: tuple[int, int]) -> Part:
    """Mean over the passes, the variance of that mean, and the deviations of batches of passes from it.

    Of a pixel that now and then gets no light at all nothing is known; so it has no entries.
    """
    dark = np.logical_or.reduce([one.dark for one in passes])
    if dark.any():
        passes = [_lit(one, ~dark[one.where // shape[1]]) for one in passes]
    matrix = sparse.csr_array(shape, dtype=np.float64)
    for one in passes:
        matrix = sparse.csr_array(matrix + _matrix(one, shape))
    matrix.data /= len(passes)
    mean: NDArray[np.float64] = matrix.data
    places = np.repeat(np.arange(shape[0]), np.diff(matrix.indptr)) * shape[1] + matrix.indices
    squares = np.zeros(places.size)
    batches = np.zeros((BATCHES, places.size))
    for number, (where, values, _) in enumerate(passes):
        found = np.searchsorted(places, where)
        batches[number % BATCHES, found] += values * (BATCHES / len(passes))
        away = -mean
        away[found] += values
        squares += np.square(away)
    return matrix, squares / (len(passes) * (len(passes) - 1)), (batches - mean).astype(np.float32)


def _matrix(one: TracedEntries, shape: tuple[int, int]) -> sparse.csr_array:
    pixel, texel = np.divmod(one.where, shape[1])
    starts = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=shape[0]))])
    return sparse.csr_array((one.values, texel, starts), shape=shape)


def _lit(one: TracedEntries, kept: NDArray[np.bool_]) -> TracedEntries:
    return TracedEntries(one.where[kept], one.values[kept], one.dark)
