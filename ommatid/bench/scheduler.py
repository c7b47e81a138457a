"""Run measurements one after the other, the cheapest first, within a time limit, and store each as soon as it is done.

A measurement is a job of several repeats. The duration of a job is predicted from the previous job of its series, since
the ratio of their work is known; jobs that do not fit into the remaining time are left out. Short jobs with an adaptive
number of samples precede all others, since each gives as much information as the end of a curve.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.files import append_text
from ommatid.runtime.input_files import parse_json, read_text
from ommatid.runtime.progress import Progress

from .resources import Cost
from .table import AUTO, Cell, Quantiles, SkippedJob, Stage

REPEATS, FEWER_REPEATS = 5, 3  # with independent seeds; odd, so that the median is one of the values
LONG = 1.0  # seconds of a repeat, from which on FEWER_REPEATS are made
SHORT_SHARE = 0.1  # of the time limit: the longest adaptive job that precedes all others


@dataclass(frozen=True)
class Repeat:
    """Result of one repeat.

    mse : mean squared error of the resulting image, None if not computed
    samples : per pixel, of a job with an adaptive number
    """

    error: float
    cost: Cost
    mse: float | None
    samples: int | None = None


@dataclass(frozen=True)
class Job:
    """A cell to be measured. `guess`: expected seconds per repeat; `work`: runs the repeat of an index."""

    stage: Stage
    way: str
    variant: str | None
    samples: int | None
    setting: str
    guess: float
    work: Callable[[int], Repeat]

    @property
    def name(self) -> str:
        """Readable name, and key in the journal."""
        return name_of(self)

    @property
    def series(self) -> tuple[str, str, str | None, str]:
        """Key of the jobs that differ only in their number of samples."""
        return self.stage, self.way, self.variant, "" if self.samples else self.setting


def name_of(item: Job | Cell) -> str:
    """Return the readable name of a job or its cell, the key in the journal."""
    known = item.samples is not None and item.setting != AUTO  # adaptive: known only after the measurement
    samples = f"{item.samples} samples" if known else None
    return ", ".join(part for part in (f"{item.stage} {item.way}", item.variant, samples, item.setting) if part)


class Journal:
    """Finished cells by name, stored in a file with one line per job, so that an interrupted bench can continue."""

    def __init__(self, path: Path, fingerprint: str) -> None:
        """Read the cells of an earlier, interrupted bench with the same fingerprint."""
        self._path, self._fingerprint = path, fingerprint
        self.cells: dict[str, Cell] = {}
        self.refused: dict[str, str] = {}
        self.seconds = 0.0
        try:
            lines = read_text(path).splitlines()
        except (OSError, ValueError):
            lines = []
        for line in lines:
            self._load(line)

    def _load(self, line: str) -> None:
        try:
            entry = parse_json(line)
            if entry["fingerprint"] != self._fingerprint:
                return
            if "cell" in entry:
                self.cells[str(entry["name"])] = Cell.model_validate(entry["cell"], strict=True)
            else:
                self.refused[str(entry["name"])] = str(entry["why"])
            self.seconds += float(entry["seconds"])
        except (ValueError, KeyError, TypeError, RecursionError):  # truncated when the program was killed
            return

    def add(self, name: str, cell: Cell | str, seconds: float) -> None:
        """Store a cell, or the reason why there is none. Raises MachineError if the file cannot be written."""
        entry = {"fingerprint": self._fingerprint, "name": name, "seconds": seconds}
        if isinstance(cell, Cell):
            self.cells[name] = cell
            line = json.dumps({**entry, "cell": cell.model_dump()}, allow_nan=False)
        else:
            self.refused[name] = cell
            line = json.dumps({**entry, "why": cell}, allow_nan=False)
        self.seconds += seconds
        try:
            append_text(self._path, f"\n{line}\n")  # a new line, even after a truncated one
        except OSError as error:
            reason = error.strerror or str(error)
            raise MachineError(f"{self._path}: could not be written ({reason}); free some space") from error

    def remove(self) -> None:
        """Delete the file, when the table has replaced it."""
        self._path.unlink(missing_ok=True)


def measure(
    jobs: Sequence[Job], limit: float, journal: Journal, progress: Progress, spent: float = 0.0
) -> list[SkippedJob]:
    """Run the jobs that are not in the journal, the cheapest first, and return those that did not fit.

    limit : seconds, of which `spent` and those in the journal are already used
    """
    waiting = [job for job in jobs if job.name not in journal.cells and job.name not in journal.refused]
    ratios: dict[tuple[str, str, str | None, str], float] = {}  # measured over guessed seconds, by series
    for job in jobs:
        if job.name in journal.cells:
            ratios[job.series] = max(1.0, journal.cells[job.name].seconds.median / job.guess)
    start, used = perf_counter(), spent + journal.seconds

    def left() -> float:
        return limit - used - (perf_counter() - start)

    def per_repeat(job: Job) -> float:
        return job.guess * ratios.get(job.series, 1.0)

    def order(job: Job) -> tuple[bool, float]:
        seconds = per_repeat(job)
        return job.setting != AUTO or seconds * _repeats(seconds) > SHORT_SHARE * limit, seconds

    left_out: list[SkippedJob] = []
    while waiting:
        job = min(waiting, key=order)
        waiting.remove(job)
        total = per_repeat(job) * _repeats(per_repeat(job))
        if total > left():
            why = f"its {total:.2g} s did not fit into {limit:g} s; raise --seconds"
            left_out.append(SkippedJob(what=job.name, why=why, late=True))
            continue
        job_start = perf_counter()
        result = _run(job, left)
        seconds = perf_counter() - job_start
        if isinstance(result, SkippedJob):
            ratios[job.series] = seconds / job.guess
            left_out.append(result)
        else:
            journal.add(job.name, result, seconds)
            if isinstance(result, Cell):
                ratios[job.series] = seconds / result.repeats / job.guess
        progress(min(1.0, 1 - left() / limit))
    progress(1.0)
    return left_out


def _run(job: Job, left: Callable[[], float]) -> Cell | SkippedJob | str:
    """Return the cell of a job, or the reason why there is none."""
    repeats: list[Repeat] = []
    start = perf_counter()
    seconds = 0.0
    while not repeats or len(repeats) < _repeats(seconds):
        if repeats and seconds > left():
            why = f"a repeat took {seconds:.2g} s, too long for {FEWER_REPEATS} in the remaining time"
            return SkippedJob(what=job.name, why=why, late=True)
        try:
            repeats.append(job.work(len(repeats)))
        except InputError as error:
            return str(error)
        seconds = (perf_counter() - start) / len(repeats)
    return cell_from_repeats(job, repeats)


def _repeats(seconds: float) -> int:
    return REPEATS if seconds < LONG else FEWER_REPEATS


def cell_from_repeats(job: Job, repeats: Sequence[Repeat]) -> Cell:
    """Return the cell of a job: quantiles over its repeats, and the largest memory and number of samples."""
    errors = [repeat.error for repeat in repeats]
    mses = [repeat.mse for repeat in repeats if repeat.mse is not None]
    samples = [repeat.samples for repeat in repeats if repeat.samples is not None]
    memory = [repeat.cost.memory for repeat in repeats if repeat.cost.memory is not None]
    return Cell(
        stage=job.stage,
        way=job.way,
        variant=job.variant,
        samples=max(samples, default=None) if job.samples is None else job.samples,
        setting=job.setting,
        repeats=len(repeats),
        error=Quantiles.of(errors),
        seconds=Quantiles.of([repeat.cost.seconds for repeat in repeats]),
        memory=max(memory, default=None),
        mse=Quantiles.of(mses) if mses else None,
        scatter=float(np.std(np.log(errors), ddof=1)) if len(errors) > 1 and min(errors) > 0 else None,
    )
