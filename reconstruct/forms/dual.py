"""Dual form: of all (u, w) with H L u + S w = r the one of least norm, by pivoted QR of [H L, S].

It divides by neither S nor L and so serves measurements without noise, pixels that are known, and noise of very
different size side by side. Pivoting splits (u, w) into basic variables, which the measurements determine, and free
ones t, for which the prior speaks: basic = y - W t with W = R1^-1 R2. Small variances then come from small numbers,
not from differences of large ones. The dearest form: cubic in measurements and unknowns together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy import linalg

from ..problem import Problem
from .form import Form, Matrix, NotSolvableError, Vector, root_variance
from .sorted_qr import Indices, SortedQr, sorted_qr

EPS = float(np.finfo(np.float64).eps)


@dataclass(frozen=True)
class Dual(Form):
    """Rows with signal `active`, of size `scale`; [H L, S] of them is Q [R1 R2] in the order `basic`, `free`.

    orthogonal : (m, rank) Q
    triangle : (rank, rank) R1;  weights : (rank, K + m - rank) W
    normal : the QR of [W; I]
    """

    active: Indices
    scale: Vector
    basic: Indices
    free: Indices
    orthogonal: Matrix
    triangle: Matrix
    weights: Matrix
    normal: SortedQr

    name: ClassVar[str] = "dual"

    def solve(self, shift: Matrix, residual: Matrix) -> tuple[Matrix, Matrix]:
        """The (u, w) nearest to (c, 0) that meets r; l from the basic columns of (H L, S)^T l = (u - c, w)."""
        freedoms, rank = self.problem.prior.freedoms, self.basic.size
        scaled = residual[self.active] / self.scale[:, None]
        target = np.zeros((freedoms + self.active.size, shift.shape[1]))
        target[:freedoms] = shift
        particular = linalg.solve_triangular(self.triangle, self.orthogonal.T @ scaled, check_finite=False)
        right = np.vstack([particular - target[self.basic], target[self.free]])
        chosen = self.normal.solve(right)
        found = np.empty_like(target)
        found[self.free] = chosen
        found[self.basic] = particular - self.weights @ chosen
        moved = (found - target)[self.basic]
        multiplier = np.zeros_like(residual)
        if rank:
            some = self.orthogonal @ linalg.solve_triangular(self.triangle, moved, trans="T", check_finite=False)
            multiplier[self.active] = some / self.scale[:, None]
        noise = self.problem.noise_variance
        silent = np.setdiff1d(np.flatnonzero(noise > 0), self.active)
        multiplier[silent] = residual[silent] / noise[silent, None]
        return found[:freedoms], multiplier

    def variance(self) -> Vector:
        """The diagonal of L T T^T L^T, T = [I; -W] R^-1 in the rows of u."""
        inverse = self.normal.inverse()
        root = np.zeros((self.problem.prior.freedoms + self.active.size, self.free.size))
        root[self.free] = inverse
        root[self.basic] = -self.weights @ inverse
        return root_variance(self.problem, root[: self.problem.prior.freedoms])


def dual(problem: Problem) -> Dual:
    """Factorise in dual form. Raises NotSolvableError where noise drowns in the rounding of H without being 0."""
    observed = problem.observed()
    size = np.sqrt(np.square(observed).sum(axis=1))
    active = np.flatnonzero(size > 0)
    scale = size[active]
    count, freedoms = active.size, problem.prior.freedoms
    whole = np.zeros((count, freedoms + count))
    whole[:, :freedoms] = observed[active] / scale[:, None]
    whole[np.arange(count), freedoms + np.arange(count)] = problem.deviation[active] / scale
    norms = np.sqrt(np.square(whole).sum(axis=0))
    rows = np.argsort(-np.abs(whole).max(axis=1, initial=0.0), kind="stable")
    active, scale = active[rows], scale[rows]
    whole = whole[rows]
    whole[:, freedoms:] = whole[:, freedoms:][:, rows]
    norms[freedoms:] = norms[freedoms:][rows]
    decompose: Any = linalg.qr
    orthogonal, triangle, pivots = decompose(whole, overwrite_a=True, pivoting=True, check_finite=False)
    rounding = 4 * EPS * (freedoms + count) * norms[pivots]
    diagonal = np.abs(np.diagonal(triangle))
    sound = diagonal > rounding[:count]
    rank = int(np.argmin(sound)) if not sound.all() else count
    if sound[rank:].any():
        raise NotSolvableError("noise so small that it drowns in the rounding of H")
    # What is below the rounding of its own column is rounding: the prior speaks there, and noise must not drown it.
    triangle = np.where(np.abs(triangle[:rank]) > rounding, triangle[:rank], 0.0)
    first = triangle[:, :rank]
    if rank:
        weights = np.asarray(linalg.solve_triangular(first, triangle[:, rank:], check_finite=False))
    else:
        weights = np.zeros((0, freedoms + count))
    kept = diagonal[:rank]
    condition = float(kept.max(initial=1.0) / kept.min(initial=1.0))
    return Dual(
        problem,
        condition,
        active,
        scale,
        pivots[:rank],
        pivots[rank:],
        orthogonal[:, :rank],
        first,
        weights,
        sorted_qr(np.vstack([weights, np.eye(weights.shape[1])])),
    )
