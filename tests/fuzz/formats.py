"""Damage inside file formats: inconsistent headers, missing archive members, altered contents with valid checksums."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable
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
TYPES = ("f2", "f4", "f8", "g", ">f8", "c8", "c16", "i8", "U5", "?", "i1")
PATHS = ("../x.npy", "/etc/x.npy", "x" * 60000 + ".npy", "a\\b.npy", "\x1b[31m.npy", "x")
LARGE = 300_000_000  # bytes of zeros, deflated to a thousandth
PICKLE = b"\x93NUMPY\1\0v\0{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\ncos\nsystem\n."
HEADERS = ("[" * 5000, "{" * 99, "(" * 90, "1" * 5000, "{'descr': " + "-" * 3000 + "1}", "", "lambda: 0")


def exr_damaged(rng: Random, original: bytes) -> bytes:
    """Damage an OpenEXR file: the sizes in its header, its record, or any bytes."""
    choice = rng.random()
    if choice < 0.1:
        start = original.find(b'{"')
        text = rng.choice(mutations.DEEP).encode()[: original.find(b"}", start) - start]
        return original[:start] + text + original[start + len(text) :]
    return damaged_near(rng, original, EXR_MARKS) if choice < 0.6 else damaged(rng, original)


def stack_resealed(rng: Random, original: bytes) -> bytes:
    """Alter a stack and update its checksums."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "altered.exr"
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
    """Damage an archive: its directory, members, the header of an array, or any bytes; a new one if there is none."""
    if not original:
        stream = io.BytesIO()
        np.savez(stream, fingerprint=np.array("x"), tried=np.array("[]"))
        original = stream.getvalue()
    choice = rng.random()
    if choice < 0.2:
        return damaged_near(rng, original, ZIP_MARKS, room=46)
    if choice < 0.4:
        return damaged(rng, original)
    with zipfile.ZipFile(io.BytesIO(original)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    index, (other, exchanged) = rng.randrange(len(members)), rng.choice(members)
    name, content = members[index]
    changes: tuple[Callable[[], list[tuple[str, bytes]]], ...] = (
        list,
        lambda: [(name, exchanged), (other, content)],
        lambda: [(name, npy_damaged(rng, content))],
        lambda: [(name, content), (name, damaged(rng, content))],
        lambda: [("extra.npy", PICKLE if rng.random() < 0.3 else _many_texts(rng))],
        lambda: [(rng.choice(PATHS), content)],
    )
    changed = rng.choice(changes)() if rng.random() < 0.99 else [("extra.npy", npy(np.zeros(LARGE, np.uint8)))]
    kept = [pair for pair in members if pair[0] not in {name, *(each for each, _ in changed)} or rng.random() < 0.1]
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # of names that are there already
        for member, data in rng.choice(([*kept, *changed], [*changed, *kept])):
            archive.writestr(member, data)
    return stream.getvalue()


def npy(array: Any) -> bytes:
    """Return an array as a file."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _many_texts(rng: Random) -> bytes:
    """Return the header of very many empty texts, which take no bytes."""
    count = rng.choice((300_000_000, 10**12, 1000))
    header = f"{{'descr': '<U0', 'fortran_order': False, 'shape': ({count},), }}".ljust(117) + "\n"
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode()


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
    """Return an array with one or some values, its order, number type or shape changed."""
    changed = array.copy()
    at, end = (rng.randrange(max(array.size - back, 1)) for back in (1, 0))
    choice = rng.randrange(11) if array.size else rng.randrange(6)
    if choice < 2:
        return changed.astype(rng.choice(TYPES))
    if choice == 2:
        return changed[: len(changed) // 2] if array.ndim else changed.reshape(1)
    if choice == 3:
        return changed.reshape(*changed.shape, 1)
    if choice < 6:
        return np.array(rng.choice((0, 1.5, "x", [10**9, 10**9], [-1, 3], [1.5, 2], [3])))
    numbers = (-1, 0, 10**6, 2**31 - 1, 1, *((np.nan, np.inf, -1.0, 1e300) if array.dtype.kind == "f" else ()))
    with np.errstate(over="ignore"):
        if choice == 6:
            changed.flat[rng.choice((end, -1))] = rng.choice(numbers)
        elif choice == 7:
            changed.fill(rng.choice(numbers))
        elif choice == 8:  # of indices: an entry twice
            changed.flat[at : at + 2] = changed.flat[at]
        elif choice == 9:  # of indices: entries that are out of order
            changed.flat[at : at + 9] = changed.flat[at : at + 9][::-1]
        else:
            return changed.reshape(-1)[::-1].copy()
    return changed


def encoded(suffix: str, pixels: Any) -> bytes:
    """Return a picture as a file of the format with this suffix."""
    if suffix == ".npy":
        return npy(pixels)
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"sound{suffix}"
        if suffix == ".exr":
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
