"""The number of a job and of all jobs that share a batch, as `--job` names them or as a scheduler's job array does."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

from ommatid.runtime.errors import InputError, shortened

AUTO = "auto"
MOST_JOBS, LONGEST = 100_000, 20  # jobs of a batch, and digits of a number
TASK, FIRST, LAST, COUNT = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "MIN", "MAX", "COUNT"))
INDICES = (TASK, "PBS_ARRAY_INDEX")  # number of this job, as SLURM and PBS say it
EXPECTED = '--job: expected I/N, such as 2/8, or in a job array /N or "auto"'


@dataclass(frozen=True)
class ArrayJob:
    """Job `number`, from 1, of `count`."""

    number: int
    count: int

    def __str__(self) -> str:
        """Return it as messages name it."""
        return f"job {self.number} of {self.count}"


def read_job(text: str, environment: Mapping[str, str]) -> ArrayJob:
    """Read `--job I/N`, or `/N` and `auto`, whose numbers are those of the job array in `environment`.

    Raises InputError, also for an array that is not numbered from 1: of one whose jobs are repeated in part, only the
    index is known.
    """
    if text == AUTO:
        return _whole_array(environment)
    match = re.fullmatch(r"(\d*)/(\d+)", text.strip(), re.ASCII)
    if match is None:
        raise InputError(f"{EXPECTED}, got '{shortened(text)}'")
    count = _number("--job", match[2])
    name, index = ("", match[1]) if match[1] else _index(environment, text)
    if not 1 <= _number(name, index) <= count:
        origin = f", which is {name}; submit the jobs as an array from 1 to {count}" if name else ""
        raise InputError(f"--job {shortened(text)}: expected a job from 1 to {count}, got {index}{origin}")
    return ArrayJob(int(index), count)


def _index(environment: Mapping[str, str], text: str) -> tuple[str, str]:
    """Return the variable that has the index of this job, and its value."""
    for name in INDICES:
        if environment.get(name):
            return name, environment[name]
    raise InputError(
        f"--job {text}: neither {' nor '.join(INDICES)} is set, so this is no job of an array; write I/N, such as 1/8"
    )


def _whole_array(environment: Mapping[str, str]) -> ArrayJob:
    """Read the job and the number of jobs of a whole array of SLURM, which alone says both."""
    if TASK not in environment:
        raise InputError(
            f"--job auto: {TASK} is not set; expected a job array of SLURM, which says the number of its jobs;"
            " elsewhere write I/N, or /N in an array of PBS"
        )
    index, first, last, count = (_number(name, environment.get(name, "")) for name in (TASK, FIRST, LAST, COUNT))
    if (first, last) != (1, count):
        raise InputError(
            f"--job auto: expected a whole array, from 1 to the number of jobs, got {count} of {first} to {last};"
            " to repeat some jobs write /N, with the number of all"
        )
    return ArrayJob(index, count)


def _number(name: str, text: str) -> int:
    if not text.isdecimal() or len(text) > LONGEST or int(text) > MOST_JOBS:
        raise InputError(
            f"--job: expected a whole number of at most {MOST_JOBS} as {name}, got '{shortened(text)}';"
            " write I/N, such as 1/8"
        )
    return int(text)
