"""Ctrl-C that is not lost.

Python raises KeyboardInterrupt wherever it happens to be. Where that is a callback of the garbage collector or the end
of an object, it is printed and dropped, and the command would go on as if nothing had been pressed.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def interrupts_remembered() -> Generator[Callable[[], None]]:
    """A function that raises KeyboardInterrupt if there was one since, whoever swallowed it.

    Only the main thread is interrupted, so elsewhere the function never raises.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield _nothing
        return
    pressed: list[int] = []

    def remember(number: int, frame: object) -> None:
        pressed.append(number)
        before(number, frame)  # type: ignore[arg-type]

    def look() -> None:
        if pressed:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, remember)
    try:
        yield look
    finally:
        signal.signal(signal.SIGINT, before)


def _nothing() -> None:
    """Nobody is interrupted here."""
