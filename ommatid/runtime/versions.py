"""What a result's record says of its origin: versions of libraries, the command, the time and the machine.

The command is kept in the environment, where processes that share its work find it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from importlib.metadata import version
from platform import node, python_version
from typing import Any

VARIABLE = "OMMATID_COMMAND"


def versions(*names: str) -> dict[str, str]:
    """Return installed versions by distribution name, always with those of Python, ommatid and numpy."""
    return {"python": python_version(), **{name: version(name) for name in ("ommatid", "numpy", *names)}}


@contextmanager
def command_line(words: Sequence[str]) -> Generator[None]:
    """Let `origin` return these words as the command; none: no command."""
    before = os.environ.get(VARIABLE)
    _set(json.dumps(list(words)) if words else None)
    try:
        yield
    finally:
        _set(before)


def command() -> tuple[str, ...]:
    """Return the words of the command line that this process works for; none in a script or a notebook."""
    return tuple(json.loads(os.environ.get(VARIABLE, "[]")))


def origin() -> dict[str, Any]:
    """Return `date` (UTC, ISO 8601), `host` and, where there is one, `command`."""
    words = command()
    here = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "host": node()}
    return {"command": words, **here} if words else here


def _set(value: str | None) -> None:
    if value is None:
        os.environ.pop(VARIABLE, None)
    else:
        os.environ[VARIABLE] = value
