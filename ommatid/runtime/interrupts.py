"""Reliable Ctrl-C.

Python raises KeyboardInterrupt in whatever code the main thread is running. In a callback of the garbage collector or
in a `__del__` method the exception is printed and dropped, and the command would continue.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager


@contextmanager
def interrupts_remembered() -> Generator[Callable[[], None]]:
    """Yield a function that raises KeyboardInterrupt if Ctrl-C was pressed inside, even if the exception was dropped.

    Signals reach the main thread only; in other threads the function does nothing.
    """
    previous = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(previous):
        yield lambda: None
        return
    interrupted = False

    def remember(number: int, frame: object) -> None:
        nonlocal interrupted
        interrupted = True
        previous(number, frame)  # type: ignore[arg-type]

    def check() -> None:
        if interrupted:
            raise KeyboardInterrupt

    signal.signal(signal.SIGINT, remember)
    try:
        yield check
    finally:
        signal.signal(signal.SIGINT, previous)
