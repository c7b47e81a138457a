"""Kill commands at random moments, repeat them until they end, and compare their files with an undisturbed run's.

Times differ from run to run, and with them dates, fingerprints of records that hold times, and the pages that show
them. Everything else has to be equal bit for bit, and a finished stage keeps the time that it took first.
"""

from __future__ import annotations

import csv
import os
import random
import select
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ommatid.page.cached import read_stamp
from ommatid.reconstruct.output import run_json
from ommatid.scenes import model_file, stack
from ommatid.scenes.formats import exr

from ..conftest import TINY
from ..runs import content, differences

SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)
NOT_BEGUN = 99  # exit code of a process that is interrupted before its command
MOST_KILLS = 6  # of one folder, before its commands may run to their end
SCENES = ("a.toml", "b.toml", "c.toml")
OUT, INPUTS = "out", "inputs"
STACK, MODEL = "stack.exr", "model.npz"
BATCH = ("run", *SCENES, "-o", OUT)
SWEEP = ("run", SCENES[0], "-o", OUT, "--sweep", "noise.variance=1e-3,1e-2", "--sweep", "render.seed=1,2")
FRAMES = ("reconstruct", *(f"{INPUTS}/{name}.exr" for name in "abc"), f"{INPUTS}/{MODEL}", "-o", OUT)

# Commands that fill one folder together, the same in any order.
COMMANDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "single run": (("run", SCENES[0], "-o", OUT),),
    "batch": ((*BATCH, "--workers", "1"),),
    "batch of two processes": ((*BATCH, "--workers", "2"),),
    "sweep": ((*SWEEP, "--workers", "1"),),
    "shares of --job": tuple((*BATCH, "--workers", "1", "--job", f"{share}/2") for share in (1, 2)),
    "frames": (FRAMES,),
    "frames of two processes": ((*FRAMES, "--workers", "2"),),
    "stack and model": (("reconstruct", f"{INPUTS}/a.exr", f"{INPUTS}/{MODEL}", "-o", f"{OUT}/a"),),
}


# Forks commands from a process that has imported everything, so that each begins its work at once.
STARTER = """
import os, sys
import mitsuba, scipy.linalg, skimage.metrics, matplotlib.backends.backend_agg
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


@dataclass
class Tally:
    """What happened to the commands of one name."""

    killed: Counter[str] = field(default_factory=Counter[str])
    folders: int = 0
    waits: int = 0
    wrong: list[str] = field(default_factory=list[str])

    @property
    def kills(self) -> int:
        """Number of commands that ended by a signal."""
        return sum(self.killed.values())


def _heed_signals() -> None:
    """Undo what shells do to background jobs: they ignore some signals."""
    for number in SIGNALS:
        if number != signal.SIGKILL:
            signal.signal(number, signal.SIG_DFL)


@contextmanager
def prepared(here: Path) -> Generator[subprocess.Popen[str]]:
    """Write the scenes and the recorded frames into a folder, and yield a process that starts commands there."""
    for number, name in enumerate(SCENES):
        text = TINY.replace("[render]", f"[render]\nseed = {number}")
        (here / name).write_text(text, encoding="utf-8")
    with subprocess.Popen(
        [sys.executable, "-c", STARTER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=_heed_signals,
    ) as starter:
        try:
            run(starter, here, (*BATCH, "--workers", "1"))
            (here / INPUTS).mkdir()
            for name in SCENES:
                folder = here / OUT / Path(name).stem
                shutil.copyfile(folder / STACK, here / INPUTS / f"{folder.name}.exr")
                shutil.copyfile(folder / MODEL, here / INPUTS / MODEL)
            shutil.rmtree(here / OUT)
            yield starter
        finally:
            starter.terminate()


def run(
    starter: subprocess.Popen[str],
    here: Path,
    command: Sequence[str],
    kill: Callable[[int, Callable[[], bool]], None] | None = None,
) -> tuple[int, str]:
    """Run a command in a folder and return its wait status and its messages; `kill` may end it before."""
    assert starter.stdin is not None
    assert starter.stdout is not None
    waiting = starter.stdout
    (here / "number").unlink(missing_ok=True)
    starter.stdin.write(" ".join((str(here), *command)) + "\n")
    starter.stdin.flush()
    while not (here / "number").exists():
        assert starter.poll() is None, "the process that starts commands has ended"
        time.sleep(0.001)
    process = int((here / "number").read_text(encoding="ascii"))
    if kill is not None:
        kill(process, lambda: bool(select.select([waiting], [], [], 0.001)[0]))
    number, status = map(int, waiting.readline().split())
    assert number == process
    return status, (here / "stderr").read_text(encoding="utf-8")


def campaign(starter: subprocess.Popen[str], here: Path, name: str, kills: int, seed: int) -> Tally:
    """Kill the commands of a name so many times, and compare what they leave with an undisturbed run."""
    rng, tally, commands = random.Random(f"{name} {seed}"), Tally(), COMMANDS[name]
    begun = time.perf_counter()
    for command in commands:
        status, messages = run(starter, here, command)
        assert status == 0, messages
    seconds = (time.perf_counter() - begun) / len(commands)
    expected = results(here / OUT)
    while tally.kills < kills:
        shutil.rmtree(here / OUT)
        _fill(starter, here, commands, rng, seconds, tally)
        tally.folders += 1
        tally.wrong += [
            f"{name}, folder {tally.folders}: {what} differs" for what in differences(results(here / OUT), expected)
        ]
    shutil.rmtree(here / OUT)
    return tally


def _fill(
    starter: subprocess.Popen[str],
    here: Path,
    commands: Sequence[Sequence[str]],
    rng: random.Random,
    seconds: float,
    tally: Tally,
) -> None:
    """Run commands until all have ended, killing them on the way."""
    times: dict[str, float] = {}
    for command in rng.sample(commands, len(commands)):
        most = rng.randint(1, MOST_KILLS)
        for attempt in range(most + 1):
            number = rng.choice(SIGNALS)
            whole_group = rng.random() < 0.5 and number != signal.SIGHUP
            after = rng.uniform(0, 1.1 * seconds)

            def kill(
                process: int,
                ended: Callable[[], bool],
                after: float = after,
                number: int = number,
                group: bool = whole_group,
            ) -> None:
                until = time.perf_counter() + after
                while time.perf_counter() < until and not ended():
                    pass
                with suppress(ProcessLookupError):
                    (os.killpg if group else os.kill)(process, number)

            status, messages = run(starter, here, command, kill if attempt < most else None)
            tally.waits += "waiting for its end" in messages
            now = finished_times(here / OUT)
            tally.wrong += [f"repeated: {file}" for file in times if now.get(file) != times[file]]
            times |= now
            if os.WIFSIGNALED(status):
                tally.killed[signal.Signals(os.WTERMSIG(status)).name] += 1
            elif number == signal.SIGINT and (os.waitstatus_to_exitcode(status) == NOT_BEGUN or "stopped" in messages):
                tally.killed["SIGINT"] += 1
            elif status:
                tally.wrong.append(f"exit status {status} of {' '.join(command)}: {messages}")
            else:
                break


def finished_times(out: Path) -> dict[str, float]:
    """Seconds that finished stages took, by their file: a stage that is repeated takes another time."""
    times: dict[str, float] = {}
    for path in out.glob(f"*/{STACK}"):
        times[str(path)] = stack.read(path).record["seconds"]
    for path in out.glob(f"*/{MODEL}"):
        times[str(path)] = model_file.read(path).record["seconds"]
    for path in out.glob("*/run.json"):
        times[str(path)] = run_json.read(path.parent).stages["reconstruct"].seconds
    for path in out.glob("[!.]*.exr"):
        times[str(path)] = exr.read(path)[0].record["report"]["stages"]["reconstruct"]["seconds"]
    return times


def results(out: Path) -> dict[str, Any]:
    """Everything in an output folder that does not depend on the time it took."""
    found: dict[str, Any] = {"names": sorted(str(path.relative_to(out)) for path in out.rglob("*")), **content(out)}
    for path in (*out.rglob("report.html"), *out.glob("index.html")):
        text = path.read_text(encoding="utf-8")
        stamped = read_stamp(path)[1] is not None
        found[str(path.relative_to(out))] = stamped, text.count("report.html"), text.count("<img")
    for path in out.glob("sweep.csv"):
        with path.open(encoding="utf-8", newline="") as stream:
            found[path.name] = [
                {key: row[key] for key in row if "seconds" not in key} for row in csv.DictReader(stream)
            ]
    return found
