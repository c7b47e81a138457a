"""H from rendered point sources: emitters of radiance 1 that fill one pixel of f, a grid of them at a time.

The grid's spacing is wider than any sensor pixel's footprint, so every sensor pixel sees at most one of its sources,
and sweeping the grid over all its places gives every pixel of f its turn: H column by column. All sweeps of one pass
share a seed, so that the errors of a row of H cancel in its sum; none is shared with the data.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

from scenes.camera import Camera, LensType
from scenes.errors import DeniedError
from scenes.files import fingerprint
from scenes.model import Model
from scenes.moderate import moderate
from scenes.scene import Scene, resolved
from scenes.versions import versions

from .ideal import ideal_matrix, ideal_model
from .passes import BATCHES, Plan, Tally, plan, rounding_variance
from .render import Progress, no_progress
from .streams import sampler_seed
from .variant import choose

if TYPE_CHECKING:
    from .rig import Rig

ROW_TOLERANCE = 1e-4  # float32 sums of up to 4096 samples are wrong by 4e-5


@dataclass(frozen=True)
class Responses:
    """H before it becomes a model: the means of its entries, (nnz,) variances of them from the scatter of the passes,

    and (batches, nnz) deviations of the means of some passes from those of all.
    """

    matrix: sparse.csr_array
    variance: NDArray[np.float64]
    batches: NDArray[np.float32]
    passes: int
    samples: int
    variant: str


def made_from(scene: Scene, camera: Camera) -> str:
    """Fingerprint of everything that H depends on."""
    description: dict[str, Any] = {"camera": camera.describe(), "calibration": scene.calibration.model_dump()}
    if scene.calibration.method != "ideal":
        render = scene.render
        description["render"] = {"seed": render.seed, "variant": render.variant, "sampler": render.sampler}
    return fingerprint(description)


def calibrate(scene: Scene, camera: Camera, progress: Progress = no_progress) -> Model:
    """H as the scene's `calibration.method` finds it, with the variance of every entry and its record.

    Raises InputError if the variant asked for does not work here, DeniedError if a row fails its check.
    """
    start = perf_counter()
    kept = resolved(scene, (camera.rows, camera.columns))
    record: dict[str, Any] = {"fingerprint": made_from(scene, camera), "method": scene.calibration.method}
    if scene.calibration.method == "ideal":
        model = ideal_model(kept, camera)
        record |= {"seconds": perf_counter() - start, "versions": versions("scipy")}
        return replace(model, record=record)
    responses = from_points(scene, camera, progress)
    variance = settle(responses, camera)
    record |= {
        "seconds": perf_counter() - start,
        "samples": responses.passes * responses.samples,
        "passes": responses.passes,
        "seed": scene.render.seed,
        "variant": responses.variant,
        "agreement": agreement(responses.matrix, variance, camera, responses.passes),
        "versions": versions("mitsuba", "drjit", "scipy"),
    }
    return Model(kept, camera, responses.matrix, variance, responses.batches, record)


def spacing(kind: LensType) -> int:
    """Pixels of f from one source to the next: a footprint touches at most ceil(m) + 2, rounding included."""
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
    batches: list[NDArray[np.float64]] = []
    done = 0
    for group, types in rig.groups.items():
        begun = done

        def report(fraction: float, begun: int = begun, share: int = shares[group]) -> None:
            progress((begun + fraction * share) / sum(shares.values()))

        tally, means = _sweep(rig, group, work, scene.render.seed, report)
        matrix, order = _entries(camera, rig.places(group), spacing(types[0]), tally.mean)
        rows.append(matrix)
        variances.append(tally.variance.ravel()[order])
        batches.append(means.reshape(BATCHES, -1)[:, order] - matrix.data)
        done += shares[group]
    stacked = sparse.csr_array(sparse.vstack(rows, format="csr"))
    return Responses(
        matrix=stacked,
        variance=np.concatenate(variances),
        batches=np.concatenate(batches, axis=1).astype(np.float32),
        passes=work.passes,
        samples=work.samples,
        variant=variant,
    )


def _sweep(rig: Rig, group: str, work: Plan, seed: int, progress: Progress) -> tuple[Tally, NDArray[np.float64]]:
    """What each sensor pixel reads, (pixels of the group, places of the grid), over all passes and in batches."""
    camera = rig.camera
    apart = spacing(rig.groups[group][0])
    pixels = rig.places(group).stop - rig.places(group).start
    tally = Tally(pixels, apart**2)
    batches = np.zeros((BATCHES, pixels, apart**2))
    values = np.empty((pixels, apart**2))
    for number in range(work.passes):
        pass_seed = sampler_seed(seed, "calibration", group, number)
        for first in range(0, apart**2, rig.channels):
            several = range(first, min(first + rig.channels, apart**2))
            rig.show(*(grid(camera, apart, *divmod(place, apart)) for place in several))
            values[:, several] = rig.expose(group, work.samples, pass_seed)[: len(several)].T
            progress((number + several.stop / apart**2) / work.passes)
        rig.show(np.ones((camera.rows, camera.columns)))
        _check_rows(values.sum(axis=1), rig.expose(group, work.samples, pass_seed)[0], camera)
        tally.add(values)
        batches[number % BATCHES] += values * (BATCHES / work.passes)
    return tally, batches


def _check_rows(total: NDArray[np.float64], uniform: NDArray[np.float64], camera: Camera) -> None:
    worst = float(np.abs(total - uniform).max())
    if worst > ROW_TOLERANCE:
        raise DeniedError(
            f"calibration: the {camera.unknowns} point sources together give a sensor pixel {worst:.2g} more or less"
            " than a uniform target does; this should not happen, try another render.variant"
        )


def _entries(
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
            np.array([ceil(start + sub.type.ratio * number) - 1 for number in range(count)], dtype=np.int64)
            for start, count in zip(sub.window, sub.type.pixels, strict=True)
        ]
        rows.append(np.repeat(first[0], sub.type.pixels[1]))
        columns.append(np.tile(first[1], sub.type.pixels[0]))
    return np.concatenate(rows), np.concatenate(columns)


def settle(responses: Responses, camera: Camera) -> NDArray[np.float64]:
    """Variances of H's entries, drawn towards their sub-imager's mean and never below float32's rounding."""
    starts = responses.matrix.indptr
    settled = np.empty_like(responses.variance)
    for place in camera.slices():
        stored = slice(int(starts[place.start]), int(starts[place.stop]))
        settled[stored] = moderate(responses.variance[stored], responses.passes)
    return np.maximum(settled, rounding_variance(responses.matrix.data, responses.samples))


def agreement(matrix: sparse.csr_array, variance: NDArray[np.float64], camera: Camera, passes: int) -> dict[str, float]:
    """How far H lies from the ideal one: RMS difference, largest z, and the chance of so large a one (Sidak).

    Over every entry that either of them has. The chance takes z as Student's t with one degree fewer than passes.
    """
    difference = sparse.csr_array(matrix - ideal_matrix(camera))
    entries = int(difference.nnz)
    known = sparse.csr_array((variance, matrix.indices, matrix.indptr), shape=matrix.shape)
    # An entry that no ray has hit has the smallest uncertainty that one ray more could have shown.
    unseen = float(variance.mean())
    spread = np.asarray(known[difference.nonzero()], dtype=np.float64).ravel()
    spread[spread == 0] = unseen
    values = np.asarray(difference[difference.nonzero()], dtype=np.float64).ravel()
    largest = float(np.max(np.abs(values) / np.sqrt(spread), initial=0.0))
    single = 2 * float(stats.t.sf(largest, passes - 1))
    chance = -np.expm1(entries * np.log1p(-single)) if single < 1 else 1.0
    rms = float(np.sqrt((difference.data**2).sum() / max(matrix.nnz, 1)))
    return {"rms_difference_from_ideal": rms, "max_z": largest, "p_value": float(chance)}
