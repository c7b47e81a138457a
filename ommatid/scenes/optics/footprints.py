"""H of distorted or misaligned pinholes, by exact overlap of areas.

Entry (i, j) of H is the share of the area of sensor pixel i that the image of texel j covers. Edges of the image are
cut into parabolas: exact for an undistorted lens, whose edges are straight, and within `TOLERANCE` for a distorted one.
By Green's theorem the area within pixel [j, j + 1] x [i, i + 1] is the sum over the edges of

    integral of min(max(U - j, 0), 1) dV   over i < V < i + 1,

with (U, V) in pixels from the patch's corner. Parabolas are cut where they cross sides of pixels; a piece in pixel
(i, j) adds its integral of (U - j) dV to that pixel, and its rise of V to the pixels to its left. A lens with an
aperture is replaced by its centre, which is right for a target in focus.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from functools import partial
from math import lcm

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.machine import processors

from ..camera import Camera
from ..lens_type import SubImager
from ..pose import Pose, corner_offset
from .distortion import coefficients, distort, field

LEAST_SHARE = 1e-13  # smaller shares are rounding errors where edges of texels and of pixels coincide
LEAST_DEPTH = 1e-6  # of W, which is 1 in the middle of a patch, and 0 in the plane through the lens
TOLERANCE = 1e-6  # pixels, of a parabola a quarter along it; areas are closer, since the error changes sign halfway
MOST_PARTS = 64  # parabolas in an edge
BLOCK = 1 << 15  # texels at a time, for memory
NODES = 0.5 + np.array([[-1], [1]]) / np.sqrt(12)  # Gauss's, exact for U dV of a parabola

Image = Callable[[FloatArray, FloatArray], FloatArray]


def sub_matrix(camera: Camera, sub: SubImager, pose: Pose) -> sparse.csr_array:
    """H of one sub-imager: (its pixels, N), with entries accurate to 1e-13, or 1e-7 with distortion.

    Pixels that are open in part are divided, and the parts inside the opening averaged.

    Raises InputError if its distortion folds the image, ValueError if its lens has surfaces.
    """
    field(camera, sub, pose)
    if sub.type.optics.surfaces is not None:
        raise ValueError(f"lens type {sub.type.name} has surfaces, expected a pinhole or a thin lens")
    k = coefficients(sub)
    project = _from_tangents(camera, sub, pose)
    r = sub.distance / camera.half_diagonal

    def image(row: FloatArray, column: FloatArray) -> FloatArray:
        """(U, V) of points of the target in pixels of f: (2, rows, columns); NaN behind the plane of the patch."""
        x = (camera.columns / 2 - column) * camera.target_pitch - pose.lens[0]
        y = (camera.rows / 2 - row[:, None]) * camera.target_pitch - pose.lens[1]
        tangents = distort(x / sub.distance, y / sub.distance, *k, r)
        u, v, w = (a * tangents[0] + b * tangents[1] + c for a, b, c in project)
        return np.stack([u, v]) / np.where(w < LEAST_DEPTH, np.nan, w)

    parts = _parts(image, camera.shape) if any(k) else 1
    openings = [_opening(part) for part in sub.type.open]
    pixels_divided = sub.type.pixels[0] * openings[0].size, sub.type.pixels[1] * openings[1].size
    division = np.array([openings[1].size, openings[0].size])[:, None, None, None]  # of U and of V
    tall = max(1, BLOCK // (camera.columns * parts))
    blocks: list[sparse.csc_array] = []
    for top in range(0, camera.rows, tall):
        rows = range(top, min(top + tall, camera.rows))
        edges = division * _edges(image, rows, camera.columns, parts)
        pixels, texels, shares = _shares(edges, pixels_divided)
        shape = pixels_divided[0] * pixels_divided[1], len(rows) * camera.columns
        blocks.append(sparse.csc_array((shares, (pixels, texels)), shape))
    h = sparse.csr_array(sparse.hstack(blocks, format="csr"))
    h.data[h.data < LEAST_SHARE] = 0
    h.eliminate_zeros()
    if not sub.type.is_open:
        down, across = (
            sparse.kron(sparse.eye_array(count), opening[None])
            for count, opening in zip(sub.type.pixels, openings, strict=True)
        )
        h = sparse.csr_array(sparse.kron(down, across, format="csr") @ h)
    return float(sub.type.light) * h


def _opening(part: Fraction) -> FloatArray:
    """Return the weights, in the mean along a side of a pixel that is open in part, of the parts it is divided into."""
    beside = (1 - part) / 2
    division = lcm(part.denominator, beside.denominator)
    inside, closed = int(part * division), int(beside * division)
    weights = np.zeros(division)
    weights[closed : closed + inside] = 1 / inside
    return weights


def matrix(camera: Camera, poses: tuple[Pose, ...]) -> sparse.csr_array:
    """H of all sub-imagers, with poses in the order of measurements: (M, N). Raises as `sub_matrix` does."""
    with ThreadPoolExecutor(processors()) as threads:
        parts = list(threads.map(partial(sub_matrix, camera), camera.sub_imagers, poses))
    return sparse.csr_array(sparse.vstack(parts, format="csr"))


def _from_tangents(camera: Camera, sub: SubImager, pose: Pose) -> FloatArray:
    """The (3, 3) matrix from (image tangents, 1) to (U W, V W, W), with U and V in pixels from the patch's corner."""
    left, top = corner_offset(camera, sub)
    to_pixels = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, camera.pixel_pitch]]) / camera.pixel_pitch
    return to_pixels @ np.linalg.inv(np.column_stack([pose.axes, pose.middle])) * pose.middle[2]


def _parts(image: Image, shape: tuple[int, int]) -> int:
    """The number of parabolas of equal length in an edge that reach `TOLERANCE`; errors fall with its third power."""
    rows, columns = (np.arange(size + 1.0) for size in shape)
    fine_rows, fine_columns = (np.arange(4 * size + 1) / 4 for size in shape)
    across, down = image(rows, fine_columns), image(fine_rows, columns).swapaxes(1, 2)
    errors = (
        np.abs(at[..., 1::4] - (3 * at[..., :-1:4] + 6 * at[..., 2::4] - at[..., 4::4]) / 8) for at in (across, down)
    )
    largest = max(float(np.nanmax(error, initial=0)) for error in errors)
    return min(max(1, int(np.ceil((largest / TOLERANCE) ** (1 / 3)))), MOST_PARTS)


def _edges(image: Image, rows: range, columns: int, parts: int) -> FloatArray:
    """Control points (U, V) of the parabolas around texels of some rows of f: (3, 2, 4, texels, parts).

    Edges run from the left and from the top, in the order top, right, bottom, left.
    """
    tops, sides = np.arange(rows.start, rows.stop + 1.0), np.arange(columns + 1.0)
    halves = (np.arange(2 * parts * size + 1) / (2 * parts) for size in (columns, len(rows)))
    across = _control_points(image(tops, next(halves)), parts)
    down = _control_points(image(rows.start + next(halves), sides).swapaxes(1, 2), parts).swapaxes(2, 3)
    edges = np.stack([across[:, :, :-1], down[:, :, :, 1:], across[:, :, 1:], down[:, :, :, :-1]], axis=2)
    return edges.reshape(3, 2, 4, -1, parts)


def _control_points(points: FloatArray, parts: int) -> FloatArray:
    """Control points of the parabolas through points half a part apart: (3, 2, lines, texels, parts)."""
    start, middle, end = points[..., :-1:2], points[..., 1::2], points[..., 2::2]
    return np.stack([start, 2 * middle - (start + end) / 2, end]).reshape(3, *points.shape[:2], -1, parts)


def _shares(edges: FloatArray, pixels: tuple[int, int]) -> tuple[IntArray, IntArray, FloatArray]:
    """Pixels, texels and shares, of which those of a pair add, of texels inside `_edges`."""
    low, high = edges.min(axis=(0, 2, 4)), edges.max(axis=(0, 2, 4))  # NaN is in no pixel
    seen = np.flatnonzero((low < np.array([pixels[::-1]]).T).all(axis=0) & (high > 0).all(axis=0))
    parabolas = edges[:, :, :, seen].reshape(3, 2, -1)
    parabola, start, length = _pieces(parabolas, pixels)
    side, texel, _ = np.unravel_index(parabola, (4, seen.size, edges.shape[-1]))
    first, control, last = parabolas[:, :, parabola]
    slope, bend = 2 * (control - first), first - 2 * control + last
    t = start + length * NODES  # (2, pieces)
    u = first[0] + t * (slope[0] + t * bend[0])
    steps = np.where(side < 2, 0.5, -0.5) * length * (slope[1] + 2 * t * bend[1])
    middle = start + length / 2
    column, row = np.floor(first + middle * (slope + middle * bend)).astype(int)

    within = (row >= 0) & (row < pixels[0])
    inside = np.flatnonzero(within & (column >= 0) & (column < pixels[1]))
    left = np.maximum(np.floor(low[0, seen]).astype(int), 0)[texel]
    count = np.where(within, np.maximum(np.minimum(column, pixels[1]) - left, 0), 0)
    beside = np.repeat(np.arange(count.size), count)
    columns = np.concatenate([column[inside], left[beside] + _ramp(count)])
    shares = np.concatenate([(steps * (u - column)).sum(axis=0)[inside], steps.sum(axis=0)[beside]])
    chosen = np.concatenate([inside, beside])
    return row[chosen] * pixels[1] + columns, seen[texel[chosen]], shares


def _pieces(parabolas: FloatArray, pixels: tuple[int, int]) -> tuple[IntArray, FloatArray, FloatArray]:
    """Pieces between crossings of pixels' sides: their parabola, in order, and their start and length of 0 to 1."""
    everything: IntArray = np.arange(int(parabolas.shape[2]))
    found, cuts = [everything], [np.zeros(everything.size)]
    for axis, size in enumerate(pixels[::-1]):
        start, control, end = parabolas[:, axis]
        first = np.maximum(np.ceil(parabolas[:, axis].min(axis=0)), 0)
        count = np.maximum(np.minimum(np.floor(parabolas[:, axis].max(axis=0)), size) - first + 1, 0).astype(int)
        edge = np.repeat(everything, count)
        a = (start - 2 * control + end)[edge]
        b = 2 * (control - start)[edge]
        c = start[edge] - first[edge] - _ramp(count)
        with np.errstate(divide="ignore", invalid="ignore"):
            q = -(b + np.copysign(np.sqrt(b * b - 4 * a * c), b)) / 2
            roots = q / a, c / q
        for root in roots:
            inside = (root > 0) & (root < 1)
            found.append(edge[inside])
            cuts.append(root[inside])
    edge, cut = np.concatenate(found), np.concatenate(cuts)
    order = np.lexsort((cut, edge))
    edge, cut = edge[order], cut[order]
    following = np.append(cut[1:], 1.0)
    following[np.append(edge[1:] != edge[:-1], True)] = 1.0
    return edge, cut, following - cut


def _ramp(count: IntArray) -> IntArray:
    """0, 1, ... count[k] - 1 for each k, one after the other."""
    return np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
