"""Measurements one after the other, the cheapest first, as far as the time goes; each is kept as soon as it is done.

A measurement is a job of several repeats. How long a job takes is guessed from the one before it in its series, which
differs from it in a known ratio; jobs that do not fit into what is left of the time are left out. Short ones of
AUTO come before all others, since each tells as much as the end of a curve.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.progress import Progress

from .resources import Cost
from .table import AUTO, Cell, Quantiles, SkippedJob, Stage, cell_of

REPEATS, FEWER = 5, 3  # with seeds of their own; odd, so that the median is one of them
SOON = 0.1  # of the time: what a cell of AUTO may take to be measured before all others
LONG = 1.0  # seconds of a repeat, from which on there are fewer


@dataclass(frozen=True)
class Repeat:
    """What one repeat found.

    mse : of the image that it brings, None where that was not computed
    samples : a pixel, where they were not known beforehand
    """

    error: float
    cost: Cost
    mse: float | None
    samples: int | None = None


@dataclass(frozen=True)
class Job:
    """One cell to be measured. `guess`: about how many seconds a repeat takes; `work`: does the repeat of a number."""

    stage: Stage
    way: str
    variant: str | None
    samples: int | None
    setting: str
    guess: float
    work: Callable[[int], Repeat]

    @property
    def name(self) -> str:
        """For people, and what it is kept under."""
        return name_of(self)

    @property
    def series(self) -> tuple[str, str, str | None, str]:
        """What it has in common with jobs that differ from it in samples alone."""
        return self.stage, self.way, self.variant, "" if self.samples else self.setting


def name_of(one: Job | Cell) -> str:
    """For people, and what it is kept under."""
    known = one.samples is not None and one.setting != AUTO  # of AUTO only once it is done
    samples = f"{one.samples} samples" if known else None
    return ", ".join(part for part in (f"{one.stage} {one.way}", one.variant, samples, one.setting) if part)


class Journal:
    """What is done, by name, in a file to which a line is added for each: whatever stops the program, it is kept."""

    def __init__(self, path: Path, fingerprint: str) -> None:
        """Read what an earlier run of the same left."""
        self._path, self._fingerprint = path, fingerprint
        self.cells: dict[str, Cell] = {}
        self.refused: dict[str, str] = {}
        self.seconds = 0.0
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError):
            lines = []
        for line in lines:
            self._take(line)

    def _take(self, line: str) -> None:
        try:
            one = json.loads(line)
            if one["fingerprint"] != self._fingerprint:
                return
            if "cell" in one:
                self.cells[str(one["name"])] = cell_of(json.dumps(one["cell"]))
            else:
                self.refused[str(one["name"])] = str(one["why"])
            self.seconds += float(one["seconds"])
        except (ValueError, KeyError, TypeError):  # cut short when the program was stopped
            return

    def add(self, name: str, cell: Cell | str, seconds: float) -> None:
        """Keep a cell, or why there is none. Raises DeniedError."""
        if isinstance(cell, Cell):
            self.cells[name] = cell
            told = {"cell": asdict(cell)}
        else:
            self.refused[name] = cell
            told = {"why": cell}
        self.seconds += seconds
        line = json.dumps({"fingerprint": self._fingerprint, "name": name, "seconds": seconds, **told}, allow_nan=False)
        try:
            with self._path.open("a", encoding="utf-8") as stream:
                stream.write(f"\n{line}\n")  # on a line of its own, whatever the last one was cut to
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            reason = error.strerror or str(error)
            raise MachineError(f"{self._path}: could not be written ({reason}); free some space") from error

    def remove(self) -> None:
        """The table stands for it now."""
        self._path.unlink(missing_ok=True)


def measure(
    jobs: Sequence[Job], allowed: float, finished: Journal, progress: Progress, spent: float = 0.0
) -> list[SkippedJob]:
    """Do those jobs that are not finished, short ones of AUTO and then the cheapest first, and say what did not fit.

    allowed : seconds, of which `spent` and those of what is finished are gone
    """
    waiting = [job for job in jobs if job.name not in finished.cells and job.name not in finished.refused]
    ratios: dict[tuple[str, str, str | None, str], float] = {}
    for job in jobs:
        if job.name in finished.cells:
            ratios[job.series] = max(1.0, finished.cells[job.name].seconds.median / job.guess)
    start, before = perf_counter(), spent + finished.seconds

    def left() -> float:
        return allowed - before - (perf_counter() - start)

    def expected(job: Job) -> float:
        return job.guess * ratios.get(job.series, 1.0)

    def turn(job: Job) -> tuple[bool, float]:
        each = expected(job)
        return job.setting != AUTO or each * _repeats(each) > SOON * allowed, each

    left_out: list[SkippedJob] = []
    while waiting:
        job = min(waiting, key=turn)
        waiting.remove(job)
        each = expected(job)
        if each * _repeats(each) > left():
            left_out.append(_late(job, each * _repeats(each), allowed))
            continue
        begun = perf_counter()
        found = _repeated(job, left)
        seconds = perf_counter() - begun
        if isinstance(found, SkippedJob):
            ratios[job.series] = seconds / job.guess
            left_out.append(found)
        elif isinstance(found, str):
            finished.add(job.name, found, seconds)
        else:
            finished.add(job.name, found, seconds)
            ratios[job.series] = seconds / found.repeats / job.guess
        progress(min(1.0, 1 - left() / allowed))
    progress(1.0)
    return left_out


def _repeated(job: Job, left: Callable[[], float]) -> Cell | SkippedJob | str:
    """The cell of a job, or why there is none."""
    done: list[Repeat] = []
    begun = perf_counter()
    while not done or len(done) < _repeats((perf_counter() - begun) / len(done)):
        each = (perf_counter() - begun) / max(len(done), 1)
        if done and each > left():
            return SkippedJob(
                job.name, f"a repeat took {each:.2g} s, too long for {FEWER} in the seconds left", late=True
            )
        try:
            done.append(job.work(len(done)))
        except InputError as error:
            return str(error)
    return cell_from_repeats(job, done)


def _repeats(each: float) -> int:
    return REPEATS if each < LONG else FEWER


def cell_from_repeats(job: Job, done: Sequence[Repeat]) -> Cell:
    """What repeats come to."""
    errors, mse = [one.error for one in done], [one.mse for one in done if one.mse is not None]
    several = len(errors) > 1 and min(errors) > 0
    taken = [one.samples for one in done if one.samples is not None]
    peaks = [one.cost.memory for one in done if one.cost.memory is not None]
    return Cell(
        stage=job.stage,
        way=job.way,
        variant=job.variant,
        samples=max(taken, default=None) if job.samples is None else job.samples,
        setting=job.setting,
        repeats=len(done),
        error=Quantiles.of(errors),
        seconds=Quantiles.of([one.cost.seconds for one in done]),
        memory=max(peaks, default=None),
        mse=Quantiles.of(mse) if mse else None,
        scatter=float(np.std(np.log(errors), ddof=1)) if several else None,
    )


def _late(job: Job, seconds: float, allowed: float) -> SkippedJob:
    return SkippedJob(job.name, f"its {seconds:.2g} s did not fit into {allowed:g} s; raise --seconds", late=True)
