"""Points that stand for all normally distributed parameters of a misaligned sub-imager, with equal weights.

Edges of sensor pixels move by sums of parameters, and H has a kink where such a sum is zero. Second moments of H
follow from the second moments of the parameters, its mean from their absolute values. So the points are an orthogonal
array of strength 2 (Bose and Bush 1952): every parameter takes the same levels, and every two of them all pairs of
levels equally often. Means of products of functions of two parameters are therefore products of means, and the levels
give E|t|, E t^2 and E|t|^3 of a normal variable exactly. A parameter has the same levels whatever others there are,
so that a vanishing tolerance changes nothing.
"""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray

# |t| at a quarter of the points each, in standard deviations: the solution of three equations for the mean of |t|,
# t^2 and |t|^3 with two equal levels. E t^4 is 2.78 instead of 3: no four real levels have all four moments.
MAGNITUDES = (0.5615901610541997, 0.2499019887107961, 0.5615901610541997, 1.818455932392266)
# Columns of the array, one for each parameter; of all choices these have the least error of E|sum| over random sums.
COLUMNS = (0, 1, 2, 3, 4, 7)
ORDER = 8  # of the Galois field, and number of signed levels
MODULUS = 0b1011  # x^3 + x + 1


def points_of(free: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Return the weights, (points,), and the points, (points, 6) in standard deviations, of the parameters `free`.

    Parameters that are not free are 0. Every point's opposite is among the points.
    """
    a, b = (index.ravel() for index in np.indices((ORDER, ORDER)))
    table = np.array([[_product(first, second) for second in range(ORDER)] for first in range(ORDER)])
    levels = a[:, None] ^ table[b][:, list(COLUMNS)]
    scores = np.array(MAGNITUDES)[levels >> 1] * np.where(levels & 1, 1.0, -1.0) * free
    points, counts = np.unique(scores + 0.0, axis=0, return_counts=True)
    return np.asarray(counts / ORDER**2, dtype=np.float64), np.asarray(points, dtype=np.float64)


def _product(first: int, second: int) -> int:
    """Return the product of two elements of the field of 8 elements, polynomials over the field of 2."""
    product = 0
    for power in range(3):
        product ^= (first << power) * (second >> power & 1)
    for power in (4, 3):
        product ^= (MODULUS << (power - 3)) * (product >> power & 1)
    return product
