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
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.model import MeasuredRows

from ..sampling.passes import BATCHES, Plan, Plans

if TYPE_CHECKING:
    from ..renderer.rays import Pixels
    from ..renderer.renderer import Renderer


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
