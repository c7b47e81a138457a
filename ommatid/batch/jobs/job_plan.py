"""Batches that several jobs share: which scenes each of them runs, and which of the jobs have ended.

The folder `.jobs` inside that of the batch holds a plan, made by the job that begins first, and a record of every job
that has ended. The last job to end writes what describes the whole batch. A new plan follows one whose jobs have all
ended; until then, jobs of another command are refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.files import make_folder
from ommatid.runtime.input_files import check_unique_keys, read_bytes, read_text
from ommatid.runtime.outputs.kinds import check_inside

from ..batch import Member
from ..sweep_row import SweepRow
from .array_job import MOST_JOBS, ArrayJob
from .job_files import claimed_text, replace_text

Result = TypeVar("Result")

FOLDER = ".jobs"
MOST_NAMED = 10  # jobs that a message lists


class _JobFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class JobPlan(_JobFile):
    """What the jobs of a batch have in common.

    command : as words, without `--job`
    scenes : the folders of the results by name, each with its scene file and the changes to it
    shares : indices of the scenes of every job;  versions : those of the machine that made the plan
    """

    jobs: int = Field(ge=1, le=MOST_JOBS)
    command: tuple[str, ...]
    scenes: dict[str, tuple[str, ...]]
    versions: dict[str, str]
    shares: tuple[tuple[int, ...], ...] = ()

    @model_validator(mode="after")
    def _check_shares(self) -> JobPlan:
        indices = [index for share in self.shares for index in share]
        if self.shares and (len(self.shares) != self.jobs or sorted(indices) != list(range(len(self.scenes)))):
            raise ValueError("expected every scene in the share of one job")
        return self

    def difference(self, other: JobPlan) -> str:
        """Say what these jobs do, not those of another plan; empty if they do the same."""
        if self.command != other.command:
            return f"'{' '.join(self.command)}', not '{' '.join(other.command)}'"
        if self.jobs != other.jobs:
            return f"{self.jobs} jobs, not {other.jobs}"
        if self.scenes != other.scenes:
            names = {**self.scenes, **other.scenes}
            name = next(name for name in names if self.scenes.get(name) != other.scenes.get(name))
            return f"{len(self.scenes)} scenes, not {len(other.scenes)}: the first to differ is '{name}'"
        return ""

    def other_versions(self, here: dict[str, str]) -> str:
        """Name the versions that differ from those of this machine; empty if there are none."""
        differing = [name for name, version in here.items() if self.versions.get(name) != version]
        return "; ".join(f"{name} {self.versions.get(name)}, here {here[name]}" for name in differing)


class EndedScene(_JobFile):
    """Result of a scene: the name of its folder, the reason of a failure, and its row in the table of a sweep."""

    folder: str
    failure: str = ""
    row: SweepRow | None = None


class _JobRecord(_JobFile):
    scenes: tuple[EndedScene, ...]


def shares(seconds: Sequence[float], count: int) -> tuple[tuple[int, ...], ...]:
    """Distribute scenes that take these times over `count` jobs, so that all end at about the same time.

    The longest scene goes first, each to the job with the least work so far; equal scenes go round.
    """
    loads = [(0.0, 0)] * count
    parts: list[list[int]] = [[] for _ in range(count)]
    for index in sorted(range(len(seconds)), key=lambda index: (-seconds[index], index)):
        job = loads.index(min(loads))
        parts[job].append(index)
        loads[job] = loads[job][0] + seconds[index], len(parts[job])
    return tuple(tuple(sorted(part)) for part in parts)


@dataclass(frozen=True)
class JobShare:
    """The part of a batch that one job runs.

    members : its scenes;  number : of the plan, of those that `folder` has seen
    """

    job: ArrayJob
    plan: JobPlan
    members: tuple[Member, ...]
    folder: Path
    number: int

    def end(
        self, ended: Sequence[EndedScene], describe: Callable[[Sequence[EndedScene]], Result]
    ) -> tuple[Result | None, str]:
        """Record that the job has ended; if all have, `describe` the batch. Return its result, and a sentence.

        Jobs that end at the same moment exclude one another by a file, and the one that describes looks again
        afterwards: a record that came meanwhile is seen either by it or by the job that wrote the record.
        """
        if not self.members:
            return None, f"{self.job}: nothing to do, all {len(self.plan.scenes)} scenes are those of other jobs"
        record = _JobRecord(scenes=tuple(ended)).model_dump_json()
        replace_text(self._record(self.job.number), record, self._temporary)
        described: dict[int, str] = {}
        scenes: list[EndedScene] = []
        result: Result | None = None
        while True:
            records = _records(self.plan, self.folder, self.number)
            missing = _missing(self.plan, records)
            if missing:
                return result, f"{self.job}: done; not ended yet: {_listed(missing)}"
            if records == described:
                return result, f"{self.job}: done; all jobs have ended{_failed(scenes)}"
            writer = claimed_text(self._claim, str(self.job.number), self._temporary)
            if writer != str(self.job.number):
                return result, f"{self.job}: done; job {writer} writes the tables, repeat it if it was stopped"
            try:
                scenes = self._in_order(records)
                result = describe(scenes)
            finally:
                self._claim.unlink(missing_ok=True)
            described = records

    def _in_order(self, records: dict[int, str]) -> list[EndedScene]:
        by_folder: dict[str, EndedScene] = {}
        for number, text in records.items():
            try:
                by_folder |= {scene.folder: scene for scene in _JobRecord.model_validate_json(text).scenes}
                check_unique_keys(self._record(number), text.encode())
            except ValueError as error:
                raise InputError(f"{self._record(number)}: is damaged; repeat job {number}") from error
        for name in self.plan.scenes:
            if name not in by_folder:
                raise InputError(f"{self.folder}: no job has a record of {shortened(name)}; repeat the jobs")
        return [by_folder[name] for name in self.plan.scenes]

    def begin(self) -> None:
        """Forget that the job has ended before, and what it left when it was killed."""
        self._temporary.unlink(missing_ok=True)
        self._record(self.job.number).unlink(missing_ok=True)

    def _record(self, job: int) -> Path:
        return _record(self.folder, self.number, job)

    @property
    def _claim(self) -> Path:
        return self.folder / f"{self.number}.tables"

    @property
    def _temporary(self) -> Path:
        return _temporary(self.folder, self.job)


def join_jobs(
    job: ArrayJob,
    everyone: Sequence[Member],
    output: Path,
    command: Sequence[str],
    cost: Callable[[Member], float],
    versions: Callable[[], dict[str, str]],
) -> JobShare:
    """Return the share of a job in the plan of its batch, which is made if this job is the first.

    output : folder of the batch;  command : as words, without `--job`;  cost : of a scene, in seconds
    Raises InputError if jobs of another command, or of other versions, have not all ended in this folder.
    """
    folder = output / FOLDER
    check_inside(folder)
    make_folder(folder)
    here = versions()
    wanted = JobPlan(
        jobs=job.count,
        command=tuple(command),
        scenes={member.folder.name: (str(member.scene), *member.changes) for member in everyone},
        versions=here,
    )
    number = max((_number_of(path) for path in folder.glob("*.plan.json")), default=1)
    while True:
        path = folder / f"{number}.plan.json"
        if not path.exists():
            parts = shares([cost(member) for member in everyone], job.count)
            text = wanted.model_copy(update={"shares": parts}).model_dump_json()
            claimed_text(path, text, _temporary(folder, job))
        plan = _read_plan(path)
        different, others = plan.difference(wanted), plan.other_versions(here)
        if not different and not others:
            break
        missing = _missing(plan, _records(plan, folder, number))
        if missing:
            raise _refused(output, plan, missing, different, others)
        number += 1
    members = tuple(everyone[index] for index in plan.shares[job.number - 1])
    share = JobShare(job, plan, members, folder, number)
    share.begin()
    return share


def _read_plan(path: Path) -> JobPlan:
    try:
        content = read_bytes(path)
        plan = JobPlan.model_validate_json(content)
        check_unique_keys(path, content)
        if not plan.shares:
            raise ValueError("a plan without shares")
    except ValueError as error:
        raise InputError(f"{path}: expected the plan of jobs, got something else; delete {path.parent}") from error
    return plan


def _records(plan: JobPlan, folder: Path, number: int) -> dict[int, str]:
    """Read the records of the jobs that have ended, by job."""
    records: dict[int, str] = {}
    for job in range(1, plan.jobs + 1):
        with suppress(FileNotFoundError):
            records[job] = read_text(_record(folder, number, job))
    return records


def _missing(plan: JobPlan, records: dict[int, str]) -> list[int]:
    """Return the jobs that have scenes and have not ended."""
    return [job for job, share in enumerate(plan.shares, 1) if share and job not in records]


def _refused(output: Path, plan: JobPlan, missing: Sequence[int], different: str, others: str) -> InputError:
    where = f"choose another folder with -o, or delete {output / FOLDER} once none of them runs"
    if different:
        return InputError(
            f"{output}: {plan.jobs} jobs of another command share this folder, of which {_listed(missing)} have not"
            f" ended: expected {different}; {where}"
        )
    return InputError(
        f"{output}: results would differ, because the job that began first has {others}; install the same versions on"
        f" all machines, or {where}"
    )


def _failed(scenes: Sequence[EndedScene]) -> str:
    count = sum(bool(scene.failure) for scene in scenes)
    return f"; {count} of {len(scenes)} scenes failed" if count else ""


def _listed(jobs: Sequence[int]) -> str:
    """Name jobs by number, the first of many."""
    more = len(jobs) - MOST_NAMED
    return ", ".join(map(str, jobs[:MOST_NAMED])) + (f" and {more} more" if more > 0 else "")


def _record(folder: Path, number: int, job: int) -> Path:
    return folder / f"{number}.job-{job}.json"


def _temporary(folder: Path, job: ArrayJob) -> Path:
    return folder / f"job-{job.number}.part"


def _number_of(plan: Path) -> int:
    first = plan.name.partition(".")[0]
    return int(first) if first.isdecimal() else 1
