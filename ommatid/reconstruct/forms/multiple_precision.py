"""Covariance form in ball arithmetic: slow, certain, and for small problems only.

The float64 numbers of a problem are taken as the rationals that they are. With B = H L and C = B B^T + Rv over the
measurements with noise and a basis of those without,

    l = C^-1 (r - B c),    u = c + B^T l,

in numbers with an error bound each (Johansson 2017), whose precision is doubled until every bound is negligible. Which
rows without noise are linearly dependent is decided modulo a prime of 61 bits. Other forms are compared with it where
no bound of theirs holds, and it is the last resort where they fail.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray

from ..problem import Problem
from .balls import (
    LEAST_FLOAT,
    ball_matrix,
    balls,
    column,
    dense_root,
    floats,
    independent_rows,
    negligible_radii,
    product_diagonal,
    relative_misfit,
)
from .form import Form, NotSolvableError

LEAST_BITS, MOST_BITS = 256, 16384
EPS = float(np.finfo(np.float64).eps)
MOST_ROWS = 64  # measurements, and pixels, of a small problem

Pair = tuple[FloatArray, FloatArray]
Compute = Callable[[Any, Any], Iterable[Any]]  # from B and C^-1


@dataclass(frozen=True)
class ExactEstimate:
    """The estimate, exact to float64.

    high, low : (K,) each, whose sum is u;  multipliers : (M,)
    uncertainty : of |u|, where measurements without noise contradict one another by rounding
    contradiction : largest |g - H f^|_i / (|g| + |H| |f^|)_i of the measurements without noise
    """

    high: FloatArray
    low: FloatArray
    multipliers: FloatArray
    uncertainty: float
    contradiction: float


@dataclass
class _Precision:
    """The bits that have sufficed so far, and B and C^-1 with them."""

    bits: int = LEAST_BITS
    observed: Any = None
    inverse: Any = None


@dataclass(frozen=True)
class MultiplePrecision(Form):
    """A problem every solution of which is exact to float64.

    kept : measurements with noise, then a basis of those without;  free : all those without noise but with signal
    """

    kept: NDArray[np.intp]
    free: NDArray[np.intp]
    precision: _Precision = field(default_factory=_Precision, compare=False, repr=False)

    name: ClassVar[str] = "multiple-precision"

    def solve(self, shift: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return u and l, each exact to float64; of dependent measurements without noise the first ones are met."""

        def compute(observed: Any, inverse: Any) -> tuple[Any, Any]:
            multipliers = inverse * (balls(residual[self.kept]) - observed * balls(shift))
            return balls(shift) + observed.transpose() * multipliers, multipliers

        (u, _), (multipliers, _) = self._converged(compute)
        return u, self._on_all(multipliers, residual.shape)

    def solve_sum(self, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve for c = L^T w, without rounding c, and r = 0: w, (N, 1), to u, (K, 1), and l, (M, 1)."""

        def compute(observed: Any, inverse: Any) -> tuple[Any, Any]:
            shift = balls(dense_root(self.problem.prior)).transpose() * balls(weights)
            multipliers = inverse * (observed * shift)
            return shift - observed.transpose() * multipliers, multipliers

        (u, _), (multipliers, _) = self._converged(compute)
        return u, -self._on_all(multipliers, (self.problem.measurements, 1))

    def estimate(self, recorded: FloatArray) -> ExactEstimate:
        """Return the estimate for g, (M,) `recorded`.

        Measurements without noise that contradict one another are made consistent by least squares, relative to their
        signal. Each counts as uncertain, relative to its signal, as the worst of them, and the estimate at least as
        uncertain as its distance from the one that meets the first independent ones.
        """
        problem = self.problem
        free = np.flatnonzero(problem.noise_variance == 0)
        misfits: list[float] = []

        def compute(observed: Any, inverse: Any) -> tuple[Any, ...]:
            matrix, mean = balls(problem.matrix.toarray()), balls(problem.prior.mean[:, None])
            measured = balls(recorded[:, None])
            residual = measured - matrix * mean
            right, blur = self._consistent(residual)
            other = column([residual[int(row), 0] for row in self.kept])
            multipliers = inverse * right
            u = observed.transpose() * multipliers
            image = mean + balls(dense_root(problem.prior)) * u
            misfits[:] = [relative_misfit(matrix, image, measured, int(row)) for row in free]
            back = observed.transpose() * inverse
            return u, multipliers, back * blur, back * (right - other)

        (high, low), (multipliers, _), (blur, _), (change, _) = self._converged(compute)
        return ExactEstimate(
            high[:, 0],
            low[:, 0],
            self._on_all(multipliers, (problem.measurements, 1))[:, 0],
            max(float(np.linalg.norm(np.abs(blur).sum(axis=1))), float(np.linalg.norm(change))),
            max(misfits, default=0.0),
        )

    def variance(self) -> FloatArray:
        """Return the diagonal of L (I - B^T C^-1 B) L^T."""
        return self._variance

    @cached_property
    def _variance(self) -> FloatArray:
        roots = dense_root(self.problem.prior)

        def compute(observed: Any, inverse: Any) -> tuple[Any]:
            root = balls(roots)
            cross = observed * root.transpose()
            prior, explained = (
                product_diagonal(root, root),
                product_diagonal(cross.transpose(), (inverse * cross).transpose()),
            )
            return (column([before - less for before, less in zip(prior, explained, strict=True)]),)

        ((variance, _),) = self._converged(compute, elementwise=True)
        return np.maximum(variance[:, 0], 0.0)

    @property
    def description(self) -> str:
        """Name of the form."""
        return self.name

    @cached_property
    def variance_error(self) -> float:
        """Return a bound on the relative error of every posterior variance above 0, from rounding."""
        variance = self.variance()
        return EPS + float(
            np.divide(LEAST_FLOAT, variance, out=np.zeros_like(variance), where=variance > 0).max(initial=0.0)
        )

    def scaled_condition(self) -> float:
        """Return the 1-norm condition number of C scaled to a unit diagonal."""

        def compute(observed: Any, inverse: Any) -> tuple[Any]:
            innovation = observed * observed.transpose()
            for index, noise in enumerate(self.problem.noise_variance[self.kept].tolist()):
                innovation[index, index] += noise
            count = range(self.kept.size)
            scale = [innovation[index, index].sqrt() for index in count]
            norms = [
                max((sum(abs(innovation[i, j]) / scale[i] for i in count) / scale[j]).mid() for j in count),
                max((sum(abs(inverse[i, j]) * scale[i] for i in count) * scale[j]).mid() for j in count),
            ]
            return (column([norms[0] * norms[1]]),)

        ((condition, _),) = self._converged(compute) if self.kept.size else [(np.ones((1, 1)), np.zeros((1, 1)))]
        return float(condition[0, 0])

    def _consistent(self, recorded: Any) -> tuple[Any, Any]:
        """Return r of the measurements kept, and what its uncertainties add to it, a column for each."""
        basis = [int(row) for row in self.kept if self.problem.noise_variance[row] == 0]
        first = self.kept.size - len(basis)
        right = column([recorded[int(row), 0] for row in self.kept])
        if len(basis) == self.free.size:
            return right, column([0] * self.kept.size)
        whole, spanning = self._signal(self.free), self._signal(np.array(basis, dtype=np.intp))
        weights = whole * spanning.transpose() * (spanning * spanning.transpose()).inv()
        size = [square.sqrt() for square in product_diagonal(whole, whole)]
        scaled = ball_matrix([[weights[i, k] / size[i] for k in range(len(basis))] for i in range(len(size))])
        fit = (scaled.transpose() * scaled).inv() * scaled.transpose()
        readings = column([recorded[int(row), 0] / size[i] for i, row in enumerate(self.free)])
        consistent = fit * readings
        misfit = max(abs(entry.mid()) for entry in (readings - scaled * consistent).entries())
        blur = [[0] * len(size) for _ in range(first)] + [[entry * misfit for entry in row] for row in fit.tolist()]
        for index in range(len(basis)):
            right[first + index, 0] = consistent[index, 0]
        return right, ball_matrix(blur)

    def _signal(self, rows: NDArray[np.intp]) -> Any:
        """Return rows of B."""
        return balls(self.problem.matrix.toarray()[rows]) * balls(dense_root(self.problem.prior))

    def _on_all(self, multipliers: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        filled = np.zeros(shape)
        filled[self.kept] = multipliers
        return filled

    def _converged(self, compute: Compute, *, elementwise: bool = False) -> list[Pair]:
        """Return results, each the sum of two arrays, in the least precision in which all radii are negligible."""
        from flint import ctx

        before = ctx.prec
        try:
            while self.precision.bits <= MOST_BITS:
                ctx.prec = self.precision.bits
                results = self._attempt(compute)
                if results is not None and all(negligible_radii(result, elementwise=elementwise) for result in results):
                    return [floats(result) for result in results]
                self.precision.bits, self.precision.inverse = 2 * self.precision.bits, None
        finally:
            ctx.prec = before
        raise NotSolvableError(f"{MOST_BITS} bits do not suffice")

    def _attempt(self, compute: Compute) -> list[Any] | None:
        """Return results in the present precision, None where its balls hold 0 and cannot be divided by."""
        try:
            return list(compute(*self._factorised()))
        except ZeroDivisionError:
            return None

    def _factorised(self) -> tuple[Any, Any]:
        """Return B and C^-1. Raises ZeroDivisionError if balls are too wide to divide by."""
        if self.precision.inverse is None:
            observed = self._signal(self.kept)
            innovation = observed * observed.transpose()
            for index, noise in enumerate(self.problem.noise_variance[self.kept].tolist()):
                innovation[index, index] += noise
            self.precision.observed = observed
            self.precision.inverse = innovation.inv() if self.kept.size else innovation
        return self.precision.observed, self.precision.inverse


def is_small(problem: Problem) -> bool:
    """Return True if multiple precision takes a fraction of a second."""
    return max(problem.measurements, problem.prior.dimension, problem.unknowns) <= MOST_ROWS


def multiple_precision(problem: Problem) -> MultiplePrecision:
    """Choose independent measurements. Raises NotSolvableError if the problem is not small."""
    if not is_small(problem):
        raise NotSolvableError(f"it takes at most {MOST_ROWS} measurements and pixels")
    noise_free = np.flatnonzero(problem.noise_variance == 0)
    signal, basis = independent_rows(problem.matrix.toarray()[noise_free], dense_root(problem.prior))
    kept = np.concatenate([np.flatnonzero(problem.noise_variance > 0), noise_free[basis]]).astype(np.intp)
    form = MultiplePrecision(problem, float("nan"), kept, noise_free[signal])
    return replace(form, condition=form.scaled_condition())
