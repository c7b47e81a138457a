"""Areas of texels' images within sensor pixels, compiled; see `footprints` for what they are of.

The image of a texel's edge on the sensor is a rational curve of degree 5, (U, V) = (X(t), Y(t)) / W(t) for t from 0 to
1, in sensor pixels. By Green's theorem the area of a texel's image within pixel [j, j + 1] x [i, i + 1] is the sum over
its edges of

    integral of min(max(U - j, 0), 1) dV   over where i < V < i + 1.

Pixels' own sides need no integral, and the sum is continuous where edges and sides coincide. Each edge is cut where it
crosses sides, so that pieces are smooth; a piece in pixel (i, j) adds its integral of (U - j) dV to that, and the
rise of V to all pixels of the texel to its left.
"""

# pyright: basic
from __future__ import annotations

from math import comb

import numba
import numpy as np

DEGREE = 5
BERNSTEIN = np.array([[comb(i, k) / comb(DEGREE, k) for k in range(DEGREE + 1)] for i in range(DEGREE + 1)])
NODES, WEIGHTS = (x / 2 for x in np.polynomial.legendre.leggauss(6))  # exact to degree 11; X dY has degree 9
NODES = NODES + 0.5
ROUNDING = 4 * np.finfo(np.float64).eps
SHALLOWEST = 1e-6  # W; it is 1 in the middle of a patch, and near that on all of it
DEEPEST = 40  # halvings; roots nearer each other enclose no area that counts


@numba.njit(cache=True, nogil=True)
def curve(start, other, length, down, k1, k2, project, powers, net):
    """The image of an edge: coefficients of t^k, and of Bernstein's polynomials, of X, Y, W: (3, 6).

    The edge runs in x, or `down` in y, from `start` over `length`, the other coordinate is `other`: in units of r.
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


@numba.njit(cache=True, nogil=True)
def value(powers, t):
    """A polynomial and its derivative."""
    total, slope = powers[5], 0.0
    for k in range(4, -1, -1):
        slope = slope * t + total
        total = total * t + powers[k]
    return total, slope


@numba.njit(cache=True, nogil=True)
def single_root(powers, low, high, rising):
    """The only root between `low` and `high`, by Newton's method kept in a shrinking bracket."""
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


@numba.njit(cache=True, nogil=True)
def crossings(powers, net, tolerance, found, count):
    """Add to `found` where a polynomial changes its sign between 0 and 1; less than `tolerance` counts as 0.

    Bernstein's coefficients change sign at least as often as the polynomial; halves are looked at until it is once.
    """
    nets = np.empty((DEEPEST + 2, 6))
    ends = np.empty((DEEPEST + 2, 2))
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
            if count < found.size:
                found[count] = single_root(powers, low, high, first < 0)
                count += 1
        elif changes > 1 and waiting + 2 <= DEEPEST and high - low > 2.0**-DEEPEST:
            middle = (low + high) / 2
            if abs(value(powers, middle)[0]) <= tolerance and count < found.size:
                found[count] = middle  # a root that neither half may own
                count += 1
            for level in range(1, 6):  # de Casteljau: the left half's coefficients pass by, the right half's remain
                nets[waiting + 1, level - 1] = nets[waiting, 0]
                for k in range(6 - level):
                    nets[waiting, k] = (nets[waiting, k] + nets[waiting, k + 1]) / 2
            nets[waiting + 1, 5] = nets[waiting, 0]
            ends[waiting, 0], ends[waiting, 1] = middle, high
            ends[waiting + 1, 0], ends[waiting + 1, 1] = low, middle
            waiting += 2
    return count


@numba.njit(cache=True, nogil=True)
def bounds(net):
    """Least and largest U and V of a curve, from the net that it stays in."""
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for k in range(6):
        u, v = net[0, k] / net[2, k], net[1, k] / net[2, k]
        left, right = min(left, u), max(right, u)
        top, bottom = min(top, v), max(bottom, v)
    return left, right, top, bottom


@numba.njit(cache=True, nogil=True)
def cuts(powers, net, box, size, found):
    """Sorted values of t at which a curve crosses sides of pixels, 0 and 1 among them; how many.

    size : (columns, rows) of pixels
    """
    found[0], found[1], count = 0.0, 1.0, 2
    line, corners = np.empty(6), np.empty(6)
    for axis in range(2):
        for n in range(max(0, int(np.ceil(box[2 * axis]))), min(size[axis], int(np.floor(box[2 * axis + 1]))) + 1):
            for k in range(6):
                line[k] = powers[axis, k] - n * powers[2, k]
                corners[k] = net[axis, k] - n * net[2, k]
            count = crossings(line, corners, ROUNDING * (n + 1), found, count)
    for last in range(2, count):  # few, and compiled much sooner than a call of sort()
        t, place = found[last], last
        while found[place - 1] > t:
            found[place] = found[place - 1]
            place -= 1
        found[place] = t
    return count


@numba.njit(cache=True, nogil=True)
def add(powers, net, sign, size, first, cells, found):
    """Add a curve's integrals, times `sign`, to the pixels `cells` that begin at pixel `first` = (row, column)."""
    box = bounds(net)
    if box[3] <= first[0] or box[2] >= first[0] + cells.shape[0]:
        return
    count = cuts(powers, net, box, size, found)
    for piece in range(count - 1):
        low, length = found[piece], found[piece + 1] - found[piece]
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


@numba.njit(cache=True, nogil=True)
def surround(x, y, row, column, k1, k2, project, powers, nets):
    """The image of a texel: its edges, top, right, bottom and left, and (left, right, top, bottom) that hold them.

    One that the plane of a tilted patch does not show, W being next to nothing, lies nowhere.
    """
    wide, tall = x[column + 1] - x[column], y[row + 1] - y[row]
    curve(x[column], y[row], wide, False, k1, k2, project, powers[0], nets[0])
    curve(y[row], x[column + 1], tall, True, k1, k2, project, powers[1], nets[1])
    curve(x[column], y[row + 1], wide, False, k1, k2, project, powers[2], nets[2])
    curve(y[row], x[column], tall, True, k1, k2, project, powers[3], nets[3])
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for edge in range(4):
        for k in range(6):
            if nets[edge, 2, k] < SHALLOWEST:
                return 0.0, 0.0, 0.0, 0.0
        box = bounds(nets[edge])
        left, right = min(left, box[0]), max(right, box[1])
        top, bottom = min(top, box[2]), max(bottom, box[3])
    return left, right, top, bottom


@numba.njit(cache=True, nogil=True)
def shares(x, y, k1, k2, project, size, least):
    """What share of each pixel each texel's image covers, where that is more than `least`: pixels, texels, shares.

    x, y : (columns + 1,) and (rows + 1,) of the texels' edges in units of r;  size : (columns, rows) of pixels
    project : (3, 3) that makes (X, Y, W) of image tangents and 1
    """
    capacity, stored = 1024, 0
    pixels, texels, values = np.empty(capacity, np.int64), np.empty(capacity, np.int64), np.empty(capacity)
    powers, nets, found = np.empty((4, 3, 6)), np.empty((4, 3, 6)), np.empty(6 * (size[0] + size[1] + 4))
    signs = (1.0, 1.0, -1.0, -1.0)  # once around: edges run from the left and from the top
    for texel in range((y.size - 1) * (x.size - 1)):
        box = surround(x, y, texel // (x.size - 1), texel % (x.size - 1), k1, k2, project, powers, nets)
        if box[1] <= 0 or box[3] <= 0 or box[0] >= size[0] or box[2] >= size[1]:
            continue
        first = max(0, int(np.floor(box[2]))), max(0, int(np.floor(box[0])))
        last = min(size[1], int(np.ceil(box[3]))), min(size[0], int(np.ceil(box[1])))
        cells = np.zeros((last[0] - first[0], last[1] - first[1]))
        for edge in range(4):
            add(powers[edge], nets[edge], signs[edge], size, first, cells, found)
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


@numba.njit(cache=True, nogil=True)
def longer(array, capacity):
    """A copy with room for more."""
    copy = np.empty(capacity, array.dtype)
    for k in range(array.size):  # compiled much sooner than a slice
        copy[k] = array[k]
    return copy
