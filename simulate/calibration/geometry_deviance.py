"""Deviance between measured entries of H and those of a geometry, and its minimisation.

The rays of a pixel are a draw from its row of H, so the measure is the multinomial deviance of all cells: the entries,
those that are zero included, and the light that misses the target. Each share, h measured and p of the model, is
raised by c, half a ray of them all,

    D = 2 n sum of (h + c) ln((h + c) / (p + c)) - (h - p),

whose mean slope is 0 at the true p. Its Gauss-Newton steps are least squares weighted by n / (p + c).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import SubImager

from .geometry_model import BLUR, FEW, WIDE, entries, scales

LEAST_BLUR = 0.05  # pixels of f; a smaller blur cannot be distinguished from none
STEPS, HALVINGS = 20, 8
SETTLED = 1e-5  # relative gain of deviance below which a fit has converged
NEAR = 0.01  # pixels of f within which derivatives are reused before convergence
DIFFERENCE = 1e-4  # pixels of f, of derivatives
PAIRS = 3  # of displacements, for derivatives of a blur that is not wide: they need not be as accurate as H


@dataclass(frozen=True)
class EntryTable:
    """Shares of light by cell: `keys` rise, pixel * (N + 1) + texel, texel N for the light that misses the target."""

    keys: IntArray
    values: FloatArray

    def at(self, keys: IntArray) -> FloatArray:
        """Return the shares of other cells, 0 where there is none."""
        index = np.minimum(np.searchsorted(self.keys, keys), self.keys.size - 1)
        return np.where(self.keys[index] == keys, self.values[index], 0.0)


def entry_table(matrix: sparse.csr_array) -> EntryTable:
    """Return the entries of some rows of H, and the part of each row that is missing to 1."""
    table = with_outside(matrix)
    return EntryTable(table.keys, np.maximum(table.values, 0.0))


def with_outside(matrix: sparse.csr_array, whole: float = 1.0) -> EntryTable:
    """Return the entries of some rows, (pixels, N), and the part of each row that is missing to `whole`."""
    pixels, texels = matrix.shape
    rows = np.repeat(np.arange(pixels), np.diff(matrix.indptr))
    keys = np.concatenate([rows * (texels + 1) + matrix.indices, np.arange(pixels) * (texels + 1) + texels])
    order = np.argsort(keys)
    values = np.concatenate([matrix.data, whole - matrix.sum(axis=1)]).astype(np.float64)
    return EntryTable(keys[order], values[order])


@dataclass(frozen=True)
class Derivatives:
    """Derivatives of shares by the free parameters at `where`: `jacobian`, (cells, free), of the cells `keys`."""

    where: FloatArray
    keys: IntArray
    jacobian: FloatArray

    def at(self, keys: IntArray) -> FloatArray:
        """Return those of other cells, 0 where there is none: (keys, free parameters)."""
        return np.column_stack([EntryTable(self.keys, column).at(keys) for column in self.jacobian.T])


class Deviance:
    """The deviance of one sub-imager as a function of its geometry, and its minimum."""

    def __init__(self, camera: Camera, sub: SubImager, measured: EntryTable, rays: int) -> None:
        """Create the deviance from entries that were measured with `rays` rays per pixel."""
        self.camera, self.sub, self.measured, self.rays = camera, sub, measured, rays
        self.least = 0.5 / rays
        self.scales = scales(camera, sub)

    def model(self, numbers: FloatArray, pairs: int | None = None) -> EntryTable:
        """Return the shares of a geometry. Raises InputError if the image folds."""
        return entry_table(entries(self.camera, self.sub, numbers, pairs))

    def ridge(self, free: BoolArray) -> FloatArray:
        """Return the information that fixes unobservable parameters to within a pixel of f of their start."""
        return np.diag(1 / np.square(self.scales[free]))

    def deviance(self, numbers: FloatArray, start: FloatArray) -> float:
        """Return D and the ridge; infinite if the image folds."""
        try:
            model = self.model(numbers)
        except InputError:
            return np.inf
        keys = np.union1d(self.measured.keys, model.keys)
        h, p = self.measured.at(keys) + self.least, model.at(keys) + self.least
        return float(
            2 * self.rays * (h * np.log(h / p) - (h - p)).sum() + np.square((numbers - start) / self.scales).sum()
        )

    def derivatives(self, numbers: FloatArray, free: BoolArray) -> Derivatives:
        """Return central differences by all free parameters."""
        pairs = PAIRS if numbers[BLUR] <= WIDE else FEW
        sides: list[tuple[EntryTable, EntryTable, float]] = []
        for number in np.flatnonzero(free):
            step = np.zeros_like(numbers)
            step[number] = DIFFERENCE * self.scales[number]
            ahead, behind = (self.model(numbers + sign * step, pairs) for sign in (1, -1))
            sides.append((ahead, behind, 2 * step[number]))
        keys = np.unique(np.concatenate([side.keys for ahead, behind, _ in sides for side in (ahead, behind)]))
        columns = [(ahead.at(keys) - behind.at(keys)) / step for ahead, behind, step in sides]
        return Derivatives(numbers, keys, np.column_stack(columns))

    def solve(self, candidates: list[FloatArray]) -> tuple[FloatArray, BoolArray, Derivatives]:
        """Return the parameters of least deviance, which of them are free, and the derivatives there."""
        deviances = [self.deviance(each, each) for each in candidates]
        at, least = candidates[int(np.argmin(deviances))], min(deviances)
        start, free = at, np.ones(at.size, dtype=np.bool_)
        free[BLUR] = at[BLUR] > 0
        derivatives = self.derivatives(at, free)
        for _ in range(STEPS):
            if np.abs((at - derivatives.where) / self.scales).max() > NEAR:
                derivatives = self.derivatives(at, free)
            step, gain = self._step(at, start, free, derivatives)
            if free[BLUR] and at[BLUR] + step[BLUR] < LEAST_BLUR:  # its bound
                at, free = np.where(np.arange(at.size) == BLUR, 0.0, at), free & (np.arange(at.size) != BLUR)
                start = np.where(free, start, 0.0)
                least, derivatives = self.deviance(at, start), self.derivatives(at, free)
                continue
            if gain < SETTLED * (least + 1):
                if derivatives.where is at:
                    break
                derivatives = self.derivatives(at, free)
                continue
            for halved in range(HALVINGS):
                there = at + step / 2**halved
                deviance = self.deviance(there, start)
                if deviance < least:
                    break
            else:  # converged to within half a ray
                break
            at, least = there, deviance
        return at, free, derivatives if derivatives.where is at else self.derivatives(at, free)

    def _step(
        self, at: FloatArray, start: FloatArray, free: BoolArray, derivatives: Derivatives
    ) -> tuple[FloatArray, float]:
        """Return a Gauss-Newton step, (6,), and the predicted fall of the deviance."""
        model = self.model(at)
        keys = np.union1d(np.union1d(derivatives.keys, self.measured.keys), model.keys)
        jacobian, p = derivatives.at(keys), model.at(keys)
        weighted = jacobian.T * (self.rays / (p + self.least))
        ridge = self.ridge(free)
        slope = weighted @ (self.measured.at(keys) - p) - ridge @ (at - start)[free]
        step = np.zeros_like(at)
        step[free] = np.linalg.solve(weighted @ jacobian + ridge, slope)
        return step, float(slope @ step[free])
