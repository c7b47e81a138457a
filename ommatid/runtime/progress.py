"""Who hears how far some work is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float], None]


def no_progress(fraction: float) -> None:
    """Report to nobody."""
