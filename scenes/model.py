"""The observation model g = H f + v: a sparse H with the variance of its every entry (Wood et al., Eq. 1).

H is (M, N): a row a sensor pixel in the order of measurements, a column a pixel of f, row by row. The file is what
`scipy.sparse.load_npz` reads, with `variance` (in the order of `data`) and a JSON text `ommatid` beside it. The ideal
H of a large frame is not stored, it follows from the scene: such a file has the format "boxes" and no entries.
"""

from __future__ import annotations

import errno
import hashlib
import json
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from . import npz
from .boxes import Boxes
from .camera import Camera, derive
from .errors import InputError, short
from .files import digest, write_whole
from .moderate import moderate
from .record import checked
from .scene import Scene, parse
from .table import LARGEST

Vector = NDArray[np.float64]

ENTRIES = ("indices", "indptr", "data")
ALIKE = 200  # pixels of like contrast, at least, whose scatter is moderated together
MOST_KINDS = 24  # such groups of a lens type, at most
RECORDED = "recorded points"  # the method of a model whose every entry was read by itself
NOWHERE = -1  # what a measurement sees that sees nothing: no window has it


@dataclass(frozen=True)
class Judge:
    """Who says of a model whether its H is known well enough.

    adds : what the uncertainty of H adds to the expected error of a reconstruction, relative to all the rest of it
    by : fingerprint of what is reconstructed;  words : the same for people
    """

    adds: Callable[[Model], float]
    by: str
    words: str


@dataclass(frozen=True)
class Model:
    """H as `stored` (CSR, float64), or None where it follows from the camera; `variance` of each stored entry.

    `batches`, (B, nnz), are deviations from `stored` of B independent estimates of it whose mean it is; without
    uncertainty there are none. `record` says how it was found: method, samples, seconds, agreement with the ideal
    model, fingerprint.
    """

    scene: Scene
    camera: Camera
    stored: sparse.csr_array | None
    variance: Vector
    batches: NDArray[np.float32]
    record: dict[str, Any]

    @property
    def matrix(self) -> sparse.csr_array:
        """H. Raises InputError where it is too large to be stored."""
        if self.stored is None:
            raise InputError(
                f"H of {self.unknowns} pixels is too large to be stored; take estimator.method = 'frame' or 'tiles'"
            )
        return self.stored

    @property
    def entries(self) -> int:
        """Of H, stored or not."""
        return self.boxes.entries if self.stored is None else int(self.stored.nnz)

    @property
    def exact(self) -> bool:
        """Whether H is that of a perfect camera of pinholes, and so follows from its geometry."""
        return self.record["method"] == "ideal" and self.camera.boxed

    @cached_property
    def boxes(self) -> Boxes:
        """H of a perfect camera, whatever this one is."""
        return Boxes(self.camera)

    @property
    def measurements(self) -> int:
        """M."""
        return self.camera.measurements

    @property
    def unknowns(self) -> int:
        """N."""
        return self.camera.unknowns

    def forward(self, image: Vector) -> Vector:
        """H f: (N,) or (rows, columns) to (M,)."""
        if self.stored is None:
            return self.boxes.forward(image)
        return self.stored @ np.asarray(image, dtype=np.float64).ravel()

    def adjoint(self, measurements: Vector) -> Vector:
        """H^T g: (M,) to (N,)."""
        if self.stored is None:
            return self.boxes.adjoint(measurements)
        return self.stored.T @ np.asarray(measurements, dtype=np.float64)

    def numbers(self, rows: slice, columns: slice) -> NDArray[np.int64]:
        """Which measurements see nothing but a window of f: (m,)."""
        if self.exact:
            return self.boxes.numbers(rows, columns)
        top, bottom, left, right = self._reach
        inside = (top >= rows.start) & (bottom < rows.stop) & (left >= columns.start) & (right < columns.stop)
        return np.flatnonzero(inside)

    def part(self, rows: slice, columns: slice) -> sparse.csr_array:
        """H of the window from these measurements: (m, pixels of the window)."""
        if self.exact:
            return self.boxes.part(rows, columns)
        some = self.matrix[self.numbers(rows, columns)]
        row, column = np.divmod(some.indices, self.camera.columns)
        shape = rows.stop - rows.start, columns.stop - columns.start
        indices = (row - rows.start) * shape[1] + column - columns.start
        return sparse.csr_array((some.data, indices, some.indptr), shape=(some.shape[0], shape[0] * shape[1]))

    def signature(self, rows: slice, columns: slice) -> Hashable:
        """What two windows have in common whose `part` is the same."""
        return self.boxes.signature(rows, columns) if self.exact else (rows.start, columns.start)

    @property
    def reach(self) -> int:
        """Rows or columns of f, whichever are more, that the widest measurement sees."""
        if self.stored is None:
            return max(ceil(kind.ratio) + 1 for kind in self.camera.types)
        top, bottom, left, right = self._reach
        return int(max((bottom - top).max(), (right - left).max())) + 1

    @cached_property
    def _reach(self) -> tuple[NDArray[np.int64], ...]:
        """First and last row, first and last column of f that each measurement sees; none where it sees nothing."""
        row, column = np.divmod(self.matrix.indices.astype(np.int64), self.camera.columns)
        seen = np.diff(self.matrix.indptr) > 0
        starts = self.matrix.indptr[:-1][seen]
        found = [np.full(seen.size, NOWHERE) for _ in range(4)]
        for ends, (pick, values) in zip(found, product((np.minimum, np.maximum), (row, column)), strict=True):
            ends[seen] = pick.reduceat(values, starts)
        return found[0], found[2], found[1], found[3]

    def restrict(self, names: tuple[str, ...]) -> Model:
        """Only the named lens types, in the model's own order. Raises InputError for a name it does not have."""
        camera, kept = self.camera.restrict(names)
        if self.stored is None:
            return replace(self, camera=camera)
        stored = np.repeat(kept, np.diff(self.matrix.indptr))
        return replace(
            self,
            camera=camera,
            stored=self.matrix[kept],
            variance=self.variance[stored],
            batches=self.batches[:, stored],
            record={key: value for key, value in self.record.items() if key != "agreement"},  # of all types
        )

    def spread(self, image: Vector) -> Vector:
        """Variance that the uncertainty of H adds to each measurement of `image`: (M,).

        The errors of a row cancel in its sum, since all its entries share their rays, so what is left is about
        sum over j of var_ij (f_j - (H f)_i)^2. Neighbouring entries' errors cancel too, which smooth images notice:
        the scatter of H f over the batches, moderated among pixels of a lens type with like contrast, says by how much.
        Entries of recorded points were read one by one, and nothing cancels: sum over j of var_ij f_j^2.
        """
        flat = np.asarray(image, dtype=np.float64).ravel()
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        away = flat[self.matrix.indices]
        if self.record["method"] != RECORDED:
            away = away - (self.matrix @ flat)[rows]
        trend = self._row_sums(rows, self.variance * away**2)
        count = len(self.batches)
        if count < 2:
            return trend
        seen = sum((self._row_sums(rows, batch * away) ** 2 for batch in self.batches), np.zeros(self.measurements))
        seen /= count * (count - 1)
        if self.record.get("fit"):
            # Entries that a few fitted numbers make go together in ways that no sum over entries knows.
            return seen
        for kind in self.camera.type_slices():
            place = kind.start + np.flatnonzero(trend[kind] > 0)
            # Strong contrast lets errors cancel otherwise than weak one does, so that like is compared with like.
            for alike in np.array_split(place[np.argsort(trend[place])], max(1, min(place.size // ALIKE, MOST_KINDS))):
                if alike.size:
                    trend[alike] *= moderate(seen[alike] / trend[alike], count)
        return trend

    def feigned(self, noise_variance: Vector) -> Vector:
        """Information on each pixel that the noise of H alone would seem to bring: (N,), sum over i of var_ij / Rv_i.

        Where the measurements leave a pixel open, an estimator that takes H for exact believes this much too much.
        """
        if not self.variance.size:
            return np.zeros(self.unknowns)
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        weights = self.variance / noise_variance[rows]
        return np.bincount(self.matrix.indices, weights=weights, minlength=self.unknowns).astype(np.float64)

    def prior_spread(self, prior_variance: Vector) -> Vector:
        """The same before anything is known of the image but the (N,) variance of its pixels: sum of var_ij P0_j."""
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        return self._row_sums(rows, self.variance * prior_variance[self.matrix.indices])

    def _row_sums(self, rows: NDArray[np.int64], entries: Vector) -> Vector:
        return np.bincount(rows, weights=entries, minlength=self.measurements).astype(np.float64)


def write(path: Path, model: Model) -> None:
    """Write a model, whole or not at all. Raises InputError or DeniedError."""
    arrays: dict[str, NDArray[Any]] = {
        "shape": np.array([model.measurements, model.unknowns], dtype=np.int64),
        "variance": model.variance,
        "batches": model.batches,
    }
    if model.stored is not None:
        arrays |= {name: getattr(model.stored, name) for name in ENTRIES}
    layout = b"boxes" if model.stored is None else b"csr"
    description = json.dumps({"scene": model.scene.plain(), "record": model.record})
    record = json.dumps({"description": description, "sha256": _seal(arrays, description)})

    def fill(beside: Path) -> None:
        with beside.open("wb") as stream:
            savez: Any = np.savez_compressed
            savez(stream, format=np.array(layout), _is_array=np.array(True), ommatid=record, **arrays)
        try:
            _arrays(beside)
        except InputError as error:
            raise OSError(errno.ENOSPC, f"not all of it could be stored: {error}") from error

    write_whole(path, fill)


def read(path: Path) -> Model:
    """Read a model. Raises InputError if it is missing, damaged, pickled or no model."""
    arrays, description = _arrays(path)
    try:
        content = json.loads(description)
        scene = parse(content["scene"], path)
        record = checked(content["record"])
        method = record["method"]
        camera = derive(scene)
        matrix, shape = None, tuple(arrays["shape"].tolist())
        if "data" in arrays:
            matrix = _checked(arrays, shape)
        elif not (method == "ideal" and camera.boxed):
            raise ValueError("it has no entries")
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(
            f"{path}: holds no usable observation matrix ({short(str(error))}); calibrate again"
        ) from error
    expected = (camera.measurements, camera.unknowns)
    entries = np.shape(arrays.get("data", ()))
    if shape != expected or not arrays["variance"].shape == entries == arrays["batches"].shape[1:]:
        raise InputError(f"{path}: its matrix is {shape}, its scene wants {expected}; calibrate again")
    return Model(scene, camera, matrix, arrays["variance"], arrays["batches"], record)


def _checked(arrays: dict[str, NDArray[Any]], shape: tuple[int, ...]) -> sparse.csr_array:
    """H from its parts. Raises ValueError where they are no matrix in rows, or hold what is no number."""
    for name, kinds in (("data", "f"), ("variance", "f"), ("batches", "f"), ("indices", "i"), ("indptr", "i")):
        if arrays[name].dtype.kind not in kinds or not (np.abs(arrays[name]) <= LARGEST**2).all():
            raise ValueError(f"{name} of {arrays[name].dtype} holds what is no number of its kind")
    if (arrays["variance"] < 0).any():
        raise ValueError("a variance is below 0")
    if len(shape) != 2:
        raise ValueError(f"its shape is {shape}")
    matrix = sparse.csr_array((arrays["data"], arrays["indices"], arrays["indptr"]), shape=shape)
    matrix.check_format(full_check=True)
    return matrix


def _arrays(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    try:
        found = npz.read(path)
        names = ["shape", "variance", "batches", *(ENTRIES if found["format"][()] != b"boxes" else ())]
        arrays = {name: found[name] for name in names}
        record = json.loads(str(found["ommatid"][()]))
        description, seal = record["description"], record["sha256"]
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        raise InputError(
            f"{path}: expected a model that ommatid wrote, got one that cannot be read: {short(str(error))}"
        ) from error
    if _seal(arrays, description) != seal:
        raise InputError(f"{path}: does not match its checksum; the file is damaged, calibrate again")
    return arrays, description


def _seal(arrays: dict[str, NDArray[Any]], description: str) -> str:
    pixels = digest(*(arrays[name] for name in sorted(arrays)))
    return hashlib.sha256(f"{pixels}{description}".encode()).hexdigest()
