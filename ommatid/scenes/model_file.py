"""The file of a model: a matrix for `scipy.sparse.load_npz`, with its variances and a description, or few numbers.

`variance` is in the order of `data`; a JSON text `ommatid` holds the scene, the record of how H was determined, and a
SHA-256. A file has entries, the few numbers of a fitted H with entries of what they do not explain alone, or neither:
the ideal H of a large frame follows from the scene.
"""

from __future__ import annotations

import errno
import hashlib
import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.files import digest, write_whole
from ommatid.runtime.input_files import parse_json

from .camera import Camera, derive
from .fitted.fitted_matrix import FittedMatrix, Views
from .fitted.kernels import KernelFootprints, read_kernels
from .formats import npz
from .formats.provenance import checked
from .model import MeasuredRows, Model, fitted_model, measured_rows
from .scene import parse_stored
from .setup import Setup
from .tables.table import LARGEST

OF_SCIPY = ("format", "_is_array")  # keys by which `load_npz` knows the kind of a matrix, which only entries have
PREFIX, KERNELS, DESCRIPTION = "views.", "kernels.", "description"


def write(path: Path, model: Model) -> None:
    """Write a model, completely or not at all. Raises InputError or MachineError."""
    shape = np.array([model.measurements, model.unknowns], dtype=np.int64)
    arrays: dict[str, NDArray[Any]] = {"shape": shape, "variance": model.variance, "batches": model.batches}
    stored = model.stored
    if model.fitted is not None:
        rest = measured_rows(model)
        stored = None if rest is None else rest.matrix
        none = np.zeros(0), np.zeros((0, 0), np.float32)
        arrays["variance"], arrays["batches"] = none if rest is None else (rest.variance, rest.batches)
        for name, views in model.fitted.views.items():
            arrays |= {f"{PREFIX}{name}.{each.name}": np.array(getattr(views, each.name)) for each in fields(views)}
        for name, kernels in model.fitted.kernels.items():
            arrays |= {f"{KERNELS}{name}.{key}": each for key, each in kernels.arrays.items()}
            arrays[f"{KERNELS}{name}.{DESCRIPTION}"] = np.array(json.dumps(kernels.description))
    if stored is not None:
        arrays |= {name: getattr(stored, name) for name in ENTRIES}
    description = json.dumps({"scene": model.scene.plain(), "record": model.record})
    record = json.dumps({"description": description, "sha256": _seal(arrays, description)})

    def fill(beside: Path) -> None:
        whole = model.fitted is None and stored is not None
        kind = np.array(b"csr" if whole else b"parts"), np.array(True)
        npz.write(beside, {**dict(zip(OF_SCIPY, kind, strict=True)), "ommatid": np.array(record), **arrays})
        try:
            _arrays(beside)
        except InputError as error:
            raise OSError(errno.ENOSPC, f"not all of it could be stored: {error}") from error

    write_whole(path, fill)


def read(path: Path) -> Model:
    """Read a model. Raises InputError if the file is missing, damaged, pickled or of another kind."""
    arrays, description = _arrays(path)
    try:
        content = parse_json(description)
        scene = parse_stored(content["scene"], path)
        record = checked(content["record"])
        method = record["method"]
        camera = derive(scene).with_grid_of_matrix
        matrix, shape = None, tuple(arrays["shape"].tolist())
        if "data" in arrays:
            matrix = csr_matrix(arrays, shape)
        fitted = _fitted(arrays, camera if method == "ideal" else Setup(scene, camera).simulated)
        if matrix is None and fitted is None and (method != "ideal" or camera.has_surfaces or not camera.is_applied):
            raise ValueError("it has no entries")
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: holds no usable observation matrix ({shortened(str(error))}); calibrate again"
        ) from error
    expected = (camera.measurements, camera.unknowns)
    entries = np.shape(arrays.get("data", ()))
    if shape != expected or not arrays["variance"].shape == entries == arrays["batches"].shape[1:]:
        raise InputError(f"{path}: its matrix is {shape}, its scene needs {expected}; calibrate again")
    if fitted is None:
        return Model(scene, camera, matrix, arrays["variance"], arrays["batches"], record)
    described = [
        np.repeat(fitted.views[lens.name].explained | (lens.name in fitted.kernels), lens.measurements // lens.count)
        for lens in fitted.camera.types
    ]
    if matrix is not None and np.diff(matrix.indptr)[np.concatenate(described)].any():
        raise InputError(f"{path}: has rows of H that both few numbers and entries describe; calibrate again")
    rest = None if matrix is None else MeasuredRows(matrix, arrays["variance"], arrays["batches"])
    return fitted_model(scene, camera, fitted, rest, record)


def _fitted(arrays: dict[str, NDArray[Any]], camera: Camera) -> FittedMatrix | None:
    """The few numbers of a file, None where it has none. Raises ValueError or KeyError for others."""
    if not any(name.startswith(PREFIX) for name in arrays):
        return None
    views = {lens.name: Views.from_arrays(arrays, f"{PREFIX}{lens.name}") for lens in camera.types}
    for lens in camera.types:
        if len(views[lens.name].numbers) != lens.count:
            raise ValueError(f"lens type {lens.name} has {len(views[lens.name].numbers)} views, expected {lens.count}")
    kernels = {lens.name: _kernels(arrays, camera, f"{KERNELS}{lens.name}.") for lens in camera.types}
    fitted = FittedMatrix(camera, views, {name: each for name, each in kernels.items() if each is not None})
    if "data" not in arrays and not all(views[name].explained.all() for name in views.keys() - fitted.kernels.keys()):
        raise ValueError("it has sub-imagers that neither numbers nor entries describe")
    return fitted


def _kernels(arrays: dict[str, NDArray[Any]], camera: Camera, prefix: str) -> KernelFootprints | None:
    """The kernels of a lens type, None where it has none. Raises ValueError or KeyError for others."""
    own = {name.removeprefix(prefix): each for name, each in arrays.items() if name.startswith(prefix)}
    if not own:
        return None
    description = parse_json(str(own.pop(DESCRIPTION)[()]))
    for name, values in own.items():
        if values.dtype.kind != "f":
            raise ValueError(f"expected floating-point numbers as {prefix}{name}, got {values.dtype}")
        check_range(f"{prefix}{name}", values)
    return read_kernels(camera, description, own)


def _arrays(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    """The arrays of a file that match their checksum, and the description as JSON. Raises InputError."""
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        content = npz.read(path)
        check_shapes(content)
        arrays = {name: each for name, each in content.items() if name not in (*OF_SCIPY, "ommatid")}
        record = parse_json(str(content["ommatid"][()]))
        description, seal = record["description"], record["sha256"]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise InputError(
            f"{path}: expected a model that ommatid wrote, got one that cannot be read: {shortened(str(error))}"
        ) from error
    if _seal(arrays, description) != seal:
        raise InputError(f"{path}: does not match its checksum; the file is damaged, calibrate again")
    return arrays, description


def _seal(arrays: dict[str, NDArray[Any]], description: str) -> str:
    """SHA-256 of all arrays and the description."""
    content = digest(*(arrays[name] for name in sorted(arrays)))
    return hashlib.sha256(f"{content}{description}".encode()).hexdigest()


ENTRIES = ("indices", "indptr", "data")
MOST_BATCHES = 1024
MOST_TEXTS = 100
MOST_DIRECTIONS = 256  # of errors that many measurements share, each of which costs a pass over all of them
DIRECTIONS = {"own": 2, "shared": 2, "error_coefficients": 0}  # and the axis of these arrays that counts them
LONGEST_TEXT = 2**26  # bytes of a text, four a character
EXPECTED = {  # dimensions, kinds and bytes of a number
    **dict.fromkeys(("data", "variance"), (1, "f", (4, 8))),
    "batches": (2, "f", (4, 8)),
    "shape": (1, "i", (4, 8)),
    **dict.fromkeys(("indices", "indptr"), (1, "i", (4, 8))),
}


def check_shapes(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError for arrays that no model has."""
    shapes = {name: each.shape for name, each in arrays.items()}
    for name, shape in shapes.items():
        dtype = arrays[name].dtype
        if name in EXPECTED:
            dimensions, kinds, sizes = EXPECTED[name]
            if len(shape) != dimensions or dtype.kind not in kinds or dtype.itemsize not in sizes:
                raise ValueError(f"{name} is of type {dtype} and shape {shape}")
        elif dtype.kind in "US" and (arrays[name].size > MOST_TEXTS or dtype.itemsize > LONGEST_TEXT):
            raise ValueError(f"{name} has {dtype} texts of shape {shape}")
        axis = DIRECTIONS.get(name.rpartition(".")[2])
        if axis is not None and len(shape) == 3 and shape[axis] > MOST_DIRECTIONS:
            raise ValueError(f"{name} has {shape[axis]} directions of errors, more than {MOST_DIRECTIONS}")
    if "shape" in shapes and shapes["shape"] != (2,):
        raise ValueError(f"shape is of shape {shapes['shape']}")
    if "batches" in shapes and shapes["batches"][0] > MOST_BATCHES:
        raise ValueError(f"it has {shapes['batches'][0]} batches, more than {MOST_BATCHES}")
    for name in ("indices", "variance", "batches"):
        if {"data", name} <= shapes.keys() and shapes[name][-1:] != shapes["data"]:
            raise ValueError(f"{name} is of shape {shapes[name]} for {shapes['data'][0]} entries")


def csr_matrix(arrays: Mapping[str, NDArray[Any]], shape: tuple[int, ...]) -> sparse.csr_array:
    """H from its arrays, float64.

    Raises ValueError if they form no CSR matrix in canonical form, whose entries ascend in each row and stand there
    once, or if they hold values out of range: a variance of an entry that stands twice would be counted wrongly.
    """
    for name in ("data", "variance", "batches"):
        check_range(name, arrays[name])
    if (arrays["variance"] < 0).any():
        raise ValueError("a variance is below 0")
    data, indices, indptr = arrays["data"].astype(np.float64, copy=False), arrays["indices"], arrays["indptr"]
    if min(shape) < 0 or len(indptr) != shape[0] + 1 or indptr[0] != 0 or indptr[-1] != len(indices):
        raise ValueError(f"its rows end at other entries than those of a matrix of shape {shape}")
    matrix = sparse.csr_array((data, indices, indptr), shape=(shape[0], shape[1]))
    matrix.check_format(full_check=True)
    if not matrix.has_canonical_format:
        raise ValueError("expected the entries of a row by ascending column, each once")
    return matrix


def check_range(name: str, values: NDArray[Any]) -> None:
    """Raise ValueError for numbers that are not finite, or too large for their squares."""
    if values.size and not (values.min() >= -(LARGEST**2) and values.max() <= LARGEST**2):
        raise ValueError(f"{name} has values that are not finite or out of range")
