"""Progress callbacks."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float], None]  # takes the finished fraction, 0 to 1


def no_progress(fraction: float) -> None:
    """Ignore the progress."""
