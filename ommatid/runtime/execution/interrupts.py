"""Ctrl-C: stops a command once. Pressed again, it would interrupt what saves the state and ends the workers."""

from __future__ import annotations

import signal
from time import monotonic

STOPPING = 15.0  # seconds in which a command stops; then the next one counts, since a library may have lost the first

_raised: list[float] = []


def interrupt_once(number: int, frame: object) -> None:
    """Raise KeyboardInterrupt unless that was done less than STOPPING ago; a handler of SIGINT."""
    del number, frame
    now = monotonic()
    if not _raised or now - _raised[-1] > STOPPING:
        _raised.append(now)
        raise KeyboardInterrupt


def heed_interrupts() -> None:
    """Let Ctrl-C stop this command once, unless it is ignored, as by nohup."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, interrupt_once)
