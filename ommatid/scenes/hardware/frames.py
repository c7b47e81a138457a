"""Frames of a real camera: positions of the sub-images, and conversion of digital numbers to values of f.

A mosaic is a picture of the whole flat sensor, seen from behind the camera looking at the target: its columns run
towards -x, its rows towards -y, and its middle is the camera's axis (0, 0) unless an `origin` is given. A lens rotates
its image by 180 degrees, so that sub-images lie upside down in a mosaic and are rotated when they are cut out.
Pictures of single sub-imagers are in the order of measurements, and upright by default.

They are imported as a stack, which is reconstructed like a rendered one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import file_digest, fingerprint
from ommatid.runtime.versions import versions

from ..camera import Camera
from ..constants import WHITE
from ..formats.picture import grey, notes_of
from ..formats.picture_file import FRAMES, read_frames_of
from ..formats.stored_picture import StoredPicture
from ..recording import Recording
from ..setup import Setup
from ..stack import Stack
from ..tables.sensor import SensorTable

FLOATING = "floating-point"


@dataclass
class FrameNotes:
    """What is lost or changed when frames are read, and the types of their numbers.

    sentences : of the first file of images, of dark and of flat frames;  types : kinds of frames by type
    """

    sentences: dict[str, list[str]] = field(default_factory=dict[str, list[str]])
    types: dict[str, str] = field(default_factory=dict[str, str])

    def add(self, path: Path, stored: StoredPicture, what: str) -> None:
        """Note one picture."""
        self.sentences.setdefault(what, notes_of(str(path), stored))
        is_floating = stored.pixels.dtype.kind == "f"
        self.types.setdefault(FLOATING if is_floating else f"{stored.bits_each}-bit", what)

    def describe(self) -> list[str]:
        """Return a sentence each."""
        sentences = [sentence for of_kind in self.sentences.values() for sentence in of_kind]
        whole = [f"{words} numbers ({what})" for words, what in self.types.items() if words != FLOATING]
        if len(whole) > 1:
            sentences.append(
                f"frames have {' and '.join(whole)}, which are taken as they are: record all of them with the same bits"
            )
        return sentences


def files_in(path: Path) -> list[Path]:
    """The file itself, or the pictures in a folder sorted by name. Raises InputError if there is none."""
    if not path.is_dir():
        return [path]
    files = sorted(file for file in path.iterdir() if file.suffix.lower() in FRAMES and not file.name.startswith("."))
    if not files:
        raise InputError(f"{path}: expected a folder of PNG, TIFF, EXR or NPY files, got none of them in it")
    return files


def stored_pictures(path: Path, what: str) -> list[StoredPicture]:
    """The pictures in a file, with what is lost when they are read: one, those of an array, or of all pages.

    Raises InputError if there is none.
    """
    pictures = read_frames_of(path, what)
    for stored in pictures:
        if stored.pixels.dtype.kind not in "uif":
            raise InputError(
                f"{path}: expected whole or floating-point numbers, got {stored.pixels.dtype}, {stored.pixels.shape}"
            )
    return pictures


UNLIT = 0.01  # share of the pixels of a mosaic that are taken for dark
TIE = 1e-6  # sensor pixels, rounding error of a position half way between two pixels
DARK, FLAT = "dark frames", "flat frames"
LARGEST_NUMBER = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class AcquisitionSettings:
    """Calibration frames, position and orientation of recorded frames.

    dark, flat : frames without light and of a uniform target of value `flat_value`;  none: numbers are values of f
    origin : row and column in a mosaic of the top left pixel of the first sub-imager's patch; None: from the middle
    upright : True if sub-images are upright in the frames;  None: those of a mosaic are not, single ones are
    """

    dark: tuple[Path, ...] = ()
    flat: tuple[Path, ...] = ()
    flat_value: float = WHITE
    origin: tuple[int, int] | None = None
    upright: bool | None = None

    def describe(self) -> dict[str, Any]:
        """Return the settings without the files, in JSON's types; part of fingerprints."""
        return {"flat_value": self.flat_value, "origin": self.origin, "upright": self.upright}


@dataclass(frozen=True)
class SensorLayout:
    """The arrangement of the pictures of one exposure, which become (M,) numbers.

    shapes : shapes of the pictures of an exposure
    corners : (sub-imagers, 2) top left pixels of the patches in a mosaic,
        None if every sub-imager has its own picture;  rotated : True if sub-images are upside down
    beside : largest distance, in sensor pixels along one axis, between a patch and the whole pixels cut out for it
    turned : light at the patches of the mosaic turned by 180 degrees over that of the mosaic, 1 of several mosaics
    """

    camera: Camera
    shapes: tuple[tuple[int, ...], ...]
    corners: IntArray | None
    rotated: bool
    beside: float
    turned: float = 1.0

    def cut(self, pictures: Sequence[FloatArray]) -> FloatArray:
        """The numbers of one exposure in the order of measurements: (M,)."""
        sizes = [sub.type.pixels for sub in self.camera.sub_imagers]
        if self.corners is None:
            patches = list(pictures)
        else:
            pairs = zip(self.corners.tolist(), sizes, strict=True)
            patches = [
                pictures[0][row : row + rows, column : column + columns] for (row, column), (rows, columns) in pairs
            ]
        return np.concatenate([np.ravel(patch[::-1, ::-1] if self.rotated else patch) for patch in patches])

    def light_if_turned(self, mosaic: FloatArray) -> float:
        """Return the light at the patches of a mosaic turned by 180 degrees, over that at those of the mosaic.

        It is at most 1 if there is no light beside the sub-images.
        """
        usable = np.abs(mosaic) <= LARGEST_NUMBER
        if not usable.any():
            return 1.0
        light = np.where(usable, mosaic - np.quantile(mosaic[usable], UNLIT), 0.0)
        turned, seen = (float(self.cut([each]).sum()) for each in (light[::-1, ::-1], light))
        return turned / seen if seen > 0 else 1.0

    def exposures(self, paths: Sequence[Path], what: str, notes: FrameNotes) -> Iterator[tuple[Path, FloatArray]]:
        """Yield the last file and the numbers, (M,), of each exposure. Raises InputError for another shape.

        notes : is told of every picture
        """
        pictures: list[FloatArray] = []
        for path in paths:
            for stored in stored_pictures(path, what):
                notes.add(path, stored, what)
                picture = grey(stored.pixels, str(path))
                expected = self.shapes[len(pictures)]
                if picture.shape != expected:
                    raise InputError(
                        f"{path}: expected {what} of {expected[0]} x {expected[1]} pixels, got"
                        f" {picture.shape[0]} x {picture.shape[1]}; record all frames alike"
                    )
                pictures.append(picture)
                if len(pictures) == len(self.shapes):
                    yield path, self.cut(pictures)
                    pictures = []
        if pictures:
            raise InputError(
                f"{paths[-1]}: expected {what} in sets of {len(self.shapes)} pictures, one per sub-imager, and"
                f" {len(pictures)} are left over"
            )


@dataclass(frozen=True)
class RecordedFrames:
    """Recorded digital numbers, (exposures, M), and the means of dark and flat frames, (M,).

    darks : number of dark frames;  averaged : that, or the number of flat frames if it is smaller
    files : the last file of each exposure;  sources : names and SHA-256 of all files
    whole : True if all numbers are integers, rounded by the sensor
    notes : what is lost or changed when the files are read, a sentence each
    """

    layout: SensorLayout
    numbers: FloatArray
    dark: FloatArray | None
    flat: FloatArray | None
    darks: int
    averaged: int
    settings: AcquisitionSettings
    files: list[Path]
    whole: bool
    sources: list[dict[str, str]]
    notes: list[str]

    def conversion(self, source: Path) -> tuple[FloatArray, FloatArray]:
        """Return the means of dark and flat frames, by which a [sensor]'s readings are converted. Raises InputError."""
        if self.dark is None or self.flat is None:
            raise InputError(
                f"{source}: a [sensor] needs dark and flat frames to convert its readings; pass them with --dark and"
                " --flat, or remove [sensor]"
            )
        return self.dark, self.flat

    @property
    def flat_values(self) -> FloatArray:
        """Readings of the uniform target in the flat frames, in units of f: (M,)."""
        return self.settings.flat_value * self.layout.camera.received

    @property
    def scale(self) -> FloatArray:
        """Units of f per digital number, (M,); NaN for dead pixels."""
        if self.flat is None:
            return np.ones(self.layout.camera.measurements)
        with np.errstate(over="ignore", invalid="ignore"):
            signal: FloatArray = self.flat if self.dark is None else self.flat - self.dark
        alive = np.isfinite(signal) & (signal > 0)
        scale: FloatArray = np.full(signal.shape, np.nan)
        scale[alive] = self.flat_values[alive] / signal[alive]
        return scale

    def values(self) -> FloatArray:
        """(image - dark) / (flat - dark) flat_values, NaN for dead pixels: (exposures, M)."""
        with np.errstate(over="ignore", invalid="ignore"):
            values: FloatArray = (self.numbers if self.dark is None else self.numbers - self.dark) * self.scale
        values[~(np.abs(values) <= LARGEST_NUMBER)] = np.nan
        return values

    @property
    def not_numbers(self) -> int:
        """Count of sensor pixels whose image or dark frame is NaN, infinite or beyond single precision somewhere."""
        usable: BoolArray = np.abs(self.numbers) <= LARGEST_NUMBER
        if self.dark is not None:
            usable &= np.abs(self.dark) <= LARGEST_NUMBER
        return int(np.sum(~np.min(usable, axis=0)))


def read_frames(
    camera: Camera, images: Sequence[Path], settings: AcquisitionSettings, *, mosaics: bool
) -> RecordedFrames:
    """Read recorded images, and the dark and flat frames of the settings.

    mosaics : True if each image is one exposure; otherwise images may be pictures of single sub-imagers
    Raises InputError, naming the file, for damaged files, pictures of another size and a wrong number of them.
    """
    files, dark, flat = (
        [file for path in paths for file in files_in(path)] for paths in (images, settings.dark, settings.flat)
    )
    if not files:
        raise InputError("expected recorded images, got none; name PNG, TIFF, EXR or NPY files")
    layout = _layout(camera, files, settings, mosaics=mosaics)
    notes = FrameNotes()
    exposures = list(layout.exposures(files, "images", notes))
    numbers = np.array([recorded for _, recorded in exposures])
    dark_frames, flat_frames = (
        list(layout.exposures(paths, what, notes)) for paths, what in ((dark, DARK), (flat, FLAT))
    )
    dark_mean, flat_mean = _mean(dark_frames), _mean(flat_frames)
    _check_not_exchanged(dark_mean, flat_mean)
    return RecordedFrames(
        layout=layout,
        numbers=numbers,
        dark=dark_mean,
        flat=flat_mean,
        darks=len(dark_frames),
        averaged=min(len(dark_frames), len(flat_frames)),
        settings=settings,
        files=[path for path, _ in exposures],
        whole=bool((numbers == np.rint(numbers)).all()),
        sources=[{"name": path.name, "sha256": file_digest(path)} for path in (*files, *dark, *flat)],
        notes=notes.describe(),
    )


def _check_not_exchanged(dark: FloatArray | None, flat: FloatArray | None) -> None:
    if dark is None or flat is None:
        return
    brighter = int(np.sum(dark > flat))
    if 2 * brighter > dark.size:
        raise InputError(
            f"--dark, --flat: expected flat frames brighter than dark ones, got darker ones in {brighter} of"
            f" {dark.size} sensor pixels; exchange the two"
        )


def patches(camera: Camera) -> FloatArray:
    """Top left corners of the patches in sensor pixels from the camera's axis, in a mosaic's coordinates.

    (sub-imagers, 2): rows, growing towards -y, and columns, growing towards -x.
    """
    pitch = camera.pixel_pitch
    middles = np.array([[-sub.patch[1], -sub.patch[0]] for sub in camera.sub_imagers]) / pitch
    return middles - np.array([sub.type.pixels for sub in camera.sub_imagers]) / 2


def corners(
    camera: Camera, shape: tuple[int, ...], origin: tuple[int, int] | None, path: Path
) -> tuple[IntArray, float]:
    """Top left pixels, (sub-imagers, 2), of the patches in a mosaic, and the largest distance of a patch to them.

    Raises InputError if a patch leaves the mosaic.
    """
    exact = patches(camera)
    exact += np.array(shape) / 2 if origin is None else np.array(origin) - exact[0]
    nearest = np.floor(exact + 0.5 + TIE).astype(np.int64)
    sizes = np.array([sub.type.pixels for sub in camera.sub_imagers])
    outside = (nearest < 0).any(axis=1) | (nearest + sizes > np.array(shape)).any(axis=1)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        span = (nearest + sizes).max(axis=0) - nearest.min(axis=0)
        row, column = nearest[first].tolist()
        raise InputError(
            f"{path}: the sub-image {camera.sub_imagers[first].name} of {sizes[first][0]} x {sizes[first][1]} pixels at"
            f" row {row}, column {column} leaves the mosaic of {shape[0]} x {shape[1]} pixels; all of them span"
            f" {span[0]} x {span[1]}: record the whole sensor, or give the corner of the first with --origin"
        )
    return nearest, float(np.abs(exact - nearest).max())


def _layout(camera: Camera, images: Sequence[Path], settings: AcquisitionSettings, *, mosaics: bool) -> SensorLayout:
    """Find out from the first images if they are mosaics or pictures of single sub-imagers. Raises InputError."""
    first = stored_pictures(images[0], "images")
    picture, subs = grey(first[0].pixels, str(images[0])), camera.sub_imagers
    shape = picture.shape
    count = len(first) + (0 if mosaics else sum(len(stored_pictures(path, "images")) for path in images[1:]))
    single = len(subs) == 1 and shape == subs[0].type.pixels
    if single or (count > 1 and not mosaics):
        if settings.origin is not None:
            raise InputError("--origin: expected a mosaic of the whole sensor, got pictures of one sub-imager each")
        if not mosaics and count != len(subs):
            raise InputError(
                f"{images[0]}: expected one mosaic of the whole sensor or {len(subs)} pictures, one per sub-imager, got"
                f" {count}"
            )
        return SensorLayout(camera, tuple(sub.type.pixels for sub in subs), None, settings.upright is False, 0.0)
    pixels, beside = corners(camera, shape, settings.origin, images[0])
    layout = SensorLayout(camera, (shape,), pixels, not settings.upright, beside)
    return layout if mosaics else replace(layout, turned=layout.light_if_turned(picture))


def _mean(exposures: list[tuple[Path, FloatArray]]) -> FloatArray | None:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.mean([numbers for _, numbers in exposures], axis=0) if exposures else None


def import_stack(setup: Setup, images: Sequence[Path], settings: AcquisitionSettings) -> tuple[Stack, RecordedFrames]:
    """Read recorded images as a stack; also return the frames.

    images : one mosaic, or one picture per sub-imager in the order of measurements
    The stack's variance, which is that of a rendering, is 0; dead pixels are NaN. Raises InputError for images that do
    not fit the camera.
    """
    camera, start = setup.camera, perf_counter()
    frames = read_frames(camera, images, settings, mosaics=False)
    made_from = {"camera": camera.describe(), "bench": settings.describe(), "source": frames.sources}
    record = {
        "fingerprint": fingerprint(made_from),
        "method": "imported",
        "flat": frames.flat is not None,
        "source": frames.sources,
        "seconds": perf_counter() - start,
        "versions": versions("scikit-image", "OpenEXR"),
    }
    stored, zeros = setup.resolved, np.zeros(camera.measurements)
    if stored.sensor is None:
        return Stack(stored, camera, _as_float32(frames.values()[0]), zeros, record), frames
    recording = _recording(stored.source, stored.sensor, frames)
    stored = stored.model_copy(update={"sensor": recording.sensor})
    return Stack(stored, camera, recording.values, zeros, record, recording), frames


def _recording(source: Path, sensor: SensorTable, frames: RecordedFrames) -> Recording:
    """The recording of unscaled digital numbers.

    A single dark or flat frame is taken for the mean of `sensor.frames`; of several, their number is used instead.
    """
    dark, flat = frames.conversion(source)
    if frames.averaged > 1:
        sensor = sensor.model_copy(update={"frames": frames.averaged})
    digital, dark, flat = (_as_float32(values) for values in (frames.numbers[0], dark, flat))
    return Recording(sensor, digital, dark, flat, frames.flat_values)


def _as_float32(values: FloatArray) -> FloatArray:
    """Values rounded to float32, as the file stores them; NaN beyond its range, which marks dead pixels."""
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = values.astype(np.float32).astype(np.float64)
    return np.where(np.isinf(rounded), np.nan, rounded)
