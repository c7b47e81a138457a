"""Point sources: emitters of radiance 1 that fill one pixel of f, a grid of them at a time.

The grid's spacing is wider than any sensor pixel's footprint, so every sensor pixel sees at most one of its sources,
and sweeping the grid over all its places gives every pixel of f its turn: H column by column. Several grids shine at
once, each so much brighter than the one before that the sum of a pixel's rays, every one of which brings back one
source whole, tells how many came from each. All sweeps of one pass share a seed, so that the errors of a row of H
cancel in its sum; none is shared with the data.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import ceil, floor
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from scenes.camera import Camera, LensType
from scenes.errors import DeniedError
from scenes.partial import Partial, State
from scenes.progress import Progress, no_progress
from scenes.scene import Scene

from .passes import BATCHES, OverPasses, Plan, Tally, plan
from .streams import sampler_seeds
from .variant import choose

if TYPE_CHECKING:
    from .rig import Rig

ROW_TOLERANCE = 1e-4  # float32 sums of up to 4096 samples are wrong by 4e-5
STRAYS = 2  # rays of a sensor pixel that float32 may have rounded over the edge of the target
EXACT = 2**22  # sums of whole numbers below it come out of float32, divided by their count, with less than 1/4 lost
MARGIN = Fraction(1, 1024)  # pixels of f by which rays may land beside a footprint: far more than they are rounded


@dataclass(frozen=True)
class Responses(OverPasses):
    """H before it becomes a model.

    `matrix` holds the means of its entries, `variance`, (nnz,), their variances from the scatter of the passes, and
    `batches`, (batches, nnz), deviations of the means of some passes from those of all.
    """

    matrix: sparse.csr_array
    variance: NDArray[np.float64]
    batches: NDArray[np.float32]


def spacing(kind: LensType) -> int:
    """Pixels of f from one source to the next: a footprint and its margin touch at most ceil(m) + 2."""
    return ceil(kind.ratio) + 2


def grid(camera: Camera, apart: int, row: int, column: int) -> NDArray[np.float64]:
    """The target, (rows, columns), with sources of radiance 1 at every `apart` pixels from (row, column)."""
    image = np.zeros((camera.rows, camera.columns))
    image[row::apart, column::apart] = 1.0
    return image


def from_points(
    scene: Scene, camera: Camera, progress: Progress = no_progress, partial: Partial | None = None
) -> Responses:
    """Sweep grids of point sources over the target; nothing that light has hit is dropped.

    partial : where passes that are done are kept and found again
    """
    from .rig import Rig

    variant = choose(scene.render.variant)
    work = plan(scene.calibration.samples)
    rig = Rig(camera, variant, scene.render.sampler, together=False)  # each type its own spacing
    shares = {group: spacing(types[0]) ** 2 for group, types in rig.groups.items()}
    rows: list[sparse.csr_array] = []
    variances: list[NDArray[np.float64]] = []
    batches: list[NDArray[np.float32]] = []
    done, finished = 0, State()
    before = State() if partial is None else partial.state()
    for group, types in rig.groups.items():
        begun = done

        def report(fraction: float, begun: int = begun, share: int = shares[group]) -> None:
            progress((begun + fraction * share) / sum(shares.values()))

        sweep = Sweep(rig, group)
        sweep.resume(before)
        while sweep.tally.count < work.passes:
            sweep.one_more(work, scene.render.seed, report)
            if partial is not None:
                partial.offer(lambda sweep=sweep, finished=finished: {**finished, **sweep.state()})
        finished = {**finished, **sweep.state()} if partial is not None else finished
        tally, means = sweep.tally, sweep.batches
        matrix, order = entries_of(camera, rig.places(group), spacing(types[0]), tally.mean)
        _check_rows(matrix, sweep.uniform.mean, ROW_TOLERANCE + STRAYS / work.total)
        rows.append(matrix)
        variances.append(tally.variance.ravel()[order])
        batches.append((means.reshape(BATCHES, -1)[:, order] - matrix.data).astype(np.float32))
        done += shares[group]
    stacked = sparse.csr_array(sparse.vstack(rows, format="csr"))
    return Responses(
        matrix=stacked,
        variance=np.concatenate(variances),
        batches=np.concatenate(batches, axis=1),
        passes=work.passes,
        samples=work.samples,
        variant=variant,
        first_seed=sampler_seeds(scene.render.seed, "calibration", 0, work.passes)(0),
    )


class Sweep:
    """What each sensor pixel of a group reads of every grid, pass by pass.

    tally : (pixels of the group, places of the grid);  batches : the same, in batches of passes, one for each
    uniform : (pixels,), of a uniform target
    """

    def __init__(self, rig: Rig, group: str) -> None:
        """Before the first pass."""
        self._rig, self._group, self._apart = rig, group, spacing(rig.groups[group][0])
        shape = rig.places(group).stop - rig.places(group).start, self._apart**2
        self.tally, self.uniform = Tally(*shape), Tally(shape[0])
        self.batches = np.zeros((BATCHES, *shape), dtype=np.float32)

    def state(self) -> State:
        """All of it, to be kept."""
        tallies = {**self.tally.state(self._group), **self.uniform.state(f"{self._group}.uniform")}
        return {**tallies, f"{self._group}.batches": self.batches}

    def resume(self, state: State) -> None:
        """Go on where a kept one stopped, if there is one."""
        self.tally.resume(self._group, state)
        self.uniform.resume(f"{self._group}.uniform", state)
        self.batches = state.get(f"{self._group}.batches", self.batches)

    def one_more(self, work: Plan, seed: int, progress: Progress) -> None:
        """The next pass."""
        number, camera = self.tally.count, self._rig.camera
        places, levels = self._apart**2, brightness(work.samples)
        values = np.empty(self.tally.mean.shape)
        pass_seeds = sampler_seeds(seed, "calibration", number, work.passes)
        for first in range(0, places, self._rig.channels * levels.size):
            several = range(first, min(first + self._rig.channels * levels.size, places))
            together = [several[start : start + levels.size] for start in range(0, len(several), levels.size)]
            self._rig.show(*(_shining(camera, self._apart, some, levels) for some in together))
            readings = self._rig.expose(self._group, work.samples, pass_seeds)
            for some, reading in zip(together, readings, strict=False):
                values[:, some] = told_apart(reading, work.samples, levels)[:, : len(some)]
            progress((number + several.stop / places) / work.passes)
        self._rig.show(np.ones((camera.rows, camera.columns)))
        self.uniform.add(self._rig.expose(self._group, work.samples, pass_seeds)[0])
        self.batches[number % BATCHES] += (values * (BATCHES / work.passes)).astype(np.float32)
        self.tally.add(values)


def brightness(samples: int) -> NDArray[np.int64]:
    """Radiances of grids that shine together: powers of more than `samples`, as many as float32 adds up exactly."""
    base = 1 << samples.bit_length()
    levels = [1]
    while samples * sum([*levels, levels[-1] * base]) < EXACT:
        levels.append(levels[-1] * base)
    return np.array(levels)


def told_apart(readings: NDArray[np.float64], samples: int, levels: NDArray[np.int64]) -> NDArray[np.float64]:
    """What each of the grids alone would have given: (pixels,) to (pixels, grids).

    Raises DeniedError where rays have not brought back sources whole.
    """
    sums = readings * samples
    whole = np.rint(sums)
    if np.abs(sums - whole).max(initial=0.0) > 0.3:
        raise DeniedError("calibration: rays bring back parts of point sources; this should not happen here")
    base = int(levels[1]) if levels.size > 1 else 2 * EXACT
    return (whole.astype(np.int64)[:, None] // levels % base) / samples


def _shining(camera: Camera, apart: int, places: range, levels: NDArray[np.int64]) -> NDArray[np.float64]:
    image = np.zeros((camera.rows, camera.columns))
    for place, level in zip(places, levels.tolist(), strict=False):
        image += level * grid(camera, apart, *divmod(place, apart))
    return image


def _check_rows(matrix: sparse.csr_array, uniform: NDArray[np.float64], tolerance: float) -> None:
    worst = float(np.abs(matrix.sum(axis=1) - uniform).max())
    if worst > tolerance:
        raise DeniedError(
            f"calibration: the point sources together give a sensor pixel {worst:.2g} more or less than a uniform"
            " target of radiance 1 does; this should not happen, try another render.variant"
        )


def entries_of(
    camera: Camera, places: slice, apart: int, readings: NDArray[np.float64]
) -> tuple[sparse.csr_array, NDArray[np.int64]]:
    """Give each reading to the one source near its pixel's footprint, and drop what no light has hit.

    Returns the rows of H, and which of the flattened readings became its entries.
    """
    row, column = (start[places] for start in _first_touched(camera))
    swept = np.arange(apart)
    source_row = row[:, None] + (swept - row[:, None]) % apart
    source_column = column[:, None] + (swept - column[:, None]) % apart
    down = np.repeat(source_row, apart, axis=1).ravel()
    across = np.tile(source_column, (1, apart)).ravel()
    inside = (down >= 0) & (down < camera.rows) & (across >= 0) & (across < camera.columns)
    hit = np.flatnonzero(inside & (readings.ravel() != 0))
    pixel, unknown = hit // apart**2, (down * camera.columns + across)[hit]
    order = np.lexsort((unknown, pixel))
    shape = (readings.shape[0], camera.unknowns)
    matrix = sparse.csr_array((readings.ravel()[hit[order]], (pixel[order], unknown[order])), shape=shape)
    return matrix, hit[order]


def _first_touched(camera: Camera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Row and column of the first pixel of f that rays of each sensor pixel can reach, rounding included: (M,) each."""
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    for sub in camera.sub_imagers:
        first = [
            np.array([floor(start + sub.type.ratio * number - MARGIN) for number in range(count)], dtype=np.int64)
            for start, count in zip(sub.window, sub.type.pixels, strict=True)
        ]
        rows.append(np.repeat(first[0], sub.type.pixels[1]))
        columns.append(np.tile(first[1], sub.type.pixels[0]))
    return np.concatenate(rows), np.concatenate(columns)
