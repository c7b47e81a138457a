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
from pathlib import Path

from .sandbox import prepare
from .verdicts import ROOT
from .worker import CPU_LIMIT, Result


def campaign(inputs: Mapping[str, Iterable[int]], seed: int, finished: Path) -> list[Result]:
    """Read damaged inputs, given as numbers by family; a process that dies counts against its current input."""
    results: list[Result] = []
    left = [(name, number) for name, numbers in inputs.items() for number in numbers]
    while left:
        with tempfile.TemporaryDirectory() as folder:
            prepare(Path(folder), finished)
            code, printed, messages = _worker(left, seed, folder)
        lines = [line for line in printed.splitlines() if line.startswith('{"kind"')]
        results += [Result(**json.loads(line)) for line in lines]
        left = left[len(lines) :]
        if left:
            hangs = code == -signal.SIGPROF or "Timeout" in messages
            reason = "hangs" if hangs else f"ends with {code}: {messages[-400:]}"
            results.append(Result(*left.pop(0), f"the process {reason}", CPU_LIMIT))
    return results


def _worker(inputs: list[tuple[str, int]], seed: int, folder: str) -> tuple[int, str, str]:
    """Return exit code and output of a worker process, which ends itself if it hangs."""
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-P", "-m", "tests.fuzz.worker", str(seed), folder]
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:  # a child that stays may keep them open
        words = json.dumps(inputs).encode()
        ended = subprocess.run(command, input=words, stdout=out, stderr=err, env=environment, start_new_session=True)
        for stream in (out, err):
            stream.seek(0)
        return ended.returncode, out.read().decode(errors="replace"), err.read().decode(errors="replace")


def command_for(result: Result, seed: int) -> str:
    """Return the command that repeats one input."""
    return f"python -m tests.fuzz --kind {shlex.quote(result.kind)} --seed {seed} --only {result.number}"
