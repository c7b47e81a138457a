"""Measure error against run time of every stage of a scene, for `ommatid bench`: table, figures and recommendation."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.runtime.errors import InputError, naming_source
from ommatid.runtime.files import digest, fingerprint
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.outputs.occupied import occupied
from ommatid.runtime.progress import Progress
from ommatid.runtime.study import FAILED, Row, study
from ommatid.runtime.versions import versions
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.validation import check_scene

from . import table as bench_file
from .figure import write_figures
from .slopes import curves, recommend
from .subject import Repeat, Subject, settings
from .table import AUTO, DENSE, JSON, BenchTable, Cell, Setting, Skipped, Stage

JOURNAL = "bench.jsonl"
LOCK = ".ommatid-bench.lock"  # runs into folders of this folder do not wait for it
REPEATS, FEWER_REPEATS = 5, 3  # with independent seeds; odd, so that the median is one of the values
LONG = 1.0  # seconds of a repeat, from which on FEWER_REPEATS are made
QUANTILES = {"": 0.5, "_low": 0.1, "_high": 0.9}
LATE = "it did not fit into the time limit"
UNITS: dict[Stage, str] = {
    "render": "values of f",
    "calibrate": "entries of H",
    "reconstruct": "posterior standard deviations",
}


def bench(setup: Setup, folder: Path, seconds: float, progress: Progress) -> tuple[BenchTable, bool]:
    """Return the bench table of a scene, and True if anything had to be measured for it.

    Cells are kept in a journal, from which an interrupted bench goes on. Those that do not fit into `seconds` are left
    out. Raises InputError for a scene that cannot be measured, and if `folder` holds the table of another scene.
    """
    _check_flat(setup.scene)
    check_folder(folder)
    setup = replace(setup, scene=_with_exact_assumptions(setup.scene), given_image=setup.image)
    with occupied(folder, JOURNAL, lock=LOCK):
        check_scene(setup, calibrates=False)
        made_of = _fingerprint(setup)
        previous = _previous(folder, made_of)
        if previous is not None and (previous.budget >= seconds or not any(job.late for job in previous.left_out)):
            return previous, False
        table = _measured(setup, folder, seconds, made_of, progress)
        write_figures(folder, table)
        bench_file.write(folder, table)
        progress(1.0)
        return table, True


def _measured(setup: Setup, folder: Path, budget: float, made_of: str, progress: Progress) -> BenchTable:
    """Measure the cells that the journal of a folder lacks, and return the table."""
    with naming_source(setup.scene.source):
        subject = Subject.of(setup)
        listed, left_out = settings(subject)
    work = Measurement(subject.measure, budget, progress, folder / JOURNAL)
    of = {"scene": made_of, **_libraries()}
    rows = study(folder / JOURNAL, [of | each.model_dump() for each in listed], work.measure, work.report)
    cells = [work.read(row) for row in rows if FAILED not in row]
    failed = [(Setting(**row).name, row[FAILED]) for row in rows if FAILED in row]
    left_out += [Skipped(what=name, why=why, late=why == LATE) for name, why in failed]
    system = os.uname().sysname, os.uname().release, os.uname().machine  # `platform` runs the command uname
    return BenchTable(
        title=setup.scene.title or setup.scene.source.stem,
        fingerprint=made_of,
        camera=subject.camera.describe(),
        machine={"cores": os.cpu_count(), "system": " ".join(system), "load": os.getloadavg()[0]},
        versions=_libraries(),
        against=subject.against,
        noise_deviation=subject.noise_deviation,
        budget=budget,
        seconds=work.seconds,
        cells=tuple(cells),
        curves=tuple(curves(cells, subject.camera)),
        recommended=recommend(cells, subject.noise_floor),
        left_out=tuple(left_out),
    )


class Measurement:
    """Measures cells within a time, of which those of the journal have taken a part."""

    def __init__(
        self, work: Callable[[Setting, int], Repeat], budget: float, progress: Progress, journal: Path
    ) -> None:
        """Start the clock; work : runs a repeat of a setting."""
        self._work, self._budget, self._progress, self._journal = work, budget, progress, journal
        self._start = perf_counter()
        self._last: dict[tuple[str, ...], tuple[int, float]] = {}  # samples and seconds of the last cell of a way

    @property
    def seconds(self) -> float:
        """Duration of all measurements."""
        return perf_counter() - self._start

    def read(self, row: Row) -> Cell:
        """Return a row as a cell. Raises InputError if it is not one of a bench."""
        try:
            return Cell(**row)
        except (TypeError, ValueError) as error:
            raise InputError(f"{self._journal}: expected rows of a bench, got others; delete it") from error

    def report(self, row: Row, new: bool) -> None:
        """Take notice of a row of the study, and of the time that one of the journal took."""
        if FAILED not in row:
            cell = self.read(row)
            self._start -= 0.0 if new else cell.spent
            self._last[cell.stage, cell.way, cell.variant or ""] = cell.samples or 1, cell.seconds * cell.repeats
        self._progress(min(1.0, self.seconds / self._budget))

    def measure(self, cell: Row) -> Row:
        """Measure all repeats of a cell. Raises InputError where it cannot be measured, or its time does not suffice.

        The time is taken as proportional to the samples, from the cell before it.
        """
        setting, start, repeats = Setting(**cell), perf_counter(), list[Repeat]()
        samples, seconds = self._last.get((setting.stage, setting.way, setting.variant or ""), (1, 0.0))
        if self.seconds + seconds * (setting.samples or samples) / samples > self._budget:
            raise InputError(LATE)
        while len(repeats) < FEWER_REPEATS or (len(repeats) < REPEATS and perf_counter() - start < LONG * len(repeats)):
            if repeats and self.seconds > self._budget:
                raise InputError(LATE)
            repeats.append(self._work(setting, len(repeats)))
        return cell_of(setting, repeats).model_dump() | {"spent": perf_counter() - start}


def cell_of(setting: Setting, repeats: list[Repeat]) -> Cell:
    """Return the cell of a setting: quantiles over its repeats, and the largest memory and number of samples."""
    errors, seconds, memory, mses, samples = (
        [value for value in values if value is not None] for values in zip(*repeats, strict=True)
    )
    columns = {"error": errors, "seconds": seconds, "mse": mses}
    numbers: dict[str, Any] = {
        f"{name}{suffix}": float(np.quantile(values, share)) if values else None
        for name, values in columns.items()
        for suffix, share in QUANTILES.items()
    }
    if setting.samples is None:
        numbers["samples"] = max(samples, default=None)
    return Cell(
        **setting.model_dump() | numbers,
        repeats=len(repeats),
        error_unit=UNITS[setting.stage],
        memory=max(memory, default=None),
        scatter=float(np.std(np.log(errors), ddof=1)) if len(errors) > 1 and min(errors) > 0 else None,
    )


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


def _previous(folder: Path, made_of: str) -> BenchTable | None:
    """Return the table of a folder, None if there is none of this scene and these libraries."""
    path = folder / JSON
    if not path.exists():
        return None
    try:
        previous = bench_file.read(path)
    except InputError:  # damaged: measure again
        return None
    if previous.fingerprint != made_of:
        raise InputError(
            f"{path}: is of another scene, '{previous.title}', or of other values of its keys; choose another folder"
            " with -o"
        )
    return previous if previous.versions == _libraries() else None


def _libraries() -> dict[str, str]:
    return versions("mitsuba", "drjit", "scipy")


def rows(table: BenchTable) -> list[tuple[str, str]]:
    """Return the rows of the printed table: slopes, recommended settings, and what was left out."""
    known = [curve for curve in table.curves if curve.words]
    lines = [(f"slope, {curve.stage} {curve.way}, {curve.variant}", curve.words) for curve in known]
    for cell in table.recommended.cells:
        way = AUTO if cell.way == DENSE else cell.way
        samples = f"{cell.samples} samples" if cell.counted else f'samples = "{AUTO}"'
        words = [way, cell.setting] if cell.samples is None else [way, cell.variant, samples]
        lines.append((f"recommended, {cell.stage}", f"{', '.join(filter(None, words))}, {cell.seconds:.2g} s"))
    lines.append(("why", table.recommended.why))
    lines.append(("cells", f"{len(table.cells)} in {table.seconds:.0f} s, compared with {table.against}"))
    late = sum(job.late for job in table.left_out)
    if late:
        lines.append(("left out", f"{late} cells that did not fit into {table.budget:g} s; raise --within"))
    return lines
