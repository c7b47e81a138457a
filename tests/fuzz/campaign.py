"""A campaign: many damaged inputs, each read in a process that may not hang, crash, grow or leave anything behind.

An input is known by its kind, a seed and a number, and is the same whenever these are. A process of its own reads one
after the other, says what became of each, and is replaced where it died.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import os
import resource
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from random import Random
from time import perf_counter

from ommatid.runtime.errors import InputError

from ..examples import GALLERY
from .kinds import BASE, EVERYTHING, KINDS, SCENE, Kind

REFUSED, UNCHANGED, ANOTHER = "refused", "read unchanged", "another valid one"
VERDICTS = (REFUSED, UNCHANGED, ANOTHER)
LONGEST = 1000  # characters of a sentence
HANG = 10.0  # seconds of work after which an input of a few kilobytes hangs
STUCK = 300.0  # seconds after which it does, worked or waited, however busy the machine is
ROOM = 3 << 30  # bytes of addresses that a process may take beside what it has begun with
COMMAND = 20  # of so many inputs one is also given to the command line, beside all that are valid
ROOT = Path(__file__).parent.parent.parent


@dataclass(frozen=True)
class Result:
    """What became of an input: one of the verdicts, or in words what was wrong with the program."""

    kind: str
    number: int
    verdict: str
    seconds: float

    @property
    def wrong(self) -> bool:
        """Whether the program has to be mended."""
        return self.verdict not in VERDICTS


def damaged(kind: Kind, seed: int, number: int, originals: list[bytes]) -> tuple[int, bytes]:
    """Which original was damaged, and what it became."""
    rng = Random(f"{kind.name} {seed} {number}")
    place = rng.randrange(len(originals))
    return place, kind.damaged(rng, originals[place])


def prepare(folder: Path, finished: Path) -> None:
    """Lay out the files that inputs are read beside; `finished` is the folder of a run of the tiny scene."""
    (folder / SCENE).write_bytes((finished.parent.parent / SCENE).read_bytes())
    for beside in ("lenses", "worlds"):
        shutil.copytree(GALLERY / beside, folder / beside)
    (folder / BASE).write_text(EVERYTHING, encoding="utf-8")
    for name in ("stack.exr", "model.npz"):
        shutil.copy(finished / name, folder / f"sound{Path(name).suffix}")


def campaign(wanted: Mapping[str, Iterable[int]], seed: int, finished: Path) -> list[Result]:
    """Read damaged inputs, `wanted` by the names of their kinds, in that order.

    A process that dies counts against the input that it was reading.
    """
    results: list[Result] = []
    left = [(name, number) for name, numbers in wanted.items() for number in numbers]
    with tempfile.TemporaryDirectory() as folder:
        prepare(Path(folder), finished)
        while left:
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
            ended = subprocess.run(
                [sys.executable, "-m", "tests.fuzz.campaign", str(seed), folder],
                input=json.dumps(left),
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                check=False,
            )
            told = [Result(**json.loads(line)) for line in ended.stdout.splitlines() if line.startswith('{"kind"')]
            results += told
            left = left[len(told) :]
            if left:
                hung = ended.returncode == -signal.SIGPROF or "Timeout" in ended.stderr
                what = "hangs" if hung else f"ends with {ended.returncode}: {ended.stderr[-400:]}"
                results.append(Result(*left.pop(0), f"the process {what}", HANG))
    return results


def _work(wanted: list[tuple[str, int]], seed: int, folder: Path) -> None:
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)  # decoders that try their luck leave files open
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for name, inputs in groupby(wanted, key=lambda one: one[0]):
        kind = KINDS[name]
        originals = kind.originals(folder)
        contents = _known(kind, folder / kind.file, originals)
        for _, number in inputs:
            place, content = damaged(kind, seed, number, originals)
            faulthandler.dump_traceback_later(STUCK, exit=True)
            signal.setitimer(signal.ITIMER_PROF, HANG)  # which ends the process, even where it is deep in C
            start = perf_counter()
            verdict = judged(kind, folder / kind.file, content, contents[place], number)
            seconds = perf_counter() - start
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.cancel_dump_traceback_later()
            print(json.dumps(asdict(Result(name, number, verdict, seconds))), flush=True)


def _known(kind: Kind, path: Path, originals: list[bytes]) -> list[object]:
    """What sound ones hold. Afterwards the process may take no more than some room beside what that took."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    contents: list[object] = []
    for original in originals:
        path.write_bytes(original)
        contents.append(kind.read(path))
    if kind.command:
        _commanded(kind, path)  # imports what it needs
        _clean(path.parent, {"new.exr", "new.png"})
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + ROOM, hard))
    return contents


def judged(kind: Kind, path: Path, content: bytes, expected: object, number: int) -> str:
    """What is wrong with the program that reads this `content`, or what became of it."""
    path.write_bytes(content)
    before = set(os.listdir(path.parent))  # noqa: PTH208
    verdict = _read(kind, path, expected)
    if kind.command and verdict in VERDICTS and (number % COMMAND == 0 or verdict == ANOTHER):
        verdict = _told(kind, path, verdict)
    left = set(os.listdir(path.parent)) - before  # noqa: PTH208
    _clean(path.parent, left)
    return f"left behind: {', '.join(sorted(left))}" if left and verdict in VERDICTS else verdict


def _clean(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)


def _read(kind: Kind, path: Path, expected: object) -> str:
    try:
        found = kind.read(path)
    except InputError as error:
        sentence = str(error)
        if len(sentence) > LONGEST:
            return f"a sentence of {len(sentence)} characters: {sentence[:300]}"
        return REFUSED
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:300]} ({_where(error)})"
    if found == expected:
        return UNCHANGED
    return "a checksum that does not tell" if kind.sealed else ANOTHER


def _where(error: BaseException) -> str:
    place = error.__traceback__
    found = ""
    while place is not None:
        file = Path(place.tb_frame.f_code.co_filename)
        if ROOT in file.parents and ".venv" not in file.parts:
            found = f"{file.name}:{place.tb_lineno}"
        place = place.tb_next
    return found


def _told(kind: Kind, path: Path, verdict: str) -> str:
    """The verdict, or what the command line did otherwise than it has to."""
    code, out, err = _commanded(kind, path)
    lines = err.splitlines()
    if (
        code == 2
        and not out
        and len(lines) == 1
        and lines[0].startswith("ommatid: ")
        and not lines[0].startswith("ommatid: unexpected")
    ):
        return verdict
    if code == 0 and verdict != REFUSED:
        json.loads(out)
        _clean(path.parent, ("new.exr", "new.png"))
        return verdict
    return f"the command, of what is {verdict}, ended with {code}, printed {out[:60]!r} and said {err[:400]!r}"


def _commanded(kind: Kind, path: Path) -> tuple[int, str, str]:
    from ommatid.cli import app

    words = [path.name if word == "{file}" else word.replace("{file}", path.name) for word in kind.command]
    if words[-1] == "{sets}":
        try:
            changes = json.loads(path.read_bytes())
        except ValueError:
            changes = []
        words[-1:] = [part for change in changes for part in ("--set", change)]
    saved = sys.argv
    sys.argv = ["ommatid", *words]
    try:
        with _captured() as told:
            try:
                app.main()
                code = 0
            except SystemExit as ended:
                code = int(ended.code or 0)
    finally:
        sys.argv = saved
    out, err = told()
    return code, out, err


@contextlib.contextmanager
def _captured() -> Generator[Callable[[], tuple[str, str]]]:
    """What anything in this process writes to stdout and to stderr, libraries in C as well."""
    texts: list[str] = []
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        sys.stdout.flush()
        saved = os.dup(1), os.dup(2)
        for number, file in enumerate((out, err), start=1):
            os.dup2(file.fileno(), number)
        try:
            yield lambda: (texts[0], texts[1])
        finally:
            sys.stdout.flush()
            sys.stderr.flush()
            for number, (file, before) in enumerate(zip((out, err), saved, strict=True), start=1):
                os.dup2(before, number)
                os.close(before)
                file.seek(0)
                texts.append(file.read().decode(errors="replace"))


def again(result: Result, seed: int) -> str:
    """The command that does one input again."""
    return f"python -m tests.fuzz --kind {shlex.quote(result.kind)} --seed {seed} --only {result.number}"


if __name__ == "__main__":
    _work(json.loads(sys.stdin.read()), int(sys.argv[1]), Path(sys.argv[2]))
