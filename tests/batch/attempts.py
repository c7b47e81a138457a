"""Commands that are killed at any moment."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

# Forks commands from a process that has imported everything, so that each begins its work at once.
STARTER = """
import os, sys
import mitsuba, numba, scipy.linalg, skimage.metrics, matplotlib.backends.backend_agg
import ommatid.pipeline.stages, ommatid.analysis.depth_error, ommatid.analysis.study, ommatid.batch.sweep_table
import ommatid.reconstruct.output.run_json, ommatid.reconstruct.output.result_files
from ommatid.cli import app
for line in sys.stdin:
    number = os.fork()
    if number:
        print(number, os.waitpid(number, 0)[1], flush=True)
        continue
    os.setsid()
    folder, *sys.argv[1:] = line.split()
    os.chdir(folder)
    os.dup2(os.open("stderr", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    os.dup2(os.open("stdout", os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    open("number.new", "w").write(str(os.getpid()))
    os.rename("number.new", "number")
    try:
        app.main()
    except SystemExit as ended:
        os._exit(ended.code)
    finally:
        os._exit(99)
"""


@dataclass(frozen=True)
class Attempt:
    """A command that was killed or ended, and its output."""

    killed: bool
    out: str
    err: str


def modification_times(out: Path) -> dict[str, int]:
    """Modification time of every file below a folder, hidden ones included."""
    times: dict[str, int] = {}
    for folder, _, names in os.walk(out):
        for name in names:
            path = Path(folder) / name
            with suppress(FileNotFoundError):  # renamed meanwhile
                times[str(path.relative_to(out))] = path.stat().st_mtime_ns
    return times


def attempt(starter: subprocess.Popen[str], here: Path, command: Sequence[str], changes: int) -> Attempt:
    """Run a command in `here`, and kill it with all its processes after a number of changes of the files in out/."""
    assert starter.stdin is not None
    assert starter.stdout is not None
    (here / "number").unlink(missing_ok=True)
    before, seen = modification_times(here / "out"), 0
    starter.stdin.write(" ".join((str(here), *command)) + "\n")
    starter.stdin.flush()
    while not (here / "number").exists():
        time.sleep(0.001)
    group = int((here / "number").read_text(encoding="ascii"))
    while seen < changes and not select.select([starter.stdout], [], [], 0.001)[0]:
        now = modification_times(here / "out")
        seen += len(now.items() ^ before.items())
        before = now
    if seen >= changes:
        with suppress(ProcessLookupError):
            os.killpg(group, signal.SIGKILL)
    number, status = map(int, starter.stdout.readline().split())
    assert number == group
    out, err = ((here / name).read_text(encoding="utf-8") for name in ("stdout", "stderr"))
    killed = os.WIFSIGNALED(status)
    assert killed or os.waitstatus_to_exitcode(status) == 0, err
    return Attempt(killed, out, err)
