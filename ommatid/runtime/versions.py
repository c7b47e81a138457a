"""Versions of the libraries that a result was made with."""

from __future__ import annotations

from importlib.metadata import version
from platform import python_version


def versions(*names: str) -> dict[str, str]:
    """Return installed versions by distribution name, always with those of Python, ommatid and numpy."""
    return {"python": python_version(), **{name: version(name) for name in ("ommatid", "numpy", *names)}}
