"""Iterative refinement of an estimate, and bounds on its error that do not rely on the factorisation.

The exact u minimises |S^-1 (r - H L u)|^2 + |u - c|^2, which grows at least as the squared distance from its minimum.
So for any u and l with the residuals p and q (`residuals`), the distance is at most |p| + |S^-1 q| / 2. Solving for the
same residuals corrects the estimate, until the bound no longer decreases. Distances are in u, that is, in prior
standard deviations.

If a measurement has no noise, S is singular, and if prior and noise differ by far more than 30 decades, the bound is
dominated by the rounding error of p. Then the distance is estimated with the form itself, times 2. A form is trusted
with that only if it reproduces a random u and l to four digits; a form that loses a direction of the prior or of the
measurements does not.

The root L of a correlated prior is taken as exact. With the error E of L L^T as an approximation of P0, to first order,

    df = (I - A H) E H^T l,    dV_i = ((I - A H) E (I - A H)^T)_ii,

where |E_ij| is some epsilon of the prior's standard deviations, with signs drawn at random. It matters where P0 is
nearly singular: pixels that are correlated over a million pixels differ by less than the rounding of their variance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import Purpose, probe

from ..problem import Form
from .residuals import DoubleDouble, ExactResiduals, column_dots, exact

Indices = NDArray[np.intp]
Residuals = tuple[FloatArray, FloatArray]
Solution = tuple[DoubleDouble, DoubleDouble]

ALL_CHECKED = 128  # pixels, up to which every variance is checked
SAMPLE = 16  # pixels checked beyond that
LEAST_FLOAT = 2.0**-1074  # the smallest float64 above 0
NEGLIGIBLE_VARIANCE = 1e-28  # relative to the prior variance: smaller posterior variances count as 0
MAX_REFINEMENTS = 12
MAX_STALLED = 4  # refinements in a row that do not halve the bound
EPS = float(np.finfo(np.float64).eps)
CONVERGED = 1e-15  # relative bound; the precision of float64
REPRODUCTION_TOLERANCE = 1e-4  # relative error of a known u, above which a form is not trusted to estimate errors
PROBES = 3
SIGN_DRAWS = 6  # for noise-free measurements: a single draw may by chance agree with a contradiction
REPRODUCTION_STEPS = 4  # solutions after which measurements without noise must be met
ROUNDING_MARGIN = 1e4  # times the rounding of double-double arithmetic: some 1e-26 of the values
SAFETY = 10  # for variances, which are checked on a sample and added up by expected errors
DRAWS = 4
MARGIN = 2.0  # times the standard deviation of dV_i


def sampled_pixels(variance: FloatArray, prior: FloatArray) -> Indices:
    """Return the pixels whose variances are checked: those of extreme variance, and random others."""
    if variance.size <= ALL_CHECKED:
        return np.arange(variance.size)
    ratio = np.divide(variance, prior, out=np.ones_like(variance), where=prior > 0)
    extremes = [variance.argmin(), variance.argmax(), ratio.argmin(), ratio.argmax()]
    others = probe(Purpose.CHECKED_PIXELS).choice(variance.size, SAMPLE - len(extremes), replace=False)
    return np.concatenate([extremes, others])


def norms(values: FloatArray) -> FloatArray:
    """The 2-norm of every column, without overflow: (q,)."""
    largest = np.abs(values).max(axis=0, initial=0.0)
    scale = np.where((largest > 0) & np.isfinite(largest), largest, 1.0)
    return scale * np.linalg.norm(values / scale, axis=0)


def infinite(pairs: tuple[Residuals, Residuals]) -> FloatArray:
    """Infinity for every column with a value other than 0, else 0: (q,)."""
    return np.where(np.any([part.any(axis=0) for pair in pairs for part in pair], axis=0), np.inf, 0.0)


def relative(error: FloatArray, size: FloatArray) -> FloatArray:
    """Return error / size, 0 where both are 0."""
    return np.divide(error, size, out=np.where(error == 0, 0.0, np.inf), where=size > 0)  # NaN is not 0


def worst(bound: FloatArray) -> float:
    """Return the largest bound; NaN counts as infinite."""
    return float(np.nan_to_num(bound, nan=np.inf, posinf=np.inf).max(initial=0.0))


def last_digit(variance: FloatArray) -> float:
    """Return the smallest float64 relative to the least variance above 0."""
    least = float(variance[variance > 0].min(initial=np.inf))
    return LEAST_FLOAT / least


@dataclass(frozen=True)
class RefinedSolution:
    """The refined u, (K, q), and l, (M, q), with relative error bounds: (q,) `bound`, and `first` before refinement.

    low : (K, q), digits of u beyond those of float64
    """

    coefficients: FloatArray
    low: FloatArray
    multipliers: FloatArray
    bound: FloatArray
    first: FloatArray
    steps: int


def refine(
    form: Form, residuals: ExactResiduals, shift: DoubleDouble, recorded: DoubleDouble | None = None
) -> RefinedSolution:
    """Solve for c = `shift`, (K, q), and r = `recorded`, (M, q) or 0, with refinement; keep that of least bound."""
    with np.errstate(all="ignore"):  # overflow gives a bound that fails every tolerance
        certifier = _Certifier(form, residuals, shift, recorded or _no_data(form, shift))
        (u, multipliers), bound, first, steps = certifier.refined()
        change = relative(norms(u.high - first), norms(u.high))
    return RefinedSolution(u.high, u.low, multipliers.high, bound, change + bound, steps)


def _no_data(form: Form, shift: DoubleDouble) -> DoubleDouble:
    """Return r = 0, (M, q), for c = `shift`, (K, q)."""
    return exact(np.zeros((form.problem.measurements, shift.high.shape[1])))


def exact_sums(form: Form, residuals: ExactResiduals, shift: DoubleDouble) -> tuple[FloatArray, FloatArray]:
    """Return accurate posterior variances of sums of pixels and bounds on their errors: (n,) each.

    shift : (K, n), c = L^T w of the weights w of each. With r = 0 they are c u + u p - l q up to a term of second order
    in p and q, |M^-1/2 (p, q)|^2.
    """
    with np.errstate(all="ignore"):
        certifier = _Certifier(form, residuals, shift, _no_data(form, shift))
        (u, multipliers), *_ = certifier.refined()
        return certifier.quadratic_form(u, multipliers)


def variance_error(form: Form, residuals: ExactResiduals) -> float:
    """Return the relative error of the posterior variances, times 10, against accurate ones of sampled pixels.

    The sample has the pixels of largest and least variance, absolute and relative to the prior's, and random others; a
    sum over all pixels with random signs is checked in addition. Infinite if no accurate variances are available.
    """
    prior, count = form.problem.prior, form.problem.unknowns
    with np.errstate(all="ignore"):
        variance = form.variance()
        if not np.isfinite(variance).all():
            return float("inf")
        pixels = sampled_pixels(variance, prior.variance)
        accurate, uncertainty = exact_sums(form, residuals, exact(form.problem.pixel_shift(pixels)))
        # A variance of 0 is right if the accurate one cannot be distinguished from 0.
        negligible = uncertainty <= NEGLIGIBLE_VARIANCE * prior.variance[pixels]
        zero = (variance[pixels] == 0) & (accurate <= uncertainty) & negligible
        error = np.where(zero, 0.0, np.abs(variance[pixels] - accurate) + uncertainty)
        largest = worst(relative(error, accurate))
        if count > ALL_CHECKED:
            signs = probe(Purpose.VARIANCE_SIGNS).choice([-1.0, 1.0], (count, 1))
            shift = exact(prior.apply_root_transposed(signs))
            largest = max(largest, worst(refine(form, residuals, shift).first))
    return SAFETY * largest + last_digit(variance)


@dataclass(frozen=True)
class _Certifier:
    """Refines the solution of a form for c = `shift` and r = `recorded` and bounds its distance from the exact u."""

    form: Form
    system: ExactResiduals
    shift: DoubleDouble
    recorded: DoubleDouble

    def refined(self) -> tuple[Solution, FloatArray, FloatArray, int]:
        """Return the best u and l, the bound on u, the first u, and the number of refinements."""
        first, multiplier = self.form.solve(self.shift.high, self.recorded.high)
        solution: Solution = exact(first), exact(multiplier)
        residuals, bound, estimated = self.residuals_and_bounds(solution)
        best: tuple[Solution, FloatArray] = solution, bound
        steps, stalled = 0, 0
        while steps < MAX_REFINEMENTS and stalled < MAX_STALLED and not (best[1] <= CONVERGED).all():
            solution = self._corrected(solution, (residuals[0].high, residuals[1].high))
            before = estimated
            residuals, bound, estimated = self.residuals_and_bounds(solution)
            # An estimate may be small by chance; it counts as much as the one before.
            confirmed: FloatArray = np.fmin(bound, np.maximum(estimated, before))
            steps += 1
            stalled = 0 if worst(confirmed) < 0.5 * worst(best[1]) else stalled + 1
            if worst(confirmed) < worst(best[1]):
                best = solution, confirmed
        return best[0], best[1], first, steps

    def _corrected(self, solution: Solution, residuals: Residuals) -> Solution:
        change, step = self.form.solve(*residuals)
        return solution[0] + exact(change), solution[1] + exact(step)

    def residuals_and_bounds(self, solution: Solution) -> tuple[Solution, FloatArray, FloatArray]:
        """Return the residuals of u and l, a certain bound on the error of u relative to |u|, and an estimated one."""
        u, multipliers = solution
        residuals = self.system.residuals(u, multipliers, self.shift, self.recorded)
        values = residuals[0].high, residuals[1].high
        rounding = self.system.rounding_errors(u.high, multipliers.high, self.shift.high, self.recorded.high)
        bound, size = self._rigorous_distance(values, rounding), norms(u.high)
        distance = bound
        if not (bound <= CONVERGED * size).all() and self.trusted[1]:
            distance = np.fmin(bound, self._estimated_distance(values, rounding)[0])
        if not self.system.problem.noisy:
            noise_free = self._noise_free(values), self._noise_free(self._contradictions(values, rounding))
            trusted = self.trusted[0]
            distance = distance + (
                self._estimated_distance(*noise_free, SIGN_DRAWS)[0] if trusted else infinite(noise_free)
            )
            bound = np.full(size.shape, np.inf)
        return residuals, relative(bound, size), relative(distance, size)

    def _contradictions(self, residuals: Residuals, rounding: Residuals) -> Residuals:
        """Uncertainties of noise-free measurements that contradict one another.

        Each is as uncertain, relative to its size, as the worst of them, and at least as uncertain as a float64.
        """
        noise_free = (self.system.problem.noise_variance == 0)[:, None]
        misfit, error = np.abs(residuals[1]), rounding[1]
        ratio = np.divide(misfit, error, out=np.zeros_like(misfit), where=noise_free & (error > 0))
        ratio = ratio.max(axis=0, initial=0.0)
        least = np.inf if self._hides_dependence else EPS / self.system.rounding
        ratio = np.where(ratio > ROUNDING_MARGIN, np.maximum(ratio, least), 1.0)
        return rounding[0], np.multiply(ratio, error, out=np.zeros_like(error), where=error > 0)

    @property
    def _hides_dependence(self) -> bool:
        """True of a root that is dense and counts as exact.

        Through its own rounding, rows that differ by theirs differ by the square of that: by less than double-double
        shows. Whether such rows contradict one another or determine the image then remains unknown.
        """
        prior = self.system.problem.prior
        return not prior.independent and not prior.rounding

    def quadratic_form(self, u: DoubleDouble, multipliers: DoubleDouble) -> tuple[FloatArray, FloatArray]:
        """Return c u + u p - l q and a bound on its distance from c u of the exact u: (q,) each, for r = 0."""
        p, q = self.system.residuals(u, multipliers, self.shift, self.recorded)
        errors = self.system.rounding_errors(u.high, multipliers.high, self.shift.high, self.recorded.high)
        shifted = column_dots(self.shift.high, u) + column_dots(self.shift.low, u)
        value = (shifted + column_dots(u.high, p) - column_dots(multipliers.high, q)).high
        residuals = p.high, q.high
        second = self._rigorous_distance(residuals, errors)
        if not self.system.problem.noisy:
            noise_free = self._noise_free(residuals), self._noise_free(errors)
            second += np.sqrt(self._estimated_distance(*noise_free)[1]) if self.trusted[0] else infinite(noise_free)
        second = 4 * second**2
        if self.trusted[1]:
            second = np.fmin(second, self._estimated_distance(residuals, errors)[1])
        first = np.sum(np.abs(u.high) * errors[0], axis=0) + np.sum(np.abs(multipliers.high) * errors[1], axis=0)
        rounding = self.system.rounding * np.sum(np.abs(self.shift.high * u.high), axis=0)
        return value, first + second + rounding

    def _rigorous_distance(self, residuals: Residuals, rounding: Residuals) -> FloatArray:
        """|p| + |S^-1 q| / 2 over the measurements with noise: (q,)."""
        noisy = self.system.problem.noise_variance > 0
        white = (np.abs(residuals[1]) + rounding[1])[noisy] / self.system.problem.deviation[noisy, None]
        return norms(np.abs(residuals[0]) + rounding[0]) + 0.5 * norms(white)

    def _noise_free(self, residuals: Residuals) -> Residuals:
        """The part q of measurements without noise; everything else is 0."""
        noisy = self.system.problem.noise_variance > 0
        return np.zeros_like(residuals[0]), np.where(noisy[:, None], 0.0, residuals[1])

    def _estimated_distance(
        self, residuals: Residuals, rounding: Residuals, draws: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Twice the solution for the residuals and their rounding errors with random signs: |u|, and u p - l q."""
        rng = probe(Purpose.ROUNDING_SIGNS)
        signs = [[rng.choice([-1.0, 1.0], part.shape) for part in rounding] for _ in range(draws)]
        sides = [residuals, *((rounding[0] * p, rounding[1] * q) for p, q in signs)]
        solved = [(self.form.solve(p, q), p, q) for p, q in sides]
        distances = [norms(u) for (u, _), _, _ in solved]
        energies = [np.abs(np.sum(u * p, axis=0)) + np.abs(np.sum(pull * q, axis=0)) for (u, pull), p, q in solved]
        return 2 * (distances[0] + np.max(distances[1:], axis=0)), 4 * (energies[0] + np.max(energies[1:], axis=0))

    @cached_property
    def trusted(self) -> tuple[bool, bool]:
        """True if the form reproduces a random u and l: with l in noise-free measurements only; with l in all."""
        problem, rng = self.system.problem, probe(Purpose.REPRODUCTION)
        u = exact(rng.normal(size=(problem.prior.dimension, 2 * PROBES)))
        noisy = problem.noise_variance > 0
        scale = np.where(noisy, problem.deviation, self.system.signal)[:, None]
        white = rng.normal(size=(problem.measurements, 2 * PROBES))
        white[noisy, :PROBES] = 0.0
        multipliers = exact(np.divide(white, scale, out=np.zeros_like(white), where=scale > 0))
        zero = exact(np.zeros_like(u.high)), exact(np.zeros_like(white))
        p, q = self.system.residuals(u, multipliers, *zero)  # minus the right-hand sides that u and l solve exactly
        solution = self.form.solve(-p.high, -q.high)[0] + self.form.solve(-p.low, -q.low)[0]
        error = np.nan_to_num(relative(norms(solution - u.high), norms(u.high)), nan=np.inf)
        met = bool(noisy.all()) or self._meets_noise_free(u.high[:, :PROBES])
        right = error <= REPRODUCTION_TOLERANCE
        return met and bool(right[:PROBES].all()), met and bool(right.all())

    def _meets_noise_free(self, u: FloatArray) -> bool:
        """True if refinement meets noise-free measurements to ROUNDING_MARGIN times the rounding error.

        With c = u they record 0 first, then what H L u' gives for another u', while those with noise record anything: a
        form that drops one of two nearly equal rows for one with noise meets 0 with both, and not this.
        """
        other = probe(Purpose.NOISE_FREE)
        zero = np.zeros((self.system.problem.measurements, u.shape[1]))
        seen = self.system.forward(exact(other.normal(size=u.shape)))
        signal = np.where(self.system.problem.noise_variance > 0, self.system.signal, 0.0)
        seen = seen + exact(signal[:, None] * other.normal(size=zero.shape))
        shift = np.hstack([u, u])
        right = DoubleDouble(np.hstack([zero, seen.high]), np.hstack([zero, seen.low]))
        solution: Solution = exact(np.zeros_like(shift)), exact(np.zeros_like(right.high))
        values: Residuals = shift, right.high
        for _ in range(REPRODUCTION_STEPS):
            solution = self._corrected(solution, values)
            coefficients, multipliers = self.system.residuals(solution[0], solution[1], exact(shift), right)
            values = coefficients.high, multipliers.high
        size = np.maximum(np.abs(solution[0].high), np.abs(shift))  # where rows determine u to be 0, q has no size
        rounding = self.system.rounding_errors(size, solution[1].high, shift, right.high)[1]
        noise_free = self.system.problem.noise_variance == 0
        return bool((np.abs(values[1]) <= ROUNDING_MARGIN * rounding)[noise_free].all())


def estimate_rounding(form: Form, u: FloatArray, multipliers: FloatArray) -> float:
    """Return |df| in standard deviations of the prior, relative to |u|; u : (K,), multipliers : (M,)."""
    problem = form.problem
    deviation = np.sqrt(problem.prior.variance)
    if not problem.prior.rounding or not u.any():
        return 0.0
    with np.errstate(all="ignore"):
        pull = float(norms((deviation * (problem.matrix.T @ multipliers))[:, None])[0])
        signs = probe(Purpose.PRIOR_ROUNDING).choice([-1.0, 1.0], (problem.unknowns, DRAWS))
        change = problem.prior.rounding * pull * deviation[:, None] * signs
        change -= form.gain(problem.matrix @ change)
        whitened = np.divide(change, deviation[:, None], out=np.zeros_like(change), where=deviation[:, None] > 0)
        return float(norms(whitened).max() / norms(u[:, None])[0])


def variance_rounding(form: Form) -> float:
    """Return the largest dV_i / V_i of a sample of pixels."""
    problem = form.problem
    if not problem.prior.rounding:
        return 0.0
    variance = form.variance()
    pixels = sampled_pixels(variance, problem.prior.variance)
    pixels = pixels[variance[pixels] > 0]
    with np.errstate(all="ignore"):
        _, negative = form.pixel_solutions(pixels)
        unresolved = problem.matrix.T @ negative
        unresolved[pixels, np.arange(pixels.size)] += 1.0
        squares = problem.prior.variance @ np.square(unresolved)
        return float((MARGIN * problem.prior.rounding * squares / variance[pixels]).max(initial=0.0))
