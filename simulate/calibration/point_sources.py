"""Point sources: emitters of radiance 1 that fill one pixel of f, a grid of them at a time.

The grid's spacing is wider than any sensor pixel's footprint, so every sensor pixel sees at most one of its sources,
and sweeping the grid over all its places gives every pixel of f its turn: H column by column. Through pinholes several
grids shine at once, each so much brighter than the one before that the sum of a pixel's rays, every one of which brings
back one source whole, tells how many came from each. All sweeps of one pass share a seed, so that the errors of a row
of H cancel in its sum; none is shared with the data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import MachineError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.setup import Setup

from ..renderer.variant import choose
from ..sampling.checkpoint import Checkpoint, State
from ..sampling.passes import BATCHES, OverPasses, Plan, Tally, plan
from ..sampling.seeds import sampler_seeds
from .visible_pixels import VisiblePixels, visible_pixels

if TYPE_CHECKING:
    from ..renderer.renderer import Renderer

ROW_TOLERANCE = 1e-4  # float32 sums of up to 4096 samples are wrong by 4e-5
RENDERINGS = 8.0  # that a calibration takes, about: its seconds over those of rendering one picture as finely
STRAYS = 2  # rays of a sensor pixel that float32 may have rounded over the edge of the target


# Rows of H of one group, the variances of their entries, (nnz,), and their batches, (batches, nnz).
Part = tuple[sparse.csr_array, NDArray[np.float64], NDArray[np.float32]]
Plans = dict[str, Plan]  # by the name of a group


@dataclass(frozen=True)
class Responses(OverPasses):
    """H before it becomes a model.

    `matrix` holds the means of its entries, `variance`, (nnz,), their variances from the scatter of the passes, and
    `batches`, (batches, nnz), deviations of the means of some passes from those of all.
    Where the groups' passes differ, `samples` are the most. summed : of them, how many are added up in float32; absent:
    all
    """

    matrix: sparse.csr_array
    variance: NDArray[np.float64]
    batches: NDArray[np.float32]
    summed: int | None = None


def grid(camera: Camera, apart: int, row: int, column: int) -> NDArray[np.float64]:
    """The target, (rows, columns), with sources of radiance 1 at every `apart` pixels from (row, column)."""
    image = np.zeros(camera.shape)
    image[row::apart, column::apart] = 1.0
    return image


def responses_from_points(
    setup: Setup,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    plans: Plans | None = None,
) -> Responses:
    """Sweep grids of point sources over the target; nothing that light has hit is dropped.

    partial : where passes that are done are kept and found again;  plans : of each group, absent: all as the scene says
    """
    from ..renderer.renderer import Renderer

    scene, camera, variant = setup.scene, setup.simulated, choose(setup.scene.render.variant)
    rig = Renderer(camera, variant, scene.render.sampler, together=False)  # each type its own spacing
    if plans is None:
        plans = dict.fromkeys(rig.groups, plan(scene.calibration.sample_count, scene.render.sampler))
    sweeps = {group: SourceSweep(rig, group) for group in rig.groups}
    shares = {group: sweep.reach.apart**2 for group, sweep in sweeps.items()}
    rows: list[sparse.csr_array] = []
    variances: list[NDArray[np.float64]] = []
    batches: list[NDArray[np.float32]] = []
    done, finished = 0, State()
    before = State() if partial is None else partial.state()
    for group, sweep in sweeps.items():
        begun, work = done, plans[group]

        def report(fraction: float, begun: int = begun, share: int = shares[group]) -> None:
            progress((begun + fraction * share) / sum(shares.values()))

        sweep.resume(before)
        while sweep.tally.count < work.passes:
            sweep.one_more(work, scene.render.seed, report)
            if partial is not None:
                partial.offer(lambda sweep=sweep, finished=finished: {**finished, **sweep.state()})
        finished = {**finished, **sweep.state()} if partial is not None else finished
        tally, means = sweep.tally, sweep.batches
        # Of a pixel that now and then gets no light at all nothing is known; so it has no entries.
        lit = ~sweep.dark
        matrix, order = entries_of(camera, sweep.reach, tally.mean * lit[:, None])
        _check_rows(matrix, sweep.uniform.mean * lit, ROW_TOLERANCE + STRAYS / work.total)
        rows.append(matrix)
        variances.append(tally.variance.ravel()[order])
        batches.append((means.reshape(BATCHES, -1)[:, order] - matrix.data).astype(np.float32))
        done += shares[group]
    parts = list(zip(rows, variances, batches, strict=True))
    return responses_of(parts, plans, variant, scene.render.seed)


def responses_of(parts: list[Part], plans: Plans, variant: str, seed: int) -> Responses:
    """The responses of all groups from those of each, in their order; all have as many passes."""
    rows, variances, batches = zip(*parts, strict=True)
    work = max(plans.values(), key=lambda one: one.samples)
    return Responses(
        matrix=sparse.csr_array(sparse.vstack(rows, format="csr")),
        variance=np.concatenate(variances),
        batches=np.concatenate(batches, axis=1),
        passes=work.passes,
        samples=work.samples,
        variant=variant,
        first_seed=sampler_seeds(seed, "calibration", 0, work.passes)(0),
    )


class SourceSweep:
    """What each sensor pixel of a group reads of every grid, pass by pass.

    tally : (pixels of the group, places of the grid);  batches : the same, in batches of passes, one for each
    uniform : (pixels,), of a uniform target
    """

    def __init__(self, rig: Renderer, group: str) -> None:
        """Before the first pass."""
        self._rig, self._group, self.reach = rig, group, visible_pixels(rig, group)
        shape = self.reach.row.size, self.reach.apart**2
        self.tally, self.uniform = Tally(*shape), Tally(shape[0])
        self.dark = np.zeros(shape[0], dtype=np.bool_)
        self.batches = np.zeros((BATCHES, *shape), dtype=np.float32)

    def state(self) -> State:
        """All of it, to be kept."""
        tallies = {**self.tally.state(self._group), **self.uniform.state(f"{self._group}.uniform")}
        return {**tallies, f"{self._group}.batches": self.batches, f"{self._group}.dark": self.dark}

    def resume(self, state: State) -> None:
        """Go on where a kept one stopped, if there is one."""
        self.tally.resume(self._group, state)
        self.uniform.resume(f"{self._group}.uniform", state)
        self.batches = state.get(f"{self._group}.batches", self.batches)
        self.dark = state.get(f"{self._group}.dark", self.dark)

    def one_more(self, work: Plan, seed: int, progress: Progress) -> None:
        """The next pass."""
        number, camera = self.tally.count, self._rig.camera
        apart = self.reach.apart
        places, levels = apart**2, brightness(work.samples, self._rig.exact if self._rig.even else 0)
        values = np.empty(self.tally.mean.shape)
        pass_seeds = sampler_seeds(seed, "calibration", number, work.passes)
        for first in range(0, places, self._rig.channels * levels.size):
            several = range(first, min(first + self._rig.channels * levels.size, places))
            together = [several[start : start + levels.size] for start in range(0, len(several), levels.size)]
            self._rig.set_target(*(_shining(camera, apart, some, levels) for some in together))
            readings = self._read(work.samples, pass_seeds)
            for some, reading in zip(together, readings, strict=False):
                alone = reading[:, None] if levels.size == 1 else separate_sources(reading, work.samples, levels)
                values[:, some] = alone[:, : len(some)]
            progress((number + several.stop / places) / work.passes)
        self._rig.set_target(np.ones(camera.shape))
        self.uniform.add(self._read(work.samples, pass_seeds)[0])
        self.batches[number % BATCHES] += (values * (BATCHES / work.passes)).astype(np.float32)
        self.tally.add(values)

    def _read(self, samples: int, seeds: Callable[[int], int]) -> NDArray[np.float64]:
        found = self._rig.expose(self._group, samples, seeds)
        self.dark |= np.isnan(found[0])
        return np.nan_to_num(found)


def brightness(samples: int, exact: int) -> NDArray[np.int64]:
    """Radiances of grids that shine together: powers of more than `samples`, as many as add up exactly.

    exact : below which sums of whole numbers come out whole, 0 where rays do not bring back sources whole
    """
    base = 1 << samples.bit_length()
    levels = [1]
    while samples * sum([*levels, levels[-1] * base]) < exact:
        levels.append(levels[-1] * base)
    return np.array(levels)


def separate_sources(readings: NDArray[np.float64], samples: int, levels: NDArray[np.int64]) -> NDArray[np.float64]:
    """What each of the grids alone would have given: (pixels,) to (pixels, grids).

    Raises DeniedError where rays have not brought back sources whole.
    """
    sums = readings * samples
    whole = np.rint(sums)
    if np.abs(sums - whole).max(initial=0.0) > 0.3:
        raise MachineError("calibration: rays bring back parts of point sources; this should not happen here")
    base = int(levels[1])
    return (whole.astype(np.int64)[:, None] // levels % base) / samples


def _shining(camera: Camera, apart: int, places: range, levels: NDArray[np.int64]) -> NDArray[np.float64]:
    image = np.zeros(camera.shape)
    for place, level in zip(places, levels.tolist(), strict=False):
        image += level * grid(camera, apart, *divmod(place, apart))
    return image


def _check_rows(matrix: sparse.csr_array, uniform: NDArray[np.float64], tolerance: float) -> None:
    worst = float(np.abs(matrix.sum(axis=1) - uniform).max())
    if worst > tolerance:
        raise MachineError(
            f"calibration: the point sources together give a sensor pixel {worst:.2g} more or less than a uniform"
            " target of radiance 1 does; this should not happen, try another render.variant"
        )


def entries_of(
    camera: Camera, reach: VisiblePixels, readings: NDArray[np.float64]
) -> tuple[sparse.csr_array, NDArray[np.int64]]:
    """Give each reading to the one source near its pixel's footprint, and drop what no light has hit.

    Returns the rows of H, and which of the flattened readings became its entries.
    """
    row, column, apart = reach.row, reach.column, reach.apart
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
