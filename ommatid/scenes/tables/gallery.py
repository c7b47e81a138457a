"""Scenes that are installed with the program, found by name, and the scene file to start from."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from pathlib import Path
from typing import Any

GALLERY = Path(__file__).parents[1]
STARTER = "starter"
# By name, so that a user's own scene in the same folder of a checkout is not one of them.
NAMES = (
    *("corridor", "distorted", "doublet", "doublet119", "machine_vision", "misaligned", "photo", "planoconvex"),
    *("planoconvex119", "sensor", "sensor119", "single", "still_life", "tile19", "tile35", "tile41"),
)


def gallery_names() -> list[str]:
    """List the scenes of the gallery in alphabetical order."""
    return list(NAMES)


def find_scene(path: Path) -> Path:
    """Return the file of a gallery scene where `path` is its name and no such file exists, else `path`."""
    if str(path) in gallery_names() and not path.exists():
        return GALLERY / f"{path}.toml"
    return path


def missing_scene(path: Path) -> str:
    """Explain that neither a file nor a gallery scene is called `path`, naming the nearest gallery scene, if any."""
    names = gallery_names()
    beside = {file.name: str(file) for file in path.parent.glob("*.toml")} if path.parent.is_dir() else {}
    known = {f"{name}.toml": name for name in names} | beside
    nearest = get_close_matches(path.name if path.suffix else f"{path.name}.toml", known, 1, 0.7)
    hint = f"did you mean '{known[nearest[0]]}'? The" if nearest else "the"
    listed = f"{hint} gallery has {', '.join(names)}"
    return f"{path}: no such scene file; {listed}; `ommatid init {path.stem}.toml` writes a scene to start from"


def gallery_titles() -> dict[str, str]:
    """Return the title of each scene of the gallery by its name."""
    return {name: str(_tables(name).get("title", "")) for name in gallery_names()}


def write_starter(path: Path, name: str = STARTER) -> list[Path]:
    """Write a scene file to start from, with the files that it names beside it, and return all of them.

    name : of the scene of the gallery to copy
    Raises InputError if there is no such scene or if a file of another content is in the way, MachineError for a full
    disk.
    """
    from ommatid.runtime.errors import InputError
    from ommatid.runtime.files import make_folder, write_text
    from ommatid.runtime.outputs.kinds import check_output

    if name != STARTER and name not in gallery_names():
        raise InputError(f"--from {name}: expected a scene of the gallery, {', '.join(gallery_names())}")
    check_output(path)
    if path.exists():
        raise InputError(f"{path}: exists already; choose another name or remove it first")
    texts = {path.parent / file: (GALLERY / file).read_text(encoding="utf-8") for file in _files(name)}
    for target, text in texts.items():
        if target.parent.exists():
            check_output(target)
        if target.exists() and not _holds(target, text):
            raise InputError(f"{target}: exists already and differs from the file of '{name}'; choose another folder")
    for target, text in texts.items():
        make_folder(target.parent)
        write_text(target, text)
    write_text(path, (GALLERY / f"{name}.toml").read_text(encoding="utf-8"))
    return [path, *texts]


def _holds(path: Path, text: str) -> bool:
    from ommatid.runtime.input_files import read_bytes

    return read_bytes(path) == text.encode()


def _tables(name: str) -> dict[str, Any]:
    return tomllib.loads((GALLERY / f"{name}.toml").read_text(encoding="utf-8"))


def _files(name: str) -> list[str]:
    """Return the files, relative to the gallery, that a scene of it names: its world and its lenses."""
    tables = _tables(name)
    named = [tables.get("world", {}).get("file"), *(lens.get("surfaces") for lens in tables["camera"]["lens"])]
    return list(dict.fromkeys(file for file in named if isinstance(file, str)))
