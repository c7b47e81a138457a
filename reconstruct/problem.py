"""The linear inverse problem g = H f + v with everything that is known of f and v (Wood et al., Eq. 1 to 3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError

from .prior import Prior

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """H as `matrix`, (M, N) CSR; what is believed of f; and the diagonal of Rv as `noise_variance`, (M,), 0 allowed.

    With P0 = L L^T and Rv = S^2, S diagonal, every form works in u, f = f0 + L u, where the prior is the unit
    matrix, and where it can with B = S^-1 H L.  Raises InputError for shapes that do not fit and numbers that are none.
    """

    matrix: sparse.csr_array
    prior: Prior
    noise_variance: Vector

    def __post_init__(self) -> None:
        """Refuse what no form could solve."""
        measurements, unknowns = self.matrix.shape
        if self.prior.mean.shape != (unknowns,) or self.prior.root.shape[0] != unknowns:
            raise InputError(f"the prior is of {self.prior.mean.size} pixels, H of {unknowns}")
        if self.noise_variance.shape != (measurements,):
            raise InputError(f"{self.noise_variance.size} noise variances came for {measurements} measurements")
        if not np.isfinite(self.noise_variance).all() or (self.noise_variance < 0).any():
            raise InputError("expected noise variances of 0 or more, got negative or infinite ones or NaN")
        for name, values in (("H", self.matrix.data), ("the prior", self.prior.root), ("f0", self.prior.mean)):
            if not np.isfinite(values).all():
                raise InputError(f"{name} holds numbers that are infinite or NaN")

    @property
    def measurements(self) -> int:
        """M."""
        return int(self.matrix.shape[0])

    @property
    def unknowns(self) -> int:
        """N."""
        return int(self.matrix.shape[1])

    @property
    def noisy(self) -> bool:
        """Whether every measurement has noise, so that S has an inverse."""
        return bool((self.noise_variance > 0).all())

    @cached_property
    def deviation(self) -> Vector:
        """The diagonal of S: (M,)."""
        return np.sqrt(self.noise_variance)

    def observe(self, freedoms: Matrix) -> Matrix:
        """H L u: (K, q) to (M, q)."""
        return np.asarray(self.matrix @ self.prior.spread(freedoms))

    def adjoint(self, measurements: Matrix) -> Matrix:
        """L^T H^T g: (M, q) to (K, q)."""
        return np.asarray(self.prior.gather(self.matrix.T @ measurements))

    def observed(self) -> Matrix:
        """H L as a dense matrix: (M, K)."""
        if self.prior.independent:
            return np.asarray(self.matrix.multiply(self.prior.root[None, :]).toarray())
        return np.asarray(self.matrix @ self.prior.root)

    def whitened(self) -> Matrix:
        """B = S^-1 H L as a dense matrix: (M, K); needs noise in every measurement."""
        dense = self.observed()
        return np.divide(dense, self.deviation[:, None], out=dense)
