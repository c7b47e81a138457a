"""H from recorded point sources, each of which lights one pixel of f while the others are black.

A reading of sensor pixel i less its dark level, divided by the value of the source on pixel j, is the entry H_ij. A
reading is used if the ideal footprint of the sensor pixel, widened by a margin, contains the source, or if the source
was lit alone, and it or a neighbour exceeds the noise: readings chosen for being high alone would be biased. Several
sources of one frame must be further apart than a footprint, and a sensor pixel near to two of them is assigned to the
nearer one. Dark levels are means of dark frames and of readings without light; their errors are common to rows of H.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import expm1, log1p
from pathlib import Path
from time import perf_counter
from typing import Any, cast

import numpy as np
from scipy import ndimage, optimize, sparse, special

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError, named, shortened
from ommatid.runtime.files import fingerprint
from ommatid.runtime.input_files import read_text
from ommatid.runtime.versions import versions

from ..camera import Camera
from ..constants import WHITE
from ..model import RECORDED, Model
from ..optics.boxes import designed_box
from ..scene import Scene
from ..setup import Setup
from .frames import AcquisitionSettings, RecordedFrames, read_frames

ROUNDS = 20  # of weights, at most, in a fit of noise
TIE = 1e-9  # pixels of f, below which a distance to the edge of a footprint counts as 0


def nearest_sources(camera: Camera, positions: Sequence[IntArray], files: Sequence[Path]) -> IntArray:
    """Return the pixel of f of the source that each reading is assigned to, (exposures, M), -1 beyond all footprints.

    positions : (sources, 2) rows and columns of f, of each exposure
    The distance of a source from a footprint is the larger one along rows and columns from its edge, in pixels of f.
    Raises InputError if two sources of an exposure lie in the footprint of one sensor pixel.
    """
    sides = [np.repeat([[float(side) / 2] for side in lens.footprint], lens.measurements, 1) for lens in camera.types]
    halves, middles = np.concatenate(sides, axis=1), np.stack(camera.middles)
    nearest = np.full((len(files), camera.measurements), -1, dtype=np.int64)
    for found, where, file in zip(nearest, positions, files, strict=True):
        far = np.array([(np.abs(middles - (at[:, None] + 0.5)) - halves).max(axis=0) for at in where])  # (sources, M)
        both_inside = np.flatnonzero((far < 0.5 - TIE).sum(axis=0) > 1)
        if both_inside.size:
            nearer, farther = (
                tuple(at.tolist()) for at in where[np.argsort(far[:, both_inside[0]], kind="stable")[:2]]
            )
            raise InputError(
                f"{file}: the points at {nearer} and {farther}, row and column of f, lie in the footprint of one sensor"
                " pixel; record them in two images"
            )
        reached = far.min(axis=0) < MARGIN + 0.5 - TIE
        found[reached] = (where @ (camera.columns, 1))[far.argmin(axis=0)[reached]]
    return nearest


def unrecorded(camera: Camera, positions: IntArray) -> IntArray:
    """Indices of the pixels of f that lie in some footprint but are not in `positions`, (n, 2) rows and columns."""
    seen = np.zeros(camera.shape, dtype=bool)
    for lens_type in camera.on_grids.types:
        box = designed_box(camera.shape, lens_type)
        seen |= np.outer(box.down.shares.sum(axis=0) > 0, box.across.shares.sum(axis=0) > 0)
    seen[positions[:, 0], positions[:, 1]] = False
    return np.flatnonzero(seen)


LONGEST = 20  # characters of a number
COLUMNS = ("image", "row", "column")


def positions_by_rows(camera: Camera, files: Sequence[Path]) -> list[IntArray]:
    """Return the positions, (1, 2) each, of a source that scans f row by row, once or several times."""
    count = len(files)
    if count == 0 or count % camera.unknowns:
        raise InputError(
            f"expected an image for each of the {camera.unknowns} pixels of f, once or several times, got {count}; give"
            " the positions of the points with --places"
        )
    rows, columns = np.divmod(np.arange(count) % camera.unknowns, camera.columns)
    return list(np.stack([rows, columns], axis=1)[:, None, :])


def read_positions(path: Path, camera: Camera, files: Sequence[Path]) -> list[IntArray]:
    """Row and column of f of every source of each exposure, (sources, 2) each, from a CSV file.

    Its columns are image, row and column; an image is given by its file name, or by its number from 0.
    Raises InputError, naming the line, for a position that is damaged, outside f, or given twice.
    """
    positions: list[dict[tuple[int, int], None]] = [{} for _ in files]  # in order, as a set is not
    for number, line in _lines(path):
        where = f"{path}: line {number}"
        image = _image(line["image"], files, where)
        row, column = (_integer(line[name], name, where) for name in ("row", "column"))
        if not (0 <= row < camera.rows and 0 <= column < camera.columns):
            raise InputError(
                f"{where}: row {row}, column {column} lies outside f of {camera.rows} x {camera.columns} pixels, which"
                " are counted from 0"
            )
        if (row, column) in positions[image]:
            raise InputError(f"{where}: row {row}, column {column} is given twice for one image; remove one of them")
        positions[image][row, column] = None
    for file, of_file in zip(files, positions, strict=True):
        if not of_file:
            raise InputError(f"{path}: has no point of {file}; add its position, or leave the image out")
    return [np.array([*of_file], dtype=np.int64) for of_file in positions]


def _lines(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the lines with their numbers, one by one: a file may have millions of them before a wrong one."""
    try:
        reader = csv.DictReader(io.StringIO(read_text(path).removeprefix("\ufeff"), newline=""), skipinitialspace=True)
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        if not set(COLUMNS) <= set(header):
            given = shortened(",".join(header))
            raise InputError(f"{path}: expected the columns image,row,column in its first line, got '{given}'")
        for line in reader:
            if any(line[name] is None for name in COLUMNS):
                raise InputError(f"{path}: line {reader.line_num}: expected an image, a row and a column, got fewer")
            yield reader.line_num, line
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: expected a CSV file in UTF-8, got other bytes at {error.start}") from error
    except (OSError, csv.Error) as error:
        reason = shortened(str(error))
        raise InputError(f"{path}: could not be read as a CSV file of positions ({reason})") from error


def _image(text: str, files: Sequence[Path], where: str) -> int:
    name = text.strip()
    if name.isdecimal() and len(name) <= LONGEST and int(name) < len(files):
        return int(name)
    matches = [index for index, file in enumerate(files) if name in (str(file), file.name)]
    if len(matches) == 1:
        return matches[0]
    reason = f"{len(matches)} images have that name" if matches else "no image has that name"
    raise InputError(
        f"{where}: expected an image by its file's name or by its number from 0 to {len(files) - 1}, got"
        f" '{shortened(name)}'; {reason}"
    )


def _integer(text: str, name: str, where: str) -> int:
    try:
        if len(text) > LONGEST:
            raise ValueError
        return int(text)
    except ValueError as error:
        raise InputError(f"{where}: expected a whole number as its {name}, got '{shortened(text)}'") from error


MARGIN = 2.0  # pixels of f around an ideal footprint
WIDTH = 3  # pixels of f that are tested for light together, and reached around their middle
FAINTEST = 1e-7  # share of the value of a source, to which float32 holds it
MEDIAN_DEVIATION = 0.6745  # median of the absolute value of a normal deviate
CHANCE = 0.01  # probability that any noise counts as light
BY_ROWS = "by rows from the top left"
SCANS = {  # slopes of the light's rows and columns with those of the point, rounded; other ones are of other orders
    BY_ROWS: [[1, 0], [0, 1]],
    "from the last pixel to the first": [[-1, 0], [0, -1]],
    "from right to left": [[1, 0], [0, -1]],
    "from the bottom up": [[-1, 0], [0, 1]],
    "by columns": [[0, 1], [1, 0]],
}
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
class Background:
    """Unlit readings of each sensor pixel, (M,), and what else there is beyond the footprints.

    level, frames : mean of unlit readings and dark frames, and their number
    variance : of an unlit reading, NaN in a sub-imager without any
    far : (exposures, M) True for readings that a lone source may reach
    stray : number of readings with several sources that exceed the noise
    """

    level: FloatArray
    frames: FloatArray
    variance: FloatArray
    far: BoolArray
    stray: int


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
    if scene.sensor is not None:
        frames.conversion(scene.source)
    positions = (
        positions_by_rows(camera, frames.files) if places is None else read_positions(places, camera, frames.files)
    )
    readings = _readings(scene, frames, value)
    nearest = nearest_sources(camera, positions, frames.files)
    lone = np.array([int(where[0] @ (camera.columns, 1)) if len(where) == 1 else -1 for where in positions])
    unlit = background(camera, readings, nearest >= 0, lone, frames.darks or np.inf)
    entries = _entries(np.where(unlit.far, lone[:, None], nearest), readings - unlit.level, camera.unknowns)
    _check_complete(camera, positions, places)
    _check_separable(camera, positions, places)
    step = np.nan_to_num(frames.scale / value)
    photons = step * (0.0 if scene.sensor is None else scene.sensor.gain)
    variance, shared = _variances(camera, entries, unlit, step if frames.whole else 0.0 * step, photons)
    starts = np.searchsorted(entries.pixel, np.arange(camera.measurements + 1))
    seen = _seen(entries, variance)
    _check_seen(camera, entries, seen, starts)
    _check_order(camera, entries, seen)
    matrix = sparse.csr_array((entries.mean, entries.unknown, starts), shape=(camera.measurements, camera.unknowns))
    record = _record(camera, frames, settings, value, positions) | {"seconds": perf_counter() - start}
    once = scene.sensor is None and not (entries.count > 1).any()
    batches = np.sqrt(shared)[None].astype(np.float32)
    model = Model(setup.resolved, camera, matrix, variance, batches, record)
    return RecordedCalibration(model, frames, unlit.stray, once)


def _record(
    camera: Camera, frames: RecordedFrames, settings: AcquisitionSettings, value: float, positions: Sequence[IntArray]
) -> dict[str, Any]:
    """Return how the model was made: from which files, and by what."""
    made_from = {
        "camera": camera.describe(),
        "source": frames.sources,
        "bench": settings.describe(),
        "value": value,
        "places": [of_exposure.tolist() for of_exposure in positions],
    }
    return {
        "fingerprint": fingerprint(made_from),
        "method": RECORDED,
        "source": frames.sources,
        "exposures": len(frames.numbers),
        "versions": versions("scipy", "scikit-image", "OpenEXR"),
    }


def _check_pixels_of_f(setup: Setup) -> None:
    if setup.camera.has_detail:
        raise InputError(
            f"{setup.scene.source}: recorded point sources fill pixels of f, got target.detail {setup.camera.detail};"
            " set it to 1"
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


def background(camera: Camera, readings: FloatArray, near: BoolArray, lone: IntArray, darks: float) -> Background:
    """Tell readings without light from those that a source reaches, (exposures, M).

    near : True for readings in the footprint of a source;  lone : (exposures,) pixel of f of the only source, or -1
    darks : number of dark frames, whose mean was subtracted; infinite if the dark level is known to be 0
    """
    single, alone = lone >= 0, np.flatnonzero(lone >= 0)
    sweeps = sparse.csr_array((np.ones(alone.size), (lone[alone], alone)), shape=(camera.unknowns, lone.size))
    score, window = _score(int(np.sum(np.isfinite(readings) & ~near))), np.ones((WIDTH, WIDTH, 1))

    def around(values: FloatArray) -> FloatArray:
        """Sum the readings of each lone source and its neighbours: (exposures, pixels) to (rows, columns, pixels)."""
        of_source = np.asarray(sweeps @ values).reshape((*camera.shape, values.shape[1]))
        return ndimage.convolve(of_source, window, mode="constant")

    (levels, frames, variances), all_far, all_stray = np.zeros((3, camera.measurements)), near.copy(), near.copy()
    for part in camera.slices():
        values, finite = readings[:, part], np.isfinite(readings[:, part])
        outside, count = finite & ~near[:, part], around(finite.astype(np.float64))
        # Medians at first: a mean square would hide the light of a sub-image that lies beside all its footprints.
        level = _median(values, outside)
        variance, unlit = (_median(np.abs(values - level), outside) / MEDIAN_DEVIATION) ** 2, finite
        for _ in range(ROUNDS):
            limit, before = score * np.sqrt(np.maximum(variance, FAINTEST**2)), unlit
            above = np.where(finite, values - level, 0.0)
            lit = ndimage.maximum_filter(around(above) > limit * np.sqrt(count), window.shape, mode="constant")
            far = lit.reshape(-1, level.size)[lone] & single[:, None] & ~near[:, part]
            stray = outside & ~far & (above > limit)
            unlit = outside & ~far & ~stray
            number, dark = unlit.sum(axis=0), np.where(unlit, values, 0.0)
            level = dark.sum(axis=0) / (darks + number)
            squares = max(float(np.sum(np.square(dark) - level * dark)), 0.0)
            variance = np.full(level.size, squares / number.sum() if number.any() else np.nan)
            levels[part], frames[part], variances[part] = level, darks + number, variance
            all_far[:, part], all_stray[:, part] = far, stray
            if np.array_equal(unlit, before):
                break
    return Background(levels, frames, variances, all_far, int(np.sum(all_stray[~single])))


def _median(values: FloatArray, used: BoolArray) -> FloatArray:
    """Median over the exposures of the values used, 0 without any: (exposures, M) to (M,)."""
    return np.asarray(cast(Any, np.ma).median(np.ma.array(values, mask=~used), axis=0).filled(0.0), dtype=np.float64)


def _score(count: int) -> float:
    """Standard deviations that one of `count` normal deviates exceeds with the probability CHANCE (Sidak)."""
    return -float(special.ndtri(-expm1(log1p(-CHANCE) / max(count, 1))))


def _entries(unknown: IntArray, readings: FloatArray, unknowns: int) -> RecordedEntries:
    """Group readings, (exposures, M), of the same sensor pixel and pixel of f; unknown : -1 for those not used."""
    exposure, pixel = np.nonzero(unknown >= 0)
    keys, group = np.unique(pixel * unknowns + unknown[exposure, pixel], return_inverse=True)
    used = readings[exposure, pixel]
    alive = np.isfinite(used)
    group, used = group[alive], used[alive]
    count = np.bincount(group, minlength=keys.size)
    mean = np.bincount(group, used, keys.size) / np.maximum(count, 1)
    squares = np.bincount(group, (used - mean[group]) ** 2, keys.size)
    return RecordedEntries(keys // unknowns, keys % unknowns, mean, squares / np.maximum(count - 1, 1), count)


def _variances(
    camera: Camera, entries: RecordedEntries, unlit: Background, step: FloatArray, photons: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Variances of the entries and of the errors that those of a row share, (n,) each: of readings, or of rounding.

    The variance of a reading follows from repeats, or else from the background plus photon noise.
    step, photons : (M,) height of a digital number, and variance of photon noise per unit of light
    """
    dark, light = unlit.variance.copy(), photons.copy()
    for pixels in camera.type_slices():
        repeated = (entries.pixel >= pixels.start) & (entries.pixel < pixels.stop) & (entries.count > 1)
        if repeated.any():
            dark[pixels], light[pixels] = photon_transfer(
                entries.mean[repeated], entries.variance[repeated], entries.count[repeated]
            )
    reading = dark[entries.pixel] + light[entries.pixel] * np.maximum(entries.mean, 0.0)
    recorded = entries.count > 0
    if not np.isfinite(reading[recorded]).all():
        raise InputError(
            "--points: every pixel of a sub-image is lit in every image, so its noise is unknown; record each point"
            " twice"
        )
    variance = np.full(reading.size, UNKNOWN_VARIANCE)
    rounded = rounding(reading[recorded], step[entries.pixel[recorded]])
    variance[recorded] = np.maximum(reading[recorded] / entries.count[recorded], rounded)
    level = np.nan_to_num(dark / unlit.frames)[entries.pixel]
    # Without noise to move them between steps, readings without light are rounded as their dark level is.
    rounded = np.where(np.isfinite(unlit.frames), rounding(np.nan_to_num(dark), step), 0.0)[entries.pixel]
    return variance, np.where(entries.mean > step[entries.pixel] / 2, np.maximum(level, rounded), level)


def _seen(entries: RecordedEntries, variance: FloatArray) -> BoolArray:
    """Return True for entries that exceed their noise."""
    recorded = entries.count > 0
    return recorded & (entries.mean > _score(int(recorded.sum())) * np.sqrt(variance))


def _check_seen(camera: Camera, entries: RecordedEntries, seen: BoolArray, starts: IntArray) -> None:
    """Raise InputError for a sub-imager with pixels that work, of which no entry exceeds its noise."""
    recorded = entries.count > 0
    parts = [
        (sub.name, slice(*starts[[pixels.start, pixels.stop]]))
        for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True)
    ]
    blind = [name for name, part in parts if recorded[part].any() and not seen[part].any()]
    if blind:
        raise InputError(
            "--points: expected light of the points in every sub-image, got noise alone in that of"
            f" {named(blind)}; check --origin, --upright and the rotation of the frames, as by 180 degrees, and record"
            " one point per image"
        )


def _check_order(camera: Camera, entries: RecordedEntries, seen: BoolArray) -> None:
    """Raise InputError if the light does not move over the sensor as the points move over f.

    The centre of the footprints that a point lights is a linear function of its position, to least squares weighted by
    its light. Its slopes tell how the points were scanned.
    """
    unknown, light = entries.unknown[seen], entries.mean[seen]
    middles = np.stack(camera.middles, axis=1)[entries.pixel[seen]]
    lit, point = np.unique(unknown, return_inverse=True)
    weight = np.sqrt(np.bincount(point, light))
    centres = np.stack([np.bincount(point, light * middle) for middle in middles.T], axis=1) / weight[:, None]
    places = weight[:, None] * np.stack([np.ones(lit.size), *np.divmod(lit, camera.columns)], axis=1)
    slopes, _, rank, _ = cast(Any, np.linalg.lstsq)(places, centres, rcond=1e-9)
    if rank < 3:
        return  # the points lie on a line
    found = np.rint(np.clip(slopes[1:].T, -1, 1)).tolist()
    scan = next((scan for scan, expected in SCANS.items() if found == expected), "in another order")
    if scan != BY_ROWS:
        raise InputError(
            f"--points: the light moves over the sensor as if the points were scanned {scan}, expected {BY_ROWS}; order"
            " the images or list their positions in --places, unless the frames are mirrored, turned or --upright"
        )


def photon_transfer(mean: FloatArray, variance: FloatArray, repeats: IntArray) -> tuple[float, float]:
    """Fit the variance a + b mean of a reading, a of the dark and b of the photons, neither below 0.

    mean, variance, repeats : sample mean, sample variance and number of readings of the same light
    The variance of a sample variance is 2 sigma^4 / (repeats - 1); weights follow from the fit, which keeps it
    unbiased.
    """
    light = np.maximum(mean, 0.0)
    typical = float(np.average(variance, weights=repeats - 1))
    if typical <= 0:
        return 0.0, 0.0
    design = np.stack([np.ones_like(light), light], axis=1)
    fit = np.array([typical, 0.0])
    for _ in range(ROUNDS):
        deviation = np.maximum(design @ fit, 1e-6 * typical) / np.sqrt(repeats - 1)
        before, weighted = fit, design / deviation[:, None]
        root = np.linalg.cholesky(weighted.T @ weighted + 1e-12 * np.diag(np.sum(weighted**2, axis=0) + 1e-300))
        right = np.linalg.solve(root, weighted.T @ (variance / deviation))
        fit = np.asarray(cast(Any, optimize).nnls(root.T, right)[0], dtype=np.float64)
        if np.allclose(fit, before, rtol=1e-6, atol=0):
            break
    return float(fit[0]), float(fit[1])


def rounding(variance: FloatArray, step: FloatArray) -> FloatArray:
    """Variance of rounding to multiples of `step` in the mean of any number of repeated readings, an upper bound.

    variance : of rounded readings
    It is step^2 / 12 without noise; noise moves readings between steps, so that rounding averages out: the first
    harmonic of the sawtooth, and with it this variance, falls as exp(-4 pi^2 noise / step^2). To the variance of
    readings it adds what it no longer brings to their mean, at most pi^2 / 3 times the noise and step^2 / 12.
    """
    rounded = np.divide(variance, step**2, out=np.zeros_like(variance), where=step > 0)
    noise = np.maximum(rounded / (1 + np.pi**2 / 3), rounded - 1 / 12)
    return step**2 / 12 * np.exp(-4 * np.pi**2 * noise)
