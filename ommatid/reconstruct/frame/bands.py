"""A shift-invariant camera in front of a world, by groups of waves that its readings cannot tell apart.

The world w has F x F pixels in each pixel of f (F is 1 where it is no finer), and reflecting edges, so that its prior
P is diagonal in the cosine waves of the world. Readings one pixel of f apart that continue beyond the edges, where they
see the world reflected, map the waves of frequencies k, 2n - k, 2n + k, 4n - k, ... along an axis (n pixels of f) to
one and the same wave of readings. In such a group of at most F x F waves a lens type is one row b_t, its transfer
function with the signs of the aliases (or several, of `Readings`), and with the weights w_t = 1 / Rv

    K = P^-1 + sum over types of w_t b_t b_t^T,   K^-1 = P - P B (W^-1 + B^T P B)^-1 B^T P,

where the matrix to be inverted has as many rows as there are lens types. Pixels of f are averages of w: one more row a,
so that a^T K^-1 a, averaged over the groups, is the variance of a pixel of f far from the edges.

M is K of the readings that continue beyond the edges, and exceeds that of the camera near them. In a strip along an
edge both are small matrices for each group of waves along it, so that

    M^-1 + sum over edges of R_e^T (K_e^-1 - M_e^-1) R_e
         + sum over corners of R_c^T (K_c^-1 - sum over both edges of K_e,c^-1 + M_c^-1) R_c

is nearly the inverse of the camera's K, with K_e and M_e the two on a strip, R_e the choice of its pixels, and alike at
a corner, where K_e,c is what the strip takes for K there: so every place counts once (an additive Schwarz method;
Smith, Bjorstad and Gropp 1996). Where noise is uneven, K is about S M S with S the root of the local weight over the
mean.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy import fft

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import processors
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.observation import Observation

from .readings import Readings, box, boxes, by_kernel

DEPTH = 16  # pixels of f of a strip
CORNER = 32  # pixels of the world along the side of a corner, at most
LEAST = 1e-12  # of the eigenvalues of a strip's correction, relative to the largest


@dataclass(frozen=True)
class Bands:
    """The camera's lens types as rows b_t, and the prior, on the waves of a world.

    shape : rows and columns of f;  detail : F;  spectrum : P, (F rows, F columns);  weights : w_t
    simpler : the same by one kernel of each lens type, where some have several
    """

    shape: tuple[int, int]
    detail: int
    spectrum: FloatArray
    types: tuple[Readings, ...]
    weights: tuple[float, ...]
    simpler: Bands | None = field(default=None, repr=False)
    scale: FloatArray | float = field(default=1.0, repr=False)  # S of the precision S K S, (F rows, F columns)

    @cached_property
    def _rows(self) -> list[FloatArray]:
        """b_t of the kernels of all lens types: (F rows, F columns) each."""
        return [row for each in self.types for row in self._rows_of(each)]

    def _of_rows(self, values: Sequence[float]) -> FloatArray:
        """Return the value of the lens type of each row b_t."""
        return np.repeat(values, [len(each.kernels) for each in self.types])

    @cached_property
    def _pixels(self) -> FloatArray:
        """a, of the averages over pixels of f: (F rows, F columns)."""
        return next(self._rows_of(self._averages))

    @property
    def _averages(self) -> Readings:
        """f's pixels, which are averages of the world's."""
        return Readings(np.full((1, self.detail, self.detail), self.detail**-2.0), (0, 0), self.shape)

    def _rows_of(self, readings: Readings) -> Iterator[FloatArray]:
        """Yield the transfer function of each kernel of readings with the signs and the norms of the aliases."""
        for kernel in readings.kernels:
            down, across = (self._along(readings, axis, _is_turned(kernel, axis)) for axis in (0, 1))
            yield down @ kernel @ across.T

    def _along(self, readings: Readings, axis: int, turned: bool) -> FloatArray:
        """Return the transfer function along an axis of each line of a kernel: (waves, lines).

        turned : of kernels that are odd along it, which have no aliases, as they stand for boxes on the grid of f alone
        """
        norms = _norms(self.shape[axis], self.detail, readings.is_odd(axis, self.detail))
        return norms[:, None] * _waves(self.shape[axis], self.detail, readings.extent[axis], turned)

    @cached_property
    def _spectral(self) -> tuple[FloatArray, FloatArray]:
        """Eigenvalues of W^1/2 B^T P B W^1/2 of each group, (rows + 1, columns + 1, types), and W^1/2 eigenvectors.

        Where all types see a wave of large variance alike, the inverse of the matrix itself would have no digits.
        """
        rows, roots = self._rows, np.sqrt(self._of_rows(self.weights))
        inner = np.empty((self.shape[0] + 1, self.shape[1] + 1, len(rows), len(rows)))
        for one, first in enumerate(rows):
            weighted = self.spectrum * first
            for other, second in enumerate(rows[: one + 1]):
                inner[..., one, other] = inner[..., other, one] = self._folded(weighted * second)
        values, vectors = np.linalg.eigh(inner * roots[:, None] * roots)
        return np.maximum(values, 0.0), roots[:, None] * vectors

    def solve(self, image: FloatArray, waves: FloatArray | None = None, *, edges: bool = True) -> FloatArray:
        """Return approximately K^-1 r, (F rows, F columns): symmetric, as conjugate gradients need.

        waves : of r under the DCT-II; None: they are computed;  edges : False leaves out what lacks near them
        """
        scaled = image if isinstance(self.scale, float) else image / self.scale
        if waves is None or scaled is not image:
            waves = np.asarray(fft.dctn(scaled, 2, norm="ortho", workers=processors()))
        if self.detail == 1:
            waves = waves * self._single
        else:
            waves = waves * self.spectrum
            self._subtract_seen(waves)
        solved: FloatArray = np.asarray(fft.idctn(waves, 2, norm="ortho", workers=processors(), overwrite_x=True))
        for edge in self._edges.values() if edges else ():
            edge.add(scaled, solved)
        for rows, columns, excess in self._corners if edges else ():
            near = scaled[rows, columns]
            solved[rows, columns] += (excess @ near.ravel()).reshape(near.shape)
        return solved if scaled is image else solved / self.scale

    @cached_property
    def _single(self) -> FloatArray:
        """Eigenvalues of M^-1 where each group has one wave: (rows, columns)."""
        seen = np.zeros(self.shape)
        for readings, weight in zip(self.types, self.weights, strict=True):
            for row in self._rows_of(readings):
                seen += weight * np.square(row)
        return self.spectrum / (1 + self.spectrum * seen)

    def _subtract_seen(self, waves: FloatArray) -> None:
        """Turn the waves of P r into those of M^-1 r in place."""
        seen = np.stack([self._folded(waves * row) for row in self._rows], axis=-1)
        values, vectors = self._spectral
        along = np.einsum("ijtu,ijt->iju", vectors, seen) / (1 + values)
        back = np.einsum("ijtu,iju->ijt", vectors, along)
        for number, row in enumerate(self._rows):
            waves -= self.spectrum * row * self._unfolded(np.ascontiguousarray(back[..., number]))

    @cached_property
    def _edges(self) -> dict[tuple[int, bool], _Edge]:
        """What lacks along axis 0 or 1, at its first or last end: K has no readings there that M has."""
        return {(axis, last): self._edge(axis, last) for axis, last in product((0, 1), (False, True))}

    def _edge(self, axis: int, last: bool) -> _Edge:
        size, detail = self.shape[axis], self.detail
        depth = min(DEPTH, size // 2) * detail
        part = slice(size * detail - depth, size * detail) if last else slice(0, depth)
        members, prior = self._prior_on(axis, part)
        seen, whole = (
            sum((weight * each for weight, each in zip(self.weights, parts, strict=True)), prior)
            for parts in (self._information_on(axis, part, members, complete=complete) for complete in (False, True))
        )
        return _Edge(axis, part, members, seen, whole)

    def _prior_on(self, axis: int, part: slice) -> tuple[IntArray, FloatArray]:
        """Return the groups of waves along lines of the world, and P^-1 on them: (groups, lines, F, lines, F)."""
        depth, detail = part.stop - part.start, self.detail
        members = _members(self.shape[1 - axis], detail)
        pairs = _pairs(self.shape[axis] * detail, part)
        precision = 1 / (self.spectrum if axis == 0 else self.spectrum.T)
        priors = (precision.T @ pairs).reshape(-1, depth, depth)[members]
        priors[members < 0] = np.eye(depth)
        total = np.zeros((len(members), depth, detail, depth, detail))
        for number in range(detail):
            total[:, :, number, :, number] = priors[:, number]
        return members, total

    def _information_on(self, axis: int, part: slice, members: IntArray, *, complete: bool) -> Iterator[FloatArray]:
        """Yield H^T H of each lens type on lines of the world, as `_prior_on` has P^-1.

        complete : True for readings that continue beyond the edges, where they see the world reflected
        """
        size, detail, depth = self.shape[axis], self.detail, part.stop - part.start
        for readings in self.types:
            shares = _shares(readings, axis, size, detail, part, complete=complete)
            total = np.zeros((len(members), depth, detail, depth, detail))
            for kernel in readings.kernels:
                lines = kernel if axis == 0 else kernel.T
                along = (self._along(readings, 1 - axis, _is_turned(kernel, 1 - axis)) @ lines.T)[members]
                along[members < 0] = 0.0
                values = np.einsum("pxa,kla->kpxl", shares, along, optimize=True)
                values = values.reshape(len(members), len(shares), depth * detail)  # no readings where none reach
                total += (values.swapaxes(1, 2) @ values).reshape(total.shape)
            yield total

    def variances_across(self, axis: int, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return what `variances` does for each line of f between two edges: (3, size).

        Readings continue beyond the other two edges, so that waves along the lines separate.
        """
        size, detail = self.shape[axis], self.detail
        part = slice(0, size * detail)
        members, prior = self._prior_on(axis, part)
        weighted = [
            level * weight * each
            for weight, each in zip(
                self.weights, self._information_on(axis, part, members, complete=False), strict=True
            )
        ]
        square = (len(members), size * detail**2, size * detail**2)
        covariance = np.linalg.inv(sum(weighted, prior).reshape(square))
        waves = (self._along(self._averages, 1 - axis, False) @ self._averages.kernels[0, 0])[members]
        waves[members < 0] = 0.0
        lines = np.repeat(np.eye(size), detail, axis=1)
        pixels = np.einsum("dx,kl->kdxl", lines, waves).reshape(len(members), size, -1)
        columns = pixels @ covariance

        def mean(matrix: FloatArray) -> FloatArray:
            squares = np.einsum("kdn,kdn->kd", columns @ matrix.reshape(square), columns)
            return np.asarray(squares.sum(axis=0) / self.shape[1 - axis])

        posterior = np.einsum("kdn,kdn->d", columns, pixels) / self.shape[1 - axis]
        noisy = sum((ratio * mean(each) for ratio, each in zip(ratios, weighted, strict=True)), np.zeros(size))
        return np.array([posterior, mean(prior), noisy])

    @cached_property
    def _corners(self) -> list[tuple[slice, slice, FloatArray]]:
        """Rows and columns of each corner, and what it adds to P there: (pixels, pixels)."""
        found: list[tuple[slice, slice, FloatArray]] = []
        for bottom, right in product((False, True), repeat=2):
            down, across = self._edges[0, bottom], self._edges[1, right]
            rows, columns = (_ending(edge.part, last) for edge, last in ((down, bottom), (across, right)))
            along_row, whole = down.on_corner(rows, columns, self.shape[1])
            along_column = across.on_corner(columns, rows, self.shape[0])[0]
            tall, wide = rows.stop - rows.start, columns.stop - columns.start
            turned = along_column.reshape(wide, tall, wide, tall).transpose(1, 0, 3, 2).reshape(whole.shape)
            exact, first, second, both = (
                np.linalg.inv(each) for each in (self._on_corner(rows, columns), along_row, turned, whole)
            )
            found.append((rows, columns, exact - first - second + both))
        return found

    def _on_corner(self, rows: slice, columns: slice) -> FloatArray:
        """Return K of a corner: (its pixels, its pixels)."""
        tall, wide = rows.stop - rows.start, columns.stop - columns.start
        down, across = (_pairs(*each) for each in zip(self.spectrum.shape, (rows, columns), strict=True))
        prior = (down.T @ (1 / self.spectrum) @ across).reshape(tall, tall, wide, wide)
        total: FloatArray = np.ascontiguousarray(prior.transpose(0, 2, 1, 3)).reshape(tall * wide, tall * wide)
        for readings, weight in zip(self.types, self.weights, strict=True):
            shares = [
                _shares(readings, axis, self.shape[axis], self.detail, part, complete=False)
                for axis, part in enumerate((rows, columns))
            ]
            for kernel in readings.kernels:
                read = np.einsum("rxa,ab,syb->rsxy", shares[0], kernel, shares[1], optimize=True)
                read = read.reshape(-1, tall * wide)
                total += weight * read.T @ read
        return total

    def variances(self, level: float, ratios: tuple[float, ...]) -> tuple[float, float, float]:
        """Return the posterior variance of a pixel of f far from the edges, and the parts of Eq. 5 by prior and noise.

        level : by which all weights are multiplied;  ratios : of the actual to the expected noise of each lens type
        """
        _, _, seen, before = self._of_pixels
        posterior = before - np.einsum("iju,iju->ij", self._along_vectors(level), seen)
        expected = self.noise_of_waves(level, (1.0,) * len(ratios))
        noisy = self.noise_of_waves(level, ratios).mean()
        return float(posterior.mean()), float((posterior - expected).mean()), float(noisy)

    def groups(self) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return W^1/2 b_t and a of every group, by waves of variance 1, and the lens type of each row b_t.

        (rows, groups, waves), (groups, waves) and (rows,); without the last groups, which belong to no wave of f.
        """
        members = [_members(size, self.detail)[:-1] for size in self.shape]
        down, across = members[0][:, None, :, None], members[1][None, :, None, :]
        missing = (down < 0) | (across < 0)

        def by_group(waves: FloatArray) -> FloatArray:
            values = np.where(missing, 0.0, waves[down, across])
            return values.reshape(self.shape[0] * self.shape[1], self.detail**2)

        root = np.sqrt(self.spectrum)
        rows = [by_group(root * row) for row in self._rows]
        weighted = np.sqrt(self._of_rows(self.weights))[:, None, None] * np.array(rows)
        types = self._of_rows(range(len(self.types))).astype(np.int64)
        return weighted, by_group(root * self._pixels), types

    def noise_of_waves(self, level: float, ratios: tuple[float, ...]) -> FloatArray:
        """Return the variance of each wave of f's pixels by noise, as of `variances`: (rows, columns)."""
        gain = np.einsum("ijtu,iju->ijt", self._of_pixels[1], self._along_vectors(level))
        # The noise of a type, 1 / w, passes through its gain; both are finite for a weight of 0.
        weights = level * self._of_rows(self.weights)
        noise = np.divide(np.square(gain), weights, out=np.zeros_like(gain), where=weights > 0)
        return np.asarray(noise @ self._of_rows(ratios))

    def detail_variance(self) -> float:
        """Return the error of a pixel of f by what f does not hold of a random world of the prior.

        Such a world has the prior variance of its readings less what these share with f's pixels.
        """
        values, _, seen, before = self._of_pixels
        along = self._along_vectors(1.0)
        shared = np.square(np.einsum("iju,iju->ij", along, seen)) / before
        return float((np.einsum("iju,iju->ij", np.square(along), values) - shared).mean())

    def _along_vectors(self, level: float) -> FloatArray:
        """Return the gain of f's waves along the vectors of `_spectral`: (rows, columns, types)."""
        values, _, seen, _ = self._of_pixels
        return level * seen / (1 + level * values)

    @cached_property
    def _of_pixels(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """`_spectral`, covariances of its vectors with f's wave, and the variance of that: no last groups."""
        (values, vectors), pixels = self._spectral, self._pixels
        seen = np.stack([self._folded(self.spectrum * pixels * row) for row in self._rows], axis=-1)
        before = self._folded(self.spectrum * np.square(pixels))
        inside = (slice(None, -1), slice(None, -1))
        return values[inside], vectors[inside], np.einsum("ijtu,ijt->iju", vectors, seen)[inside], before[inside]

    @cached_property
    def prior_variance(self) -> float:
        """Prior variance of a pixel of f, averaged over the image."""
        return float(self._folded(self.spectrum * np.square(self._pixels))[:-1, :-1].mean())

    def _folded(self, waves: FloatArray) -> FloatArray:
        """Return the sums of coefficients over the waves of each group: (rows + 1, columns + 1)."""
        for axis, size in enumerate(self.shape):
            shape = list(waves.shape)
            shape[axis] = size + 1
            total = np.zeros(shape)
            for part, target in _segments(size, self.detail):
                total[_at(axis, target)] += waves[_at(axis, part)]
            waves = total
        return waves

    def _unfolded(self, groups: FloatArray) -> FloatArray:
        """Return each group's value at all of its waves: (F rows, F columns)."""
        for axis, size in enumerate(self.shape):
            shape = list(groups.shape)
            shape[axis] = size * self.detail
            waves = np.empty(shape)
            for part, target in _segments(size, self.detail):
                waves[_at(axis, part)] = groups[_at(axis, target)]
            groups = waves
        return groups


def bands_of(camera: Camera, detail: int, spectrum: FloatArray, weights: FloatArray, observation: Observation) -> Bands:
    """Return the shift-invariant camera like one in front of a world finer than f.

    camera : on the grid of the world;  weights : (M,) 1 / Rv;  observation : H, whose kernels are taken as they are
    """
    parts = {part.places.lens_type.name: part for part in observation.parts if isinstance(part, KernelFootprints)}
    means: list[Readings] = []
    types: list[Readings] = []
    noise: list[float] = []
    for lens_type, rows in zip(camera.types, camera.type_slices(), strict=True):
        part = parts.get(lens_type.name)
        kernel = box(lens_type) if part is None else part.mean_kernel
        means.append(by_kernel(lens_type, kernel, detail))
        # In front of a finer world every kernel would be one row more in every group.
        types.append(means[-1] if part is not None or detail > 1 else boxes(lens_type))
        taken = lens_type.measurements / (means[-1].count[0] * means[-1].count[1])
        noise.append(float(weights[rows].mean()) * taken)
    shape = camera.rows // detail, camera.columns // detail
    bands = Bands(shape, detail, spectrum, tuple(means), tuple(noise))
    if all(len(each.kernels) == 1 for each in types):
        return bands
    return replace(bands, types=tuple(types), simpler=bands)


def _is_turned(kernel: FloatArray, axis: int) -> bool:
    """Return True if a kernel is odd along an axis."""
    return bool(np.vdot(kernel, np.flip(kernel, axis)) < 0)


def _members(size: int, detail: int) -> IntArray:
    """Return the waves of the world in each group of an axis, (size + 1, detail), -1 where there are fewer."""
    members = np.full((size + 1, detail), -1)
    numbers = np.arange(size * detail)
    for number, (part, target) in enumerate(_segments(size, detail)):
        members[target, number] = numbers[part]
    return members


def _shares(readings: Readings, axis: int, size: int, detail: int, part: slice, *, complete: bool) -> FloatArray:
    """Return which line of a kernel lies on which line of a strip: (readings near it, lines of the strip, of a kernel).

    complete : True for readings that continue beyond the edges, where they see the world reflected
    """
    length, end = readings.extent[axis], size * detail
    starts: IntArray = readings.first[axis] + detail * np.arange(readings.count[axis])
    roots = np.ones(starts.size)
    if complete:
        odd = readings.is_odd(axis, detail)
        middles = np.asarray(np.arange(size) + 0.5 if odd else np.arange(size + 1), dtype=np.float64)
        starts = np.rint(middles * detail - length / 2).astype(np.int64)
        roots = np.ones(middles.size)
        if not odd:
            roots[[0, -1]] = 0.5**0.5
    lines: IntArray = np.asarray(starts[:, None] + np.arange(length), dtype=np.int64)
    if complete:
        lines %= 2 * end
        np.copyto(lines, 2 * end - 1 - lines, where=lines >= end)
    near = ((lines >= part.start) & (lines < part.stop)).any(axis=1)
    shares = np.zeros((int(near.sum()), part.stop - part.start, length))
    reading, line = np.nonzero((lines[near] >= part.start) & (lines[near] < part.stop))
    shares[reading, lines[near][reading, line] - part.start, line] = roots[near][reading]
    return shares


@dataclass(frozen=True)
class _Edge:
    """K_e and M_e of a strip along an edge, by groups of waves along it: (groups, depth, F, depth, F)."""

    axis: int
    part: slice
    members: IntArray
    seen: FloatArray
    whole: FloatArray

    @cached_property
    def excess(self) -> FloatArray:
        """K_e^-1 - M_e^-1: (groups, depth F, depth F)."""
        count = self.seen.shape[1] * self.seen.shape[2]
        seen, whole = (np.linalg.inv(each.reshape(-1, count, count)) for each in (self.seen, self.whole))
        excess = seen - whole
        values, vectors = np.linalg.eigh((excess + excess.swapaxes(1, 2)) / 2)
        values = np.where(values > LEAST * values[:, -1:], values, 0.0)
        return (vectors * values[:, None, :]) @ vectors.swapaxes(1, 2)

    def add(self, right: FloatArray, solution: FloatArray) -> None:
        """Add R^T (K_e^-1 - M_e^-1) R r to the solution."""
        source, target = (right, solution) if self.axis == 0 else (right.T, solution.T)
        waves = np.asarray(fft.dct(source[self.part], 2, axis=1, norm="ortho", workers=processors()))
        missing = self.members < 0
        groups = waves[:, self.members]  # (depth, groups, F)
        groups[:, missing] = 0.0
        depth, count, detail = groups.shape
        solved = np.einsum("kij,kj->ki", self.excess, groups.swapaxes(0, 1).reshape(count, -1))
        waves[:, self.members[~missing]] = solved.reshape(count, depth, detail).swapaxes(0, 1)[:, ~missing]
        target[self.part] += np.asarray(fft.idct(waves, 2, axis=1, norm="ortho", workers=processors()))

    def on_corner(self, near: slice, along: slice, size: int) -> tuple[FloatArray, FloatArray]:
        """Return K_e and M_e of some lines of the strip and a part of its length, numbered by lines: (pixels, pixels).

        size : pixels of f along the edge
        """
        lines = slice(near.start - self.part.start, near.stop - self.part.start)
        detail, pixels = self.members.shape[1], (near.stop - near.start) * (along.stop - along.start)
        waves = np.asarray(fft.dct(np.eye(size * detail)[:, along], 2, axis=0, norm="ortho"))[self.members]
        waves[self.members < 0] = 0.0
        first, second = (
            np.einsum("kax,kiajb,kby->ixjy", waves, each[:, lines, :, lines], waves, optimize=True)
            for each in (self.seen, self.whole)
        )
        return first.reshape(pixels, pixels), second.reshape(pixels, pixels)


def _pairs(size: int, part: slice) -> FloatArray:
    """Return products of each wave's values at two places of a part: (waves, places squared)."""
    waves = np.asarray(fft.dct(np.eye(size)[:, part], 2, axis=0, norm="ortho"))
    return (waves[:, :, None] * waves[:, None, :]).reshape(size, -1)


def _ending(part: slice, last: bool) -> slice:
    """Return the CORNER lines of a strip at its edge."""
    depth = min(CORNER, part.stop - part.start)
    return slice(part.stop - depth, part.stop) if last else slice(part.start, part.start + depth)


def _at(axis: int, part: slice) -> tuple[slice, ...]:
    return (part,) if axis == 0 else (slice(None), part)


def _segments(size: int, detail: int) -> Iterator[tuple[slice, slice]]:
    """Yield ranges of waves of the world and the groups that they belong to, which rise or fall."""
    for number in range(detail):
        part = slice(number * size, (number + 1) * size)
        yield part, slice(0, size) if number % 2 == 0 else slice(size, 0, -1)


def _waves(size: int, detail: int, length: int, turned: bool) -> FloatArray:
    """Return the cosines of all waves of the world about the middle of `length` of its pixels: (F size, length).

    turned : the sines in place of the cosines
    """
    angles = np.pi * np.arange(size * detail) / (size * detail)
    phases = np.outer(angles, np.arange(length) - (length - 1) / 2)
    return np.sin(phases) if turned else np.cos(phases)


def _norms(size: int, detail: int, odd: bool) -> FloatArray:
    """Return the sign of each wave as readings see it, times the root of its norm on them: (F size,)."""
    number, place = np.divmod(np.arange(size * detail), size)
    turns = (number + 1) // 2  # by which the wave of the readings is shifted
    norms = np.full(size * detail, detail**-0.5)
    zero, highest = (place == 0) & (number % 2 == 0), (place == 0) & (number % 2 == 1)
    norms[zero & (number > 0)] = (2 / detail) ** 0.5
    norms[highest] = 0.0 if odd else (2 / detail) ** 0.5
    return np.where(odd & (turns % 2 == 1), -norms, norms)
