"""Names of the plugins and metals that the installed Mitsuba ships, found without loading it."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

LIBRARIES = (".so", ".dylib", ".dll")
METAL = ".eta.spd"


@cache
def mitsuba_folder() -> Path:
    """Return the folder of the installed Mitsuba. Raises ModuleNotFoundError if there is none."""
    spec = find_spec("mitsuba")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'mitsuba'", name="mitsuba")
    return Path(spec.origin).parent


@cache
def plugin_names() -> frozenset[str]:
    """Return the names of Mitsuba's plugins."""
    return frozenset(path.stem for path in (mitsuba_folder() / "plugins").iterdir() if path.suffix in LIBRARIES)


@cache
def metals() -> frozenset[str]:
    """Return the materials whose optical constants Mitsuba ships."""
    found = (mitsuba_folder() / "data" / "ior").glob(f"*{METAL}")
    return frozenset({"none", *(path.name.removesuffix(METAL) for path in found)})
