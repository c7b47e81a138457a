"""Measure error against run time of every stage of a scene, for `ommatid bench`: table, figures and recommendation."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from time import perf_counter
from typing import cast

import numpy as np

from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.sampling.passes import FEWEST_PASSES
from ommatid.simulate.sampling.samplers import corners, law
from ommatid.simulate.validation import check_scene

from . import table as bench_file
from .figure import write_figures
from .jobs import Subject, jobs
from .reference import REFERENCE, reference
from .scheduler import Journal, measure, name_of
from .slopes import recommend, slope
from .table import AUTO, JSON, STAGES, BenchTable, Cell, ConvergenceCurve, SkippedJob, Stage

PARTIAL = ".bench.partial.jsonl"
LOCK = ".ommatid-bench.lock"  # runs into folders of this folder do not wait for it
ROUNDING: dict[Stage, float] = {"render": 1e-5 * WHITE, "calibrate": 1e-5}  # errors below these are float32 rounding
FLOOR_SHARE = 0.1  # of the time limit, for the noise floor
SETUP_SHARE = 0.02  # of the progress, for the reference and the noise floor


def bench(setup: Setup, folder: Path, seconds: float, progress: Progress) -> tuple[BenchTable, bool]:
    """Return the bench table of a scene, and True if anything had to be measured for it.

    Cells that are already in `folder` are not measured again; those that do not fit into `seconds` are left out.
    Raises InputError for a scene that cannot be measured, and if `folder` holds the table of another scene.
    """
    _check_flat(setup.scene)
    check_folder(folder)
    with occupied(folder, JSON, lock=LOCK):
        return _bench(setup, folder, seconds, progress)


def _bench(setup: Setup, folder: Path, seconds: float, progress: Progress) -> tuple[BenchTable, bool]:
    start = perf_counter()
    setup = replace(setup, scene=_with_exact_assumptions(setup.scene), given_image=setup.image)
    scene, camera = setup.scene, setup.camera
    check_scene(setup, calibrates=False)
    subject_print = _fingerprint(setup)
    made_from = fingerprint([subject_print, versions("mitsuba", "drjit", "scipy")])
    previous = _previous(folder, subject_print)
    if previous is not None and previous.fingerprint != made_from:
        previous = None
    if previous is not None and (previous.budget >= seconds or not any(job.late for job in previous.left_out)):
        return previous, False
    journal = _open_journal(folder, made_from, previous)
    seconds_before = journal.seconds
    with naming_source(scene.source):
        right = reference(setup, folder, lambda share: progress(SETUP_SHARE * share))
        subject = Subject(setup, right, FLOOR_SHARE * seconds)
        listed, left_out = jobs(subject)

    def measured(share: float) -> None:
        progress(SETUP_SHARE + (1 - SETUP_SHARE) * share)

    late = measure(listed, seconds, journal, measured, perf_counter() - start)
    left_out += [SkippedJob(what=name, why=why) for name, why in journal.refused.items()]
    cells = tuple(journal.cells[job.name] for job in listed if job.name in journal.cells)
    system = os.uname().sysname, os.uname().release, os.uname().machine  # `platform` runs the command uname
    table = BenchTable(
        title=scene.title or scene.source.stem,
        scene=subject_print,
        fingerprint=made_from,
        camera=camera.describe(),
        machine={"cores": os.cpu_count(), "system": " ".join(system), "load": os.getloadavg()[0]},
        versions=versions("mitsuba", "drjit", "scipy"),
        against=right.description,
        noise_deviation=_noise_deviation(subject),
        budget=seconds,
        seconds=seconds_before + perf_counter() - start,
        cells=cells,
        curves=tuple(curves(cells, camera)),
        recommended=recommend(cells, subject.noise_floor),
        left_out=(*left_out, *late),
    )
    _finish(folder, table, journal)
    return table, True


def _check_flat(scene: Scene) -> None:
    if scene.target.detail > 1:
        raise InputError(
            f"{scene.source}: bench measures worlds made of f's pixels, got target.detail {scene.target.detail};"
            " set it to 1"
        )
    if scene.world is not None:
        raise InputError(
            f"{scene.source}: bench measures flat targets, got a [world]; remove it, or choose another scene"
        )


def _open_journal(folder: Path, made_from: str, previous: BenchTable | None) -> Journal:
    """Open the journal of an interrupted bench, or begin one with the cells of a table that needs more time."""
    journal = Journal(folder / PARTIAL, made_from)
    if previous is not None:
        for cell in previous.cells:
            journal.cells.setdefault(name_of(cell), cell)
        journal.seconds = max(journal.seconds, previous.seconds)
    return journal


def _finish(folder: Path, table: BenchTable, journal: Journal) -> None:
    """Write the figures and the table, and remove the files of the unfinished bench."""
    write_figures(folder, table)
    bench_file.write(folder, table)
    journal.remove()
    (folder / REFERENCE).unlink(missing_ok=True)


def _with_exact_assumptions(scene: Scene) -> Scene:
    """Return the scene without misalignment of its estimator and without a study, which the cells replace."""
    estimator = scene.estimator.model_copy(update={"misalignment": "trust"})
    return scene.model_copy(update={"estimator": estimator, "study": None})


def _fingerprint(setup: Setup) -> str:
    """Return the fingerprint of camera, image and scene without the keys that the cells set."""
    tables = setup.scene.plain()
    for table, keys in {"render": ("samples", "variant"), "calibration": ("samples", "method", "fit")}.items():
        tables[table] = {key: value for key, value in tables[table].items() if key not in keys}
    for name in ("title", "target"):
        tables.pop(name, None)
    return fingerprint([setup.camera.describe(), tables, digest(setup.image.astype("float32"))])


def _previous(folder: Path, subject_print: str) -> BenchTable | None:
    path = folder / JSON
    if not path.exists():
        return None
    try:
        previous = bench_file.read(path)
    except InputError:  # damaged: measure again
        return None
    if previous.scene != subject_print:
        raise InputError(
            f"{path}: is of another scene, '{previous.title}', or of other values of its keys; choose another folder"
            " with -o"
        )
    return previous


def _noise_deviation(subject: Subject) -> float:
    """Return the root mean square of the sensor's noise on exact light, in pixel values of f."""
    noise = subject.stack(0).values - subject.reference.light
    return float(np.sqrt(np.nanmean(np.square(noise))))


def curves(cells: Sequence[Cell], camera: Camera) -> list[ConvergenceCurve]:
    """Return the slope of each method of rendering and calibration, and its theoretical slope."""
    fitted: list[ConvergenceCurve] = []
    for stage, limit in ROUNDING.items():
        counted = [cell for cell in cells if cell.stage == stage and cell.counted]
        for way, variant in dict.fromkeys((cell.way, cell.variant) for cell in counted):
            used = [cell for cell in counted if (cell.way, cell.variant) == (way, variant)]
            fitted.append(_curve([cell for cell in used if cell.error.median > limit], camera, stage, way, variant))
    return fitted


def _curve(cells: Sequence[Cell], camera: Camera, stage: Stage, way: str, variant: str | None) -> ConvergenceCurve:
    theory = law(cast(Sampler, way.split(", ")[-1]), camera)
    asymptotic = theory.least > 1
    used = [cell for cell in cells if not asymptotic or (cell.samples or 0) >= theory.least * FEWEST_PASSES]
    fit, why, agrees = slope(used), theory.why, None
    if fit is None:
        why += "; fewer than three cells to fit, or errors at the level of rounding"
    elif asymptotic:
        why += f"; fitted from {theory.least * FEWEST_PASSES} samples on"
    if fit is not None and theory.slope is not None:
        counts = [(cell.samples or 1) // FEWEST_PASSES for cell in used]
        margin = corners(camera, min(counts), max(counts)) if asymptotic else 0.0
        if 0 < margin < inf:
            why += f", where strata that contain corners may change it by {margin:.2g}"
        agrees = None if margin == inf else fit.agrees(theory.slope, margin)
    return ConvergenceCurve(
        stage=stage,
        way=way,
        variant=variant,
        slope=None if fit is None else fit.value,
        slope_deviation=None if fit is None else fit.deviation,
        theory=theory.slope,
        why=why,
        agrees=agrees,
    )


def rows(table: BenchTable) -> list[tuple[str, str]]:
    """Return the rows of the printed table: slopes, recommended settings, and what was left out."""
    lines: list[tuple[str, str]] = []
    for curve in table.curves:
        if curve.slope is None or curve.slope_deviation is None:
            continue
        theory = "" if curve.theory is None else f", theory {curve.theory:g}"
        agreement = "" if curve.agrees is None else (": agrees" if curve.agrees else ": does not agree")
        name = f"slope, {curve.stage} {curve.way}, {curve.variant}"
        lines.append((name, f"{curve.slope:.3f} ± {curve.slope_deviation:.3f}{theory}{agreement}"))
    for stage in STAGES:
        best = table.recommended.of(stage)
        if best is None:
            continue
        words = [word for word in (best.method, best.setting, best.sampler, best.variant) if word]
        if best.samples is not None:
            words.append(f'samples = "{AUTO}"' if best.samples == AUTO else f"{best.samples} samples")
        lines.append((f"recommended, {stage}", f"{', '.join(words)}, {best.seconds:.2g} s"))
    lines.append(("why", table.recommended.why))
    lines.append(("cells", f"{len(table.cells)} in {table.seconds:.0f} s, compared with {table.against}"))
    late = sum(job.late for job in table.left_out)
    if late:
        lines.append(("left out", f"{late} cells that did not fit into {table.budget:g} s; raise --seconds"))
    return lines
