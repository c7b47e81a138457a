"""Formats from inside: headers that promise something else, archives without a member, seals of what was altered."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ommatid.scenes import model_file
from ommatid.scenes.formats import exr

from . import damage, nasty

EXR_MARKS = (
    *(b"dataWindow\0box2i\0", b"displayWindow\0box2i\0", b"compression\0compression\0", b"chunkCount\0int\0"),
    *(b"channels\0chlist\0", b"lineOrder\0lineOrder\0", b"name\0string\0", b"type\0string\0", b"v/1\1", b"\0\0"),
    *(b"ommatid\0string\0", b"scanlineimage", b"pixelAspectRatio\0float\0", b"screenWindowWidth\0float\0"),
)
NPY_MARKS = (b"\x93NUMPY", b"'descr': '", b"'shape': (", b"'fortran_order': ", b"\n")
ZIP_MARKS = (b"PK\3\4", b"PK\1\2", b"PK\5\6", b".npy")
SHAPES = (
    "(100000, 100000)",
    "(1000000000000,)",
    "(-1, 3)",
    "()",
    "(0, 0)",
    "(2, 3, 4, 5)",
    "(9223372036854775807, 2)",
    "x",
)
TYPES = (
    "|O",
    "<f8",
    "<f2",
    "<c16",
    "|b1",
    "<i8",
    ">f8",
    "|S9",
    "<U5",
    "<M8[s]",
    "<f99",
    "V100000000",
    "(3,)<f4",
    "|O8",
)


def exr_damaged(rng: Random, original: bytes) -> bytes:
    """Damage anywhere, or where an OpenEXR file's header says how large things are."""
    kind = rng.random()
    if kind < 0.1:
        start = original.find(b'{"')
        text = nasty.deep(rng)[: original.find(b"}", start) - start]
        return original[:start] + text + original[start + len(text) :]
    return damage.near(rng, original, EXR_MARKS) if kind < 0.6 else damage.damaged(rng, original)


def stack_sealed(rng: Random, original: bytes) -> bytes:
    """A stack that somebody altered, and gave the checksums of what it became."""
    with _beside(original, "altered.exr") as path:
        parts = exr.read(path)
        for _ in range(rng.choice((1, 1, 2))):
            place = rng.choice((0, rng.randrange(len(parts))))
            parts[place] = _altered(rng, parts[place])
        exr.write(path, parts)
        return path.read_bytes()


def _altered(rng: Random, part: exr.Part) -> exr.Part:
    kind = rng.random()
    if kind < 0.6:
        told = nasty.record(rng, part.record)
        return replace(part, record=told if isinstance(told, dict) else {})
    channels = dict(part.channels)
    name = rng.choice(sorted(channels))
    pixels = channels.pop(name).copy()
    if kind < 0.8:
        pixels.flat[rng.randrange(pixels.size)] = rng.choice((np.nan, np.inf, -1.0, 1e38, -np.inf))
        return replace(part, channels={**channels, name: pixels})
    if kind < 0.9 and channels:
        return replace(part, channels=channels)
    return replace(part, channels={**channels, rng.choice(("Z", "é", name + "x")): pixels})


def npz_damaged(rng: Random, original: bytes) -> bytes:
    """Damage anywhere, in the archive's directory, or in an array's header inside it."""
    kind = rng.random()
    if kind < 0.3:
        return damage.near(rng, original, ZIP_MARKS, room=46)
    if kind < 0.6:
        return damage.damaged(rng, original)
    members = _members(original)
    name = rng.choice(sorted(members))
    if kind < 0.7:
        del members[name]
    elif kind < 0.8:
        other = rng.choice(sorted(members))
        members[name], members[other] = members[other], members[name]
    else:
        members[name] = npy_damaged(rng, members[name])
    return _archive(members)


def npy_damaged(rng: Random, original: bytes) -> bytes:
    """Damage anywhere, or a header that promises something else."""
    kind = rng.random()
    if kind < 0.2:
        return damage.damaged(rng, original)
    if kind < 0.5:
        return damage.near(rng, original, NPY_MARKS, room=12)
    length = int.from_bytes(original[8:10], "little")
    header, rest = original[10 : 10 + length].decode(), original[10 + length :]
    if kind < 0.75:
        start = header.index("'shape': ")
        end = header.index(")", start)
        header = header[:start] + "'shape': " + rng.choice(SHAPES) + header[end + 1 :]
    elif kind < 0.95:
        start = header.index("'descr': ")
        header = header[:start] + f"'descr': '{rng.choice(TYPES)}'" + header[header.index(",", start) :]
    else:
        header = rng.choice(
            ("[" * 5000, "{" * 99, "(" * 90, "1" * 5000, "{'descr': " + "-" * 3000 + "1}", "", "lambda: 0")
        )
    text = header.encode()
    return original[:8] + len(text).to_bytes(2, "little") + text + rest


def _members(original: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(original)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _archive(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def model_sealed(rng: Random, original: bytes) -> bytes:
    """A model that somebody altered, and gave the checksum of what it became."""
    with np.load(io.BytesIO(original)) as file:
        arrays: dict[str, Any] = {name: file[name] for name in ("shape", "variance", "batches", *model_file.ENTRIES)}
        told = json.loads(json.loads(str(file["ommatid"][()]))["description"])
    if rng.random() < 0.5:
        told = nasty.record(rng, told)
    else:
        name = rng.choice(sorted(arrays))
        arrays[name] = _array_altered(rng, arrays[name])
    description = json.dumps(told)
    seal = model_file._seal(arrays, description)  # pyright: ignore[reportPrivateUsage]
    stream = io.BytesIO()
    record = json.dumps({"description": description, "sha256": seal})
    np.savez_compressed(stream, format=np.array(b"csr"), ommatid=record, **arrays)
    return stream.getvalue()


def _array_altered(rng: Random, array: Any) -> Any:
    kind = rng.randrange(7) if array.size else 3
    changed = array.copy()
    if kind == 0:
        changed.flat[rng.randrange(changed.size)] = rng.choice((-1, 0, 10**6, 2**31 - 1, 1))
    elif kind == 1 and changed.dtype.kind == "f":
        with np.errstate(over="ignore"):
            changed.flat[rng.randrange(changed.size)] = rng.choice((np.nan, np.inf, -1.0, 1e300))
    elif kind == 2:
        return changed.reshape(-1)[::-1].copy()
    elif kind == 3:
        return changed.astype(rng.choice(("f4", "f8", "i8", "c16", "U5", "?", "i1")))
    elif kind == 4:
        return changed[: changed.shape[0] // 2]
    elif kind == 5:
        return changed.reshape(*changed.shape, 1)
    elif kind == 6:
        return np.array(rng.choice((0, 1.5, "x")))
    return changed


def encoded(suffix: str, pixels: Any) -> bytes:
    """A picture, as a file of the format that a suffix names."""
    with _beside(b"", f"sound{suffix}") as path:
        if suffix == ".npy":
            np.save(path, pixels)
        elif suffix == ".exr":
            names = "RGB" if pixels.ndim == 3 else "Y"
            channels = {name: np.atleast_3d(pixels)[..., place] for place, name in enumerate(names)}
            exr.write(path, [exr.Part("one", channels, {})])
        elif suffix == ".tif":
            import tifffile

            colours = "rgb" if pixels.shape[-1] == 3 else "minisblack"
            packed = "zlib" if pixels.dtype.itemsize > 1 else None
            tifffile.imwrite(path, pixels, photometric=colours, compression=packed)
        else:
            from skimage import io as pictures

            pictures.imsave(path, pixels, check_contrast=False)
        return path.read_bytes()


class _beside:
    """A file of its own while a `with` lasts."""

    def __init__(self, content: bytes, name: str) -> None:
        self._content, self._name = content, name

    def __enter__(self) -> Path:
        self._folder = TemporaryDirectory()
        path = Path(self._folder.name) / self._name
        path.write_bytes(self._content)
        return path

    def __exit__(self, *error: object) -> None:
        self._folder.cleanup()
