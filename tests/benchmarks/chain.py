"""The whole chain from picture to page, stage by stage: `python -m tests.benchmarks chain [SIZE...] [--cases NAMES]`.

Every case is a command `ommatid run` in a process of its own, whose time, peak memory and files are
measured from outside, and whose stages come from run.json. Frames of 60 k - 1 pixels a side are seen by all three lens
types to their edges.
"""

from __future__ import annotations

import json
import os
import sys
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from ommatid.scenes.constants import WHITE

ROOT = Path(__file__).parents[2]
SIZES = (119, 239, 479, 1019)
NARROWEST = 200
PITCH = 4.4e-3  # mm between lenses per pixel of f's side: sub-images of pixels of 6 um do not overlap
STAGES = ("start-up", "render", "calibrate", "reconstruct", "files", "page")
LENSES = ("I", "II", "III")
AUTO = ("render.samples=auto", "calibration.samples=auto")
APERTURES = tuple(f'camera.lens.{name}.aperture="0.4 mm"' for name in LENSES)


@dataclass(frozen=True)
class Case:
    """A scene with changes of its keys, the largest side for which it is of use, and the world's pixels in one of f."""

    name: str
    scene: str
    changes: tuple[str, ...]
    largest: int = 5000
    detail: int = 1


CASES = (
    Case("ideal pinholes", "photo.toml", (*AUTO, "calibration.method=ideal")),
    Case("point sources", "photo.toml", AUTO),
    Case("misaligned pinholes", "photo.toml", (*AUTO, 'camera.tolerance.position="41 nm"')),
    Case("thin lenses of 0.4 mm", "photo.toml", (*AUTO, *APERTURES)),
    # By "auto" surfaces take a million rays per sensor pixel; the scene's are 4096.
    Case("doublet", "doublet119.toml", ("target.detail=1",), largest=239),
    Case("doublet, detail 3", "doublet119.toml", (), largest=239, detail=3),
)


@dataclass(frozen=True)
class Measurement:
    """A run of a case: seconds, peak memory and bytes of files, run.json, and why it failed."""

    seconds: float
    memory: float
    files: int
    report: dict[str, Any]
    failure: str = ""


def command(arguments: Sequence[str]) -> None:
    """Measure the cases at the sizes of the command line, and print a row as soon as it is complete."""
    parser = ArgumentParser("python -m tests.benchmarks chain", description=str(__doc__).splitlines()[0])
    parser.add_argument("sizes", nargs="*", type=int, metavar="SIZE", help="pixels a side; default: 119 239 479 1019")
    parser.add_argument(
        "--cases", default="", metavar="NAME,...", help="ideal, point, misaligned, thin or doublet; default: all"
    )
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a key of every scene")
    options = parser.parse_args(arguments)
    chosen = [word for word in options.cases.split(",") if word]
    console = Console()
    console.width = max(console.width, NARROWEST)
    for case in CASES:
        if chosen and not any(case.name.startswith(word) for word in chosen):
            continue
        for size in options.sizes or SIZES:
            if size <= case.largest:
                console.print(table([(case, size, measure(case, size, options.set))]))


def measure(case: Case, size: int, changes: Sequence[str] = ()) -> Measurement:
    """Run a case once in a process and a folder of its own."""
    with TemporaryDirectory(prefix="ommatid-chain-") as folder:
        picture = Path(folder) / "picture.npy"
        np.save(picture, picture_of(case.detail * size))
        out = Path(folder) / "out"
        settings = (f'target.image="{picture}"', "target.origin=[0,0]", f"target.shape=[{size},{size}]")
        pitch = f'camera.lens_pitch="{max(1.0, round(PITCH * size, 2)) * _pixel(case):g} mm"'
        words = [word for change in (*settings, pitch, *case.changes, *changes) for word in ("--set", change)]
        code = [sys.executable, "-m", "ommatid", "run", str(ROOT / "scenes" / case.scene), *words, "-o", str(out)]
        begun = perf_counter()
        process = Popen(code, cwd=ROOT, stdout=DEVNULL, stderr=PIPE)
        errors = b"" if process.stderr is None else process.stderr.read()
        _, status, usage = os.wait4(process.pid, 0)
        seconds = perf_counter() - begun
        process.returncode = os.waitstatus_to_exitcode(status)
        made = out / Path(case.scene).stem
        files = sum(path.stat().st_size for path in made.iterdir()) if made.is_dir() else 0
        report = json.loads((made / "run.json").read_text("utf-8")) if (made / "run.json").exists() else {}
        failure = errors.decode(errors="replace").strip().splitlines()[-1] if process.returncode else ""
    kilobytes = usage.ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return Measurement(seconds, kilobytes * 1024, files, report, failure)


def _pixel(case: Case) -> float:
    """Return the pitch of the sensor pixels of a case, relative to 6 um."""
    return 3.0 if case.scene.startswith("doublet") else 1.0


def picture_of(size: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Return a photograph of size x size pixels: scikit-image's, mirrored as often as needed, with grain of its own."""
    from skimage import data

    photograph = np.asarray(data.camera(), dtype=np.float32)
    times = -(-size // photograph.shape[0])
    picture = np.pad(photograph, [(0, (times - 1) * side) for side in photograph.shape], mode="symmetric")
    grain = np.random.default_rng(0).normal(0, 3, (size, size))
    return np.clip(picture[:size, :size] + grain, 0, WHITE).astype(np.float32)


def table(rows: Sequence[tuple[Case, int, Measurement]]) -> Table:
    """Return the measurements as a table."""
    result = Table(title="From picture to page")
    for name in ("case", "side", "all", *STAGES, "memory", "files", "MSE", "99 %", "chi-squared", "verdict"):
        result.add_column(name, justify="left" if name == "case" else "right")
    for case, size, measured in rows:
        result.add_row(case.name, str(size), *_cells(measured))
    return result


def _cells(measured: Measurement) -> list[str]:
    whole = f"{measured.seconds:.1f} s"
    if measured.failure:
        return [whole, measured.failure]
    seconds = {name: stage["seconds"] for name, stage in measured.report["stages"].items()}
    seconds["start-up"] = measured.report["spent"].get("start_up", 0.0)
    stages = (f"{seconds.get(name, 0.0):.1f} s" for name in STAGES)
    error, residual = measured.report["error"], measured.report["diagnostics"]["chi_squared"]
    given = error["expected_given_truth"]
    ratio = residual["chi_squared"] / residual["expected"]
    found = f"{error['mse']:.4g}", f"{given['low']:.4g} to {given['high']:.4g}", f"{ratio:.3f}"
    return [
        whole,
        *stages,
        f"{measured.memory / 1e9:.2f} GB",
        f"{measured.files / 1e6:.3g} MB",
        *found,
        measured.report["verdict"]["level"],
    ]
