"""The target's picture in the paper's range of values, 0 to 255; row 0 is its top.

Colour becomes luminance; 8-bit and floating-point values are kept, others are scaled: 16-bit values are divided by 257.
"""

from __future__ import annotations

import importlib.util
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.machine import check_memory
from ommatid.runtime.printable import printable

from ..constants import WHITE
from ..scene import Scene
from ..tables.table import LARGEST
from .exr import Part, write
from .picture_file import read_picture
from .stored_picture import BYTES, StoredPicture

COLOURS = 3  # channels, at least, of a colour picture
LUMINANCE = (0.2125, 0.7154, 0.0721)  # Rec. 709, as scikit-image's rgb2gray weighs


def load(scene: Scene) -> FloatArray:
    """Load the target's picture, cropped as the scene says and rounded to float32: (detail rows, detail columns).

    A target without a picture, of a scene with a world, is zero: its image is not known before it is rendered.
    Raises InputError if there is neither picture nor world, or the picture is unreadable, too small for the crop or
    contains NaN or values beyond LARGEST.
    """
    target = scene.target
    where = f"{scene.source}: target.image"
    if target.image is None:
        if target.shape is None:
            raise InputError(f"{where} and target.shape are absent; name a picture, or give the shape for a [world]")
        if scene.world is None:
            raise InputError(
                f"{where} is absent, so there is nothing to render; name a picture such as photo:camera, or a [world]"
                " (show, predict, design and calibrate need none)"
            )
        check_memory(
            prod(target.shape) * target.detail**2 * BYTES, f"{scene.source}: target.shape", "take a smaller one"
        )
        return np.zeros(finer(target.shape, target.detail))
    return _read(scene, target.image)[1]


def conversions(scene: Scene) -> list[str]:
    """Return what is lost or rescaled when the target's picture is read, a sentence each.

    Raises InputError as `load` does for a picture.
    """
    image = scene.target.image
    if image is None:
        return []
    stored, _ = _read(scene, image)
    sentences = notes_of(image, stored)
    bits = stored.bits_each
    if stored.pixels.dtype.kind == "u" and bits != 8:
        sentences.append(
            f"{printable(image)} has {bits}-bit values: they are scaled from {2**bits - 1} to the range from 0 to 255"
        )
    return sentences


def notes_of(name: str, stored: StoredPicture) -> list[str]:
    """Return what is lost or changed when a picture is read without scaling, a sentence each."""
    pixels = stored.pixels
    is_colour = pixels.ndim == 3 and pixels.shape[2] in (COLOURS, COLOURS + 1)
    return [f"{printable(name)} {note}" for note in ([_COLOUR_NOTE] if is_colour else []) + list(stored.notes)]


_COLOUR_NOTE = "is a colour picture: only its luminance is used, " + " + ".join(
    f"{weight} {colour}" for weight, colour in zip(LUMINANCE, "RGB", strict=True)
)


def target_shape(scene: Scene) -> tuple[int, int]:
    """Rows and columns of the target; the picture is read only if the scene does not say."""
    if scene.target.shape is not None:
        return scene.target.shape
    rows, columns = load(scene).shape
    return rows // scene.target.detail, columns // scene.target.detail


def finer(shape: tuple[int, int], detail: int) -> tuple[int, int]:
    """Rows and columns of the picture of a target of `shape` pixels of f."""
    return shape[0] * detail, shape[1] * detail


def averaged(picture: FloatArray, detail: int) -> FloatArray:
    """f, (rows, columns), as the average of a picture `detail` times finer along both axes."""
    rows, columns = picture.shape[0] // detail, picture.shape[1] // detail
    return picture if detail == 1 else picture.reshape(rows, detail, columns, detail).mean(axis=(1, 3))


def write_truth(
    path: Path, image: FloatArray, depth: FloatArray | None = None, record: dict[str, Any] | None = None
) -> None:
    """Write a target as OpenEXR, float32, channel Y; of a world also `depth`, mm, NaN if nothing is hit."""
    channels = {"Y": image.astype(np.float32)}
    if depth is not None:
        channels["depth"] = depth.astype(np.float32)
    write(path, [Part("truth", channels, record or {})])


def luminance(stored: StoredPicture, where: str) -> FloatArray:
    """Convert a picture to one channel of values from 0 to 255, (rows, columns). Raises InputError."""
    values, kind, bits = grey(stored.pixels, where), stored.pixels.dtype.kind, stored.bits_each
    if kind == "f":
        return values
    if kind == "i" or bits > 16:
        raise InputError(f"{where}: expected 8-bit, 16-bit or floating-point values, got {stored.pixels.dtype}")
    return values / ((2**bits - 1) / WHITE)


def grey(pixels: NDArray[Any], where: str) -> FloatArray:
    """Convert a (rows, columns[, channels]) picture to one channel, without scaling its values. Raises InputError."""
    if pixels.ndim not in (2, 3) or pixels.size == 0 or (pixels.ndim == 3 and pixels.shape[2] not in (1, 2, 3, 4)):
        raise InputError(f"{where}: expected a picture of rows x columns, grey or colour, got shape {pixels.shape}")
    if pixels.dtype.kind not in "buif":
        raise InputError(f"{where}: expected 8-bit, 16-bit or floating-point values, got {pixels.dtype}")
    with np.errstate(over="ignore", invalid="ignore"):  # infinite values and NaN are refused or count as dead
        values = pixels.astype(np.float64)
    if values.ndim == 2:
        return values
    channels = values.shape[2]
    if channels in (2, 4):
        alpha = values[..., -1]
        full = float(np.iinfo(pixels.dtype).max) if pixels.dtype.kind in "iu" else 1.0
        if not (alpha.min() == alpha.max() >= full):
            raise InputError(f"{where}: the picture is at least partly transparent; save it without an alpha channel")
    return values[..., :3] @ np.array(LUMINANCE) if channels >= 3 else values[..., 0]


def _read(scene: Scene, image: str) -> tuple[StoredPicture, FloatArray]:
    """The target's picture without scaling, and its crop. Raises InputError as `load` does."""
    with naming_source(scene.source, scene.changes):
        stored = _stored(image, f"{scene.source}: target.image")
        return stored, _part_asked_for(scene, stored)


def _part_asked_for(scene: Scene, stored: StoredPicture) -> FloatArray:
    """The crop of a picture in the scene's range of values, rounded to float32. Raises InputError."""
    target, where = scene.target, f"{scene.source}: target.image"
    with np.errstate(over="ignore", invalid="ignore"):  # of values that are not finite, which are refused below
        picture = luminance(stored, where)
    asked = picture.shape if target.shape is None else finer(target.shape, target.detail)
    if target.origin is None and asked != picture.shape:
        raise InputError(
            f"{scene.source}: target.shape asks for {asked[0]} x {asked[1]} pixels, but the picture has"
            f" {picture.shape[0]} x {picture.shape[1]}; add target.origin to cut a crop from it, or remove"
            " target.shape for the whole picture"
        )
    with np.errstate(over="ignore", invalid="ignore"):
        rounded = _crop(picture, scene).astype(np.float32).astype(np.float64)  # precision of renderer and files
    if not np.isfinite(rounded).all():
        raise InputError(f"{where}: {target.image} holds NaN or infinite values in the part asked for; replace them")
    largest = float(np.abs(rounded).max(initial=0.0))
    if largest > LARGEST:
        raise InputError(
            f"{where}: expected values up to {LARGEST:g} in {target.image}, got one of size {largest:.3g}; scale them"
        )
    return rounded


def _crop(picture: FloatArray, scene: Scene) -> FloatArray:
    target = scene.target
    row, column = target.origin or (0, 0)
    left = picture.shape[0] - row, picture.shape[1] - column
    shape = (left[0] // target.detail, left[1] // target.detail) if target.shape is None else target.shape
    rows, columns = finer(shape, target.detail)
    if rows <= 0 or columns <= 0 or row + rows > picture.shape[0] or column + columns > picture.shape[1]:
        room = picture.shape[0] - max(rows, 0), picture.shape[1] - max(columns, 0)
        largest = [size // target.detail for size in picture.shape]
        key, most = ("origin", [*room]) if min(room) >= 0 else ("shape", largest)
        raise InputError(
            f"{scene.source}: target.origin: the crop of {max(rows, 0)} x {max(columns, 0)} pixels at"
            f" [{row}, {column}] is empty or leaves the picture of {picture.shape[0]} x {picture.shape[1]} pixels;"
            f" expected a target.{key} of at most {most}, or neither for the whole picture"
        )
    return picture[row : row + rows, column : column + columns]


def _stored(image: str, where: str) -> StoredPicture:
    """Read the picture that `target.image` names, without scaling."""
    name = image.removeprefix("photo:")
    return read_picture(Path(image) if name == image else _photo_path(name, where), where)


def _photo_path(name: str, where: str) -> Path:
    """The file of a photograph that scikit-image ships."""
    package = importlib.util.find_spec("skimage")
    if package is None or package.origin is None:
        raise InputError(f"{where}: 'photo:{name}' comes with scikit-image, which is not installed")
    folder = Path(package.origin).parent / "data"
    known = {path.stem: path for path in sorted(folder.iterdir()) if path.suffix in (".png", ".jpg")}
    if name not in known:
        raise InputError(f"{where}: scikit-image ships no picture 'photo:{name}'; it has {', '.join(known)}")
    return known[name]
