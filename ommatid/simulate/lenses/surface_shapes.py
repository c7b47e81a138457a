"""Points where rays meet the surfaces of a lens, and the normals there.

Plain functions of coordinates relative to the vertex of the surface, lengths in millimetres; the arrays may be NumPy's
or Dr.Jit's, see `Functions`. A conic of revolution, c (x^2 + y^2 + (1 + k) z^2) = 2 z, is met in closed form (G. H.
Spencer, M. V. R. K. Murty, J. Opt. Soc. Am. 52, 672 (1962)). An even asphere adds a polynomial to its sag,

    z(r) = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a4 r^4 + a6 r^6 + ... + a16 r^16,

and is met by Newton's method along the ray, from the point of the conic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

Direction = tuple[Any, Any, Any]

STEPS = 8  # of Newton's method; the error is squared by each
CONVERGED = 1e-5  # largest last step, in semi-diameters, above which a ray is blocked
LONGEST = 2.0  # step in semi-diameters, beyond which the method has failed
BEYOND = 4.0  # r^2 over that of the rim, where the polynomial ends; rays out there are blocked anyway
STEEPEST = 1e-3  # least cosine times length of the normal, with which Newton's method divides


class Functions(NamedTuple):
    """Functions that differ between NumPy and Dr.Jit."""

    sqrt: Callable[..., Any]
    where: Callable[..., Any]
    maximum: Callable[..., Any]


NUMPY = Functions(np.sqrt, np.where, np.maximum)


class Meeting(NamedTuple):
    """Where a ray meets a surface: distance along the ray, point, normal of any length with z > 0, their products.

    cosine : of the angle of incidence times the length of the normal;  passed : True if the ray meets the surface
    """

    run: Any
    point: Direction
    normal: Direction
    cosine: Any
    passed: Any


def meet_conic(
    curvature: Any, shape: Any, x: Any, y: Any, direction: Direction, functions: Functions, passed: Any
) -> Meeting:
    """Return where a ray that crosses the vertex plane at (x, y) meets a conic; `shape` is 1 + its conic constant."""
    u, v, w = direction
    # a t^2 - 2 b t + c = 0; in this form the nearer root loses no digit, and a plane is no special case
    a = curvature * (u * u + v * v + shape * w * w)
    b = w - curvature * (x * u + y * v)
    c = curvature * (x * x + y * y)
    square = b * b - a * c
    cosine = functions.sqrt(functions.maximum(square, 0.0))
    passed = passed & (square > 0) & (b + cosine > 0)
    run = functions.where(passed, c / functions.where(passed, b + cosine, 1.0), 0.0)
    x, y, z = x + run * u, y + run * v, run * w
    normal = -curvature * x, -curvature * y, 1 - curvature * shape * z
    return Meeting(run, (x, y, z), normal, cosine, passed & (normal[2] > 0))


def meet_asphere(
    surface: Sequence[Any], x: Any, y: Any, direction: Direction, functions: Functions, passed: Any
) -> Meeting:
    """Return where a ray that crosses the vertex plane at (x, y) meets an even asphere.

    surface : curvature, 1 + conic constant, square of the semi-diameter, and then the sag at the rim that each term of
        the polynomial, from r^4 on, adds
    """
    curvature, shape, opening, *terms = surface
    u, v, w = direction
    total, (x, y, z), *_ = meet_conic(curvature, shape, x, y, direction, functions, passed)
    step = total
    for _ in range(STEPS):
        sag, slope, _ = _sag(curvature, shape, opening, terms, x * x + y * y, functions)
        toward = w - 2 * slope * (x * u + y * v)
        step = (sag - z) / functions.where(toward > STEEPEST, toward, 1.0)
        run = functions.where(step * step < LONGEST**2 * opening, step, 0.0)
        total, x, y, z = total + run, x + run * u, y + run * v, z + run * w
    _, slope, exists = _sag(curvature, shape, opening, terms, x * x + y * y, functions)
    cosine = w - 2 * slope * (x * u + y * v)
    passed = passed & exists & (cosine > 0) & (step * step <= CONVERGED**2 * opening)
    return Meeting(total, (x, y, z), (-2 * slope * x, -2 * slope * y, 1.0), cosine, passed)


def _sag(
    curvature: Any, shape: Any, opening: Any, terms: Sequence[Any], square: Any, functions: Functions
) -> tuple[Any, Any, Any]:
    """Return the sag at r^2 = `square`, its derivative by r^2, and whether the conic reaches so far."""
    inner = 1 - shape * curvature * curvature * square
    exists = inner > 0
    root = functions.sqrt(functions.where(exists, inner, 1.0))
    share = square / opening
    share = functions.where(share < BEYOND, share, BEYOND)
    value, slope = 0.0 * share, 0.0 * share
    for term in reversed(terms):
        value, slope = value * share + term, slope * share + value
    sag = curvature * square / (1 + root) + share * share * value
    return sag, curvature / (2 * root) + (2 * share * value + share * share * slope) / opening, exists
