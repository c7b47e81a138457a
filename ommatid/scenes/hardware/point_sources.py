"""H from recorded point sources, each of which lights one pixel of f while the others are black.

A reading of sensor pixel i, divided by the value of the source on pixel j, is the entry H_ij. A reading is used if the
ideal footprint of the sensor pixel, widened by a margin, contains the source; beyond that only if one source was lit
alone and the reading exceeds the noise. Several sources of one frame must be further apart than a footprint, and a
sensor pixel near to two of them is assigned to the nearer one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import fingerprint
from ommatid.runtime.versions import versions

from ..camera import Camera
from ..constants import WHITE
from ..model import RECORDED, Model
from ..scene import Scene
from ..setup import Setup
from .assignment import FootprintAssignment, unrecorded
from .frames import AcquisitionSettings, RecordedFrames, read_frames
from .photon_transfer import background, photon_transfer, rounding
from .source_positions import positions_by_rows, read_positions

MARGIN = 2.0  # pixels of f around an ideal footprint
CHANCE = 0.01  # probability that any noise beyond all footprints counts as light
UNKNOWN_VARIANCE = 1.0  # of an entry without readings, which is a share from 0 to 1


@dataclass(frozen=True)
class RecordedEntries:
    """Entries of H that were recorded, (n,) each: mean and sample variance of `count` readings, 0 for dead pixels."""

    pixel: IntArray
    unknown: IntArray
    mean: FloatArray
    variance: FloatArray
    count: IntArray


@dataclass(frozen=True)
class StrayLight:
    """Readings outside all footprints: their mean square per sensor pixel, (M,), NaN without readings.

    lit : (exposures, M) True where such a reading exceeds the noise
    """

    mean_square: FloatArray
    lit: BoolArray


@dataclass(frozen=True)
class RecordedCalibration:
    """The model, its frames, and what makes it doubtful.

    stray : number of readings that exceed the noise, lie outside every footprint and belong to no source
    once : True if there is no information on photon noise, neither from repeats nor from a [sensor]
    """

    model: Model
    frames: RecordedFrames
    stray: int
    once: bool


def from_recorded_points(
    setup: Setup,
    images: Sequence[Path],
    settings: AcquisitionSettings,
    places: Path | None = None,
    value: float = WHITE,
) -> RecordedCalibration:
    """H from frames of point sources of a `value`, with the variance of each entry.

    images : mosaics, several in an array of (count, rows, columns) or in a folder
    places : a CSV file of image, row, column;  None: one image per pixel of f by rows, the whole sweep once or more
    Raises InputError for frames that do not fit the camera, positions outside f, and pixels of f without a source.
    """
    scene, camera, start = setup.scene, setup.camera, perf_counter()
    _check_pixels_of_f(setup)
    frames = read_frames(camera, images, settings, mosaics=True)
    _check_conversion(scene, frames)
    positions = (
        positions_by_rows(camera, frames.files) if places is None else read_positions(places, camera, frames.files)
    )
    readings = _readings(scene, frames, value)
    entries, beyond, stray = _assign(camera, positions, frames.files, readings)
    _check_complete(camera, positions, places)
    _check_separable(camera, positions, places)
    step = np.nan_to_num(frames.scale / value)
    photons = step * (0.0 if scene.sensor is None else scene.sensor.gain)
    variance = _variance(camera, entries, beyond, step if frames.whole else 0.0 * step, photons)
    starts = np.searchsorted(entries.pixel, np.arange(camera.measurements + 1))
    matrix = sparse.csr_array((entries.mean, entries.unknown, starts), shape=(camera.measurements, camera.unknowns))
    made_from = {
        "camera": camera.describe(),
        "source": frames.sources,
        "bench": settings.describe(),
        "value": value,
        "places": [of_exposure.tolist() for of_exposure in positions],
    }
    record = {
        "fingerprint": fingerprint(made_from),
        "method": RECORDED,
        "source": frames.sources,
        "exposures": len(frames.numbers),
        "seconds": perf_counter() - start,
        "versions": versions("scipy", "scikit-image", "OpenEXR"),
    }
    once = scene.sensor is None and not (entries.count > 1).any()
    batches = np.zeros((0, entries.mean.size), dtype=np.float32)
    return RecordedCalibration(Model(setup.resolved, camera, matrix, variance, batches, record), frames, stray, once)


def _check_pixels_of_f(setup: Setup) -> None:
    if setup.camera.has_detail:
        raise InputError(
            f"{setup.scene.source}: recorded point sources fill pixels of f, got target.detail {setup.camera.detail};"
            " set it to 1"
        )


def _check_conversion(scene: Scene, frames: RecordedFrames) -> None:
    if scene.sensor is not None and (frames.dark is None or frames.flat is None):
        raise InputError(
            f"{scene.source}: a [sensor] needs dark and flat frames to convert readings of points; pass them with"
            " --dark and --flat, or remove [sensor]"
        )


def _check_complete(camera: Camera, positions: list[IntArray], places: Path | None) -> None:
    missing = unrecorded(camera, np.concatenate(positions))
    if missing.size:
        row, column = divmod(int(missing[0]), camera.columns)
        others = f", nor at {missing.size - 1} more that the camera sees" if missing.size > 1 else ""
        raise InputError(
            f"{places}: no point was recorded at row {row}, column {column} of f{others}; record every pixel of f"
        )


def _check_separable(camera: Camera, positions: list[IntArray], places: Path | None) -> None:
    """Raise InputError for several sources in an exposure if footprints are not those of ideal pinholes."""
    ideal = camera.has_box_footprints and camera.has_sharp_footprints
    if not ideal and any(len(of_exposure) > 1 for of_exposure in positions):
        raise InputError(
            f"{places}: several points in an image are separated by the footprints of pinholes, which this camera's"
            " lenses do not have; record one point per image"
        )


def _readings(scene: Scene, frames: RecordedFrames, value: float) -> FloatArray:
    """Readings relative to the source's value, (exposures, M), NaN for dead pixels and saturated readings."""
    readings = frames.values() / value
    if scene.sensor is not None:
        readings[frames.numbers >= scene.sensor.full] = np.nan
    readings[~np.isfinite(readings)] = np.nan
    return readings


def _assign(
    camera: Camera, positions: list[IntArray], files: list[Path], readings: FloatArray
) -> tuple[RecordedEntries, StrayLight, int]:
    """Assign readings, (exposures, M), to entries; also return the stray light and the number of lit readings of it."""
    footprints = FootprintAssignment(camera, MARGIN)
    assigned = [footprints.nearest_sources(where, file) for where, file in zip(positions, files, strict=True)]
    outside = np.isfinite(readings)
    for exposure, (pixel, _) in enumerate(assigned):
        outside[exposure, pixel] = False
    beyond = _stray_light(camera, readings, outside)
    alone = np.array([len(of_exposure) == 1 for of_exposure in positions])
    near = [np.full(pixel.size, exposure) for exposure, (pixel, _) in enumerate(assigned)]
    source = np.array([of_exposure[0, 0] * camera.columns + of_exposure[0, 1] for of_exposure in positions])
    far = _far_readings(outside & alone[:, None], source, beyond)
    exposure = np.concatenate([*near, far[0]])
    pixel = np.concatenate([*(pixel for pixel, _ in assigned), far[1]])
    unknown = np.concatenate([*(unknown for _, unknown in assigned), source[far[0]]])
    stray = int(np.sum(beyond.lit[~alone]))
    return _entries(pixel, unknown, readings[exposure, pixel], camera.unknowns), beyond, stray


def _stray_light(camera: Camera, readings: FloatArray, outside: BoolArray) -> StrayLight:
    mean_square, lit = np.empty(camera.measurements), np.zeros_like(outside)
    slices = camera.slices()
    for pixels in slices:
        mean_square[pixels], limit = background(readings[:, pixels][outside[:, pixels]], CHANCE / len(slices))
        lit[:, pixels] = outside[:, pixels] & (readings[:, pixels] > limit)
    return StrayLight(mean_square, lit)


def _far_readings(outside: BoolArray, source: IntArray, beyond: StrayLight) -> tuple[IntArray, IntArray]:
    """Exposures and pixels where a source that was lit alone brought light outside its footprint: (n,) each.

    If it was lit several times, all its readings of a pixel are used or none: selecting the largest would bias them.
    """
    exposures, pixels = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    lit = beyond.lit & outside
    for unknown in np.unique(source[lit.any(axis=1)]):
        repeats = np.flatnonzero((source == unknown) & outside.any(axis=1))
        used = np.flatnonzero(outside[repeats].all(axis=0) & (np.mean(lit[repeats], axis=0) > 0.5))
        exposures.append(np.repeat(repeats, used.size))
        pixels.append(np.tile(used, repeats.size))
    return np.concatenate(exposures), np.concatenate(pixels)


def _entries(pixel: IntArray, unknown: IntArray, readings: FloatArray, unknowns: int) -> RecordedEntries:
    """Group readings, (n,) each, of the same sensor pixel and pixel of f."""
    keys, group = np.unique(pixel * unknowns + unknown, return_inverse=True)
    alive = np.isfinite(readings)
    group, readings = group[alive], readings[alive]
    count = np.bincount(group, minlength=keys.size)
    mean = np.bincount(group, readings, keys.size) / np.maximum(count, 1)
    squares = np.bincount(group, (readings - mean[group]) ** 2, keys.size)
    return RecordedEntries(keys // unknowns, keys % unknowns, mean, squares / np.maximum(count - 1, 1), count)


def _variance(
    camera: Camera, entries: RecordedEntries, beyond: StrayLight, step: FloatArray, photons: FloatArray
) -> FloatArray:
    """Variances of the entries: that of a reading over their count, or that of rounding if larger: (n,).

    The variance of a reading follows from repeats, or else from the background plus photon noise.
    step, photons : (M,) height of a digital number, and variance of photon noise per unit of light
    """
    reading = beyond.mean_square[entries.pixel] + photons[entries.pixel] * np.maximum(entries.mean, 0.0)
    for pixels in camera.type_slices():
        of_type = (entries.pixel >= pixels.start) & (entries.pixel < pixels.stop)
        repeated = of_type & (entries.count > 1)
        if repeated.any():
            dark, light = photon_transfer(entries.mean[repeated], entries.variance[repeated], entries.count[repeated])
            reading[of_type] = dark + light * np.maximum(entries.mean[of_type], 0.0)
    recorded = entries.count > 0
    if not np.isfinite(reading[recorded]).all():
        raise InputError(
            "--points: every pixel of a sub-image is lit in every image, so its noise is unknown; record each point"
            " twice"
        )
    variance = np.full(reading.size, UNKNOWN_VARIANCE)
    rounded = rounding(reading[recorded], step[entries.pixel[recorded]])
    variance[recorded] = np.maximum(reading[recorded] / entries.count[recorded], rounded)
    return variance
