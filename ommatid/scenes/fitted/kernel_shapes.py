"""Kernels of a lens type, (S, W, W), in few numbers.

The kernels of a design are smooth in both directions, so that they are products of a few columns down and across. What
was learnt from rays changes their core cell by cell, and the light in square rings around the core, in which it leaves
the design its shape.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import BoolArray, FloatArray

Numbers = NDArray[np.floating[Any]]  # float32 of what files hold
ACCURACY = 1e-5  # of low-rank products, relative to the largest value of a kernel


def ring_masks(width: int, core: int) -> list[BoolArray]:
    """Return the cells of each ring around a core, (W, W): half as wide again as the square inside it, and more."""
    offset = np.abs(2 * np.arange(width) + 1 - width)
    apart = np.maximum.outer(offset, offset)  # in halves of a cell
    masks: list[BoolArray] = []
    inner = core
    while inner < width:
        outer = min(width, inner + 2 * max(1, inner // 4))
        outer = width if width - outer < outer - inner else outer
        masks.append((apart >= inner) & (apart < outer))
        inner = outer
    return masks


@dataclass(frozen=True, eq=False)
class KernelShapes:
    """Kernels down @ products @ across^T, then L learnt ones; and E kernels of errors, which are learnt.

    down, across : (W, R);  products : (D, R, R)
    core : (L, w, w) in the middle of W x W;  rings : (L, B) light in the rings, distributed as in the first kernel
    error_core, error_rings : (E, w, w), (E, B) likewise
    """

    down: Numbers
    across: Numbers
    products: Numbers
    core: Numbers
    rings: Numbers
    error_core: Numbers
    error_rings: Numbers

    def __post_init__(self) -> None:
        """Raise ValueError for arrays that do not belong together."""
        wide, rank = self.down.shape
        side = self.core.shape[-1]
        if self.across.shape != (wide, rank) or self.products.shape[1:] != (rank, rank):
            raise ValueError("the products of kernels do not belong to their columns")
        if (
            side > wide
            or (wide - side) % 2
            or any(each.shape[1:] != (side, side) for each in (self.core, self.error_core))
        ):
            raise ValueError(f"expected the cores of kernels in the middle of {wide} x {wide} pixels of f")
        rings = len(self.ring_masks)
        if self.rings.shape != (len(self.core), rings) or self.error_rings.shape != (len(self.error_core), rings):
            raise ValueError(f"expected the light of kernels in {rings} rings")

    @classmethod
    def dense(cls, kernels: FloatArray, errors: FloatArray | None = None) -> KernelShapes:
        """Return kernels, (S, W, W), as they are. errors : (E, W, W)"""
        columns, errors = np.zeros((kernels.shape[1], 0)), kernels[:0] if errors is None else errors
        none = np.zeros((len(kernels), 0)), np.zeros((len(errors), 0))
        return cls(columns, columns, np.zeros((0, 0, 0)), kernels, none[0], errors, none[1])

    @classmethod
    def low_rank(cls, kernels: FloatArray, core: int) -> KernelShapes:
        """Return kernels, (S, W, W), as products of as few columns as they need, in float32.

        core : width of what may be learnt
        """
        least = ACCURACY * float(np.abs(kernels).max())
        bases: list[FloatArray] = []
        for unfolded in (kernels.swapaxes(0, 1), kernels.transpose(2, 0, 1)):
            lines = unfolded.reshape(kernels.shape[1], -1)
            values, vectors = np.linalg.eigh(lines @ lines.T)
            bases.append(vectors[:, values > least**2][:, ::-1])
        rank = max(basis.shape[1] for basis in bases)
        down, across = (np.pad(basis, ((0, 0), (0, rank - basis.shape[1]))) for basis in bases)
        none = np.zeros((0, core, core)), np.zeros((0, len(ring_masks(kernels.shape[1], core))))
        return cls(down, across, down.T @ kernels @ across, *none, *none).rounded

    @property
    def rounded(self) -> KernelShapes:
        """The same kernels in float32, as a file holds them."""
        return KernelShapes(**{name: np.asarray(each, np.float32) for name, each in self.arrays.items()})

    @property
    def arrays(self) -> dict[str, Numbers]:
        """The arrays of a file."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @property
    def width(self) -> int:
        """W."""
        return len(self.down)

    @property
    def count(self) -> int:
        """S."""
        return len(self.products) + len(self.core)

    @property
    def without_errors(self) -> KernelShapes:
        """The same kernels, taken for exact."""
        return replace(self, error_core=self.error_core[:0], error_rings=self.error_rings[:0])

    @cached_property
    def ring_masks(self) -> list[BoolArray]:
        """The cells of each ring: (W, W)."""
        return ring_masks(self.width, self.core.shape[-1])

    @cached_property
    def designed(self) -> FloatArray:
        """The kernels of the design: (D, W, W)."""
        down, across, products = (_double(each) for each in (self.down, self.across, self.products))
        return down @ products @ across.T

    @cached_property
    def kernels(self) -> FloatArray:
        """All kernels: (S, W, W)."""
        return np.concatenate([self.designed, self._learnt(self.core, self.rings)])

    @cached_property
    def error_kernels(self) -> FloatArray:
        """The kernels of the errors: (E, W, W)."""
        return self._learnt(self.error_core, self.error_rings)

    def _learnt(self, core: Numbers, rings: Numbers) -> FloatArray:
        margin = (self.width - core.shape[-1]) // 2
        whole = np.pad(_double(core), ((0, 0), (margin, margin), (margin, margin)))
        for numbers, mask in zip(_double(rings).T, self.ring_masks, strict=True):
            light = float(self.designed[0][mask].sum())
            if light > 0:
                whole[:, mask] += numbers[:, None] * (self.designed[0][mask] / light)
        return whole


def _double(values: Numbers) -> FloatArray:
    return np.asarray(values, dtype=np.float64)
