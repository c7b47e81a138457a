"""The kinds of files that are read: where sound ones come from, how they are damaged, and what is read of them."""

from __future__ import annotations

import hashlib
import json
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ommatid.runtime.files import digest
from ommatid.scenes import camera, model_file, scene, stack
from ommatid.scenes.formats import picture
from ommatid.scenes.hardware import frames, source_positions
from ommatid.scenes.tables import lens_file

from ..conftest import TINY
from ..examples import GALLERY
from . import damage, nasty
from .formats import encoded, exr_damaged, model_sealed, npy_damaged, npz_damaged, stack_sealed

EVERYTHING = (
    TINY.replace("pixels = [3, 3]", 'pixels = "fit"\naperture = "0.1 mm"\nfocus = "1.1 m"\nstep = 1')
    .replace("[noise]\nvariance = 1e-2\n", "")
    .replace("[camera]", '[camera]\nwavelength = "550 nm"')
    + """
[camera.tolerance]
position = "1 um"
rotation = "0.01 deg"
focal_length = 0.001

[sensor]
illuminance = "500 lux"
exposure = "10 ms"
read_noise = 2.0

[prior]
kind = "exponential"
correlation_length = "3 mm"

[estimator]
memory = "1 GB"
tolerance = 1e-6

[tiles]
size = 12
overlap = 3
"""
)
SCENE = "tiny.toml"  # stands in the folder, whole
BASE = "base.toml"  # holds what --set is tried on
PNG_MARKS = (b"IHDR", b"IDAT", b"IEND", b"\x89PNG\r\n\x1a\n")
TIFF_MARKS = (b"II*\0", b"\0\1\3\0", b"\1\1\3\0", b"\2\1\3\0", b"\3\1\3\0", b"\x11\1\4\0", b"\x16\1", b"\x17\1")


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    file : its name in the folder;  originals : sound ones, by that folder
    damaged : one of them after what befell it;  read : what it holds, so that equal contents are equal
    sealed : whether a checksum tells whether the content is the original's
    command : what reads it on the command line
    """

    name: str
    file: str
    originals: Callable[[Path], list[bytes]]
    damaged: Callable[[Random, bytes], bytes]
    read: Callable[[Path], object]
    command: tuple[str, ...]
    sealed: bool = False


def sum_of(*parts: Any) -> str:
    """Of arrays and whatever has a text: equal for equal contents."""
    total = hashlib.sha256()
    for part in parts:
        total.update((digest(part) if isinstance(part, np.ndarray) else repr(part)).encode())
    return total.hexdigest()


# Scenes


def gallery(folder: Path) -> list[bytes]:
    """The scenes that come with the program, and the tiny one; what they name is found beside them."""
    del folder
    return [TINY.encode(), *(path.read_bytes() for path in sorted(GALLERY.glob("*.toml")))]


def tiny(folder: Path) -> list[bytes]:
    """The tiny scene, and some of everything that a scene may say."""
    del folder
    return [TINY.encode(), EVERYTHING.encode()]


def scene_in(path: Path, changes: tuple[str, ...] = ()) -> str:
    """What a scene file says, and what follows from it."""
    described = scene.read(path, changes)
    derived = camera.derive(described)
    return sum_of(described.plain(), derived.describe(), derived.measurements)


def rewritten(rng: Random, original: bytes) -> bytes:
    """A scene with other keys and values."""
    return nasty.scene(rng, tomllib.loads(original.decode())).encode()


def rows_damaged(rng: Random, original: bytes) -> bytes:
    """Rows with other words, or damage anywhere."""
    if rng.random() < 0.4:
        return damage.damaged(rng, original)
    words = original.decode().split(" ")
    words[rng.randrange(len(words))] = rng.choice((*nasty.NUMBERS, "x", "#", "\n", "1,5", "١", "1e9", "\x00", "\x85"))
    return " ".join(words).encode()


def gallery_settings(folder: Path) -> list[bytes]:
    """What settings are tried on: the last scene that stands in the folder."""
    return [(folder / BASE).read_bytes()]


def options(rng: Random, original: bytes) -> bytes:
    """Settings, one a line."""
    return json.dumps(nasty.settings(rng, nasty.keys_of(tomllib.loads(original.decode())))).encode()


def with_options(path: Path) -> str:
    """What a scene says after settings on the command line."""
    text = path.read_bytes()
    changes = json.loads(text) if text.startswith(b"[") and text[1:2] in (b'"', b"]") else []
    return scene_in(path.with_name(BASE), tuple(changes))


# Lenses


def lens_toml(folder: Path) -> list[bytes]:
    """The gallery's lens files."""
    del folder
    return [path.read_bytes() for path in sorted((GALLERY / "lenses").glob("*.toml"))]


def lens_rows(folder: Path) -> list[bytes]:
    """Lenses in PBRT's form."""
    del folder
    doublet = b"# a doublet\n50.0\n29.475 3.76 1.67 25.2\n84.83 0.12 1 25.2\n0 4.2 0 17.1  # stop\n-25.87 2 1.603 14\n"
    return [doublet, *(path.read_bytes() for path in sorted((GALLERY / "lenses").glob("*.dat")))]


def lens_in(path: Path) -> str:
    """The surfaces of a lens."""
    return sum_of(lens_file.read_lens(path))


# Stacks and models


def made(name: str) -> Callable[[Path], list[bytes]]:
    """A file of a finished run, which stands in the folder."""
    return lambda folder: [(folder / name).read_bytes()]


def stack_in(path: Path) -> str:
    """What a stack holds."""
    found = stack.read(path)
    return sum_of(found.values, found.variance, found.scene.plain(), found.record)


def model_in(path: Path) -> str:
    """What a model holds."""
    found, stored = model_file.read(path), None
    if found.stored is not None:
        stored = [found.stored.data, found.stored.indices.astype(np.int64), found.stored.indptr.astype(np.int64)]
    return sum_of(*(stored or ()), found.variance, found.batches, found.scene.plain(), found.record)


# Pictures, frames and places


def picture_of(suffix: str, *types: str) -> Callable[[Path], list[bytes]]:
    """The same picture in some types of numbers, and one in colour."""

    def originals(folder: Path) -> list[bytes]:
        del folder
        row, column = np.indices((20, 24))
        grey = (row * 9 + column * 3) % 251
        pictures = [grey.astype(kind) for kind in types] + [np.stack([grey] * 3, axis=-1).astype(types[0])]
        return [encoded(suffix, pixels) for pixels in pictures]

    return originals


def picture_in(path: Path) -> str:
    """The target that a scene with this picture has."""
    described = scene.read(path.with_name(SCENE), [f"target.image={path.name}", "target.origin=", "target.shape="])
    return sum_of(picture.load(described))


def frames_in(path: Path) -> str:
    """The numbers of frames of the tiny camera, each a mosaic."""
    derived = camera.derive(scene.read(path.with_name(SCENE)))
    bench = frames.AcquisitionSettings(origin=(0, 0))
    return sum_of(frames.read_frames(derived, [path], bench, mosaics=True).numbers)


def mosaics(suffix: str) -> Callable[[Path], list[bytes]]:
    """Frames of the tiny camera's whole sensor: one, and three in one file."""

    def originals(folder: Path) -> list[bytes]:
        derived = camera.derive(scene.read(folder / SCENE))
        corners = frames.patches(derived)
        rows, columns = (corners.max(axis=0) - corners.min(axis=0) + 8).astype(int)
        rng = np.random.default_rng(3)
        several = rng.integers(0, 4096, (3, rows, columns), dtype=np.uint16)
        return [encoded(suffix, several[0]), encoded(suffix, several)]

    return originals


def places_csv(folder: Path) -> list[bytes]:
    """Where points stood in three images, in two ways of writing it."""
    del folder
    rows = [(image, row, column) for image in range(3) for row in (1, 7) for column in (2, 9)]
    text = "image,row,column\n" + "".join(f"{image},{row},{column}\n" for image, row, column in rows)
    named = "row, column, image, note\r\n" + "".join(
        f'{row}, {column}, "{image}.png", x\r\n' for image, row, column in rows
    )
    return [text.encode(), b"\xef\xbb\xbf" + named.encode()]


def places_in(path: Path) -> str:
    """Rows and columns of the points in three images."""
    derived = camera.derive(scene.read(path.with_name(SCENE)))
    return sum_of(*source_positions.read_positions(path, derived, [Path(f"{number}.png") for number in range(3)]))


# Worlds


def worlds(folder: Path) -> list[bytes]:
    """The gallery's Mitsuba scenes."""
    del folder
    return [path.read_bytes() for path in sorted((GALLERY / "worlds").glob("*.xml"))]


def world_in(path: Path) -> str:
    """The files that a world names, and that Mitsuba builds it."""
    from ommatid.simulate.renderer import world

    described = scene.read(path.with_name(SCENE), [f"world.file={path.name}"])
    found = world.files(described)
    built = world.stage(described, "scalar_rgb", None)
    return sum_of(path.read_bytes(), len(found), len(built.scene.shapes()))


def _marked(*marks: bytes) -> Callable[[Random, bytes], bytes]:
    def harm(rng: Random, original: bytes) -> bytes:
        return damage.near(rng, original, marks) if rng.random() < 0.5 else damage.damaged(rng, original)

    return harm


SHOW = ("show", "{file}", "--json")
LENS = ("show", SCENE, "--json", "--set", "camera.lens.I.surfaces={file}")
STACK = ("reconstruct", "{file}", "sound.npz", "-o", "new.exr", "--json")
MODEL = ("reconstruct", "sound.exr", "{file}", "-o", "new.exr", "--json")
LOOK = ("show", SCENE, "--json", "--set", "target.image={file}", "--set", "target.origin=", "--set", "target.shape=")
IMPORT = ("import", SCENE, "{file}", "-o", "new.exr", "--origin", "0,0", "--json")
KINDS = {
    kind.name: kind
    for kind in (
        Kind("scene, bytes", "scene.toml", gallery, damage.damaged, scene_in, SHOW),
        Kind("scene, keys and values", "scene.toml", gallery, rewritten, scene_in, SHOW),
        Kind("scene, predicted", "scene.toml", tiny, rewritten, scene_in, ("predict", "{file}", "--json")),
        Kind("settings", "settings.json", gallery_settings, options, with_options, ("show", BASE, "--json", "{sets}")),
        Kind("lens, TOML", "lens.toml", lens_toml, damage.damaged, lens_in, LENS),
        Kind("lens, keys and values", "lens.toml", lens_toml, rewritten, lens_in, LENS),
        Kind("lens, rows", "lens.dat", lens_rows, rows_damaged, lens_in, LENS),
        Kind("stack", "stack.exr", made("sound.exr"), exr_damaged, stack_in, STACK, sealed=True),
        Kind("stack, sealed anew", "stack.exr", made("sound.exr"), stack_sealed, stack_in, STACK),
        Kind("model", "model.npz", made("sound.npz"), npz_damaged, model_in, MODEL, sealed=True),
        Kind("model, sealed anew", "model.npz", made("sound.npz"), model_sealed, model_in, MODEL),
        Kind("picture, PNG", "p.png", picture_of(".png", "u1", "u2"), _marked(*PNG_MARKS), picture_in, LOOK),
        Kind("picture, TIFF", "p.tif", picture_of(".tif", "u1", "u2", "f4"), _marked(*TIFF_MARKS), picture_in, LOOK),
        Kind("picture, NPY", "p.npy", picture_of(".npy", "u1", "u2", "f8"), npy_damaged, picture_in, LOOK),
        Kind("picture, EXR", "p.exr", picture_of(".exr", "f4"), exr_damaged, picture_in, LOOK),
        Kind("frames, NPY", "f.npy", mosaics(".npy"), npy_damaged, frames_in, IMPORT),
        Kind("frames, TIFF", "f.tif", mosaics(".tif"), _marked(*TIFF_MARKS), frames_in, IMPORT),
        Kind("places, CSV", "places.csv", places_csv, damage.damaged, places_in, ()),
        Kind("world, XML", "world.xml", worlds, damage.damaged, world_in, ()),
    )
}
