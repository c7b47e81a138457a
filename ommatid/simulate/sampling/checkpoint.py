"""Checkpoints of interrupted computations, stored beside the result so that the next run continues from there."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.files import short_name, write_whole
from ommatid.scenes.formats import npz

State = dict[str, NDArray[Any]]

SPACING = 30.0  # seconds between two savings: the work that a power cut may lose
# Exceptions of a computation that continues from a state of other arrays than it saves.
_UNUSABLE = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError)
SHARE = 0.02  # of the time, at most, that goes into saving: after a large state the next one waits longer


class Checkpoint:
    """The finished part of a computation that a fingerprint identifies."""

    def __init__(self, path: Path, fingerprint: str) -> None:
        """Create the checkpoint of the result at `path`; nothing is read or written yet."""
        self._path = _beside(path)
        self._fingerprint = fingerprint
        self._saved, self._spacing = monotonic(), SPACING
        self._latest: Callable[[], State] | None = None
        self.continued = False  # from a state that was saved

    def state(self) -> State:
        """Return the state that an earlier run saved; empty if there is none or its fingerprint differs."""
        try:
            state = npz.read(self._path)
        except ValueError:
            return {}
        if str(state.pop("fingerprint", "")) != self._fingerprint:
            return {}
        self.continued = bool(state)
        return state

    def offer(self, latest: Callable[[], State]) -> None:
        """Register the current state, written every 30 seconds or more, and when the computation is interrupted."""
        self._latest = latest
        if monotonic() - self._saved > self._spacing:
            self.save()

    def save(self) -> None:
        """Write the state that was offered last. Raises MachineError."""
        if self._latest is None:
            return
        start = monotonic()
        state = {**self._latest(), "fingerprint": np.array(self._fingerprint)}

        def fill(beside: Path) -> None:
            with beside.open("wb") as stream:
                np.savez(stream, allow_pickle=False, **state)

        write_whole(self._path, fill)
        self._saved = monotonic()
        self._spacing = max(SPACING, (self._saved - start) / SHARE)


def _beside(path: Path) -> Path:
    return path.with_name(f".{short_name(path.name)}.partial.npz")


def _remove(path: Path) -> None:
    if not path.is_dir():  # one of another program
        path.unlink(missing_ok=True)


@contextmanager
def open_checkpoint(path: Path, fingerprint: str) -> Generator[Checkpoint]:
    """Open the checkpoint of the result at `path`: saved if the computation is interrupted, removed when it ends.

    Raises InputError where the computation fails because it continued from a state that it did not save.
    """
    checkpoint = Checkpoint(path, fingerprint)
    try:
        yield checkpoint
    except InputError:  # the next run would be refused as well
        raise
    except BaseException as error:
        if checkpoint.continued and isinstance(error, _UNUSABLE):
            raise InputError(
                f"{_beside(path)}: expected the state of an interrupted run, got another; delete it"
            ) from error
        try:
            checkpoint.save()
        except (InputError, MachineError):  # the original exception is the one to report
            _remove(_beside(path))
        raise
    _remove(_beside(path))
