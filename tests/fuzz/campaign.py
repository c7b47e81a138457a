"""Campaigns of damaged inputs, read in a process that must not hang, crash, exceed its memory or leave files behind.

An input is determined by its family, a seed and a number. A worker process reads the inputs one by one and reports
each result; if it dies, a new one continues with the next input.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import psutil

from .sandbox import prepare
from .verdicts import ROOT
from .worker import CPU_LIMIT, Result

STALLED = 30.0  # seconds in which a process that hangs neither works nor reports
LOOK_EVERY = 0.25  # seconds


@dataclass(frozen=True)
class WorkerEnd:
    """How a worker ended: its exit code, output, and whether it was killed because it waited for nothing."""

    code: int
    out: str
    err: str
    stalled: bool


def campaign(inputs: Mapping[str, Iterable[int]], seed: int, finished: Path) -> list[Result]:
    """Read damaged inputs, given as numbers by family; a process that dies counts against its current input."""
    results: list[Result] = []
    left = [(name, number) for name, numbers in inputs.items() for number in numbers]
    while left:
        with tempfile.TemporaryDirectory() as folder:
            prepare(Path(folder), finished)
            ended = _worker(left, seed, folder)
        lines = [line for line in ended.out.splitlines() if line.startswith('{"kind"')]
        results += [Result(**json.loads(line)) for line in lines]
        left = left[len(lines) :]
        if left:
            hangs = ended.stalled or ended.code == -signal.SIGPROF or "Timeout" in ended.err
            reason = "hangs" if hangs else f"ends with {ended.code}: {ended.err[-400:]}"
            results.append(Result(*left.pop(0), f"the process {reason}", CPU_LIMIT))
    return results


def _worker(inputs: list[tuple[str, int]], seed: int, folder: str) -> WorkerEnd:
    """Start a worker process, and kill it if it neither works nor reports."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "tests.fuzz.worker", str(seed), folder]
    with tempfile.TemporaryFile() as words, tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        words.write(json.dumps(inputs).encode())
        words.seek(0)
        stalled = False
        with subprocess.Popen(
            command, stdin=words, stdout=out, stderr=err, env=environment, start_new_session=True
        ) as process:
            last, since = (0.0, 0), monotonic()
            while True:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(LOOK_EVERY)
                    break
                now = _seconds_of_work(process.pid), os.fstat(out.fileno()).st_size
                if now != last:
                    last, since = now, monotonic()
                elif monotonic() - since > STALLED:
                    os.killpg(process.pid, signal.SIGKILL)
                    stalled = True
        for stream in (out, err):
            stream.seek(0)
        printed, messages = (stream.read().decode(errors="replace") for stream in (out, err))
        return WorkerEnd(process.returncode, printed, messages, stalled)


def _seconds_of_work(process: int) -> float:
    """Return the processor time of a process and of those that it has started, in tenths of a second."""
    total = 0.0
    with suppress(psutil.Error):
        root = psutil.Process(process)
        for each in (root, *root.children(recursive=True)):
            with suppress(psutil.Error):
                times = each.cpu_times()
                total += times.user + times.system
    return round(total, 1)


def command_for(result: Result, seed: int) -> str:
    """Return the command that repeats one input."""
    return f"python -m tests.fuzz --kind {shlex.quote(result.kind)} --seed {seed} --only {result.number}"
