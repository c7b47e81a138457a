"""report.html in a run's folder, which is rewritten only if its content changes."""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path

from ommatid.bench.table import bench_tables
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, fingerprint, write_text
from ommatid.runtime.input_files import open_input
from ommatid.scenes import stack
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from .data import read_run

REPORT = "report.html"
HERE = Path(__file__).parent
FIGURES = HERE.parent / "figures"  # what the pages draw
HEAD, TAIL = 4096, 64  # bytes at the beginning of a page that contain its stamp, and at its end


def cached_page(
    folder: Path, report: RunReport, recorded: Stack | None = None, calibrated: Model | None = None
) -> bool:
    """Write report.html of a run unless it is up to date, and return True if it was written.

    report : of the run, of which times of files and of the page do not count
    recorded, calibrated : the stack and the model in the folder, None to read them
    Raises InputError for missing or damaged files, MachineError for a full disk.
    """
    report = report.of_stages()
    recorded = stack.read(folder / "stack.exr") if recorded is None else recorded
    bench = next(bench_tables(folder, recorded.camera.describe()), None)
    described = None if bench is None else bench.describe()
    stamp = fingerprint([report.plain(), described, sources_digest()])

    def make() -> str:
        from .sections import page

        return page(read_run(folder, report, recorded, calibrated), bench, stamp)

    return cached(folder / REPORT, stamp, read_stamp, make, write_text)[1]


def read_stamp(path: Path) -> tuple[None, str | None]:
    """Return the fingerprint of a page on disk; None for a foreign or truncated file."""
    with open_input(path) as stream:
        head = stream.read(HEAD)
        stream.seek(-min(TAIL, stream.seek(0, os.SEEK_END)), os.SEEK_END)
        end = stream.read(TAIL)
    match = re.search(rb'<meta name="ommatid" content="([0-9a-f]+)">', head)
    return None, match[1].decode() if match and end.rstrip().endswith(b"</html>") else None


def check_own_page(path: Path) -> None:
    """Raise InputError if a page of another program would be replaced by one of this program."""
    if path.is_file() and not path.is_symlink() and path.stat().st_size and read_stamp(path)[1] is None:
        raise InputError(
            f"{path}: would be replaced, but is a page of another program; move it, or choose another folder with -o"
        )


def sources_digest() -> str:
    """Return the SHA-256 of the modules and templates of the pages: a new version redraws the pages."""
    total = hashlib.sha256()
    sources = [*HERE.rglob("*.py"), *(HERE / "templates").iterdir()]
    for path in sorted([*sources, *FIGURES.glob("*.py")]):
        total.update(path.read_bytes())
    return total.hexdigest()
