"""The observation model g = H f + v: a sparse H with the variance of its every entry (Wood et al., Eq. 1).

H is (M, N): a row a sensor pixel in the order of measurements, a column a pixel of f, row by row. The file is what
`scipy.sparse.load_npz` reads, with `variance` (in the order of `data`) and a JSON text `ommatid` beside it.
"""

from __future__ import annotations

import errno
import hashlib
import json
import tokenize
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .camera import Camera, derive
from .errors import InputError
from .files import digest, write_whole
from .moderate import moderate
from .scene import Scene, parse

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Model:
    """H as `matrix` (CSR, float64), `variance` of each stored entry, the camera it belongs to.

    `batches`, (B, nnz), are deviations from `matrix` of B independent estimates of it whose mean it is; without
    uncertainty there are none. `record` says how it was found: method, samples, seconds, agreement with the ideal
    model, fingerprint.
    """

    scene: Scene
    camera: Camera
    matrix: sparse.csr_array
    variance: Vector
    batches: NDArray[np.float32]
    record: dict[str, Any]

    @property
    def measurements(self) -> int:
        """M."""
        return int(self.matrix.shape[0])

    @property
    def unknowns(self) -> int:
        """N."""
        return int(self.matrix.shape[1])

    def forward(self, image: Vector) -> Vector:
        """H f: (N,) or (rows, columns) to (M,)."""
        return self.matrix @ np.asarray(image, dtype=np.float64).ravel()

    def adjoint(self, measurements: Vector) -> Vector:
        """H^T g: (M,) to (N,)."""
        return self.matrix.T @ np.asarray(measurements, dtype=np.float64)

    def restrict(self, names: tuple[str, ...]) -> Model:
        """Only the named lens types, in the model's own order. Raises InputError for a name it does not have."""
        camera, kept = self.camera.restrict(names)
        stored = np.repeat(kept, np.diff(self.matrix.indptr))
        return replace(
            self,
            camera=camera,
            matrix=self.matrix[kept],
            variance=self.variance[stored],
            batches=self.batches[:, stored],
            record={key: value for key, value in self.record.items() if key != "agreement"},  # of all types
        )

    def spread(self, image: Vector) -> Vector:
        """Variance that the uncertainty of H adds to each measurement of `image`: (M,).

        The errors of a row cancel in its sum, since all its entries share their rays, so what is left is about
        sum over j of var_ij (f_j - (H f)_i)^2. Neighbouring entries' errors cancel too, which smooth images notice:
        the scatter of H f over the batches, moderated among the pixels of a lens type, says by how much.
        """
        flat = np.asarray(image, dtype=np.float64).ravel()
        rows = np.repeat(np.arange(self.measurements), np.diff(self.matrix.indptr))
        away = flat[self.matrix.indices] - (self.matrix @ flat)[rows]
        trend = self._row_sums(rows, self.variance * away**2)
        count = len(self.batches)
        if count < 2:
            return trend
        seen = sum((self._row_sums(rows, batch * away) ** 2 for batch in self.batches), np.zeros(self.measurements))
        seen /= count * (count - 1)
        start = 0
        for kind in self.camera.types:
            place = np.arange(start, start + kind.measurements)
            place = place[trend[place] > 0]
            trend[place] *= moderate(seen[place] / trend[place], count)
            start += kind.measurements
        return trend

    def feigned(self, noise_variance: Vector) -> Vector:
        """Information on each pixel that the noise of H alone would seem to bring: (N,), sum over i of var_ij / Rv_i.

        Where the measurements leave a pixel open, an estimator that takes H for exact believes this much too much.
        """
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
    matrix = model.matrix
    arrays: dict[str, NDArray[Any]] = {
        "indices": matrix.indices,
        "indptr": matrix.indptr,
        "data": matrix.data,
        "shape": np.array(matrix.shape, dtype=np.int64),
        "variance": model.variance,
        "batches": model.batches,
    }
    description = json.dumps({"scene": model.scene.plain(), "record": model.record})
    record = json.dumps({"description": description, "sha256": _seal(arrays, description)})

    def fill(beside: Path) -> None:
        with beside.open("wb") as stream:
            savez: Any = np.savez_compressed
            savez(stream, format=np.array(b"csr"), _is_array=np.array(True), ommatid=record, **arrays)
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
        record = content["record"]
        matrix = sparse.csr_array(
            (arrays["data"], arrays["indices"], arrays["indptr"]), shape=tuple(arrays["shape"].tolist())
        )
        matrix.check_format()
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path}: holds no usable observation matrix ({error}); calibrate again") from error
    camera = derive(scene)
    expected = (camera.measurements, camera.unknowns)
    if matrix.shape != expected or not arrays["variance"].shape == arrays["data"].shape == arrays["batches"].shape[1:]:
        raise InputError(f"{path}: its matrix is {matrix.shape}, its scene wants {expected}; calibrate again")
    return Model(scene, camera, matrix, arrays["variance"], arrays["batches"], record)


def _arrays(path: Path) -> tuple[dict[str, NDArray[Any]], str]:
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    names = ("indices", "indptr", "data", "shape", "variance", "batches")
    try:
        # numpy leaves a damaged file open, so we open it
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays: dict[str, NDArray[Any]] = {name: file[name] for name in names}
            record = json.loads(str(file["ommatid"][()]))
            description, seal = record["description"], record["sha256"]
    except _UNREADABLE as error:
        reason = "it holds pickled objects" if "pickle" in str(error) else str(error)
        raise InputError(
            f"{path}: expected a model that ommatid wrote, got one that cannot be read: {reason}"
        ) from error
    if _seal(arrays, description) != seal:
        raise InputError(f"{path}: does not match its checksum; the file is damaged, calibrate again")
    return arrays, description


# What numpy, zipfile and json raise for damaged files: RuntimeError for an encrypted one, TokenError for a header
# that is no Python.
_UNREADABLE = (
    *(ValueError, KeyError, IndexError, TypeError, OSError, EOFError, RuntimeError),
    *(zipfile.BadZipFile, zlib.error, tokenize.TokenError),
)


def _seal(arrays: dict[str, NDArray[Any]], description: str) -> str:
    pixels = digest(*(arrays[name] for name in sorted(arrays)))
    return hashlib.sha256(f"{pixels}{description}".encode()).hexdigest()
