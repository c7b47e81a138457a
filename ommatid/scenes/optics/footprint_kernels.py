"""Areas of texels' images within sensor pixels, compiled for `footprints`.

The image of a texel's edge on the sensor is a rational curve of degree 5, (U, V) = (X(t), Y(t)) / W(t) for t from 0 to
1, in sensor pixels. By Green's theorem the area of a texel's image within pixel [j, j + 1] x [i, i + 1] is the sum over
its edges of

    integral of min(max(U - j, 0), 1) dV   over i < V < i + 1.

The sides of pixels need no integral, and the sum is continuous where edges and sides coincide. Each edge is cut where
it crosses sides, so that the integrand of each piece is smooth; a piece in pixel (i, j) adds its integral of (U - j) dV
to that pixel, and its rise of V to all pixels to the left within the texel's bounds.
"""

# pyright: basic
from __future__ import annotations

from math import comb

import numpy as np

from ommatid.runtime.library_caches import compiled

DEGREE = 5
BERNSTEIN = np.array([[comb(i, k) / comb(DEGREE, k) for k in range(DEGREE + 1)] for i in range(DEGREE + 1)])
NODES, WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(6))  # exact to degree 11; X dY has degree 9
NODES = NODES + 0.5
ROUNDING = 4 * np.finfo(np.float64).eps
LEAST_DEPTH = 1e-6  # of W, which is 1 in the middle of a patch, and about 1 all over it
MOST_HALVINGS = 40  # roots closer together enclose no area that matters


@compiled
def curve(start, other, length, down, k1, k2, project, powers, net):
    """Fill `powers` and `net`, (3, 6), with the coefficients of X, Y, W of an edge in t^k and in Bernstein polynomials.

    The edge runs along x, or along y if `down`, from `start` over `length`; the other coordinate is `other`; in r.
    """
    w0, w1, w2 = start * start + other * other, 2 * start * length, length * length
    bend = k1 + 2 * w0 * k2
    s = (1 + w0 * (k1 + w0 * k2), w1 * bend, w2 * bend + w1 * w1 * k2, 2 * w1 * w2 * k2, w2 * w2 * k2)
    along, across = (1, 0) if down else (0, 1)
    for row in range(3):
        first, second = project[row, along], project[row, across] * other
        powers[row, 0] = (first * start + second) * s[0] + project[row, 2]
        for k in range(1, 5):
            powers[row, k] = (first * start + second) * s[k] + first * length * s[k - 1]
        powers[row, 5] = first * length * s[4]
        for i in range(6):
            total = 0.0
            for k in range(i + 1):
                total += BERNSTEIN[i, k] * powers[row, k]
            net[row, i] = total


@compiled
def value(powers, t):
    """The values at t of a polynomial and of its derivative."""
    total, slope = powers[5], 0.0
    for k in range(4, -1, -1):
        slope = slope * t + total
        total = total * t + powers[k]
    return total, slope


@compiled
def single_root(powers, low, high, rising):
    """The only root between `low` and `high`, by Newton's method within a shrinking bracket."""
    t = (low + high) / 2
    for _ in range(100):
        f, slope = value(powers, t)
        if (f > 0) == rising:
            high = t
        else:
            low = t
        step = f / slope if slope != 0 else np.inf
        if abs(step) < ROUNDING / 4:
            return t
        t = t - step if low < t - step < high else (low + high) / 2
        if high - low < ROUNDING / 4:
            return t
    return t


@compiled
def crossings(powers, net, tolerance, roots, count):
    """Add to `roots` where a polynomial changes sign between 0 and 1; values below `tolerance` count as 0.

    Bernstein's coefficients change sign at least as often as the polynomial; intervals are halved until they change
    once at most. Returns the number of roots in all.
    """
    nets = np.empty((MOST_HALVINGS + 2, 6))
    ends = np.empty((MOST_HALVINGS + 2, 2))
    for k in range(6):
        nets[0, k] = net[k]
    ends[0, 0], ends[0, 1] = 0.0, 1.0
    waiting = 1
    while waiting:
        waiting -= 1
        low, high = ends[waiting, 0], ends[waiting, 1]
        changes, before, first = 0, 0, 0
        for k in range(6):
            sign = 1 if nets[waiting, k] > tolerance else (-1 if nets[waiting, k] < -tolerance else 0)
            if sign:
                if before == 0:
                    first = sign
                elif sign != before:
                    changes += 1
                before = sign
        if changes == 1:
            if count < roots.size:
                roots[count] = single_root(powers, low, high, first < 0)
                count += 1
        elif changes > 1 and waiting + 2 <= MOST_HALVINGS and high - low > 2.0**-MOST_HALVINGS:
            middle = (low + high) / 2
            if abs(value(powers, middle)[0]) <= tolerance and count < roots.size:
                roots[count] = middle  # a root at the middle may be missed by both halves
                count += 1
            for level in range(1, 6):  # de Casteljau: `nets[waiting]` ends as the right half
                nets[waiting + 1, level - 1] = nets[waiting, 0]
                for k in range(6 - level):
                    nets[waiting, k] = (nets[waiting, k] + nets[waiting, k + 1]) / 2
            nets[waiting + 1, 5] = nets[waiting, 0]
            ends[waiting, 0], ends[waiting, 1] = middle, high
            ends[waiting + 1, 0], ends[waiting + 1, 1] = low, middle
            waiting += 2
    return count


@compiled
def bounds(net):
    """Bounds (least U, largest U, least V, largest V) of a curve, from the hull of its Bernstein coefficients."""
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for k in range(6):
        u, v = net[0, k] / net[2, k], net[1, k] / net[2, k]
        left, right = min(left, u), max(right, u)
        top, bottom = min(top, v), max(bottom, v)
    return left, right, top, bottom


@compiled
def cuts(powers, net, box, size, roots):
    """Fill `roots` with the sorted t, 0 and 1 included, where a curve crosses sides of pixels; return their number.

    size : (columns, rows) of pixels
    """
    roots[0], roots[1], count = 0.0, 1.0, 2
    line, corners = np.empty(6), np.empty(6)
    for axis in range(2):
        for n in range(max(0, int(np.ceil(box[2 * axis]))), min(size[axis], int(np.floor(box[2 * axis + 1]))) + 1):
            for k in range(6):
                line[k] = powers[axis, k] - n * powers[2, k]
                corners[k] = net[axis, k] - n * net[2, k]
            count = crossings(line, corners, ROUNDING * (n + 1), roots, count)
    for last in range(2, count):  # insertion sort: they are few, and sort() takes long to compile
        t, position = roots[last], last
        while roots[position - 1] > t:
            roots[position] = roots[position - 1]
            position -= 1
        roots[position] = t
    return count


@compiled
def add(powers, net, sign, size, first, cells, roots):
    """Add a curve's integrals, times `sign`, to the pixels `cells` that begin at pixel `first` = (row, column)."""
    box = bounds(net)
    if box[3] <= first[0] or box[2] >= first[0] + cells.shape[0]:
        return
    count = cuts(powers, net, box, size, roots)
    for piece in range(count - 1):
        low, length = roots[piece], roots[piece + 1] - roots[piece]
        w = value(powers[2], low + length / 2)[0]
        row = int(np.floor(value(powers[1], low + length / 2)[0] / w)) - first[0]
        if row < 0 or row >= cells.shape[0]:
            continue
        column = int(np.floor(value(powers[0], low + length / 2)[0] / w)) - first[1]
        rise, area = 0.0, 0.0
        for node in range(NODES.size):
            t = low + length * NODES[node]
            x, (y, dy), (w, dw) = value(powers[0], t)[0], value(powers[1], t), value(powers[2], t)
            step = WEIGHTS[node] * length * (dy - y / w * dw) / w
            rise += step
            area += step * (x / w - (column + first[1]))
        for left in range(min(column, cells.shape[1])):
            cells[row, left] += sign * rise
        if 0 <= column < cells.shape[1]:
            cells[row, column] += sign * area


@compiled
def texel_edges(x, y, row, column, k1, k2, project, powers, nets):
    """Fill `powers` and `nets` with a texel's edges, top, right, bottom, left; return (left, right, top, bottom).

    The bounds are empty for a texel that lies behind the plane of a tilted patch, where W is about 0 or less.
    """
    wide, tall = x[column + 1] - x[column], y[row + 1] - y[row]
    curve(x[column], y[row], wide, False, k1, k2, project, powers[0], nets[0])
    curve(y[row], x[column + 1], tall, True, k1, k2, project, powers[1], nets[1])
    curve(x[column], y[row + 1], wide, False, k1, k2, project, powers[2], nets[2])
    curve(y[row], x[column], tall, True, k1, k2, project, powers[3], nets[3])
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for edge in range(4):
        for k in range(6):
            if nets[edge, 2, k] < LEAST_DEPTH:
                return 0.0, 0.0, 0.0, 0.0
        box = bounds(nets[edge])
        left, right = min(left, box[0]), max(right, box[1])
        top, bottom = min(top, box[2]), max(bottom, box[3])
    return left, right, top, bottom


@compiled
def shares(x, y, k1, k2, project, size, least):
    """The shares of pixels that texels' images cover, where larger than `least`: indices of pixels, of texels, shares.

    x, y : (columns + 1,) and (rows + 1,) of the texels' edges in units of r;  size : (columns, rows) of pixels
    project : (3, 3) matrix from (image tangents, 1) to (X, Y, W)
    """
    capacity, stored = 1024, 0
    pixels, texels, values = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    powers, nets, roots = np.empty((4, 3, 6)), np.empty((4, 3, 6)), np.empty(6 * (size[0] + size[1] + 4))
    signs = (1.0, 1.0, -1.0, -1.0)  # around the texel: edges run from the left and from the top
    for texel in range((y.size - 1) * (x.size - 1)):
        box = texel_edges(x, y, texel // (x.size - 1), texel % (x.size - 1), k1, k2, project, powers, nets)
        if box[1] <= 0 or box[3] <= 0 or box[0] >= size[0] or box[2] >= size[1]:
            continue
        first = max(0, int(np.floor(box[2]))), max(0, int(np.floor(box[0])))
        last = min(size[1], int(np.ceil(box[3]))), min(size[0], int(np.ceil(box[1])))
        cells = np.zeros((last[0] - first[0], last[1] - first[1]))
        for edge in range(4):
            add(powers[edge], nets[edge], signs[edge], size, first, cells, roots)
        if stored + cells.size > capacity:
            capacity = 2 * (stored + cells.size)
            pixels, texels, values = longer(pixels, capacity), longer(texels, capacity), longer(values, capacity)
        for i in range(cells.shape[0]):
            for j in range(cells.shape[1]):
                if cells[i, j] > least:
                    pixels[stored], texels[stored] = (first[0] + i) * size[0] + first[1] + j, texel
                    values[stored] = cells[i, j]
                    stored += 1
    return pixels[:stored], texels[:stored], values[:stored]


@compiled
def longer(array, capacity):
    """A copy of an array with a larger capacity."""
    copy = np.empty(capacity, array.dtype)
    for k in range(array.size):  # compiles much faster than a slice
        copy[k] = array[k]
    return copy
