"""Folders in which libraries keep what they compile: Numba functions, Dr.Jit kernels, and matplotlib its list of fonts.

They lie beside the program and in the home folder. Where neither can be written, Numba raises an exception, and the
others print messages and work without.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

Function = TypeVar("Function", bound=Callable[..., Any])

PACKAGE = Path(__file__).parents[1]


@contextmanager
def library_caches() -> Generator[None]:
    """Name a temporary folder in the environment for every cache whose folder cannot be written; remove it at the end.

    Processes that are started inside inherit it. Without any writable folder for it, nothing is named.
    """
    missing = [name for name, folders in _default_folders().items() if name not in os.environ and not _usable(folders)]
    if not missing:
        yield
        return
    import tempfile

    try:
        temporary = tempfile.TemporaryDirectory(prefix="ommatid-", ignore_cleanup_errors=True)
    except OSError:
        yield
        return
    with temporary as folder:
        os.environ.update({name: str(Path(folder, name.lower())) for name in missing})
        try:
            for name in missing:
                Path(os.environ[name]).mkdir()
            yield
        finally:
            for name in missing:
                os.environ.pop(name, None)


def compiled(function: Function) -> Function:
    """Compile a function of numbers with Numba, and keep the machine code for later processes where that is possible.

    It runs without Python's lock.
    """
    import numba

    try:
        return numba.njit(cache=True, nogil=True)(function)  # pyright: ignore
    except RuntimeError:  # no folder can be written
        return numba.njit(nogil=True)(function)  # pyright: ignore


def _default_folders() -> dict[str, list[list[Path]]]:
    """For each variable that names a cache, the groups of folders without it, of which one group must be usable."""
    named = os.environ.get("HOME", "")
    home = _home()
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return {
        "DRJIT_CACHE_DIR": [[Path(named, ".drjit")]] if named else [],
        "MPLCONFIGDIR": [[config / "matplotlib", cache / "matplotlib"]],
        "NUMBA_CACHE_DIR": [[PACKAGE / "__pycache__"], [cache / "numba"]],
    }


def _home() -> Path:
    """Return the home folder; one that does not exist for a user without any."""
    try:
        return Path.home() if os.environ.get("HOME") != "" else Path(os.devnull)  # empty: would be the root folder
    except RuntimeError:
        return Path(os.devnull)


def _usable(groups: list[list[Path]]) -> bool:
    return any(all(_writable(folder) for folder in group) for group in groups)


def _writable(folder: Path) -> bool:
    """True if files can be made in a folder, which may have to be created, but whose home or system folder exists."""
    if not folder.is_absolute() or not folder.parts[1:]:
        return False
    try:
        existing = next(path for path in (folder, *folder.parents) if path.exists())
    except OSError:  # a folder that may not be entered
        return False
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK) and existing != Path(folder.anchor)
