"""The mixture of lens types of least error or most information, and a bound on every other mixture.

With x_t arrays of the lens types t, whose windows stand one pixel of f apart, the expected error of a pixel far from
the edges (Eq. 5) is the mean over groups of waves (`bands`) of

    e(x) = a^T (P^-1 + sum_t x_t w_t b_t b_t^T)^-1 a,

a convex function of x >= 0, as is minus the information of the readings, -1/2 log2 det(I + P sum_t x_t w_t b_t b_t^T).
Let an array of type t cost c_t, and a camera B (readings per pixel of f, or area of the sensor). The steps

    x_t <- x_t (g_t / c_t)^1/2 B / sum_k c_k x_k (g_k / c_k)^1/2,   g_t = -de / dx_t,

never increase either (Yu 2010, "Monotonic convergence of a general algorithm for computing optimal designs"); between
them the cost of the type of least g_t / c_t in the mixture goes to that of the largest of all, as far as this helps
(vertex exchange; Boehning 1986). No mixture is better than e by more than

    B max_t g_t / c_t - sum_t x_t g_t

(the equivalence theorem of optimal design; Kiefer and Wolfowitz 1960), which tends to 0.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ommatid.reconstruct.frame.bands import Bands
from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray

Goal = Literal["error", "information", "resolution"]
TIGHT = 1e-5  # gap relative to the value, at which the steps end
MOST_EXCHANGES = 400  # of costs between two lens types
STEPS = 6  # between two exchanges
PARTS = (1.0, 0.3, 0.1, 0.03, 0.01, 0.001)  # of a type's cost that an exchange tries to give away
LEAST = 1e-3  # of the largest amount, below which a lens type leaves a mixture
PART = 0.01  # of an array, from which a lens type belongs to a mixture
MOST_ROUNDS = 50  # of exchanges of whole arrays
TRIED = 8  # lens types that are evaluated for the place of one array


@dataclass(frozen=True)
class Evaluation:
    """What a mixture brings. value : what is minimised;  gains : g_t of every type;  error : squared, of a pixel"""

    value: float
    gains: FloatArray
    error: float


@dataclass(frozen=True)
class WaveGroups:
    """What each lens type tells of every group of waves.

    rows : (groups, rows, waves) (w_t P)^1/2 b_t;  owners : (rows,) lens types
    pixels : (groups, waves, sums) P^1/2 a, of one or several weighted sums whose errors are added
    costs : (types,) of an array;  shape : rows and columns of groups, whose waves of f have 0 to 1/2 periods per pixel
    goal : "resolution" is the part of the error in fine waves
    """

    rows: FloatArray
    pixels: FloatArray
    owners: IntArray
    costs: FloatArray
    shape: tuple[int, int]
    goal: Goal = "error"

    @classmethod
    def of(cls, bands: Bands, costs: Sequence[float], goal: Goal = "error") -> WaveGroups:
        """Take the groups of a camera that has one array of each lens type."""
        rows, pixels, owners = bands.groups()
        rows = np.ascontiguousarray(rows.transpose(1, 0, 2))
        return cls(rows, pixels[..., None], owners, np.array(costs, dtype=np.float64), bands.shape, goal)

    def only(self, kept: BoolArray) -> WaveGroups:
        """Return the groups with some of the lens types; kept : (types,)."""
        numbers, rows = np.cumsum(kept) - 1, kept[self.owners]
        return replace(self, rows=self.rows[:, rows], owners=numbers[self.owners[rows]], costs=self.costs[kept])

    def evaluate(self, amounts: FloatArray) -> Evaluation:
        """Return what these amounts of the lens types bring, in arrays."""
        precision = self._precision(amounts)
        seen = np.linalg.solve(precision, self.pixels)
        error = float(np.einsum("gmc,gmc->g", self.pixels, seen) @ self._counted) / len(self.pixels)
        if self.goal == "information":
            value = -_bits(precision)
            slopes = np.einsum("grm,gmr->gr", self.rows, np.linalg.solve(precision, self._columns)) / np.log(4)
        else:
            value = error
            slopes = np.square(self.rows @ seen).sum(axis=2) * self._counted[:, None]
        return Evaluation(value, self._by_type(slopes), error)

    def information(self, amounts: FloatArray) -> float:
        """Return the information that the readings hold, in bits per pixel of f."""
        return _bits(self._precision(amounts))

    def falls(self, amounts: FloatArray) -> FloatArray:
        """Return by how much one array more of each lens type lowers the value, (types,), by updates of rank one.

        Exact for lens types of one row; an upper bound for others, whose rows are taken one by one.
        """
        precision = self._precision(amounts)
        spread = np.linalg.solve(precision, self._columns)
        within = 1 + np.einsum("grm,gmr->gr", self.rows, spread)
        if self.goal == "information":
            falls = np.log(within) / np.log(4)
        else:
            falls = np.square(self.pixels.swapaxes(1, 2) @ spread).sum(axis=1) / within * self._counted[:, None]
        return self._by_type(falls)

    def errors(self, amounts: FloatArray) -> FloatArray:
        """Return the error of each wave of f, whose mean is that of a pixel: (rows, columns)."""
        seen = np.linalg.solve(self._precision(amounts), self.pixels)
        return np.einsum("gmc,gmc->g", self.pixels, seen).reshape(self.shape)

    def _by_type(self, values: FloatArray) -> FloatArray:
        """Return means over the groups, summed over the rows of each lens type: (groups, rows) to (types,)."""
        return np.bincount(self.owners, values.mean(axis=0), self.costs.size).astype(np.float64)

    @property
    def _counted(self) -> FloatArray:
        """1 for groups whose error counts, 0 for others: (groups,)."""
        if self.goal != "resolution":
            return np.ones(len(self.pixels))
        down, across = (2 * np.arange(size) >= size for size in self.shape)
        return (down[:, None] | across).ravel().astype(np.float64)

    @property
    def _columns(self) -> FloatArray:
        return self.rows.swapaxes(1, 2)

    def _precision(self, amounts: FloatArray) -> FloatArray:
        """Return I + sum_t x_t w_t P^1/2 b_t b_t^T P^1/2 of every group: (groups, waves, waves)."""
        each = amounts[self.owners]
        taken = self.rows[:, each > 0] * np.sqrt(each[each > 0])[:, None]
        return np.eye(self.pixels.shape[1]) + taken.swapaxes(1, 2) @ taken


def _bits(precision: FloatArray) -> float:
    _, logarithms = np.linalg.slogdet(precision)
    return float(logarithms.mean() / np.log(4))


@dataclass(frozen=True)
class Mixture:
    """Amounts of the lens types, in arrays, what they bring, and by how much another mixture may be better at most."""

    amounts: FloatArray
    found: Evaluation
    gap: float

    @property
    def bound(self) -> float:
        """A value that no mixture of these lens types of the same cost falls below."""
        return self.found.value - self.gap


def best_mixture(groups: WaveGroups, budget: float, tight: float = TIGHT, most: int = MOST_EXCHANGES) -> Mixture:
    """Return the mixture of least value that costs so much.

    tight : gap relative to the value, at which the steps end;  most : number of exchanges, after which they end, too
    """
    costs = groups.costs
    mixture = _mixture(groups, budget, budget / costs / costs.size)
    bound = mixture.bound
    if not mixture.found.gains.any():
        return mixture  # no reading tells anything, as where all are saturated
    for number in range(most + 1):
        for _ in range(STEPS):
            steps = mixture.amounts * np.sqrt(mixture.found.gains / costs)
            steps[steps < LEAST * steps.max()] = 0.0  # exchanges bring back what was needed
            mixture = _mixture(groups, budget, steps * budget / float(costs @ steps))
            bound = max(bound, mixture.bound)
        if mixture.found.value - bound <= tight * abs(mixture.found.value):
            break
        if number < most:
            mixture = _exchange(groups, budget, mixture)
            bound = max(bound, mixture.bound)
    return replace(mixture, gap=mixture.found.value - bound)


def _exchange(groups: WaveGroups, budget: float, mixture: Mixture) -> Mixture:
    """Return the mixture after the exchange of cost between two lens types, as much of it as helps."""
    slopes = mixture.found.gains / groups.costs
    held = np.flatnonzero(mixture.amounts)
    worst, best = int(held[slopes[held].argmin()]), int(slopes.argmax())
    if worst == best:
        return mixture
    for part in PARTS:
        amounts, moved = mixture.amounts.copy(), part * mixture.amounts[worst]
        amounts[worst] -= moved
        amounts[best] += moved * groups.costs[worst] / groups.costs[best]
        tried = _mixture(groups, budget, amounts)
        if tried.found.value < mixture.found.value:
            return tried
    return mixture


def _mixture(groups: WaveGroups, budget: float, amounts: FloatArray) -> Mixture:
    found = groups.evaluate(amounts)
    gap = float(budget * (found.gains / groups.costs).max() - amounts @ found.gains)
    return Mixture(amounts, found, max(gap, 0.0))


@dataclass(frozen=True)
class WholeMixture:
    """Whole arrays of the lens types, and what they bring."""

    counts: tuple[int, ...]
    found: Evaluation


Fits = Callable[[tuple[int, ...]], bool]


def best_whole(groups: WaveGroups, budget: float, start: Mixture, most: int, fits: Fits) -> list[WholeMixture]:
    """Return cameras of whole arrays of at most this cost, the best of those met first.

    Whole parts of a mixture are completed array by array, then one array is exchanged for another as long as that
    helps; `most` : number of cameras;  fits : True for numbers of arrays that a camera can have
    """
    known: dict[tuple[int, ...], WholeMixture] = {}

    def value(counts: tuple[int, ...]) -> float:
        if counts not in known:
            known[counts] = WholeMixture(counts, groups.evaluate(np.array(counts, dtype=np.float64)))
        return known[counts].found.value

    counts = tuple(int(part) for part in np.floor(start.amounts))
    if not fits(counts):
        counts = tuple(0 for _ in counts)
    while larger := list(_more(groups, counts, budget, fits)):
        counts = min(larger, key=value)
    for _ in range(MOST_ROUNDS):
        best = min(_exchanged(groups, counts, budget, fits), key=value, default=counts)
        if not any(counts) or value(best) >= value(counts):
            break
        counts = best
    return sorted(known.values(), key=lambda each: each.found.value)[:most]


def _more(groups: WaveGroups, counts: tuple[int, ...], budget: float, fits: Fits) -> Iterator[tuple[int, ...]]:
    """Yield the mixtures of one array more, of which a first estimate expects most."""
    amounts, found = np.array(counts, dtype=np.float64), 0
    for index in np.argsort(-groups.falls(amounts), kind="stable").tolist():
        larger = tuple(count + (index == other) for other, count in enumerate(counts))
        if float(groups.costs @ np.array(larger)) <= budget and fits(larger):
            yield larger
            found += 1
            if found == TRIED:
                return


def _exchanged(groups: WaveGroups, counts: tuple[int, ...], budget: float, fits: Fits) -> Iterator[tuple[int, ...]]:
    """Yield the mixtures in which one array, or none, makes way for another."""
    yield from _more(groups, counts, budget, fits)
    for index, count in enumerate(counts):
        if count:
            smaller = tuple(each - (index == other) for other, each in enumerate(counts))
            yield from (each for each in _more(groups, smaller, budget, fits) if each != counts)
