"""report.html in a run's folder: kept while what it shows has not changed, written anew when it has."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path

from ommatid.reconstruct.output import run_json
from ommatid.runtime.files import cached, fingerprint, write_text
from ommatid.runtime.versions import versions
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from .data import read_run
from .point_response import Ideal
from .time_curves import bench_of

REPORT = "report.html"
HERE = Path(__file__).parent
BEGIN = 4096  # characters of a page, in which its stamp stands


def cached_page(
    folder: Path, ideal: Ideal | None, recorded: Stack | None = None, calibrated: Model | None = None
) -> bool:
    """Whether report.html of a finished run had to be written.

    ideal : H of one sub-imager as designed;  recorded, calibrated : of the folder, read only where they are not given
    Raises InputError for files that are missing or damaged, DeniedError for a disk that is full.
    """
    from ommatid.scenes import stack

    recorded = stack.read(folder / "stack.exr") if recorded is None else recorded
    bench = bench_of(folder, recorded.camera.describe())
    made_from = fingerprint([run_json.read(folder).plain(), bench, versions("bokeh"), own_files()])

    def make() -> str:
        from .document import page

        return page(read_run(folder, recorded, calibrated), ideal, bench, made_from)

    return cached(folder / REPORT, made_from, read_stamp, make, write_text)[1]


def read_stamp(path: Path) -> tuple[None, str | None]:
    """The fingerprint of a page on disk; None where it is none of ours, or half of one."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r'<meta name="ommatid" content="([0-9a-f]+)">', text[:BEGIN])
    return None, found[1] if found and text.rstrip().endswith("</html>") else None


def own_files() -> str:
    """SHA-256 of all that decides how pages look: a page that an older program drew is drawn anew."""
    total = hashlib.sha256()
    for path in sorted(
        path
        for path in (*HERE.iterdir(), *(HERE / "templates").iterdir())
        if path.suffix in (".py", ".html", ".css", ".js")
    ):
        total.update(path.read_bytes())
    return total.hexdigest()
