"""The mixture of lens types of least error, and a bound on the error of every other.

With x_t arrays of the lens types t, whose windows stand one pixel of f apart, the expected error of a pixel far from
the edges (Eq. 5) is the mean over groups of waves (`bands`) of

    e(x) = a^T (P^-1 + sum_t x_t w_t b_t b_t^T)^-1 a,

a convex function of x >= 0. Let an array of type t take c_t readings per pixel of f, and a camera B of them. The steps

    x_t <- x_t (g_t / c_t)^1/2 B / sum_k c_k x_k (g_k / c_k)^1/2,   g_t = -de / dx_t,

never increase e (they minimise a majorant of it), and no mixture is better than e by more than

    B max_t g_t / c_t - sum_t x_t g_t

(the equivalence theorem of optimal design; Kiefer and Wolfowitz 1960), which tends to 0.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ommatid.reconstruct.frame.bands import Bands
from ommatid.runtime.arrays import FloatArray, IntArray

TIGHT = 1e-5  # gap relative to the error, at which the steps end
MOST_STEPS = 2000
PART = 0.01  # of an array, from which a lens type belongs to a mixture
MOST_ROUNDS = 50  # of exchanges


@dataclass(frozen=True)
class Evaluation:
    """The error of a mixture, g_t of every lens type, and the information that the readings hold, in bits per pixel."""

    error: float
    gains: FloatArray
    information: float


@dataclass(frozen=True)
class WaveGroups:
    """What each lens type tells of every group of waves.

    rows : (rows, groups, waves) (w_t P)^1/2 b_t;  pixels : (groups, waves) P^1/2 a;  owners : (rows,) lens types
    costs : (types,) readings per pixel of f of an array
    """

    rows: FloatArray
    pixels: FloatArray
    owners: IntArray
    costs: FloatArray

    @classmethod
    def of(cls, bands: Bands, costs: Sequence[float]) -> WaveGroups:
        """Take the groups of a camera that has one array of each lens type."""
        return cls(*bands.groups(), np.array(costs, dtype=np.float64))

    def evaluate(self, amounts: FloatArray) -> Evaluation:
        """Return the error with these amounts of the lens types, in arrays."""
        waves = self.pixels.shape[1]
        precision = np.tile(np.eye(waves), (len(self.pixels), 1, 1))
        for row, owner in zip(self.rows, self.owners, strict=True):
            if amounts[owner] > 0:
                precision += amounts[owner] * row[:, :, None] * row[:, None, :]
        seen = np.linalg.solve(precision, self.pixels[..., None])[..., 0]
        squares = np.square(np.einsum("rgm,gm->rg", self.rows, seen)).mean(axis=1)
        gains = np.zeros(self.costs.size)
        np.add.at(gains, self.owners, squares)
        _, logarithms = np.linalg.slogdet(precision)
        error = float(np.einsum("gm,gm->g", self.pixels, seen).mean())
        return Evaluation(error, gains, float(logarithms.mean() / np.log(4)))


@dataclass(frozen=True)
class Mixture:
    """Amounts of the lens types, in arrays, what they bring, and by how much another mixture may be better at most."""

    amounts: FloatArray
    found: Evaluation
    gap: float

    @property
    def error(self) -> float:
        """The expected error."""
        return self.found.error

    @property
    def bound(self) -> float:
        """An error that no mixture of these lens types with as many readings falls below."""
        return self.error - self.gap


def best_mixture(groups: WaveGroups, readings: float) -> Mixture:
    """Return the mixture of least error that takes so many readings per pixel of f."""
    costs = groups.costs
    mixture = _mixture(groups, readings, readings / costs / costs.size)
    for _ in range(MOST_STEPS):
        if mixture.gap <= TIGHT * mixture.error:
            break
        steps = mixture.amounts * np.sqrt(mixture.found.gains / costs)
        mixture = _mixture(groups, readings, steps * readings / float(costs @ steps))
    return mixture


def _mixture(groups: WaveGroups, readings: float, amounts: FloatArray) -> Mixture:
    found = groups.evaluate(amounts)
    gap = float(readings * (found.gains / groups.costs).max() - amounts @ found.gains)
    return Mixture(amounts, found, max(gap, 0.0))


@dataclass(frozen=True)
class WholeMixture:
    """Whole arrays of the lens types, and their error."""

    counts: tuple[int, ...]
    error: float
    information: float


def best_whole(groups: WaveGroups, readings: float, start: Mixture, most: int) -> list[WholeMixture]:
    """Return cameras of whole arrays with at most so many readings per pixel of f, the best of those met first.

    Whole parts of a mixture are completed array by array, then one array is exchanged for another as long as that
    helps; `most` : number of cameras
    """
    known: dict[tuple[int, ...], WholeMixture] = {}

    def error(counts: tuple[int, ...]) -> float:
        if counts not in known:
            found = groups.evaluate(np.array(counts, dtype=np.float64))
            known[counts] = WholeMixture(counts, found.error, found.information)
        return known[counts].error

    counts = tuple(int(part) for part in np.floor(start.amounts + PART))
    while larger := list(_more(counts, groups.costs, readings)):
        counts = min(larger, key=error)
    for _ in range(MOST_ROUNDS):
        best = min(_exchanged(counts, groups.costs, readings), key=error, default=counts)
        if not any(counts) or error(best) >= error(counts):
            break
        counts = best
    return sorted(known.values(), key=lambda each: each.error)[:most]


def _more(counts: tuple[int, ...], costs: FloatArray, readings: float) -> Iterator[tuple[int, ...]]:
    """Yield the mixtures of one array more."""
    for index in range(len(counts)):
        larger = tuple(count + (index == other) for other, count in enumerate(counts))
        if float(costs @ np.array(larger)) <= readings:
            yield larger


def _exchanged(counts: tuple[int, ...], costs: FloatArray, readings: float) -> Iterator[tuple[int, ...]]:
    """Yield the mixtures in which one array, or none, makes way for another."""
    yield from _more(counts, costs, readings)
    for index, count in enumerate(counts):
        if count:
            smaller = tuple(each - (index == other) for other, each in enumerate(counts))
            yield from (each for each in _more(smaller, costs, readings) if each != counts)
