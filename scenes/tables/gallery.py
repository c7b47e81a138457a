"""Scenes that are installed with the program, found by name, and the scene file to start from."""

from __future__ import annotations

from difflib import get_close_matches
from pathlib import Path

GALLERY = Path(__file__).parents[1]
STARTER = "starter"


def gallery_names() -> list[str]:
    """List the scenes of the gallery in alphabetical order."""
    return sorted(path.stem for path in GALLERY.glob("*.toml") if path.stem != STARTER)


def find_scene(path: Path) -> Path:
    """Return the file of a gallery scene where `path` is its name and no such file exists, else `path`."""
    if not path.exists() and str(path) in gallery_names():
        return GALLERY / f"{path}.toml"
    return path


def missing_scene(path: Path) -> str:
    """Explain that neither a file nor a gallery scene is called `path`, naming the nearest gallery scene, if any."""
    names = gallery_names()
    nearest = get_close_matches(path.stem, names, 1)
    hint = f"did you mean '{nearest[0]}'? The" if nearest else "the"
    listed = f"{hint} gallery has {', '.join(names)}"
    return f"{path}: no such scene file; {listed}; `ommatid init {path.stem}.toml` writes a scene to start from"


def write_starter(path: Path) -> None:
    """Write a scene file to start from. Raises InputError if `path` exists, MachineError for a full disk."""
    from ommatid.runtime.errors import InputError
    from ommatid.runtime.files import write_text

    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or remove it first")
    write_text(path, (GALLERY / f"{STARTER}.toml").read_text(encoding="utf-8"))
