"""Point sources behind pinholes: emitters of radiance 1 that fill one pixel of f, a grid of them at a time.

The grid's spacing is wider than any sensor pixel's footprint, so every sensor pixel sees at most one of its sources,
and sweeping the grid over all its offsets lights every pixel of f once: H column by column. Several
grids shine at once, each so much brighter than the previous one that the sum of a pixel's rays, every one of which
brings back one source whole, encodes how many came from each. All sweeps of one pass share a seed, so that the errors
of a row of H cancel in its sum; none is shared with the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, lcm
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import MachineError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.model import MeasuredRows

from ..sampling.checkpoint import Checkpoint, State
from ..sampling.passes import BATCHES, Plan, Plans, Tally

if TYPE_CHECKING:
    from ..renderer.rays import Pixels
    from ..renderer.renderer import Renderer

ROW_TOLERANCE = 1e-4  # float32 sums of up to 4096 samples are wrong by 4e-5
RENDERINGS = 8.0  # approximate time of a calibration, in renderings of one picture with as many samples
STRAYS = 2  # rays of a sensor pixel that float32 may have rounded over the edge of the target


MARGIN = Fraction(1, 1024)  # pixels of f by which rays may land beside a footprint: far more than they are rounded


def rows_from_points(
    renderer: Renderer,
    every: list[Pixels],
    plans: Plans,
    seed: int,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
) -> list[MeasuredRows]:
    """Measure the rows of H of the pixels of some groups of ideal pinholes by sweeping grids of point sources."""
    sweeps = [SourceSweep(renderer, pixels) for pixels in every]
    shares = [sweep.visible.spacing**2 for sweep in sweeps]
    finished, state = State(), State() if checkpoint is None else checkpoint.state()
    for number, (sweep, pixels) in enumerate(zip(sweeps, every, strict=True)):
        work, done, share = plans[pixels.group], sum(shares[:number]), shares[number]

        def report(fraction: float, done: int = done, share: int = share) -> None:
            progress((done + fraction * share) / sum(shares))

        sweep.resume(state)
        while sweep.tally.count < work.passes:
            sweep.add_pass(work, seed, report)
            if checkpoint is not None:
                checkpoint.offer(lambda sweep=sweep, finished=finished: {**finished, **sweep.state()})
        finished = {**finished, **sweep.state()} if checkpoint is not None else finished
    return [sweep.part(plans[pixels.group]) for sweep, pixels in zip(sweeps, every, strict=True)]


class SourceSweep:
    """Readings of all sensor pixels of a group for every grid, pass by pass.

    tally : (pixels of the group, offsets of the grid);  batches : the same, per batch of passes
    uniform : (pixels,), of a uniform target
    """

    def __init__(self, renderer: Renderer, pixels: Pixels) -> None:
        """Create an empty sweep of the pixels of a group."""
        self._renderer, self._group, self._pixels = renderer, pixels.group, pixels
        self.visible = visible_pixels(renderer, pixels)
        shape = self.visible.row.size, self.visible.spacing**2
        self.tally, self.uniform = Tally(*shape), Tally(shape[0])
        self.batches = np.zeros((BATCHES, *shape), dtype=np.float32)

    def state(self) -> State:
        """Return the arrays of a checkpoint."""
        tallies = {**self.tally.state(self._group), **self.uniform.state(f"{self._group}.uniform")}
        return {**tallies, f"{self._group}.batches": self.batches}

    def resume(self, state: State) -> None:
        """Continue from a checkpoint, if it holds this group."""
        self.tally.resume(self._group, state)
        self.uniform.resume(f"{self._group}.uniform", state)
        self.batches = state.get(f"{self._group}.batches", self.batches)

    def add_pass(self, work: Plan, seed: int, progress: Progress) -> None:
        """Render the next pass."""
        renderer, number, spacing = self._renderer, self.tally.count, self.visible.spacing
        levels = brightness(work.samples, renderer.exact_below)
        offsets, together = spacing**2, renderer.channels * levels.size
        values = np.empty(self.tally.mean.shape)
        seeds = [sampler_seeds(seed, "calibration", number, work.passes)]
        for first in range(0, offsets, together):
            chunk = range(first, min(first + together, offsets))
            channels = [chunk[start : start + levels.size] for start in range(0, len(chunk), levels.size)]
            renderer.set_target(*(sources(renderer.camera, spacing, shown, levels) for shown in channels))
            readings = renderer.expose(self._pixels, work.samples, seeds)[:, 0]
            for shown, reading in zip(channels, readings, strict=False):
                alone = reading[:, None] if levels.size == 1 else separate_sources(reading, work.samples, levels)
                values[:, shown] = alone[:, : len(shown)]
            progress((number + chunk.stop / offsets) / work.passes)
        renderer.set_target(np.ones(renderer.camera.shape))
        self.uniform.add(renderer.expose(self._pixels, work.samples, seeds)[0, 0])
        self.batches[number % BATCHES] += (values * (BATCHES / work.passes)).astype(np.float32)
        self.tally.add(values)

    def part(self, work: Plan) -> MeasuredRows:
        """Return the rows of H of these pixels. Raises MachineError."""
        matrix, order = entries_of(self._renderer.camera, self.visible, self.tally.mean)
        _check_rows(matrix, self.uniform.mean, ROW_TOLERANCE + STRAYS / work.total)
        batches = (self.batches.reshape(BATCHES, -1)[:, order] - matrix.data).astype(np.float32)
        return MeasuredRows(matrix, self.tally.variance.ravel()[order], batches)


def brightness(samples: int, exact_below: int) -> IntArray:
    """Return the radiances of grids that shine together: powers of more than `samples`, as many as add up exactly.

    exact_below : limit of exact sums of whole numbers
    """
    base = 1 << samples.bit_length()
    levels = [1]
    while samples * sum([*levels, levels[-1] * base]) < exact_below:
        levels.append(levels[-1] * base)
    return np.array(levels)


def separate_sources(readings: FloatArray, samples: int, levels: IntArray) -> FloatArray:
    """Return the readings that each of the grids alone would have given: (pixels,) to (pixels, grids).

    Raises MachineError if rays have not brought back sources whole.
    """
    sums = readings * samples
    whole = np.rint(sums)
    if np.abs(sums - whole).max(initial=0.0) > 0.3:
        raise MachineError("calibration: a ray carries a fraction of a point source; please report this")
    base = int(levels[1])
    return (whole.astype(np.int64)[:, None] // levels % base) / samples


def sources(camera: Camera, spacing: int, offsets: range, levels: IntArray) -> FloatArray:
    """Return the target, (rows, columns), with a source at every `spacing` pixels for each offset, of its radiance."""
    image = np.zeros(camera.shape)
    for offset, level in zip(offsets, levels.tolist(), strict=False):
        row, column = divmod(offset, spacing)
        image[row::spacing, column::spacing] += level
    return image


def _check_rows(matrix: sparse.csr_array, uniform: FloatArray, tolerance: float) -> None:
    worst = float(np.abs(matrix.sum(axis=1) - uniform).max())
    if worst > tolerance:
        raise MachineError(
            f"calibration: the point sources together give a sensor pixel {worst:.2g} more or less than a uniform"
            " target of radiance 1 does; this should not happen, try another render.variant"
        )


def entries_of(camera: Camera, visible: VisiblePixels, readings: FloatArray) -> tuple[sparse.csr_array, IntArray]:
    """Assign each reading to the one source near its pixel's footprint, and drop those without light.

    Returns the rows of H, and the indices of the flattened readings that became its entries.
    """
    row, column, spacing = visible.row, visible.column, visible.spacing
    swept = np.arange(spacing)
    source_row = row[:, None] + (swept - row[:, None]) % spacing
    source_column = column[:, None] + (swept - column[:, None]) % spacing
    down = np.repeat(source_row, spacing, axis=1).ravel()
    across = np.tile(source_column, (1, spacing)).ravel()
    inside = (down >= 0) & (down < camera.rows) & (across >= 0) & (across < camera.columns)
    hit = np.flatnonzero(inside & (readings.ravel() != 0))
    pixel, unknown = hit // spacing**2, (down * camera.columns + across)[hit]
    order = np.lexsort((unknown, pixel))
    shape = (readings.shape[0], camera.unknowns)
    matrix = sparse.csr_array((readings.ravel()[hit[order]], (pixel[order], unknown[order])), shape=shape)
    return matrix, hit[order]


@dataclass(frozen=True)
class VisiblePixels:
    """First row and column of f that each pixel of a group may see, (pixels,) each, and the largest number of them."""

    row: IntArray
    column: IntArray
    spacing: int


def visible_pixels(renderer: Renderer, pixels: Pixels) -> VisiblePixels:
    """Return the visible pixels of some pixels of a group of the renderer, which is one lens type."""
    (lens_type,), numbers = renderer.groups[pixels.group], pixels.numbers
    visible = of_pinholes(renderer.camera, lens_type)
    return replace(visible, row=visible.row[numbers], column=visible.column[numbers])


def of_pinholes(camera: Camera, lens_type: LensType) -> VisiblePixels:
    """Return those of a type of ideal pinholes, whose footprint with its margin touches at most ceil(m) + 2 pixels."""
    rows: list[IntArray] = []
    columns: list[IntArray] = []
    for sub in (sub for sub in camera.sub_imagers if sub.type == lens_type):
        starts = zip(sub.window, lens_type.pixels, strict=True)
        first = [_floors(start - MARGIN, lens_type.ratio, count) for start, count in starts]
        rows.append(np.repeat(first[0], lens_type.pixels[1]))
        columns.append(np.tile(first[1], lens_type.pixels[0]))
    return VisiblePixels(np.concatenate(rows), np.concatenate(columns), ceil(lens_type.ratio) + 2)


def _floors(start: Fraction, step: Fraction, count: int) -> IntArray:
    """Return the whole parts of start, start + step, ..., (count,)."""
    unit = lcm(start.denominator, step.denominator)
    numbers = int(start * unit) + int(step * unit) * np.arange(count, dtype=object)  # of any size
    return (numbers // unit).astype(np.int64)
