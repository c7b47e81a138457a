"""Frames of a real camera: where its sub-images lie in them, and how digital numbers become values of f.

A mosaic is a picture of the whole flat sensor, seen from behind the camera looking at the target: its columns run
towards -x, its rows towards -y, and its middle is the camera's axis (0, 0) unless the `origin` says otherwise. A lens
turns its image by 180 degrees, so every sub-image lies upside down in it and is turned upright when it is cut out.
Pictures of one sub-imager each come in the order of measurements, upright already unless said otherwise.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError

from ..camera import Camera
from ..constants import WHITE
from ..formats import tiff
from ..formats.picture import decode, grey

Vector = NDArray[np.float64]
Grid = NDArray[np.float64]

KINDS = (".png", ".tif", ".tiff", ".exr", ".npy")
TIE = 1e-6  # sensor pixels by which a place half way between two pixels may be computed wrongly
DARK, FLAT = "dark frames", "flat frames"
TIFF = (".tif", ".tiff")
COLOURS = 4  # channels of a picture, at most: more are pictures one after the other


@dataclass(frozen=True)
class AcquisitionSettings:
    """How frames were recorded.

    dark, flat : frames without light and of a uniform target of value `flat_value`;  none: numbers are values of f
    origin : row and column of a mosaic where the first sub-imager's patch has its top left pixel; None: it follows
    upright : whether sub-images need not be turned;  None: those of a mosaic must be, others need not
    """

    dark: tuple[Path, ...] = ()
    flat: tuple[Path, ...] = ()
    flat_value: float = WHITE
    origin: tuple[int, int] | None = None
    upright: bool | None = None

    def describe(self) -> dict[str, Any]:
        """What decides, beside the files, in JSON's types."""
        return {"flat_value": self.flat_value, "origin": self.origin, "upright": self.upright}


@dataclass(frozen=True)
class SensorLayout:
    """How the pictures of one exposure become (M,) numbers.

    shapes : of the pictures of an exposure;  corners : (sub-imagers, 2) top left pixels of the patches in a mosaic,
    None where every sub-imager has a picture of its own;  turned : whether they are upside down
    beside : sensor pixels, along one axis, between a patch and the whole pixels cut out for it, at most
    """

    camera: Camera
    shapes: tuple[tuple[int, ...], ...]
    corners: NDArray[np.int64] | None
    turned: bool
    beside: float

    def cut(self, pictures: Sequence[Grid]) -> Vector:
        """The numbers of an exposure in the order of measurements: (M,)."""
        sizes = [sub.type.pixels for sub in self.camera.sub_imagers]
        if self.corners is None:
            cut = list(pictures)
        else:
            places = zip(self.corners.tolist(), sizes, strict=True)
            cut = [
                pictures[0][row : row + rows, column : column + columns] for (row, column), (rows, columns) in places
            ]
        return np.concatenate([np.ravel(patch[::-1, ::-1] if self.turned else patch) for patch in cut])

    def exposures(self, paths: Sequence[Path], what: str) -> Iterator[tuple[Path, Vector]]:
        """The numbers of each exposure in some files, (M,), and its last file. Raises InputError for another shape."""
        pictures: list[Grid] = []
        for path in paths:
            for pixels in pictures_of(path, what):
                picture = grey(pixels, str(path))
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
                f"{paths[-1]}: expected {what} in sets of {len(self.shapes)} pictures, one a sub-imager, and"
                f" {len(pictures)} are left over"
            )


@dataclass(frozen=True)
class RecordedFrames:
    """What was recorded, in digital numbers: (exposures, M), and the means of dark and flat frames, (M,).

    averaged : dark or flat frames, whichever are fewer
    files : of each exposure;  sources : SHA-256 of all files by name
    whole : whether numbers are whole, rounded by the sensor
    """

    layout: SensorLayout
    numbers: Grid
    dark: Vector | None
    flat: Vector | None
    averaged: int
    settings: AcquisitionSettings
    files: list[Path]
    whole: bool
    sources: list[dict[str, str]]

    @property
    def scale(self) -> Vector:
        """Values of f in a digital number, (M,); NaN for dead pixels."""
        if self.flat is None:
            return np.ones(self.layout.camera.measurements)
        signal: Vector = self.flat if self.dark is None else self.flat - self.dark
        alive = np.isfinite(signal) & (signal > 0)
        scale: Vector = np.full(signal.shape, np.nan)
        scale[alive] = self.settings.flat_value / signal[alive]
        return scale

    def values(self) -> Grid:
        """(image - dark) / (flat - dark) flat_value, NaN for dead pixels: (exposures, M)."""
        return (self.numbers if self.dark is None else self.numbers - self.dark) * self.scale


def read_frames(camera: Camera, images: Sequence[Path], bench: AcquisitionSettings, *, mosaics: bool) -> RecordedFrames:
    """Read recorded images, and the bench's dark and flat frames.

    mosaics : whether each image is an exposure of its own; else one may be a picture of one sub-imager
    Raises InputError, naming the file, for what cannot be read, has another size, or comes in another number.
    """
    listed = [path for given in images for path in files_in(given)]
    dark, flat = ([path for given in paths for path in files_in(given)] for paths in (bench.dark, bench.flat))
    if not listed:
        raise InputError("expected recorded images, got none; name PNG, TIFF, EXR or NPY files")
    layout = _layout(camera, listed, bench, mosaics=mosaics)
    exposures = list(layout.exposures(listed, "images"))
    numbers = np.array([recorded for _, recorded in exposures])
    without, uniform = (list(layout.exposures(paths, what)) for paths, what in ((dark, DARK), (flat, FLAT)))
    return RecordedFrames(
        layout=layout,
        numbers=numbers,
        dark=_mean(without),
        flat=_mean(uniform),
        averaged=min(len(without), len(uniform)),
        settings=bench,
        files=[path for path, _ in exposures],
        whole=bool((numbers == np.rint(numbers)).all()),
        sources=[{"name": path.name, "sha256": _sha256(path)} for path in (*listed, *dark, *flat)],
    )


def files_in(path: Path) -> list[Path]:
    """The file, or the pictures in a folder by name. Raises InputError where there is none."""
    if not path.is_dir():
        return [path]
    found = sorted(file for file in path.iterdir() if file.suffix.lower() in KINDS and not file.name.startswith("."))
    if not found:
        raise InputError(f"{path}: expected a folder of PNG, TIFF, EXR or NPY files, got none of them in it")
    return found


def pictures_of(path: Path, what: str) -> list[NDArray[Any]]:
    """The numbers in a file as they are: one picture, or all of a (count, rows, columns) array.

    Raises InputError where there are none.
    """
    if path.suffix.lower() not in KINDS:
        raise InputError(f"{path}: expected {what} as PNG, TIFF, EXR or NPY files, whose numbers are the sensor's")
    if not path.is_file():
        raise InputError(f"{path}: there is no such file among the {what}")
    pages = _pages(path) if path.suffix.lower() in TIFF else []
    if pages:
        return pages
    pixels = decode(path, what)
    # A last axis of up to four is one of colours; a sensor has more columns.
    several = pixels.ndim == 3 and pixels.shape[2] > COLOURS
    pictures = list(pixels) if several else [pixels]
    if not pictures or pixels.dtype.kind not in "uif":
        raise InputError(f"{path}: expected whole or floating-point numbers, got {pixels.dtype}, {pixels.shape}")
    return pictures


def _pages(path: Path) -> list[NDArray[Any]]:
    """The pages of a TIFF that has several, whoever wrote it; else none, and it is read as any picture."""
    try:
        pages = tiff.pages(path)
    except InputError:
        raise
    except Exception:  # the library has kinds of its own; what is damaged is said where single pictures are read
        return []
    return pages if len(pages) > 1 and all(page.dtype.kind in "uif" for page in pages) else []


def patches(camera: Camera) -> Grid:
    """Top left corners of the patches in sensor pixels from the camera's axis, as a mosaic shows them.

    (sub-imagers, 2): rows, growing towards -y, and columns, growing towards -x.
    """
    pitch = camera.pixel_pitch
    middles = np.array([[-sub.patch[1], -sub.patch[0]] for sub in camera.sub_imagers]) / pitch
    return middles - np.array([sub.type.pixels for sub in camera.sub_imagers]) / 2


def corners(
    camera: Camera, shape: tuple[int, ...], origin: tuple[int, int] | None, path: Path
) -> tuple[NDArray[np.int64], float]:
    """Top left pixels, (sub-imagers, 2), of the patches in a mosaic, and how far beside them the patches lie, at most.

    Raises InputError where a patch leaves the mosaic.
    """
    places = patches(camera)
    places += np.array(shape) / 2 if origin is None else np.array(origin) - places[0]
    nearest = np.floor(places + 0.5 + TIE).astype(np.int64)
    sizes = np.array([sub.type.pixels for sub in camera.sub_imagers])
    outside = (nearest < 0).any(axis=1) | (nearest + sizes > np.array(shape)).any(axis=1)
    if outside.any():
        first = int(np.flatnonzero(outside)[0])
        span = (nearest + sizes).max(axis=0) - nearest.min(axis=0)
        row, column = nearest[first].tolist()
        raise InputError(
            f"{path}: the sub-image {camera.sub_imagers[first].name} of {sizes[first][0]} x {sizes[first][1]} pixels at"
            f" row {row}, column {column} leaves the mosaic of {shape[0]} x {shape[1]} pixels; all of them span"
            f" {span[0]} x {span[1]}: record the whole sensor, or say with --origin where the first of them begins"
        )
    return nearest, float(np.abs(places - nearest).max())


def _layout(camera: Camera, images: Sequence[Path], bench: AcquisitionSettings, *, mosaics: bool) -> SensorLayout:
    first = pictures_of(images[0], "images")
    shape, subs = grey(first[0], str(images[0])).shape, camera.sub_imagers
    count = len(first) + (0 if mosaics else sum(len(pictures_of(path, "images")) for path in images[1:]))
    alone = len(subs) == 1 and shape == subs[0].type.pixels
    if alone or (count > 1 and not mosaics):
        if bench.origin is not None:
            raise InputError("--origin: expected a mosaic of the whole sensor, got pictures of one sub-imager each")
        if not mosaics and count != len(subs):
            raise InputError(
                f"{images[0]}: expected one mosaic of the whole sensor or {len(subs)} pictures, one a sub-imager, got"
                f" {count}"
            )
        return SensorLayout(camera, tuple(sub.type.pixels for sub in subs), None, bench.upright is False, 0.0)
    found, beside = corners(camera, shape, bench.origin, images[0])
    return SensorLayout(camera, (shape,), found, not bench.upright, beside)


def _mean(exposures: list[tuple[Path, Vector]]) -> Vector | None:
    return np.mean([numbers for _, numbers in exposures], axis=0) if exposures else None


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
