"""Memory that the dense forms of the estimator need."""

from __future__ import annotations


def needed_memory(form: str, measurements: int, unknowns: int, *, correlated: bool = False) -> int:
    """Return the bytes needed by a form and its error analysis; a `correlated` prior adds its root and copies of it."""
    both = measurements + unknowns
    matrix = {
        "covariance": 3 * measurements**2 + 2 * measurements * unknowns + 2 * unknowns**2,
        "information": 7 * unknowns**2,
        "square-root-information": 4 * both * unknowns + 2 * unknowns**2,
        "square-root-covariance": 3 * both**2,
        "svd": 4 * measurements * unknowns + 5 * unknowns**2,
        "dual": 5 * measurements * both + 4 * both * unknowns,
    }
    return 8 * (matrix[form] + (4 * unknowns**2 if correlated else 0))
