"""Which releases of the libraries made a result."""

from __future__ import annotations

from importlib.metadata import version
from platform import python_version


def versions(*names: str) -> dict[str, str]:
    """Installed versions by distribution name, Python's and our own included."""
    return {"python": python_version(), **{name: version(name) for name in ("ommatid", "numpy", *names)}}
