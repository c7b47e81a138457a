"""Error against run time of every stage of a scene: what `bench` measures, writes, draws and recommends."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import cast

import numpy as np

from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import digest, fingerprint, make_folder
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.scene import Sampler, Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.sampling.passes import FEWEST_PASSES
from ommatid.simulate.sampling.samplers import corners, law
from ommatid.simulate.validation import check_scene

from . import table as bench_file
from .figure import write_figures
from .jobs import Subject, jobs
from .reference import REFERENCE, reference
from .scheduler import Job, Journal, measure, name_of
from .slopes import recommend, slope
from .table import JSON, BenchTable, Cell, ConvergenceCurve, SkippedJob, Stage

PARTIAL = ".bench.partial.jsonl"
FLAT: dict[Stage, float] = {"render": 1e-5 * WHITE, "calibrate": 1e-5}  # errors below which float32 shows, and no slope
PATIENCE = 0.1  # of the time: how long the noise alone may take
SETTING_UP = 0.02  # of the progress: the reference, and what the noise alone leaves


def bench(setup: Setup, folder: Path, seconds: float, progress: Progress) -> tuple[BenchTable, bool]:
    """The table of a scene, and whether anything had to be measured for it; what stands in `folder` is not repeated.

    seconds : that it may take; cells that do not fit are left out
    Raises InputError for a scene that cannot be measured, and where `folder` holds the table of another scene.
    """
    start = perf_counter()
    setup = replace(setup, scene=_as_measured(setup.scene))
    _refuse(setup)
    what = _described(setup)
    made = fingerprint([what, versions("mitsuba", "drjit", "scipy")])
    old = _standing(folder, what)
    if old is not None and old.fingerprint == made and not (old.budget < seconds and any(o.late for o in old.left_out)):
        return old, False
    make_folder(folder)
    finished = Journal(folder / PARTIAL, made)
    if old is not None and old.fingerprint == made:
        for cell in old.cells:
            finished.cells.setdefault(name_of(cell), cell)
        finished.seconds = max(finished.seconds, old.seconds)
    before = finished.seconds
    with naming_source(setup.scene.source):
        found = reference(setup, folder, lambda done: progress(SETTING_UP * done))
        subject = Subject(setup, found, PATIENCE * seconds)
        told, left_out = jobs(subject)
    spent = perf_counter() - start
    late = measure(told, seconds, finished, lambda done: progress(SETTING_UP + (1 - SETTING_UP) * done), spent)
    left_out += [SkippedJob(name, why) for name, why in finished.refused.items()]
    total = before + perf_counter() - start
    table = _table(subject, told, finished, [*left_out, *late], (what, made, seconds, total))
    write_figures(folder, table)
    bench_file.write(folder, table)
    finished.remove()
    (folder / REFERENCE).unlink(missing_ok=True)
    return table, True


def _as_measured(scene: Scene) -> Scene:
    """Without what the cells set themselves; a misaligned camera is one whose H was calibrated."""
    estimator = scene.estimator.model_copy(update={"misalignment": "trust"})
    return scene.model_copy(update={"estimator": estimator, "study": None})


def _refuse(setup: Setup) -> None:
    if setup.scene.world is not None:
        raise InputError(
            f"{setup.scene.source}: bench measures flat targets, got a [world]; remove it, or take another scene"
        )
    check_scene(setup, calibrates=False)


def _described(setup: Setup) -> str:
    """Fingerprint of what is measured, whatever samples and methods the scene itself asks for."""
    tables = setup.scene.plain()
    for table, keys in {"render": ("samples", "variant"), "calibration": ("samples", "method", "fit")}.items():
        tables[table] = {key: value for key, value in tables[table].items() if key not in keys}
    for name in ("title", "target"):
        tables.pop(name, None)
    return fingerprint([setup.camera.describe(), tables, digest(setup.image.astype("float32"))])


def _standing(folder: Path, what: str) -> BenchTable | None:
    path = folder / JSON
    if not path.exists():
        return None
    try:
        old = bench_file.read(path)
    except InputError:  # damaged: to be made again
        return None
    if old.scene != what:
        raise InputError(
            f"{path}: is of another scene, '{old.title}', or of other values of its keys; choose another folder with -o"
        )
    return old


def _table(
    subject: Subject,
    told: Sequence[Job],
    finished: Journal,
    left_out: list[SkippedJob],
    numbers: tuple[str, str, float, float],
) -> BenchTable:
    cells = [finished.cells[job.name] for job in told if job.name in finished.cells]
    what, made, budget, total = numbers
    return BenchTable(
        title=subject.scene.title or subject.scene.source.stem,
        scene=what,
        fingerprint=made,
        camera=subject.camera.describe(),
        machine={"cores": os.cpu_count(), "system": platform.platform(), "load": os.getloadavg()[0]},
        versions=versions("mitsuba", "drjit", "scipy"),
        against=subject.reference.words,
        noise_deviation=_noise_deviation(subject),
        budget=budget,
        seconds=total,
        cells=tuple(cells),
        curves=tuple(curves(cells, subject.camera)),
        recommended=recommend(cells, subject.floor),
        left_out=tuple(left_out),
    )


def _noise_deviation(subject: Subject) -> float:
    """Root mean square of what the sensor adds to exact light, in values of f."""
    away = subject.stack(0).values - subject.reference.light
    return float(np.sqrt(np.nanmean(np.square(away))))


def curves(cells: Sequence[Cell], camera: Camera) -> list[ConvergenceCurve]:
    """The slope of each way of rendering and calibrating, beside what theory says."""
    found: list[ConvergenceCurve] = []
    for stage, limit in FLAT.items():
        some = [cell for cell in cells if cell.stage == stage and cell.counted]
        for way, variant in dict.fromkeys((cell.way, cell.variant) for cell in some):
            alike = [cell for cell in some if (cell.way, cell.variant) == (way, variant) and cell.error.median > limit]
            found.append(_curve(alike, camera, (stage, way, variant)))
    return found


def _curve(cells: Sequence[Cell], camera: Camera, key: tuple[Stage, str, str | None]) -> ConvergenceCurve:
    stage, way, variant = key
    theory = law(cast(Sampler, way.split(", ")[-1]), camera)
    limited = theory.least > 1
    used = [cell for cell in cells if not limited or (cell.samples or 0) >= theory.least * FEWEST_PASSES]
    fitted, why = slope(used), theory.why
    if fitted is None:
        why += "; fewer than three cells to fit, or errors that are rounding alone"
        return ConvergenceCurve(stage, way, variant, None, None, theory.slope, why, None)
    counts = [(cell.samples or 1) // FEWEST_PASSES for cell in used]
    if limited:
        why += f"; fitted from {theory.least * FEWEST_PASSES} samples on"
    allowed = corners(camera, min(counts), max(counts)) if limited and theory.slope is not None else 0.0
    if 0 < allowed < float("inf"):
        why += f", where strata that hold corners may change it by {allowed:.2g}"
    agrees = None if theory.slope is None or allowed == float("inf") else fitted.agrees(theory.slope, allowed)
    return ConvergenceCurve(stage, way, variant, fitted.value, fitted.deviation, theory.slope, why, agrees)


def rows(table: BenchTable) -> list[tuple[str, str]]:
    """The lines of the printed table: slopes, what is recommended, and what was left out."""
    lines: list[tuple[str, str]] = []
    for curve in table.curves:
        if curve.slope is None or curve.slope_deviation is None:
            continue
        beside = "" if curve.theory is None else f", theory {curve.theory:g}"
        verdict = "" if curve.agrees is None else (": agrees" if curve.agrees else ": does not agree")
        name = f"slope, {curve.stage} {curve.way}, {curve.variant}"
        lines.append((name, f"{curve.slope:.3f} ± {curve.slope_deviation:.3f}{beside}{verdict}"))
    for stage in bench_file.STAGES:
        best = table.recommended.get(stage)
        if best is not None:
            words = [str(value) for key, value in best.items() if key not in ("samples", "seconds") and value]
            if "samples" in best:
                counted = best["samples"] != bench_file.AUTO
                words.append(f"{best['samples']} samples" if counted else f'samples = "{bench_file.AUTO}"')
            lines.append((f"recommended, {stage}", f"{', '.join(words)}, {best['seconds']:.2g} s"))
    lines.append(("why", str(table.recommended["why"])))
    lines.append(("cells", f"{len(table.cells)} in {table.seconds:.0f} s, held against {table.against}"))
    late = sum(one.late for one in table.left_out)
    if late:
        lines.append(("left out", f"{late} cells that did not fit into {table.budget:g} s; raise --seconds"))
    return lines
