"""Archives of arrays: repeated names, bombs, other number types, matrices with entries twice or out of order."""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ommatid.scenes import model_file

from .. import file_types
from ..damage import damaged
from ..family import FileType

LARGE = 300_000_000  # bytes of zeros, deflated to a thousandth


def rearranged(rng: Random, original: bytes) -> bytes:
    """Return a model whose archive or entries are not as written, with a valid checksum where that is possible."""
    choice = rng.random()
    if choice < 0.25:
        return _entries(rng, original)
    with zipfile.ZipFile(io.BytesIO(original)) as archive:
        members = [(name, archive.read(name)) for name in archive.namelist()]
    name, content = rng.choice(members)
    kinds = ["twice", "twice", "texts", "other", "pickle"]
    more = {
        "twice": lambda: [(name, damaged(rng, content))],
        "large": lambda: [("extra.npy", _npy(np.zeros(LARGE, np.uint8)))],
        "texts": lambda: [("extra.npy", _texts(rng))],
        "other": lambda: [
            (rng.choice(("../x.npy", "/etc/x.npy", "x" * 60000 + ".npy", "a\\b.npy", "\x1b[31m.npy", "")), content)
        ],
        "pickle": lambda: [
            ("extra.npy", b"\x93NUMPY\1\0v\0{'descr': '|O', 'fortran_order': False, 'shape': (1,)}\ncos\nsystem\n.")
        ],
    }[rng.choice(kinds) if rng.random() < 0.98 else "large"]()
    if rng.random() < 0.3:
        members = [pair for pair in members if pair[0] != name]
    stream = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        warnings.simplefilter("ignore")  # of names that are there already
        for member, data in rng.choice(([*members, *more], [*more, *members])):
            archive.writestr(member or "x", data)
    return stream.getvalue()


def _npy(array: Any) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _texts(rng: Random) -> bytes:
    """Return the header of very many empty texts, which take no bytes."""
    count = rng.choice((300_000_000, 10**12, 1000))
    header = f"{{'descr': '<U0', 'fortran_order': False, 'shape': ({count},), }}".ljust(117) + "\n"
    return b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header.encode()


def _entries(rng: Random, original: bytes) -> bytes:
    """Return a model with a matrix that is not in its canonical form, and with its checksum."""
    with np.load(io.BytesIO(original)) as file:
        arrays: dict[str, Any] = {name: file[name] for name in ("shape", "variance", "batches", *model_file.ENTRIES)}
        description = json.loads(str(file["ommatid"][()]))["description"]
    start = int(arrays["indptr"][0])
    end = int(arrays["indptr"][1])
    change = rng.randrange(6)
    if change == 0 and end - start > 1:
        arrays["indices"][start + 1] = arrays["indices"][start]
    elif change == 1:
        arrays["indices"][start:end] = arrays["indices"][start:end][::-1].copy()
    elif change == 2:
        arrays["data"] = arrays["data"].astype(rng.choice((np.float16, np.longdouble, ">f8", np.complex64)))
    elif change == 3:
        arrays["indptr"][-1] = rng.choice((0, -1, 2**31 - 1))
    elif change == 4:
        arrays["shape"] = np.array(rng.choice(([10**9, 10**9], [-1, 3], [1.5, 2], [3])))
    else:
        arrays["variance"] = np.full_like(arrays["variance"], rng.choice((np.nan, np.inf, -1.0)))
    seal = model_file._seal(arrays, description)  # pyright: ignore[reportPrivateUsage]
    stream = io.BytesIO()
    np.savez_compressed(
        stream, format=np.array(b"csr"), ommatid=json.dumps({"description": description, "sha256": seal}), **arrays
    )
    return stream.getvalue()


def originals(folder: Path) -> list[bytes]:
    """Return the model of a finished run."""
    return [(folder / "sound.npz").read_bytes()]


ARCHIVES = (FileType("model, rearranged", "model.npz", originals, rearranged, file_types.read_model, file_types.MODEL),)
