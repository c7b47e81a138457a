"""Work that was broken off: what is done of it waits beside the result, and the next run carries on from there."""

from __future__ import annotations

from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.errors import MachineError
from ommatid.runtime.files import write_whole
from ommatid.scenes.formats import npz

State = dict[str, NDArray[Any]]

SPACING = 30.0  # seconds between two savings: what a power cut may cost


class Checkpoint:
    """What is done so far of something that a fingerprint names."""

    def __init__(self, path: Path, fingerprint: str) -> None:
        """Of the result that will stand at `path`."""
        self._path = _beside(path)
        self._fingerprint = fingerprint
        self._saved = monotonic()
        self._latest: Callable[[], State] | None = None

    def state(self) -> State:
        """What an earlier run left, if it was of the same; else nothing."""
        try:
            found = npz.read(self._path)
        except ValueError:
            return {}
        return found if str(found.pop("fingerprint", "")) == self._fingerprint else {}

    def offer(self, latest: Callable[[], State]) -> None:
        """Say how far the work is; it is written now and then, and when the work is broken off."""
        self._latest = latest
        if monotonic() - self._saved > SPACING:
            self.save()

    def save(self) -> None:
        """Write what was offered last. Raises DeniedError."""
        if self._latest is None:
            return
        state = {**self._latest(), "fingerprint": np.array(self._fingerprint)}

        def fill(beside: Path) -> None:
            with beside.open("wb") as stream:
                np.savez(stream, allow_pickle=False, **state)

        write_whole(self._path, fill)
        self._saved = monotonic()

    def remove(self) -> None:
        """The work is done."""
        self._path.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f".{path.name}.partial.npz")


@contextmanager
def open_checkpoint(path: Path, fingerprint: str) -> Generator[Checkpoint]:
    """What is done so far of the result at `path`: kept when the work is broken off, removed when it is done."""
    partial = Checkpoint(path, fingerprint)
    try:
        yield partial
    except BaseException:
        try:
            partial.save()
        except MachineError:  # what broke the work off is the thing to tell
            partial.remove()
        raise
    partial.remove()
