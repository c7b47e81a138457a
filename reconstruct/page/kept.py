"""report.html in a run's folder: kept while what it shows has not changed, written anew when it has."""

from __future__ import annotations

from pathlib import Path

from scenes.files import fingerprint, write_text
from scenes.model import Model
from scenes.stack import Stack
from scenes.versions import versions

from .data import described, read_run
from .effort import bench_of
from .response import Ideal
from .stamp import own_files, stamp_of

REPORT = "report.html"


def kept_page(
    folder: Path, ideal: Ideal | None, recorded: Stack | None = None, calibrated: Model | None = None
) -> bool:
    """Whether report.html of a finished run had to be written.

    ideal : H of one sub-imager as designed;  recorded, calibrated : of the folder, read only where they are not given
    Raises InputError for files that are missing or damaged, DeniedError for a disk that is full.
    """
    from scenes import stack

    recorded = stack.read(folder / "stack.exr") if recorded is None else recorded
    bench = bench_of(folder, recorded.camera.describe())
    made_from = fingerprint([described(folder), bench, versions("bokeh"), own_files()])
    path = folder / REPORT
    if stamp_of(path) == made_from:
        return False
    from .document import page

    write_text(path, page(read_run(folder, recorded, calibrated), ideal, bench, made_from))
    return True
