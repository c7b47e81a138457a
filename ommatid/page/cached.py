"""report.html in a run's folder, which is rewritten only if its content changes."""

from __future__ import annotations

import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from ommatid.bench.table import bench_tables
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.run_json import PAGE, before_page, with_stage, without_page
from ommatid.runtime.files import cached, fingerprint, write_text
from ommatid.runtime.input_files import open_input
from ommatid.scenes import stack

from .data import read_run

if TYPE_CHECKING:
    from .panels.point_response import IdealMatrix

REPORT = "report.html"
HERE = Path(__file__).parent
DRAWN = HERE.parent / "analysis" / "quality", HERE.parent / "figures"  # folders of what the pages draw
HEAD, TAIL = 4096, 64  # bytes at the beginning of a page that contain its stamp, and at its end


def cached_page(folder: Path, ideal: IdealMatrix | None) -> bool:
    """Write report.html of a finished run unless it is up to date, and return True if it was written.

    The time that the first page takes is added to run.json.

    ideal : H of one sub-imager as designed
    Raises InputError for missing or damaged files, MachineError for a full disk.
    """
    recorded, report = stack.read(folder / "stack.exr"), run_json.read(folder)
    bench = next(bench_tables(folder, recorded.camera.describe()), None)
    described = None if bench is None else bench.describe()
    stamp = fingerprint([without_page(report), described, sources_digest()])

    def make() -> str:
        begun = perf_counter()
        from .sections import page
        from .tables import with_page_time

        run = read_run(folder, recorded)
        html = page(replace(run, report=before_page(run.report)), ideal, bench, stamp)
        if PAGE not in report.stages:  # a page that is made again is the same
            stages = with_stage(report, PAGE, perf_counter() - begun)
            run_json.write(folder, stages)
            return with_page_time(html, stages.stages[PAGE].seconds)
        return with_page_time(html, report.stages[PAGE].seconds)

    return cached(folder / REPORT, stamp, read_stamp, make, write_text)[1]


def read_stamp(path: Path) -> tuple[None, str | None]:
    """Return the fingerprint of a page on disk; None for a foreign or truncated file."""
    with open_input(path) as stream:
        head = stream.read(HEAD)
        stream.seek(-min(TAIL, stream.seek(0, os.SEEK_END)), os.SEEK_END)
        end = stream.read(TAIL)
    match = re.search(rb'<meta name="ommatid" content="([0-9a-f]+)">', head)
    return None, match[1].decode() if match and end.rstrip().endswith(b"</html>") else None


def sources_digest() -> str:
    """Return the SHA-256 of the modules and templates of the pages: a new version redraws the pages."""
    total = hashlib.sha256()
    sources = [*HERE.rglob("*.py"), *(HERE / "templates").iterdir()]
    sources += [path for folder in DRAWN for path in folder.glob("*.py")]
    for path in sorted(sources):
        total.update(path.read_bytes())
    return total.hexdigest()
