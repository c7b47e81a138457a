"""The types of files that are read: their valid originals, how these are damaged, and what is read from them."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from random import Random

import numpy as np

from ommatid.scenes import camera, model_file, scene, stack
from ommatid.scenes.formats import picture
from ommatid.scenes.formats.curve import read_curve
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.formats.zemax import read_catalogue
from ommatid.scenes.hardware import frames, point_sources

from ..conftest import TINY
from . import mutations
from .damage import damaged, marked, words_exchanged
from .family import BASE, SCENE, FileType, Originals, from_folder, gallery_files
from .formats import encoded, exr_damaged, model_resealed, npy_damaged, npz_damaged, stack_resealed

EVERYTHING = (
    TINY.replace("pixels = [3, 3]", 'pixels = "fit"\naperture = "0.1 mm"\nfocus = "1.1 m"\nstep = 1')
    .replace("[noise]\nvariance = 1e-2\n", "")
    .replace('[prior]\nkind = "independent"', '[prior]\nkind = "exponential"\ncorrelation_length = "3 mm"')
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

[estimator]
memory = "1 GB"
tolerance = 1e-6

[tiles]
size = 12
overlap = 3
"""
)
PNG_MARKS = (b"IHDR", b"IDAT", b"IEND", b"\x89PNG\r\n\x1a\n")
TIFF_MARKS = (b"II*\0", b"\0\1\3\0", b"\1\1\3\0", b"\2\1\3\0", b"\3\1\3\0", b"\x11\1\4\0", b"\x16\1", b"\x17\1")
DOUBLET = b"# a doublet\n50.0\n29.475 3.76 1.67 25.2\n84.83 0.12 1 25.2\n0 4.2 0 17.1  # stop\n-25.87 2 1.603 14\n"


# Scenes and lenses


def read_scene(path: Path, changes: tuple[str, ...] = ()) -> object:
    described = scene.read(path, changes)
    derived = camera.derive(described)
    return described.plain(), derived.describe(), derived.measurements


def scene_mutated(rng: Random, original: bytes) -> bytes:
    return mutations.scene(rng, tomllib.loads(original.decode())).encode()


def tiny_scene_mutated(rng: Random, original: bytes) -> bytes:
    """Alter a scene without making it large: a target without a shape is all of its picture."""
    altered = scene_mutated(rng, original)
    while b"\nshape = " not in altered:
        altered = scene_mutated(rng, original)
    return altered


def settings_mutated(rng: Random, original: bytes) -> bytes:
    return json.dumps(mutations.settings(rng, mutations.keys_of(tomllib.loads(original.decode())))).encode()


def read_with_settings(path: Path) -> object:
    text = path.read_bytes()
    changes = json.loads(text) if text.startswith(b"[") and text[1:2] in (b'"', b"]") else []
    return read_scene(path.with_name(BASE), tuple(changes))


CONTROLS = ("x", "\x00", "\x85", "\x1b[31m", "\u202e", "1.5", "-1", "")
rows_damaged = words_exchanged(b" ", *mutations.NUMBERS, *CONTROLS, "#", "\n", "1,5", "١", "1e9", "1\n" * 20000)
fields_damaged = words_exchanged(b",", *mutations.NUMBERS, *CONTROLS, '"', '"x\ny"', "x" * 200000)


def read_glasses(path: Path) -> object:
    catalogue = read_catalogue(path)
    dispersions = [catalogue.dispersion(name) for name in catalogue.entries]
    return [(each.model_dump(mode="json"), each.index(550e-6)) for each in dispersions]


# Stacks and models


def read_stack(path: Path) -> object:
    content = stack.read(path)
    return content.values, content.variance, content.scene.plain(), content.record


def read_model(path: Path) -> object:
    model = model_file.read(path)
    entries = () if model.stored is None else (model.stored.data, model.stored.indices, model.stored.indptr)
    return *entries, model.variance, model.batches, model.scene.plain(), model.record


# Pictures, frames and source positions


def pictures(suffix: str, *dtypes: str) -> Originals:
    """The same picture in several number types, and one in colour."""

    def originals(_: Path) -> list[bytes]:
        row, column = np.indices((20, 24))
        grey = (row * 9 + column * 3) % 251
        images = [grey.astype(dtype) for dtype in dtypes] + [np.stack([grey] * 3, axis=-1).astype(dtypes[0])]
        return [encoded(suffix, pixels) for pixels in images]

    return originals


def read_picture(path: Path) -> object:
    described = scene.read(path.with_name(SCENE), [f"target.image={path.name}", "target.origin=", "target.shape="])
    return picture.load(described)


def mosaics(suffix: str) -> Originals:
    """Frames of the tiny camera's whole sensor: one, and three in one file."""

    def originals(folder: Path) -> list[bytes]:
        corners = frames.patches(camera.derive(scene.read(folder / SCENE)))
        rows, columns = (corners.max(axis=0) - corners.min(axis=0) + 8).astype(int)
        several = np.random.default_rng(3).integers(0, 4096, (3, rows, columns), dtype=np.uint16)
        return [encoded(suffix, several[0]), encoded(suffix, several)]

    return originals


def read_mosaics(path: Path) -> object:
    derived = camera.derive(scene.read(path.with_name(SCENE)))
    settings = frames.AcquisitionSettings(origin=(0, 0))
    return frames.read_frames(derived, [path], settings, mosaics=True).numbers


def positions_csv(_: Path) -> list[bytes]:
    """Source positions in three images, in two notations."""
    rows = [(image, row, column) for image in range(3) for row in (1, 7) for column in (2, 9)]
    text = "image,row,column\n" + "".join(f"{image},{row},{column}\n" for image, row, column in rows)
    named = "".join(f'{row}, {column}, "{image}.png", x\r\n' for image, row, column in rows)
    return [text.encode(), b"\xef\xbb\xbfrow, column, image, note\r\n" + named.encode()]


def read_positions(path: Path) -> object:
    derived = camera.derive(scene.read(path.with_name(SCENE)))
    return point_sources.read_positions(path, derived, [Path(f"{index}.png") for index in range(3)])


SHOW = ("show", "{file}", "--json")
LENS = ("show", SCENE, "--json", "--set", "camera.lens.I.surfaces={file}")
LIGHT = ("show", SCENE, "--json", "--set", "light.spectrum={file}")
STACK = ("reconstruct", "{file}", "sound.npz", "-o", "new.exr", "--json")
ZMX = b"""UNIT MM X W X CM
SURF 0
  DISZ INFINITY
SURF 1
  STOP
  TYPE EVENASPH
  CURV 0.05 0 0 0
  CONI -0.5
  PARM 2 1e-5
  PARM 8 1e-20
  DISZ 3
  GLAS N-BK7 0 0 1.5 60
  DIAM 4 1
SURF 2
  CURV -0.04
  DISZ 20
  CLAP 0 3 0
  GLAS ___BLANK 1 0 1.6 36
SURF 3
  TYPE STANDARD
  DIAM 2
SURF 4
"""
AGF = b"""CC some glasses
NM N-BK7 2 517642 1.5168 64.17 0 1
CD 1.03961212 6.00069867E-3 0.231792344 2.00179144E-2 1.01046945 103.560653 0 0
LD 0.3 2.5
NM KRS 13 0 2.3 20 0
CD 2.2 0.03 0 0 2e-4 3e-6 1e-7
LD 0.4 20
NM C 5 0
CD 1.5 0.01 0.002
LD 0.3 1
"""
MODEL = ("reconstruct", "sound.exr", "{file}", "-o", "new.exr", "--json")
PICTURE = ("show", SCENE, "--json", "--set", "target.image={file}", "--set", "target.origin=", "--set", "target.shape=")
IMPORT = ("import", SCENE, "{file}", "-o", "new.exr", "--origin", "0,0", "--json")
PREDICT = ("predict", "{file}", "--json")
SET = ("show", BASE, "--json", "{sets}")
SCENES = gallery_files("*.toml", TINY.encode())
LENSES_TOML, LENSES_DAT = gallery_files("lenses/*.toml"), gallery_files("lenses/*.dat", DOUBLET)
TINY_SCENES: Originals = lambda _: [TINY.encode(), EVERYTHING.encode()]  # noqa: E731
STACKS, MODELS = from_folder("sound.exr"), from_folder("sound.npz")
PNG, TIFF = marked(*PNG_MARKS), marked(*TIFF_MARKS)
FILE_TYPES = (
    FileType("scene, bytes", "scene.toml", SCENES, damaged, read_scene, SHOW),
    FileType("scene, keys and values", "scene.toml", SCENES, scene_mutated, read_scene, SHOW),
    FileType("scene, predicted", "scene.toml", TINY_SCENES, tiny_scene_mutated, read_scene, PREDICT),
    FileType("settings", "settings.json", from_folder(BASE), settings_mutated, read_with_settings, SET),
    FileType("lens, TOML", "lens.toml", LENSES_TOML, damaged, read_lens, LENS),
    FileType("lens, keys and values", "lens.toml", LENSES_TOML, scene_mutated, read_lens, LENS),
    FileType("lens, rows", "lens.dat", LENSES_DAT, rows_damaged, read_lens, LENS),
    FileType("lens, ZMX", "lens.zmx", lambda _: [ZMX], rows_damaged, read_lens, LENS),
    FileType("glasses, AGF", "glass.agf", lambda _: [AGF], rows_damaged, read_glasses, ()),
    FileType("curve, CSV", "curve.csv", gallery_files("spectra/*5.csv"), damaged, read_curve, LIGHT),
    FileType("curve, rows", "curve.csv", gallery_files("spectra/*5.csv"), rows_damaged, read_curve, LIGHT),
    FileType("stack", "stack.exr", STACKS, exr_damaged, read_stack, STACK, sealed=True),
    FileType("stack, resealed", "stack.exr", STACKS, stack_resealed, read_stack, STACK),
    FileType("model", "model.npz", MODELS, npz_damaged, read_model, MODEL, sealed=True),
    FileType("model, resealed", "model.npz", MODELS, model_resealed, read_model, MODEL),
    FileType("picture, PNG", "p.png", pictures(".png", "u1", "u2"), PNG, read_picture, PICTURE),
    FileType("picture, TIFF", "p.tif", pictures(".tif", "u1", "u2", "f4"), TIFF, read_picture, PICTURE),
    FileType("picture, NPY", "p.npy", pictures(".npy", "u1", "u2", "f8"), npy_damaged, read_picture, PICTURE),
    FileType("picture, EXR", "p.exr", pictures(".exr", "f4"), exr_damaged, read_picture, PICTURE),
    FileType("frames, NPY", "f.npy", mosaics(".npy"), npy_damaged, read_mosaics, IMPORT),
    FileType("frames, TIFF", "f.tif", mosaics(".tif"), TIFF, read_mosaics, IMPORT),
    FileType("places, CSV", "places.csv", positions_csv, damaged, read_positions, ()),
    FileType("places, rows", "places.csv", positions_csv, fields_damaged, read_positions, ()),
)
