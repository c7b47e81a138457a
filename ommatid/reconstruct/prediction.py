"""The expected error of a camera before anything is recorded (Wood et al., Eq. 5), and what its H leaves open."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import Any

import numpy as np
from scipy import linalg, sparse

from ommatid.runtime.arrays import FloatArray

from .expected_error import ExpectedError
from .measured_error import TRIM, trimmed_mean
from .problem import gram

PRIOR_ALONE = 0.9  # of the prior's variance: error from which measurements bring next to nothing
RANK_TOLERANCE = 1e-7  # of singular values, relative; their squares come from an eigenvalue problem in float64


@dataclass(frozen=True)
class Observability:
    """Rank of H, the dimension of its null space, and its largest over its smallest singular value above zero."""

    rank: int
    null_space: int
    condition: float


@dataclass(frozen=True)
class Prediction:
    """Expected error (Eq. 5) of a camera, averaged over the pixels, and the properties of its H.

    rank, null_space, condition : of H, None for frames
    trimmed_mse : without a border of `trim` pixels, None where nothing is left
    degrees_of_freedom : trace of A H;  resolution : median width of the averaging kernel, in pixels of f
    misalignment : the part of `mse` that the camera's tolerance brings, None where there is none or it is not known
    prior_variance : of a pixel, the error where nothing is recovered
    mse_for_picture : expected error of the scene's picture, which is no draw of the prior
    interval : ends of what holds its measured error in 99 of 100 runs, None where that is not known
    budget : parts of `mse` by cause, which add up to it
    assumes : what the prediction takes for granted, in sentences
    as_designed, calibrated : `mse` with H as designed and with a calibrated H, where the camera has a tolerance
    """

    measurements: int
    unknowns: int
    rank: int | None
    null_space: int | None
    condition: float | None
    mse: float
    trimmed_mse: float | None
    trim: int
    degrees_of_freedom: float
    resolution: float | None
    method: str
    misalignment: float | None = None
    prior_variance: float | None = None
    mse_for_picture: float | None = None
    interval: tuple[float, float] | None = None
    budget: dict[str, float] | None = None
    assumes: tuple[str, ...] = ()
    as_designed: float | None = None
    calibrated: float | None = None

    def __repr__(self) -> str:
        """Return size, rank and error in one line."""
        size = f"{self.measurements} measurements, {self.unknowns} unknowns"
        rank = "" if self.rank is None else f", rank {self.rank}"
        return f"<Prediction: {size}{rank}, expected error {self.mse**0.5:.3g} rms>"

    @classmethod
    def of(
        cls,
        variance: FloatArray,
        expected: ExpectedError,
        seen: Observability | None,
        shape: tuple[int, int],
        **others: Any,
    ) -> Prediction:
        """Return the prediction of an estimate; variance : (N,) with all that adds to Eq. 5; seen : None for frames."""
        rank, null_space, condition = (None, None, None) if seen is None else astuple(seen)
        return cls(
            unknowns=variance.size,
            rank=rank,
            null_space=null_space,
            condition=condition,
            mse=float(variance.mean()),
            trimmed_mse=trimmed_mean(variance, shape),
            trim=TRIM,
            degrees_of_freedom=expected.degrees_of_freedom,
            resolution=expected.median_width,
            **others,
        )

    @property
    def recovers_nothing(self) -> bool:
        """True if the error is that of the prior alone, to a tenth."""
        return self.prior_variance is not None and self.mse >= PRIOR_ALONE * self.prior_variance


def observability(matrix: sparse.csr_array) -> Observability:
    """Return rank and condition of H, from the eigenvalues of the smaller of H H^T and H^T H."""
    wide = matrix.shape[0] < matrix.shape[1]
    square = gram(sparse.csr_array(matrix.T) if wide else matrix)
    values: FloatArray = np.asarray(linalg.eigvalsh(square, overwrite_a=True, check_finite=False), dtype=np.float64)
    largest = float(values.max(initial=0.0))
    seen = values[values > RANK_TOLERANCE**2 * largest]
    condition = float(np.sqrt(largest / seen.min())) if seen.size else float("inf")
    return Observability(int(seen.size), matrix.shape[1] - int(seen.size), condition)
