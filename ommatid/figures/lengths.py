"""Lengths and counts in words."""

from __future__ import annotations

UNITS = ((1e3, "m"), (1.0, "mm"), (1e-3, "µm"), (1e-6, "nm"))  # in mm


def length_words(length: float, digits: int = 4) -> str:
    """Return a length given in mm with its unit: 0.006 is 6 µm."""
    size, unit = next((entry for entry in UNITS if abs(length) >= entry[0] * (1 - 1e-9)), UNITS[-1])
    return f"{length / size:.{digits}g} {unit}"


def plural(count: int, noun: str) -> str:
    """Return a count with its noun."""
    return f"{count} {noun}{'' if count == 1 else 's'}"
