"""How far a computed estimate is from the exact one, at most: refinement, and a bound that asks no factorisation.

The exact u is where |S^-1 (r - H L u)|^2 + |u - c|^2 is least, a function that rises at least as fast as the square of
the distance from there. So for any u and l, with the residuals p and q (`residuals`), the distance is at most
|p| + |S^-1 q| / 2, whoever computed them. The same residuals, solved for, correct the estimate until the bound no
longer falls. Distances are in u, that is in standard deviations of the prior.

Where a measurement has no noise S has no inverse, and where prior and noise are far more than 30 decades apart the
bound drowns in the rounding of p. Then the form that solved is asked how far off u is, twice that is taken, and only
if it gives back to four digits a u and l that were chosen by chance: what loses a direction, of the prior's or of the
measurements', does not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..forms.form import Form
from .double_double import DoubleDouble, dots, exact
from .residuals import ExactResiduals

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]
Indices = NDArray[np.intp]
Pair = tuple[DoubleDouble, DoubleDouble]
Parts = tuple[Matrix, Matrix]

MOST_REFINEMENTS = 12
MOST_STALLED = 4  # refinements that do not halve the bound
EPS = float(np.finfo(np.float64).eps)
ENOUGH = 1e-15  # relative: float64 holds no more
GIVEN_BACK = 1e-4  # relative error of a known u, above which a form is not believed about errors
PROBES = 3
DRAWS = 6  # of signs for what contradicts: the few rows of a contradiction may all be met by chance
MEETINGS = 4  # solutions after which measurements without noise must be met
FAR_BELOW = 1e4  # times the rounding of twice the precision: some 1e-26 of the values
SAFETY = 10  # for variances, of which not all are checked and which expected errors add up
FEW = 128  # pixels up to which every variance is checked
SAMPLE = 16  # pixels beyond that
NOTHING = 1e-28  # of the prior's variance: a posterior variance below, in twice the precision, is 0


@dataclass(frozen=True)
class RefinedSolution:
    """u, (K, q), as good as it gets, the relative `bound` of its error and that of the `first` u: (q,) each."""

    freedoms: Matrix
    multipliers: Matrix
    bound: Vector
    first: Vector
    steps: int


def refine(form: Form, exactly: ExactResiduals, shift: Matrix, recorded: DoubleDouble) -> RefinedSolution:
    """Solve for c = `shift`, (K, q), and r = `recorded`, (M, q), and correct; what has the least bound is kept."""
    with np.errstate(all="ignore"):  # what overflows makes a bound that no tolerance admits
        found, bound, first, steps = _Certifier(form, exactly, shift, recorded).corrected()
        away = _relative(_norms(found[0].high - first), _norms(found[0].high))
    return RefinedSolution(found[0].high, found[1].high, bound, away + bound, steps)


def exact_variances(form: Form, exactly: ExactResiduals, pixels: Indices) -> tuple[Vector, Vector]:
    """Posterior variances of some pixels, whatever the form lost, and how far they may be off: (n,) each.

    With c = L^T e_i and r = 0 they are c u + u p - l q but for a term of second order in p and q, |M^-1/2 (p, q)|^2.
    """
    images = np.zeros((form.problem.unknowns, pixels.size))
    images[pixels, np.arange(pixels.size)] = 1.0
    shift = form.problem.prior.gather(images)
    with np.errstate(all="ignore"):
        judge = _Certifier(form, exactly, shift, exact(np.zeros((form.problem.measurements, pixels.size))))
        (u, pull), *_ = judge.corrected()
        return judge.form_of_second_order(u, pull)


def variance_error(form: Form, exactly: ExactResiduals) -> float:
    """Relative error of the posterior variances, times 10, from exact ones for every pixel, or for some of very many.

    Of many pixels those of the largest and the least variance, in itself and beside the prior's, others by chance, and
    a sum over all of them with signs by chance, whose solution is compared as a whole.
    Infinite where no exact variances are to be had.
    """
    prior, count = form.problem.prior, form.problem.unknowns
    with np.errstate(all="ignore"):
        variance = form.variance()
        if not np.isfinite(variance).all():
            return float("inf")
        pixels = _chosen(variance, prior.variance)
        right, doubt = exact_variances(form, exactly, pixels)
        # Where neither knows better than 0, 0 it is.
        zero = (variance[pixels] == 0) & (right <= doubt) & (doubt <= NOTHING * prior.variance[pixels])
        wrong = np.where(zero, 0.0, np.abs(variance[pixels] - right) + doubt)
        worst = _worst(_relative(wrong, right))
        if count > FEW:
            signs = np.random.default_rng(0).choice([-1.0, 1.0], (count, 1))
            nothing = exact(np.zeros((form.problem.measurements, 1)))
            worst = max(worst, _worst(refine(form, exactly, prior.gather(signs), nothing).first))
    return SAFETY * worst


@dataclass(frozen=True)
class _Certifier:
    """A form that solves for c = `shift` and r = `recorded`, and how far what it finds is from the exact u."""

    form: Form
    exactly: ExactResiduals
    shift: Matrix
    recorded: DoubleDouble

    def corrected(self) -> tuple[Pair, Vector, Matrix, int]:
        """The best u and l, the bound of u, the u found at first, and how many corrections were made."""
        first, multiplier = self.form.solve(self.shift, self.recorded.high)
        found: Pair = exact(first), exact(multiplier)
        residuals, bound = self.judged(found)
        best, steps, stalled = (found, bound), 0, 0
        while steps < MOST_REFINEMENTS and stalled < MOST_STALLED and not (bound <= ENOUGH).all():
            change, step = self.form.solve(residuals[0].high, residuals[1].high)
            found = found[0] + exact(change), found[1] + exact(step)
            residuals, bound = self.judged(found)
            steps += 1
            stalled = 0 if _worst(bound) < 0.5 * _worst(best[1]) else stalled + 1
            if _worst(bound) < _worst(best[1]):
                best = found, bound
        return *best, first, steps

    def judged(self, found: Pair) -> tuple[Pair, Vector]:
        """The residuals of u and l, and the bound of the module's text, relative to |u|: (q,)."""
        residuals = self.exactly.residuals(found[0], found[1], exact(self.shift), self.recorded)
        parts = residuals[0].high, residuals[1].high
        doubts = self.exactly.doubts(found[0].high, found[1].high, self.shift, self.recorded.high)
        distance, size = self._rigorous(parts, doubts), _norms(found[0].high)
        if not (distance <= ENOUGH * size).all() and self.trusted[1]:
            distance = np.fmin(distance, self._believed(parts, doubts)[0])
        if not self.exactly.problem.noisy:
            silent = self._silent(parts), self._silent(self._contradictions(parts, doubts))
            distance += self._believed(*silent, draws=DRAWS)[0] if self.trusted[0] else _infinite(silent)
        return residuals, _relative(distance, size)

    def _contradictions(self, residuals: Parts, doubts: Parts) -> Parts:
        """Doubts of measurements without noise that contradict one another, with whatever weights that is shared out.

        Every one is as doubtful, in proportion to its size, as the worst of them, and no less than a float64 is.
        """
        silent = (self.exactly.problem.noise_variance == 0)[:, None]
        left, doubt = np.abs(residuals[1]), doubts[1]
        share = np.divide(left, doubt, out=np.zeros_like(left), where=silent & (doubt > 0)).max(axis=0, initial=0.0)
        share = np.where(share > FAR_BELOW, np.maximum(share, EPS / self.exactly.rounding), 1.0)
        return doubts[0], share * doubt

    def form_of_second_order(self, u: DoubleDouble, pull: DoubleDouble) -> tuple[Vector, Vector]:
        """c u + u p - l q, and how far that may be from c u of the exact u: (q,) each, for r = 0."""
        p, q = self.exactly.residuals(u, pull, exact(self.shift), self.recorded)
        doubts = self.exactly.doubts(u.high, pull.high, self.shift, self.recorded.high)
        value = (dots(self.shift, u) + dots(u.high, p) - dots(pull.high, q)).high
        parts = p.high, q.high
        second = self._rigorous(parts, doubts)
        if not self.exactly.problem.noisy:
            silent = self._silent(parts), self._silent(doubts)
            second += np.sqrt(self._believed(*silent)[1]) if self.trusted[0] else _infinite(silent)
        second = 4 * second**2
        if self.trusted[1]:
            second = np.fmin(second, self._believed(parts, doubts)[1])
        first = np.sum(np.abs(u.high) * doubts[0], axis=0) + np.sum(np.abs(pull.high) * doubts[1], axis=0)
        rounding = self.exactly.rounding * np.sum(np.abs(self.shift * u.high), axis=0)
        return value, first + second + rounding

    def _rigorous(self, residuals: Parts, doubts: Parts) -> Vector:
        """|p| + |S^-1 q| / 2 over the measurements with noise."""
        noisy = self.exactly.problem.noise_variance > 0
        white = (np.abs(residuals[1]) + doubts[1])[noisy] / self.exactly.problem.deviation[noisy, None]
        return _norms(np.abs(residuals[0]) + doubts[0]) + 0.5 * _norms(white)

    def _silent(self, parts: Parts) -> Parts:
        """q of the measurements without noise alone."""
        noisy = self.exactly.problem.noise_variance > 0
        return np.zeros_like(parts[0]), np.where(noisy[:, None], 0.0, parts[1])

    def _believed(self, residuals: Parts, doubts: Parts, draws: int = 1) -> tuple[Vector, Vector]:
        """Twice what the form makes of residuals and of their rounding, with signs by chance: |u|, and u p - l q."""
        rng = np.random.default_rng(0)
        signs = [[rng.choice([-1.0, 1.0], part.shape) for part in doubts] for _ in range(draws)]
        parts = [residuals, *((doubts[0] * p, doubts[1] * q) for p, q in signs)]
        solved = [(self.form.solve(p, q), p, q) for p, q in parts]
        distances = [_norms(u) for (u, _), _, _ in solved]
        energies = [np.abs(np.sum(u * p, axis=0)) + np.abs(np.sum(pull * q, axis=0)) for (u, pull), p, q in solved]
        return 2 * (distances[0] + np.max(distances[1:], axis=0)), 4 * (energies[0] + np.max(energies[1:], axis=0))

    @cached_property
    def trusted(self) -> tuple[bool, bool]:
        """Whether the form gives back u and l by chance: with l in measurements without noise alone; in all of them."""
        problem, rng = self.exactly.problem, np.random.default_rng(1)
        u = exact(rng.normal(size=(problem.prior.freedoms, 2 * PROBES)))
        noisy = problem.noise_variance > 0
        scale = np.where(noisy, problem.deviation, self.exactly.signal)[:, None]
        white = rng.normal(size=(problem.measurements, 2 * PROBES))
        white[noisy, :PROBES] = 0.0
        pull = exact(np.divide(white, scale, out=np.zeros_like(white), where=scale > 0))
        nothing = exact(np.zeros_like(u.high)), exact(np.zeros_like(white))
        p, q = self.exactly.residuals(u, pull, *nothing)  # right sides whose exact solution is u and l, but for signs
        found = self.form.solve(-p.high, -q.high)[0] + self.form.solve(-p.low, -q.low)[0]
        error = np.nan_to_num(_relative(_norms(found - u.high), _norms(u.high)), nan=np.inf)
        met = bool(noisy.all()) or self._meets(u.high[:, :PROBES])
        return met and bool((error[:PROBES] <= GIVEN_BACK).all()), met and bool((error <= GIVEN_BACK).all())

    def _meets(self, shift: Matrix) -> bool:
        """Whether corrections meet r = 0 without noise, far below rounding; else what is dependent is arbitrary."""
        right = exact(shift), exact(np.zeros((self.exactly.problem.measurements, shift.shape[1])))
        found: Pair = exact(np.zeros_like(shift)), right[1]
        p, q = shift, right[1].high
        for _ in range(MEETINGS):
            change, step = self.form.solve(p, q)
            found = found[0] + exact(change), found[1] + exact(step)
            residuals = self.exactly.residuals(found[0], found[1], *right)
            p, q = residuals[0].high, residuals[1].high
        doubt = self.exactly.doubts(found[0].high, found[1].high, shift, right[1].high)[1]
        silent = self.exactly.problem.noise_variance == 0
        return bool((np.abs(q) <= FAR_BELOW * doubt)[silent].all())


def _chosen(variance: Vector, before: Vector) -> NDArray[np.intp]:
    """Pixels whose variances are checked."""
    if variance.size <= FEW:
        return np.arange(variance.size)
    share = np.divide(variance, before, out=np.ones_like(variance), where=before > 0)
    extremes = [variance.argmin(), variance.argmax(), share.argmin(), share.argmax()]
    others = np.random.default_rng(2).choice(variance.size, SAMPLE - len(extremes), replace=False)
    return np.concatenate([extremes, others])


def _norms(values: Matrix) -> Vector:
    """The 2-norm of every column, without overflow: (q,)."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    scale = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    return scale * np.linalg.norm(values / scale, axis=0)


def _infinite(pairs: tuple[Parts, Parts]) -> Vector:
    return np.where(np.any([part.any(axis=0) for pair in pairs for part in pair], axis=0), np.inf, 0.0)


def _relative(error: Vector, size: Vector) -> Vector:
    return np.divide(error, size, out=np.where(error == 0, 0.0, np.inf), where=size > 0)  # NaN is no zero


def _worst(bound: Vector) -> float:
    return float(np.nan_to_num(bound, nan=np.inf, posinf=np.inf).max(initial=0.0))
