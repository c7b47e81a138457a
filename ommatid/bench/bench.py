"""Measure error against run time of every stage of a scene, for `ommatid bench`: table, figures and recommendation."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import perf_counter

from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.validation import check_scene

from . import table as bench_file
from .cells import Job, Subject, jobs, name_of
from .figure import write_figures
from .reference import reference
from .slopes import curves, recommend
from .table import AUTO, JSON, STAGES, BenchTable, Cell, SkippedJob

LOCK = ".ommatid-bench.lock"  # runs into folders of this folder do not wait for it


def bench(setup: Setup, folder: Path, seconds: float, progress: Progress) -> tuple[BenchTable, bool]:
    """Return the bench table of a scene, and True if anything had to be measured for it.

    The table is written after every cell, so that an interrupted bench goes on with the cells that it lacks. Those that
    do not fit into `seconds` are left out.
    Raises InputError for a scene that cannot be measured, and if `folder` holds the table of another scene.
    """
    _check_flat(setup.scene)
    check_folder(folder)
    setup = replace(setup, scene=_with_exact_assumptions(setup.scene), given_image=setup.image)
    with occupied(folder, JSON, lock=LOCK):
        check_scene(setup, calibrates=False)
        previous = _previous(folder, _fingerprint(setup))
        if previous is not None and _is_complete(previous, seconds):
            return previous, False
        return _measured(setup, folder, seconds, previous, progress), True


def _measured(
    setup: Setup, folder: Path, seconds: float, previous: BenchTable | None, progress: Progress
) -> BenchTable:
    """Measure the cells that `previous` lacks, and write table and figures."""
    start = perf_counter() - (0.0 if previous is None else previous.seconds)
    with naming_source(setup.scene.source):
        subject = Subject(setup, reference(setup))
        listed, never = jobs(subject)

    def table(cells: Sequence[Cell], left_out: Sequence[SkippedJob], budget: float) -> BenchTable:
        return _table(subject, cells, (*never, *left_out), budget, perf_counter() - start)

    def save(cells: Sequence[Cell]) -> None:
        bench_file.write(folder, table(cells, (), 0.0))
        progress(min(1.0, (perf_counter() - start) / seconds))

    known = {} if previous is None else {name_of(cell): cell for cell in previous.cells}
    complete = table(*measure(listed, known, start + seconds, save), seconds)
    write_figures(folder, complete)
    bench_file.write(folder, complete)
    progress(1.0)
    return complete


def _table(
    subject: Subject, cells: Sequence[Cell], left_out: tuple[SkippedJob, ...], budget: float, seconds: float
) -> BenchTable:
    """Return the table of cells; budget : 0 while they are measured."""
    scene, made_of = subject.scene, _fingerprint(subject.setup)
    system = os.uname().sysname, os.uname().release, os.uname().machine  # `platform` runs the command uname
    return BenchTable(
        title=scene.title or scene.source.stem,
        scene=made_of,
        fingerprint=_made_from(made_of),
        camera=subject.camera.describe(),
        machine={"cores": os.cpu_count(), "system": " ".join(system), "load": os.getloadavg()[0]},
        versions=versions("mitsuba", "drjit", "scipy"),
        against=subject.reference.description,
        noise_deviation=subject.noise_deviation,
        budget=budget,
        seconds=seconds,
        cells=tuple(cells),
        curves=tuple(curves(cells, subject.camera)),
        recommended=recommend(cells, subject.noise_floor),
        left_out=left_out,
    )


def _is_complete(previous: BenchTable, seconds: float) -> bool:
    """Return True unless a bench was interrupted, or left out cells that fit into more time."""
    late = any(job.late for job in previous.left_out)
    return previous.budget > 0 and (previous.budget >= seconds or not late)


def measure(
    listed: Sequence[Job], known: dict[str, Cell], deadline: float, save: Callable[[Sequence[Cell]], None]
) -> tuple[list[Cell], list[SkippedJob]]:
    """Measure the cells that are not known, in their order, and return all, and those that were left out.

    deadline : on the clock of `perf_counter`;  save : called with all cells after each that is measured
    A cell is left out whose time does not suffice, if its time is proportional to its samples in the cells before it.
    """
    left_out: list[SkippedJob] = []
    seconds: dict[tuple[str, str, str | None], tuple[int, float]] = {}  # samples and seconds of the last cell of a way
    for job in listed:
        way, samples, start = (job.stage, job.way, job.variant), job.samples or 1, perf_counter()
        last_samples, last_seconds = seconds.get(way, (samples, 0.0))
        cell = known.get(job.name)
        if cell is None:
            late = start + last_seconds * samples / last_samples > deadline
            try:
                cell = None if late else job.measure(deadline)
            except InputError as error:
                left_out.append(SkippedJob(what=job.name, why=str(error)))
                continue
            if cell is None:
                left_out.append(SkippedJob(what=job.name, why="it did not fit into the time limit", late=True))
                continue
            known = {**known, job.name: cell}
            save([known[one.name] for one in listed if one.name in known])
        if job.samples is not None:
            seconds[way] = samples, cell.seconds.median * cell.repeats
    return [known[job.name] for job in listed if job.name in known], left_out


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
    return previous if previous.fingerprint == _made_from(subject_print) else None


def _made_from(subject_print: str) -> str:
    return fingerprint([subject_print, versions("mitsuba", "drjit", "scipy")])


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
        lines.append(("left out", f"{late} cells that did not fit into {table.budget:g} s; raise --within"))
    return lines
