"""Every command, with a harmless scene, as it is run in a folder of traps."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from ..conftest import TINY
from .traps import make_traps

WORLD = """<scene version="3.0.0"><emitter type="constant"><rgb name="radiance" value="1"/></emitter>
<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><translate z="900"/></transform>
<bsdf type="diffuse"/></shape></scene>"""
RUN = ("results/tiny/stack.exr", "results/tiny/model.npz")
COMMANDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "show": (("tiny.toml", "--figure", "figure.png"),),
    "predict": (("tiny.toml",), ("tiny.toml", "--set", "world.file=world.xml", "--set", "world.white=1")),
    "design": (("tiny.toml",),),
    "run": (("tiny.toml", "-o", "results"), ("tiny.toml", "other.toml", "-o", "results", "--workers", "2")),
    "render": (("tiny.toml", "-o", "rendered"),),
    "calibrate": (("tiny.toml", "-o", "calibrated.npz"),),
    "reconstruct": ((*RUN, "-o", "reconstructed"),),
    "report": (("results",),),
    "figure": (("results/tiny", "-o", "slide.png"),),
    "check": (RUN,),
    "import": (("tiny.toml", "mosaic.npy", "-o", "imported.exr", "--origin", "0,0"),),
    "export": (("tiny.toml", "-o", "exported.xml"), (RUN[1], "-o", "exported.npz")),
    "init": (("mine.toml",),),
    "schema": ((),),
    "doctor": ((),),
}
SLOW: dict[str, tuple[tuple[str, ...], ...]] = {
    "bench": (("tiny.toml", "-o", "results/bench", "--within", "1 s"),),
    "paper": (("-o", "paper_results"),),
    "stability": (("-o", "stability_results"),),
}
TIME_LIMIT = 900.0  # seconds of a command that hangs


def trapped_folder(parent: Path) -> tuple[Path, Path, int]:
    """Return a folder of traps with two scenes, a world and a mosaic, that of the marks, and the number of traps."""
    folder, marks = parent / "downloaded", parent / "marks"
    folder.mkdir()
    marks.mkdir()
    count = make_traps(folder, marks)
    for name in ("tiny.toml", "other.toml"):
        (folder / name).write_text(TINY, encoding="utf-8")
    (folder / "world.xml").write_text(WORLD, encoding="utf-8")
    np.save(folder / "mosaic.npy", np.full((400, 400), 100, np.uint16))
    return folder, marks, count


def executed(marks: Path) -> list[str]:
    """Return the names of the traps that left their marks, and remove these."""
    found = sorted(marks.iterdir())
    for mark in found:
        mark.unlink()
    return [mark.name for mark in found]


def ended(words: tuple[str, ...], folder: Path) -> tuple[int, str, float]:
    """Run a command in a new process; return its exit code, its messages and its seconds."""
    script = shutil.which("ommatid", path=str(Path(sys.executable).parent))
    command = [script] if script else [sys.executable, "-P", "-m", "ommatid"]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONSAFEPATH")}
    start = perf_counter()
    process = subprocess.run(
        [*command, *words],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=TIME_LIMIT,
        check=False,
    )
    return process.returncode, process.stderr.decode(errors="replace"), perf_counter() - start
