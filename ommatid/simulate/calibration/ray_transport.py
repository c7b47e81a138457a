"""H from rays alone: every ray of a sensor pixel adds its weight to the pixel of f that it meets.

Row i of H is the distribution of the rays of pixel i over the target, which point sources measure one after the other.
The rays are those of the point sources' renderings, with the same seeds, and are summed in float64, so that both
methods give the same H. A ray followed from the sensor carries the light that travels it in reverse (Veach 1997,
section 4.5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.library_caches import compiled
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.setup import Setup

from ..renderer.variant import check_transport_variant, choose
from ..sampling.passes import BATCHES, Plan
from .point_sources import Part, Plans, Responses, Subsets, joined_parts, same_plans

if TYPE_CHECKING:
    from ..renderer.renderer import Renderer


@compiled
def sums_by_texel(texels: IntArray, weights: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Sum the weights, (P, S), by texel for every pixel, without texels below 0: counts (P,), texels and sums.

    Texels rise within a pixel. A pixel sees few of them again and again, so each ray is looked up by bisection among
    the previous ones.
    """
    pixels, samples = texels.shape
    counts = np.zeros(pixels, dtype=np.int64)
    known = np.empty(texels.size, dtype=np.int64)
    sums = np.empty(texels.size, dtype=np.float64)
    start = 0
    for pixel in range(pixels):
        stop = start
        for sample in range(samples):
            texel = texels[pixel, sample]
            if texel < 0 or weights[pixel, sample] == 0.0:
                continue
            low, high = start, stop
            while low < high:
                middle = (low + high) // 2
                if known[middle] < texel:
                    low = middle + 1
                else:
                    high = middle
            if low == stop or known[low] != texel:
                for index in range(stop, low, -1):
                    known[index] = known[index - 1]
                    sums[index] = sums[index - 1]
                known[low] = texel
                sums[low] = 0.0
                stop += 1
            sums[low] += weights[pixel, sample]
        counts[pixel] = stop - start
        start = stop
    return counts, known[:start].copy(), sums[:start].copy()


class TracedEntries(NamedTuple):
    """Entries of H from one pass: `where`, pixel * N + texel, rising, and their values; (pixels,) without any light."""

    where: IntArray
    values: FloatArray
    dark: BoolArray


def responses_from_rays(
    setup: Setup, progress: Progress = no_progress, plans: Plans | None = None, subsets: Subsets | None = None
) -> Responses:
    """Measure H by tracing all rays of all passes. Raises InputError if only Mitsuba's scalar backend works.

    plans : of each group; None: all as the scene says
    subsets : as for `responses_from_points`
    """
    from ..renderer.renderer import Renderer

    scene, variant = setup.scene, choose(setup.scene.render.variant)
    check_transport_variant(variant)
    renderer = Renderer(setup.simulated, variant, scene.render.sampler, together=False)
    plans = same_plans(setup) if plans is None else plans
    parts: dict[str, list[Part]] = {group: [] for group in renderer.groups}
    chosen: Subsets = dict.fromkeys(renderer.groups) if subsets is None else subsets
    blocks = [
        (group, block)
        for group in renderer.groups
        if group in chosen
        for block in renderer.blocks(group, plans[group].samples, chosen[group])
    ]
    for index, (group, block) in enumerate(blocks):
        passes: list[TracedEntries] = []
        work = plans[group]
        for number in range(work.passes):
            passes.append(one_pass(renderer, group, block, work, number, scene.render.seed, chosen[group]))
            progress((index + (number + 1) / work.passes) / len(blocks))
        parts[group].append(_joined(passes, (block.stop - block.start, setup.camera.unknowns)))
    return joined_parts(renderer, parts, chosen, plans, variant, scene.render.seed)


def one_pass(
    renderer: Renderer, group: str, block: slice, work: Plan, number: int, seed: int, subset: IntArray | None = None
) -> TracedEntries:
    """Trace one pass of the pixels of a block, of all or of a subset."""

    seeds = sampler_seeds(seed, "calibration", number, work.passes)
    texels, weights = renderer.hits(group, work.samples, seeds, block, subset)
    weights = np.ones(texels.shape) if weights is None else weights
    counts, columns, sums = sums_by_texel(texels, weights)
    pixel = np.repeat(np.arange(counts.size), counts)
    total = weights.sum(axis=1)
    values = sums * (renderer.captured(group) / total[pixel])
    return TracedEntries(pixel * renderer.camera.unknowns + columns, values, total == 0)


def _joined(passes: list[TracedEntries], shape: tuple[int, int]) -> Part:
    """Return the mean over the passes, the variance of that mean, and the deviations of batches of passes from it.

    A pixel that gets no light at all in some pass has no entries, since nothing is known of it.
    """
    dark = np.logical_or.reduce([entries.dark for entries in passes])
    if dark.any():
        passes = [_without(entries, dark[entries.where // shape[1]]) for entries in passes]
    matrix = sparse.csr_array(shape, dtype=np.float64)
    for entries in passes:
        matrix = sparse.csr_array(matrix + _matrix(entries, shape))
    matrix.data /= len(passes)
    mean: FloatArray = matrix.data
    cells = np.repeat(np.arange(shape[0]), np.diff(matrix.indptr)) * shape[1] + matrix.indices
    squares = np.zeros(cells.size)
    batches = np.zeros((BATCHES, cells.size))
    for number, (where, values, _) in enumerate(passes):
        index = np.searchsorted(cells, where)
        batches[number % BATCHES, index] += values * (BATCHES / len(passes))
        deviation = -mean
        deviation[index] += values
        squares += np.square(deviation)
    return matrix, squares / (len(passes) * (len(passes) - 1)), (batches - mean).astype(np.float32)


def _matrix(entries: TracedEntries, shape: tuple[int, int]) -> sparse.csr_array:
    pixel, texel = np.divmod(entries.where, shape[1])
    starts = np.concatenate([[0], np.cumsum(np.bincount(pixel, minlength=shape[0]))])
    return sparse.csr_array((entries.values, texel, starts), shape=shape)


def _without(entries: TracedEntries, removed: BoolArray) -> TracedEntries:
    return TracedEntries(entries.where[~removed], entries.values[~removed], entries.dark)
