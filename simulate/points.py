"""Point sources: emitters of radiance 1 that fill one pixel of f, a grid of them at a time.

The grid's spacing is wider than any sensor pixel's footprint, so every sensor pixel sees at most one of its sources,
and sweeping the grid over all its places gives every pixel of f its turn: H column by column. All sweeps of one pass
share a seed, so that the errors of a row of H cancel in its sum; none is shared with the data.
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
from scenes.scene import Scene

from .passes import BATCHES, OverPasses, Plan, Tally, plan
from .render import Progress, no_progress
from .streams import sampler_seeds
from .variant import choose

if TYPE_CHECKING:
    from .rig import Rig

ROW_TOLERANCE = 1e-4  # float32 sums of up to 4096 samples are wrong by 4e-5
STRAYS = 2  # rays of a sensor pixel that float32 may have rounded over the edge of the target
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


def from_points(scene: Scene, camera: Camera, progress: Progress = no_progress) -> Responses:
    """Sweep grids of point sources over the target; nothing that light has hit is dropped."""
    from .rig import Rig

    variant = choose(scene.render.variant)
    work = plan(scene.calibration.samples)
    rig = Rig(camera, variant, scene.render.sampler, together=False)  # each type its own spacing
    shares = {group: spacing(types[0]) ** 2 for group, types in rig.groups.items()}
    rows: list[sparse.csr_array] = []
    variances: list[NDArray[np.float64]] = []
    batches: list[NDArray[np.float32]] = []
    done = 0
    for group, types in rig.groups.items():
        begun = done

        def report(fraction: float, begun: int = begun, share: int = shares[group]) -> None:
            progress((begun + fraction * share) / sum(shares.values()))

        tally, means, uniform = sweep(rig, group, work, scene.render.seed, report)
        matrix, order = entries_of(camera, rig.places(group), spacing(types[0]), tally.mean)
        _check_rows(matrix, uniform, ROW_TOLERANCE + STRAYS / work.total)
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


def sweep(
    rig: Rig, group: str, work: Plan, seed: int, progress: Progress
) -> tuple[Tally, NDArray[np.float32], NDArray[np.float64]]:
    """What each sensor pixel reads of every grid over all passes, in batches of them, and of a uniform target.

    The first two are (pixels of the group, places of the grid), in batches one for each; the last is (pixels,).
    """
    camera = rig.camera
    apart = spacing(rig.groups[group][0])
    pixels = rig.places(group).stop - rig.places(group).start
    tally, uniform = Tally(pixels, apart**2), Tally(pixels)
    batches = np.zeros((BATCHES, pixels, apart**2), dtype=np.float32)
    values = np.empty((pixels, apart**2))
    for number in range(work.passes):
        pass_seeds = sampler_seeds(seed, "calibration", number, work.passes)
        for first in range(0, apart**2, rig.channels):
            several = range(first, min(first + rig.channels, apart**2))
            rig.show(*(grid(camera, apart, *divmod(place, apart)) for place in several))
            values[:, several] = rig.expose(group, work.samples, pass_seeds)[: len(several)].T
            progress((number + several.stop / apart**2) / work.passes)
        rig.show(np.ones((camera.rows, camera.columns)))
        uniform.add(rig.expose(group, work.samples, pass_seeds)[0])
        tally.add(values)
        batches[number % BATCHES] += (values * (BATCHES / work.passes)).astype(np.float32)
    return tally, batches, uniform.mean


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
