"""H from recorded point sources, each of which fills one pixel of f while the others are black.

A reading of sensor pixel i, over the value of the source on pixel j, tells the entry H_ij. Readings count where the
ideal footprint of the sensor pixel, widened by a margin, holds the source; beyond it where one source shone alone and
they are more than noise. Several sources of one frame must stand further apart than a footprint, and a sensor pixel
near to two of them is given to the nearer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import fingerprint
from ommatid.runtime.versions import versions

from ..camera import Camera
from ..model import RECORDED, Model
from ..scene import Scene
from ..setup import Setup
from .assignment import FootprintAssignment, unseen
from .frames import AcquisitionSettings, RecordedFrames, read_frames
from .photon_transfer import background, photon_transfer, rounding
from .source_positions import positions_by_rows, read_positions

Vector = NDArray[np.float64]
Grid = NDArray[np.float64]
Whole = NDArray[np.int64]

UNLIKE_ONE = 0.2  # by which rows of H may miss the sum of 1 before it is said
MARGIN = 2.0  # pixels of f around an ideal footprint
CHANCE = 0.01  # that anything beyond all footprints is taken for light when all of it is noise
UNKNOWN = 1.0  # variance of an entry whose sensor pixel told nothing: it is a share, so anything up to 1


@dataclass(frozen=True)
class RecordedEntries:
    """What is known of some entries of H, (n,) each: mean and sample variance of `count` readings, 0 of dead pixels."""

    pixel: Whole
    unknown: Whole
    mean: Vector
    variance: Vector
    count: Whole


@dataclass(frozen=True)
class StrayLight:
    """Of readings that should see nothing: mean square, (M,), NaN where there are none, and which are light.

    lit : (exposures, M)
    """

    mean_square: Vector
    lit: NDArray[np.bool_]


@dataclass(frozen=True)
class RecordedCalibration:
    """The model, the frames it was told from, and what is doubtful of it.

    stray : readings that are light, lie beyond every footprint and belong to no source
    once : whether nothing tells of the noise of photons
    """

    model: Model
    frames: RecordedFrames
    stray: int
    once: bool


def from_recorded_points(
    setup: Setup,
    images: Sequence[Path],
    bench: AcquisitionSettings,
    places: Path | None = None,
    value: float = 255.0,
) -> RecordedCalibration:
    """H from frames of point sources of a `value`, with the variance of its every entry.

    images : mosaics, several in an array of (count, rows, columns) or in a folder
    places : a CSV file of image, row, column;  None: one image a pixel of f by rows, the whole sweep once or more
    Raises InputError for frames that cannot be cut, places outside f, and pixels of f without a source.
    """
    scene, camera, start = setup.scene, setup.camera, perf_counter()
    frames = read_frames(camera, images, bench, mosaics=True)
    if scene.sensor is not None and (frames.dark is None or frames.flat is None):
        raise InputError(
            f"{scene.source}: a [sensor] has dark and flat frames, by which points too are told; give them with --dark"
            " and --flat, or remove [sensor]"
        )
    shown = positions_by_rows(camera, frames.files) if places is None else read_positions(places, camera, frames.files)
    readings = _readings(scene, frames, value)
    known, beyond, stray = _sorted_out(camera, shown, frames.files, readings)
    _refuse_unseen(camera, shown, places)
    _refuse_several(camera, shown, places)
    step = np.nan_to_num(frames.scale / value)
    photons = step * (0.0 if scene.sensor is None else scene.sensor.gain)
    variance = _variance(camera, known, beyond, step if frames.whole else 0.0 * step, photons)
    shape = (camera.measurements, camera.unknowns)
    starts = np.searchsorted(known.pixel, np.arange(shape[0] + 1))
    matrix = sparse.csr_array((known.mean, known.unknown, starts), shape=shape)
    told = {"bench": bench.describe(), "value": value, "places": [one.tolist() for one in shown]}
    record = {
        "fingerprint": fingerprint({"camera": camera.describe(), "source": frames.sources, **told}),
        "method": RECORDED,
        "source": frames.sources,
        "exposures": len(frames.numbers),
        "seconds": perf_counter() - start,
        "versions": versions("scipy", "scikit-image", "OpenEXR"),
    }
    batches: NDArray[np.float32] = np.zeros((0, known.mean.size), dtype=np.float32)
    once = scene.sensor is None and not (known.count > 1).any()
    return RecordedCalibration(Model(setup.resolved, camera, matrix, variance, batches, record), frames, stray, once)


def _refuse_unseen(camera: Camera, shown: list[Whole], places: Path | None) -> None:
    missing = unseen(camera, np.concatenate(shown))
    if missing.size:
        row, column = divmod(int(missing[0]), camera.columns)
        others = f", nor at {missing.size - 1} more that the camera sees" if missing.size > 1 else ""
        raise InputError(
            f"{places}: no point stood at row {row}, column {column} of f{others}; record every pixel of f"
        )


def _refuse_several(camera: Camera, shown: list[Whole], places: Path | None) -> None:
    """Where footprints are not those of pinholes, sources that shine together cannot be told apart by them."""
    if not (camera.has_box_footprints and camera.has_sharp_footprints) and any(len(one) > 1 for one in shown):
        raise InputError(
            f"{places}: several points in an image are told apart by the footprints of pinholes, which this camera's"
            " lenses do not have; record one point an image"
        )


def warnings(calibrated: RecordedCalibration) -> list[str]:
    """What the user should know, a sentence each."""
    said: list[str] = []
    sums = np.asarray(calibrated.model.matrix.sum(axis=1)).ravel()
    whole = float(np.median(sums[sums > 0])) if (sums > 0).any() else 0.0
    if abs(whole - 1) > UNLIKE_ONE:
        said.append(
            f"all points together give a sensor pixel {whole:.3g} of the value of one, expected about 1: look at"
            " --point-value, and take dark and flat frames with --dark and --flat"
        )
    if calibrated.once:
        said.append(
            "every point was recorded once, so that the variance of H holds the noise of the dark and not that of"
            " photons: record each point twice or more, or describe the sensor in [sensor]"
        )
    if calibrated.stray:
        said.append(
            f"{calibrated.stray} readings beyond the footprints are more than noise and belong to no point: let fewer"
            " points shine at once, or look for light that should not be there"
        )
    return said


def _readings(scene: Scene, frames: RecordedFrames, value: float) -> Grid:
    """Shares of the source, (exposures, M), NaN where a pixel is dead or full: that tells less than there was."""
    readings = frames.values() / value
    if scene.sensor is not None:
        readings[frames.numbers >= scene.sensor.full] = np.nan
    readings[~np.isfinite(readings)] = np.nan
    return readings


def _sorted_out(
    camera: Camera, shown: list[Whole], files: list[Path], readings: Grid
) -> tuple[RecordedEntries, StrayLight, int]:
    """Which reading tells which entry: (exposures, M) to entries by rows, and how many are light but tell none."""
    footprints = FootprintAssignment(camera, MARGIN)
    shared = [footprints.shared_out(places, file) for places, file in zip(shown, files, strict=True)]
    away = np.isfinite(readings)
    for exposure, (pixel, _) in enumerate(shared):
        away[exposure, pixel] = False
    beyond = _beyond(camera, readings, away)
    alone = np.array([len(places) == 1 for places in shown])
    near = [np.full(pixel.size, exposure) for exposure, (pixel, _) in enumerate(shared)]
    source = np.array([place[0, 0] * camera.columns + place[0, 1] for place in shown])
    far = _far(away & alone[:, None], source, beyond)
    exposure = np.concatenate([*near, far[0]])
    pixel = np.concatenate([*(pixel for pixel, _ in shared), far[1]])
    unknown = np.concatenate([*(unknown for _, unknown in shared), source[far[0]]])
    stray = int(np.sum(beyond.lit[~alone]))
    return _entries(pixel, unknown, readings[exposure, pixel], camera.unknowns), beyond, stray


def _beyond(camera: Camera, readings: Grid, away: NDArray[np.bool_]) -> StrayLight:
    mean_square, lit = np.empty(camera.measurements), np.zeros_like(away)
    slices = camera.slices()
    for place in slices:
        found, limit = background(readings[:, place][away[:, place]], CHANCE / len(slices))
        mean_square[place] = found
        lit[:, place] = away[:, place] & (readings[:, place] > limit)
    return StrayLight(mean_square, lit)


def _far(away: NDArray[np.bool_], source: Whole, beyond: StrayLight) -> tuple[Whole, Whole]:
    """Exposures and pixels where a source that shone alone brought light beyond its footprint: (n,) each.

    Where it shone so several times all its readings count, or none, lest chance choose the largest ones.
    """
    found: list[tuple[Whole, Whole]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    lit = beyond.lit & away
    for unknown in np.unique(source[lit.any(axis=1)]):
        exposures = np.flatnonzero((source == unknown) & away.any(axis=1))
        some = away[exposures].all(axis=0) & (np.mean(lit[exposures], axis=0) > 0.5)
        pixels = np.flatnonzero(some)
        found.append((np.repeat(exposures, pixels.size), np.tile(pixels, exposures.size)))
    return np.concatenate([one for one, _ in found]), np.concatenate([other for _, other in found])


def _entries(pixel: Whole, unknown: Whole, readings: Vector, unknowns: int) -> RecordedEntries:
    keys, group = np.unique(pixel * unknowns + unknown, return_inverse=True)
    alive = np.isfinite(readings)
    group, readings = group[alive], readings[alive]
    count = np.bincount(group, minlength=keys.size)
    mean = np.bincount(group, readings, keys.size) / np.maximum(count, 1)
    squares = np.bincount(group, (readings - mean[group]) ** 2, keys.size)
    return RecordedEntries(keys // unknowns, keys % unknowns, mean, squares / np.maximum(count - 1, 1), count)


def _variance(camera: Camera, known: RecordedEntries, beyond: StrayLight, step: Vector, photons: Vector) -> Vector:
    """Of the entries' errors: that of a reading over their count, and rounding to whole steps.

    A reading's variance is told by repeats, or else by the background and what photons add to it for each unit of
    light; step, photons : (M,)
    """
    reading = beyond.mean_square[known.pixel] + photons[known.pixel] * np.maximum(known.mean, 0.0)
    repeated = known.count > 1
    for place in camera.type_slices():
        mine = (known.pixel >= place.start) & (known.pixel < place.stop)
        some = mine & repeated
        if some.any():
            dark, light = photon_transfer(known.mean[some], known.variance[some], known.count[some])
            reading[mine] = dark + light * np.maximum(known.mean[mine], 0.0)
    told = known.count > 0
    if not np.isfinite(reading[told]).all():
        raise InputError(
            "--points: every pixel of a sub-image sees light in every image, which leaves its noise unknown; record"
            " each point twice"
        )
    variance = np.full(reading.size, UNKNOWN)
    rounded = rounding(reading[told], step[known.pixel[told]])
    variance[told] = np.maximum(reading[told] / known.count[told], rounded)
    return variance
