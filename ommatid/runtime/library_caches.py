"""Folders in which libraries keep what they make: Dr.Jit its kernels, and Matplotlib its list of fonts.

They lie in the home folder. Where it cannot be written, the libraries print messages and work without.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def library_caches() -> Generator[None]:
    """Name a temporary folder in the environment for every cache whose folder cannot be written; remove it at the end.

    Processes that are started inside inherit it. Without any writable folder for it, nothing is named.
    """
    missing = [
        name
        for name, folders in _default_folders().items()
        if name not in os.environ and not all(map(_writable, folders))
    ]
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


def _default_folders() -> dict[str, list[Path]]:
    """For each variable that names a cache, the folders without it, which must all be usable."""
    home = Path(os.environ.get("HOME") or os.devnull)
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    cache = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return {
        "DRJIT_CACHE_DIR": [home / ".drjit"],
        "MPLCONFIGDIR": [config / "matplotlib", cache / "matplotlib"],
    }


def _writable(folder: Path) -> bool:
    """True if files can be made in a folder, which may have to be created, but whose home or system folder exists."""
    if not folder.is_absolute() or not folder.parts[1:]:
        return False
    try:
        existing = next(path for path in (folder, *folder.parents) if path.exists())
    except OSError:  # a folder that may not be entered
        return False
    return existing.is_dir() and os.access(existing, os.W_OK | os.X_OK) and existing != Path(folder.anchor)
