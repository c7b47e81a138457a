"""How far a computed estimate is from the exact one, at most: refinement, and a bound that asks no factorisation.

The exact u is where |S^-1 (r - H L u)|^2 + |u - c|^2 is least, a function that rises at least as fast as the square of
the distance from there. So for any u and l, with the residuals

    p = c + L^T H^T l - u,    q = r - H L u - Rv l,

the distance is at most |p| + |S^-1 q| / 2, whoever computed them. Both cancel almost wholly and are therefore formed in
twice the precision; the same residuals, solved for, correct the estimate until the bound no longer falls.
Distances are in u, that is in standard deviations of the prior.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from .forms.form import Form
from .prior import Prior
from .problem import Problem
from .twofold import ROUNDING, Rows, Twofold, exact, rows_of, rows_of_dense

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Pair = tuple[Twofold, Twofold]

MOST_REFINEMENTS = 12
ENOUGH = 1e-15  # relative: float64 holds no more
VANISHED = 1e-8  # of c or u: p must have fallen that far before the factorisation is believed about the rest
CONTRACTION = 1e-2  # of one correction to the one before, likewise


@dataclass(frozen=True)
class Refined:
    """u, (K, q), as good as it gets, the relative `bound` of its error and that of the `first` u: (q,) each."""

    freedoms: Matrix
    multipliers: Matrix
    bound: Vector
    first: Vector
    steps: int


@dataclass(frozen=True)
class Exact:
    """A problem's matrices laid out for products in twice the precision."""

    problem: Problem

    @cached_property
    def _matrix(self) -> Rows:
        return rows_of(self.problem.matrix)

    @cached_property
    def _transposed(self) -> Rows:
        return rows_of(sparse.csr_array(self.problem.matrix.T))

    @cached_property
    def _root(self) -> tuple[Rows, Rows]:
        root = self.problem.prior.root
        return rows_of_dense(root), rows_of_dense(root.T)

    @cached_property
    def _sizes(self) -> tuple[sparse.csr_array, Prior]:
        prior = self.problem.prior
        return abs(self.problem.matrix), Prior(prior.mean, np.abs(prior.root))

    @property
    def rounding(self) -> float:
        """Relative rounding of the residuals, from the number of terms in their longest sum."""
        longest = max(self._matrix.data.shape[0], self._transposed.data.shape[0])
        return ROUNDING * (4 + longest + (0 if self.problem.prior.independent else self.problem.prior.freedoms))

    def observe(self, freedoms: Twofold) -> Twofold:
        """H L u."""
        prior = self.problem.prior
        spread = freedoms.scaled(prior.root[:, None]) if prior.independent else self._root[0].times(freedoms)
        return self._matrix.times(spread)

    def adjoint(self, measurements: Twofold) -> Twofold:
        """L^T H^T l."""
        prior = self.problem.prior
        seen = self._transposed.times(measurements)
        return seen.scaled(prior.root[:, None]) if prior.independent else self._root[1].times(seen)

    def recorded(self, values: Vector) -> Twofold:
        """g - H f0: (M, 1)."""
        return exact(values[:, None]) - self._matrix.times(exact(self.problem.prior.mean[:, None]))

    def residuals(self, u: Twofold, pull: Twofold, shift: Twofold, recorded: Twofold) -> tuple[Twofold, Twofold]:
        """p and q of the module's text: (K, q) and (M, q)."""
        noise = self.problem.noise_variance[:, None]
        return shift + self.adjoint(pull) - u, recorded - self.observe(u) - pull.scaled(noise)

    def doubts(self, u: Matrix, pull: Matrix, shift: Matrix, recorded: Matrix) -> tuple[Matrix, Matrix]:
        """How far rounding may have moved p and q, from the sizes of all that is added up in them."""
        matrix, prior = self._sizes
        u, pull = np.abs(u), np.abs(pull)
        p = np.abs(shift) + prior.gather(matrix.T @ pull) + u
        q = np.abs(recorded) + matrix @ prior.spread(u) + self.problem.noise_variance[:, None] * pull
        return self.rounding * p, self.rounding * q


def refine(form: Form, exactly: Exact, shift: Matrix, recorded: Twofold) -> Refined:
    """Solve for c = `shift`, (K, q), and r = `recorded`, (M, q), and correct; what has the least bound is kept."""
    target = exact(shift)
    first, multiplier = form.solve(shift, recorded.high)
    found: Pair = exact(first), exact(multiplier)
    residuals: Pair = exactly.residuals(found[0], found[1], target, recorded)
    right = shift, recorded.high
    bound: Vector = _bound(form, exactly, found, residuals, right, None)
    best: tuple[Pair, Vector] = found, bound
    previous: Vector | None = None
    steps = 0
    while steps < MOST_REFINEMENTS and not (bound <= ENOUGH).all():
        p, q = residuals
        change, step = form.solve(p.high, q.high)
        found = found[0] + exact(change), found[1] + exact(step)
        residuals = exactly.residuals(found[0], found[1], target, recorded)
        size = np.linalg.norm(change, axis=0)
        rate = None if previous is None else size / np.where(previous > 0, previous, 1.0)
        bound, previous = _bound(form, exactly, found, residuals, right, rate), size
        steps += 1
        if _worst(bound) < _worst(best[1]):
            best = found, bound
    u, pull = best[0][0].high, best[0][1].high
    away = _relative(np.linalg.norm(u - first, axis=0), np.linalg.norm(u, axis=0))
    return Refined(u, pull, best[1], away + best[1], steps)


def variance_error(form: Form, exactly: Exact) -> float:
    """Relative error of the posterior variances where it shows best, from an exact solution for a few pixels.

    The pixels of the largest and the least variance, two more, and a sum over all of them with signs by chance, which
    is compared as a whole; infinite where no exact solution is to be had.
    """
    problem = form.problem
    with np.errstate(all="ignore"):
        variance = form.variance()
        if not np.isfinite(variance).all():
            return float("inf")
        count = problem.unknowns
        pixels = np.array([variance.argmin(), variance.argmax(), count // 3, 2 * count // 3])
        images = np.zeros((count, pixels.size + 1))
        images[pixels, np.arange(pixels.size)] = 1.0
        images[:, -1] = np.random.default_rng(0).choice([-1.0, 1.0], count)
        shift = problem.prior.gather(images)
        nothing = exact(np.zeros((problem.measurements, images.shape[1])))
        found = refine(form, exactly, shift, nothing)
        size = np.linalg.norm(found.freedoms, axis=0)
        right = np.einsum("kq,kq->q", shift, found.freedoms)[:-1]
        doubt = (np.linalg.norm(shift, axis=0) * size * found.bound)[:-1]
        wrong = np.abs(variance[pixels] - right) + doubt
        relative = np.divide(wrong, right, out=np.where(wrong > 0, np.inf, 0.0), where=right > 0)
    worst = max(float(relative.max()), float(found.first[-1]))
    return worst if isfinite(worst) else float("inf")


def _bound(
    form: Form,
    exactly: Exact,
    found: Pair,
    residuals: Pair,
    right: tuple[Matrix, Matrix],
    rate: Vector | None,
) -> Vector:
    """The bound of the module's text, relative to |u|; or a smaller one, where the factorisation earned belief.

    Belief: p has vanished beside c or u, so no direction was lost, and corrections contract. Then twice what the form
    makes of the residuals, and of their rounding, stands for the distance. Without noise there is no other bound.
    """
    problem = exactly.problem
    u, pull = found[0].high, found[1].high
    p, q = residuals[0].high, residuals[1].high
    p_doubt, q_doubt = exactly.doubts(u, pull, *right)
    size = np.linalg.norm(u, axis=0)
    p_size = np.linalg.norm(np.abs(p) + p_doubt, axis=0)
    if problem.noisy:
        rigorous = p_size + 0.5 * np.linalg.norm((np.abs(q) + q_doubt) / problem.deviation[:, None], axis=0)
    else:
        rigorous = np.where(p_size > 0, np.inf, 0.0)
    if rate is not None and not (rigorous <= ENOUGH * size).all():
        signs = np.random.default_rng(0)
        left, _ = form.solve(p, q)
        rounded, _ = form.solve(p_doubt * _signs(signs, p_doubt), q_doubt * _signs(signs, q_doubt))
        believed = 2 * (np.linalg.norm(left, axis=0) + np.linalg.norm(rounded, axis=0))
        earned = (p_size <= VANISHED * np.maximum(size, np.linalg.norm(right[0], axis=0))) & (rate <= CONTRACTION)
        rigorous = np.where(earned, np.fmin(believed, rigorous), rigorous)
    return _relative(rigorous, size)


def _relative(error: Vector, size: Vector) -> Vector:
    return np.divide(error, size, out=np.where(error > 0, np.inf, 0.0), where=size > 0)


def _signs(rng: np.random.Generator, like: Matrix) -> Matrix:
    return rng.choice([-1.0, 1.0], like.shape)


def _worst(bound: Vector) -> float:
    return float(np.nan_to_num(bound, nan=np.inf, posinf=np.inf).max(initial=0.0))
