"""H of a calibrated camera by few numbers: views of sharp lens types, kernels of blurred ones, entries of the rest.

The errors of the numbers are errors of all pixels of a sub-imager, or of a lens type, together: they do not average out
over pixels. To first order the readings of a displaced pixel change as those of its view do when that is shifted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.machine import processors

from ..camera import Camera
from ..lens_type import LensType, SubImager
from ..observation import Entries, Observation, ObservationPart, Seen
from ..tables.table import LARGEST
from .kernel_shapes import Numbers
from .kernels import KernelFootprints
from .view import COUNT, K1, LEAST, MOST, ROTATION, boxes_of, designed, displacements, part_of, slopes

STRUCTURES = {"own", "shared", "designed"}
ALIKE = 0.05  # pixels of f that views may be displaced by where error maps take H as designed


@dataclass(frozen=True)
class Views:
    """The views of all sub-imagers of one lens type.

    numbers : (sub-imagers, 5) of `view`;  explained : (sub-imagers,), False where H is measured entry by entry
    own : (sub-imagers, 5, p) factors of the error of a sub-imager's numbers, own @ xi with independent xi of variance 1
    shared : (sub-imagers, 5, q) likewise, with the same xi for all sub-imagers
    structure : of each number "own", "shared" or "designed"
    """

    numbers: FloatArray
    explained: BoolArray
    own: FloatArray
    shared: FloatArray
    structure: tuple[str, ...]

    @property
    def is_as_designed(self) -> bool:
        """True if no number differs from the design, and every sub-imager is explained."""
        return bool(self.explained.all()) and all(each == "designed" for each in self.structure)

    @classmethod
    def from_arrays(cls, arrays: dict[str, Any], name: str) -> Views:
        """Read the arrays of a file. Raises KeyError or ValueError for others."""
        numbers = np.asarray(arrays[f"{name}.numbers"], dtype=np.float64)
        explained = np.asarray(arrays[f"{name}.explained"], dtype=np.bool_)
        own, shared = (np.asarray(arrays[f"{name}.{key}"], dtype=np.float64) for key in ("own", "shared"))
        structure = tuple(str(each) for each in arrays[f"{name}.structure"])
        count = len(numbers)
        if numbers.shape != (count, COUNT) or explained.shape != (count,) or len(structure) != COUNT:
            raise ValueError(f"the views {name} have arrays of other shapes")
        if any(each.ndim != 3 or each.shape[:2] != (count, COUNT) for each in (own, shared)):
            raise ValueError(f"the errors of the views {name} have arrays of other shapes")
        if not ((numbers >= LEAST) & (numbers <= MOST)).all():
            raise ValueError(f"the views {name} have numbers that are not finite or out of range")
        if not all((np.abs(each) <= LARGEST).all() for each in (own, shared)):
            raise ValueError(f"the errors of the views {name} are not finite or out of range")
        if not set(structure) <= STRUCTURES:
            raise ValueError(f"the views {name} are none of {', '.join(sorted(STRUCTURES))}")
        return cls(numbers, explained, own, shared, structure)


Block = sparse.csc_array | FloatArray


@dataclass(frozen=True)
class Directions:
    """L, (M, q), by lens type: the error of H f is L xi, with independent xi of variance 1.

    blocks : yields the measurements of each lens type and its block of L
    """

    measurements: int
    blocks: Callable[[], Iterator[tuple[slice, Block]]]

    @property
    def matrix(self) -> sparse.csc_array:
        """L."""
        return sparse.csc_array(sparse.block_diag([sparse.csc_array(block) for _, block in self.blocks()]))

    def adjoint(self, readings: FloatArray) -> FloatArray:
        """Return L^T g: (M,) to (q,)."""
        return np.concatenate([block.T @ readings[place] for place, block in self.blocks()])

    @cached_property
    def variance(self) -> FloatArray:
        """The diagonal of L L^T: (M,)."""
        variance = np.zeros(self.measurements)
        for place, block in self.blocks():
            variance[place] = np.asarray((block**2).sum(axis=1)).ravel()
        return variance

    def draws(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Return random errors of H f: (count, M)."""
        drawn = np.zeros((count, self.measurements))
        for place, block in self.blocks():
            drawn[:, place] = (block @ rng.normal(size=(block.shape[1], count))).T
        return drawn


@dataclass(frozen=True)
class FittedMatrix:
    """H, (M, N), of which each lens type is described by its views, or by kernels.

    views : by the name of a lens type, those as designed for one with kernels;  kernels : likewise
    """

    camera: Camera
    views: dict[str, Views]
    kernels: dict[str, KernelFootprints] = field(default_factory=dict[str, "KernelFootprints"])

    @cached_property
    def _types(self) -> list[tuple[LensType, Views, list[SubImager], list[slice]]]:
        subs, slices = iter(self.camera.sub_imagers), iter(self.camera.slices())
        return [
            (lens, self.views[lens.name], list(islice(subs, lens.count)), list(islice(slices, lens.count)))
            for lens in self.camera.types
        ]

    @property
    def determining(self) -> list[Numbers]:
        """All arrays that determine H and its errors, in a fixed order; part of fingerprints."""
        names = [lens.name for lens in self.camera.types]
        views: list[Numbers] = [
            each for name in names for each in (self.views[name].numbers, self.views[name].own, self.views[name].shared)
        ]
        kernels = [self.kernels[name].arrays for name in names if name in self.kernels]
        return views + [arrays[key] for arrays in kernels for key in sorted(arrays)]

    @property
    def has_errors(self) -> bool:
        """True if some number has an error."""
        views = any(each.own.shape[2] or each.shared.shape[2] for each in self.views.values())
        return views or any(len(each.error_coefficients) for each in self.kernels.values())

    @cached_property
    def is_as_designed(self) -> bool:
        """True if H is that of the design."""
        return not self.kernels and all(self.views[lens.name].is_as_designed for lens in self.camera.types)

    @cached_property
    def _whole(self) -> Observation:
        """H by boxes, kernels and entries; rows of sub-imagers that are not explained are empty."""
        parts: list[ObservationPart] = []
        for lens, views, subs, _ in self._types:
            pairs = list(zip(subs, views.numbers, strict=True))
            if lens.name in self.kernels:
                parts.append(self.kernels[lens.name])
            elif views.explained.all() and not views.numbers[:, [ROTATION, K1]].any() and self.camera.has_boxes(lens):
                parts += boxes_of(self.camera, lens, pairs)
            else:
                empty = Entries(
                    sparse.csr_array((lens.measurements // lens.count, self.camera.unknowns)), self.camera.shape
                )
                known = zip(pairs, views.explained, strict=True)
                parts += [part_of(self.camera, *pair) if explained else empty for pair, explained in known]
        return Observation(self.camera.shape, tuple(parts))

    @property
    def observation(self) -> Observation | None:
        """H by boxes and kernels, None where it has entries: sub-imagers measured, rotated or distorted."""
        boxes = all(lens.name in self.kernels or self.camera.has_boxes(lens) for lens in self.camera.types)
        return self._whole if boxes and not any(isinstance(part, Entries) for part in self._whole.parts) else None

    @cached_property
    def is_nearly_designed(self) -> bool:
        """True if the views are where the design has them to within 0.05 pixels of f."""
        if self.kernels or self.observation is None:
            return False
        return all(
            float(np.abs(rows @ moved).max(initial=0.0)) <= ALIKE
            for _, views, subs, _ in self._types
            for sub, moved in zip(subs, views.numbers, strict=True)
            for rows in displacements(self.camera, sub, _corners(sub))
        )

    @property
    def largest_deviation(self) -> tuple[float, int]:
        """Largest deviation of a number from the design, in standard deviations, and how many numbers there are."""
        largest, count = 0.0, 1
        for _, views, subs, _ in self._types:
            moved = np.abs(views.numbers - designed_views(subs))[views.explained]
            variance = (np.square(views.own).sum(axis=2) + np.square(views.shared).sum(axis=2))[views.explained]
            free = (variance > 0) & (np.array(views.structure) != "designed")
            largest = max(largest, float((moved[free] / np.sqrt(variance[free])).max(initial=0.0)))
            count += int(free.sum())
        return largest, count

    def to_sparse(self) -> sparse.csr_array:
        """Return H, (M, N); rows of sub-imagers that are not explained are empty."""
        rows = self._whole.to_sparse()
        rows.eliminate_zeros()
        return rows

    def restrict(self, camera: Camera) -> FittedMatrix:
        """Return H of a camera with some of the lens types."""
        names = [lens.name for lens in camera.types]
        kernels = {name: each for name, each in self.kernels.items() if name in names}
        return FittedMatrix(camera, {name: self.views[name] for name in names}, kernels)

    @property
    def without_errors(self) -> FittedMatrix:
        """The same H, taken for exact."""
        views = {
            name: replace(each, own=each.own[:, :, :0], shared=each.shared[:, :, :0])
            for name, each in self.views.items()
        }
        return FittedMatrix(self.camera, views, {name: each.without_errors for name, each in self.kernels.items()})

    def errors(self, image: FloatArray) -> Directions:
        """Return the errors of H f."""
        return Directions(self.camera.measurements, lambda: self._directions(image))

    def _directions(self, image: FloatArray) -> Iterator[tuple[slice, Block]]:
        """Yield the measurements of each lens type, and its block of L: what its sub-imagers share, then their own."""
        seen = Seen(np.ascontiguousarray(image, dtype=np.float64).reshape(self.camera.shape), self.camera.shape)
        for lens, views, subs, slices in self._types:
            measurements = slice(slices[0].start, slices[-1].stop)
            if lens.name in self.kernels:
                yield measurements, self.kernels[lens.name].error_directions(image)
                continue
            moves = [self._moves(sub, seen, *parts) for sub, parts in zip(subs, self._slopes[lens.name], strict=True)]
            shared, own = (
                [sparse.csc_array(move @ factor) for move, factor in zip(moves, factors, strict=True)]
                for factors in (views.shared, views.own)
            )
            yield measurements, sparse.csc_array(sparse.hstack([sparse.vstack(shared), sparse.block_diag(own)]))

    @cached_property
    def _slopes(self) -> dict[str, list[list[ObservationPart]]]:
        """The slopes of H of every sub-imager of each lens type that views describe."""
        with ThreadPoolExecutor(processors()) as threads:
            return {
                lens.name: list(threads.map(partial(slopes, self.camera), subs, views.numbers))
                for lens, views, subs, _ in self._types
                if lens.name not in self.kernels
            }

    def _moves(self, sub: SubImager, seen: Seen, down: ObservationPart, across: ObservationPart) -> FloatArray:
        """Return the change of a sub-imager's readings per unit of each number: (pixels, 5)."""
        index = np.indices(sub.type.pixels).reshape(2, -1).astype(np.float64)
        moves, change = np.zeros((index.shape[1], COUNT)), np.empty(index.shape[1])
        for part, displaced in zip((down, across), displacements(self.camera, sub, (index[0], index[1])), strict=True):
            part.forward(seen, change)
            moves += change[:, None] * displaced
        return moves


def designed_views(subs: list[SubImager]) -> FloatArray:
    """Return the numbers of sub-imagers as designed: (sub-imagers, 5)."""
    return np.array([designed(sub) for sub in subs])


def views_as_designed(subs: list[SubImager], explained: bool = True) -> Views:
    """Return the views of a lens type's sub-imagers as designed, without errors."""
    nothing = np.zeros((len(subs), COUNT, 0))
    return Views(designed_views(subs), np.full(len(subs), explained), nothing, nothing, ("designed",) * COUNT)


def _corners(sub: SubImager) -> tuple[FloatArray, FloatArray]:
    rows, columns = (np.array([0.0, size - 1.0]) for size in sub.type.pixels)
    down, across = np.meshgrid(rows, columns, indexing="ij")
    return down.ravel(), across.ravel()
