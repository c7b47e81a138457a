"""Damage inside file formats: inconsistent headers, missing archive members, altered contents with valid checksums."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ommatid.scenes import model_file
from ommatid.scenes.formats import exr

from . import mutations
from .damage import damaged, damaged_near

EXR_MARKS = (
    *(b"dataWindow\0box2i\0", b"displayWindow\0box2i\0", b"compression\0compression\0", b"chunkCount\0int\0"),
    *(b"channels\0chlist\0", b"lineOrder\0lineOrder\0", b"name\0string\0", b"type\0string\0", b"v/1\1", b"\0\0"),
    *(b"ommatid\0string\0", b"scanlineimage", b"pixelAspectRatio\0float\0", b"screenWindowWidth\0float\0"),
)
NPY_MARKS = (b"\x93NUMPY", b"'descr': '", b"'shape': (", b"'fortran_order': ", b"\n")
ZIP_MARKS = (b"PK\3\4", b"PK\1\2", b"PK\5\6", b".npy")
SHAPES = (
    *("(100000, 100000)", "(1000000000000,)", "(-1, 3)", "()", "(0, 0)", "(2, 3, 4, 5)"),
    *("(9223372036854775807, 2)", "x"),
)
DTYPES = [
    "|O", "<f8", "<f2", "<c16", "|b1", "<i8", ">f8", "|S9", "<U5", "<M8[s]", "<f99", "V100000000", "(3,)<f4", "|O8",
]  # fmt: skip
HEADERS = ("[" * 5000, "{" * 99, "(" * 90, "1" * 5000, "{'descr': " + "-" * 3000 + "1}", "", "lambda: 0")


def exr_damaged(rng: Random, original: bytes) -> bytes:
    """Damage an OpenEXR file: the sizes in its header, its record, or any bytes."""
    choice = rng.random()
    if choice < 0.1:
        start = original.find(b'{"')
        text = mutations.deep_json(rng)[: original.find(b"}", start) - start]
        return original[:start] + text + original[start + len(text) :]
    return damaged_near(rng, original, EXR_MARKS) if choice < 0.6 else damaged(rng, original)


def stack_resealed(rng: Random, original: bytes) -> bytes:
    """Alter a stack and update its checksums."""
    with _temporary_file("altered.exr") as path:
        path.write_bytes(original)
        parts = exr.read(path)
        for _ in range(rng.choice((1, 1, 2))):
            index = rng.choice((0, rng.randrange(len(parts))))
            parts[index] = _altered_part(rng, parts[index])
        exr.write(path, parts)
        return path.read_bytes()


def _altered_part(rng: Random, part: exr.Part) -> exr.Part:
    choice = rng.random()
    if choice < 0.6:
        record = mutations.record(rng, part.record)
        return replace(part, record=record if isinstance(record, dict) else {})
    channels = dict(part.channels)
    name = rng.choice(sorted(channels))
    pixels = channels.pop(name).copy()
    if choice < 0.8:
        pixels.flat[rng.randrange(pixels.size)] = rng.choice((np.nan, np.inf, -1.0, 1e38, -np.inf))
        return replace(part, channels={**channels, name: pixels})
    if choice < 0.9 and channels:
        return replace(part, channels=channels)
    return replace(part, channels={**channels, rng.choice(("Z", "é", name + "x")): pixels})


def npz_damaged(rng: Random, original: bytes) -> bytes:
    """Damage an archive: its directory, its members, the header of an array, or any bytes."""
    choice = rng.random()
    if choice < 0.3:
        return damaged_near(rng, original, ZIP_MARKS, room=46)
    if choice < 0.6:
        return damaged(rng, original)
    with zipfile.ZipFile(io.BytesIO(original)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name, other = rng.choice(sorted(members)), rng.choice(sorted(members))
    if choice < 0.7:
        del members[name]
    elif choice < 0.8:
        members[name], members[other] = members[other], members[name]
    else:
        members[name] = npy_damaged(rng, members[name])
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, content in members.items():
            archive.writestr(member, content)
    return stream.getvalue()


def npy_damaged(rng: Random, original: bytes) -> bytes:
    """Damage an array file: shape or type in its header, the header itself, or any bytes."""
    choice = rng.random()
    if choice < 0.2:
        return damaged(rng, original)
    if choice < 0.5:
        return damaged_near(rng, original, NPY_MARKS, room=12)
    length = int.from_bytes(original[8:10], "little")
    header, rest = original[10 : 10 + length].decode(), original[10 + length :]
    if choice < 0.75:
        start = header.index("'shape': ")
        header = header[:start] + "'shape': " + rng.choice(SHAPES) + header[header.index(")", start) + 1 :]
    elif choice < 0.95:
        start = header.index("'descr': ")
        header = header[:start] + f"'descr': '{rng.choice(DTYPES)}'" + header[header.index(",", start) :]
    else:
        header = rng.choice(HEADERS)
    text = header.encode()
    return original[:8] + len(text).to_bytes(2, "little") + text + rest


def model_resealed(rng: Random, original: bytes) -> bytes:
    """Alter a model and update its checksum."""
    with np.load(io.BytesIO(original)) as file:
        arrays: dict[str, Any] = {name: file[name] for name in ("shape", "variance", "batches", *model_file.ENTRIES)}
        record = json.loads(json.loads(str(file["ommatid"][()]))["description"])
    if rng.random() < 0.5:
        record = mutations.record(rng, record)
    else:
        name = rng.choice(sorted(arrays))
        arrays[name] = _altered_array(rng, arrays[name])
    description = json.dumps(record)
    seal = model_file._seal(arrays, description)  # pyright: ignore[reportPrivateUsage]
    stream = io.BytesIO()
    text = json.dumps({"description": description, "sha256": seal})
    np.savez_compressed(stream, format=np.array(b"csr"), ommatid=text, **arrays)
    return stream.getvalue()


def _altered_array(rng: Random, array: Any) -> Any:
    choice = rng.randrange(7) if array.size else 3
    changed = array.copy()
    if choice == 0:
        changed.flat[rng.randrange(changed.size)] = rng.choice((-1, 0, 10**6, 2**31 - 1, 1))
    elif choice == 1 and changed.dtype.kind == "f":
        with np.errstate(over="ignore"):
            changed.flat[rng.randrange(changed.size)] = rng.choice((np.nan, np.inf, -1.0, 1e300))
    elif choice == 2:
        return changed.reshape(-1)[::-1].copy()
    elif choice == 3:
        return changed.astype(rng.choice(("f4", "f8", "i8", "c16", "U5", "?", "i1")))
    elif choice == 4:
        return changed[: changed.shape[0] // 2]
    elif choice == 5:
        return changed.reshape(*changed.shape, 1)
    elif choice == 6:
        return np.array(rng.choice((0, 1.5, "x")))
    return changed


def encoded(suffix: str, pixels: Any) -> bytes:
    """Return a picture as a file of the format with this suffix."""
    with _temporary_file(f"sound{suffix}") as path:
        if suffix == ".npy":
            np.save(path, pixels)
        elif suffix == ".exr":
            names = "RGB" if pixels.ndim == 3 else "Y"
            channels = {name: np.atleast_3d(pixels)[..., index] for index, name in enumerate(names)}
            exr.write(path, [exr.Part("one", channels, {})])
        elif suffix == ".tif":
            import tifffile

            colours = "rgb" if pixels.shape[-1] == 3 else "minisblack"
            compression = "zlib" if pixels.dtype.itemsize > 1 else None
            tifffile.imwrite(path, pixels, photometric=colours, compression=compression)
        else:
            from skimage import io as pictures

            pictures.imsave(path, pixels, check_contrast=False)
        return path.read_bytes()


@contextmanager
def _temporary_file(name: str) -> Generator[Path]:
    with TemporaryDirectory() as folder:
        yield Path(folder) / name
