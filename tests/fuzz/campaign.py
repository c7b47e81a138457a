"""Campaigns of damaged inputs, read in a process that must not hang, crash, exceed its memory or leave files behind.

An input is determined by its file type, a seed and a number. A worker process reads the inputs one by one and reports
each result; if it dies, a new one continues with the next input.
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
import traceback
import warnings
from collections.abc import Callable, Generator, Iterable, Mapping
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from random import Random
from time import perf_counter

from ommatid.runtime.errors import InputError

from ..examples import GALLERY
from .file_types import BASE, EVERYTHING, FILE_TYPES, SCENE, FileType

REFUSED, UNCHANGED, VALID = "refused", "read unchanged", "valid, but different"
VERDICTS = (REFUSED, UNCHANGED, VALID)
MAX_MESSAGE = 1000  # characters
CPU_LIMIT = 10.0  # seconds of work on an input of a few kilobytes
TIME_LIMIT = 300.0  # seconds, on a busy machine
MEMORY = 3 << 30  # bytes of address space beyond those at the start
COMMAND_EVERY = 20  # one of so many inputs is also given to the command line, and every valid one
COMMAND_FILES = ("new.exr", "new.png")
ROOT = Path(__file__).parent.parent.parent


@dataclass(frozen=True)
class Result:
    """The result of one input: a verdict, or a description of the error in the program."""

    kind: str
    number: int
    verdict: str
    seconds: float

    @property
    def wrong(self) -> bool:
        """True if the program has an error."""
        return self.verdict not in VERDICTS


def damaged(file_type: FileType, seed: int, number: int, originals: list[bytes]) -> tuple[int, bytes]:
    """Return the index of the original and its damaged content."""
    rng = Random(f"{file_type.name} {seed} {number}")
    index = rng.randrange(len(originals))
    return index, file_type.damaged(rng, originals[index])


def prepare(folder: Path, finished: Path) -> None:
    """Write the files that inputs refer to; `finished` is the folder of a finished run of the tiny scene."""
    (folder / SCENE).write_bytes((finished.parent.parent / SCENE).read_bytes())
    for name in ("lenses", "worlds"):
        shutil.copytree(GALLERY / name, folder / name)
    (folder / BASE).write_text(EVERYTHING, encoding="utf-8")
    for name in ("stack.exr", "model.npz"):
        shutil.copy(finished / name, folder / f"sound{Path(name).suffix}")


def campaign(inputs: Mapping[str, Iterable[int]], seed: int, finished: Path) -> list[Result]:
    """Read damaged inputs, given as numbers by file type; a process that dies counts against its current input."""
    results: list[Result] = []
    left = [(name, number) for name, numbers in inputs.items() for number in numbers]
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
            lines = [line for line in ended.stdout.splitlines() if line.startswith('{"kind"')]
            results += [Result(**json.loads(line)) for line in lines]
            left = left[len(lines) :]
            if left:
                hangs = ended.returncode == -signal.SIGPROF or "Timeout" in ended.stderr
                reason = "hangs" if hangs else f"ends with {ended.returncode}: {ended.stderr[-400:]}"
                results.append(Result(*left.pop(0), f"the process {reason}", CPU_LIMIT))
    return results


def _work(inputs: list[tuple[str, int]], seed: int, folder: Path) -> None:
    """Read inputs in this process and print one result per line."""
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)  # decoders leave files open
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    for name, numbers in groupby(inputs, key=lambda pair: pair[0]):
        file_type = FILE_TYPES[name]
        originals = file_type.originals(folder)
        contents = _original_contents(file_type, folder / file_type.file, originals)
        for _, number in numbers:
            index, content = damaged(file_type, seed, number, originals)
            faulthandler.dump_traceback_later(TIME_LIMIT, exit=True)
            signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT)  # ends the process, even inside C code
            start = perf_counter()
            verdict = verdict_on(file_type, folder / file_type.file, content, contents[index], number)
            seconds = perf_counter() - start
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            faulthandler.cancel_dump_traceback_later()
            print(json.dumps(asdict(Result(name, number, verdict, seconds))), flush=True)


def _original_contents(file_type: FileType, path: Path, originals: list[bytes]) -> list[object]:
    """Read the originals, then limit the memory of the process relative to what that took."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    contents: list[object] = []
    for original in originals:
        path.write_bytes(original)
        contents.append(file_type.read(path))
    if file_type.command:
        _run_command(file_type, path)  # imports what it needs
        _remove(path.parent, COMMAND_FILES)
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, hard))
    return contents


def verdict_on(file_type: FileType, path: Path, content: bytes, expected: object, number: int) -> str:
    """Return the verdict on this content, or a description of the error in the program."""
    path.write_bytes(content)
    before = set(os.listdir(path.parent))  # noqa: PTH208
    verdict = _read(file_type, path, expected)
    if file_type.command and verdict in VERDICTS and (number % COMMAND_EVERY == 0 or verdict == VALID):
        verdict = _command_verdict(file_type, path, verdict)
    left = set(os.listdir(path.parent)) - before  # noqa: PTH208
    _remove(path.parent, left)
    return f"left behind: {', '.join(sorted(left))}" if left and verdict in VERDICTS else verdict


def _remove(folder: Path, names: Iterable[str]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)


def _read(file_type: FileType, path: Path, expected: object) -> str:
    try:
        content = file_type.read(path)
    except InputError as error:
        message = str(error)
        if len(message) > MAX_MESSAGE:
            return f"a message of {len(message)} characters: {message[:300]}"
        return REFUSED
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:300]} ({_location(error)})"
    if content == expected:
        return UNCHANGED
    return "a change that the checksum does not reveal" if file_type.sealed else VALID


def _location(error: BaseException) -> str:
    """File and line of the innermost frame in this repository."""
    own = [
        f"{Path(frame.filename).name}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if ROOT in Path(frame.filename).parents and ".venv" not in Path(frame.filename).parts
    ]
    return own[-1] if own else ""


def _command_verdict(file_type: FileType, path: Path, verdict: str) -> str:
    """The verdict if the command line agrees with it, else a description of what it did."""
    code, out, err = _run_command(file_type, path)
    lines = err.splitlines()
    refused = code == 2 and not out and len(lines) == 1 and lines[0].startswith("ommatid: ")
    if refused and not lines[0].startswith("ommatid: unexpected"):
        return verdict
    if code == 0 and verdict != REFUSED:
        json.loads(out)
        _remove(path.parent, COMMAND_FILES)
        return verdict
    return f"the command on a file that is {verdict} ended with {code}, printed {out[:60]!r} and reported {err[:400]!r}"


def _run_command(file_type: FileType, path: Path) -> tuple[int, str, str]:
    from ommatid.cli import app

    words = [word.replace("{file}", path.name) for word in file_type.command]
    if words[-1] == "{sets}":
        try:
            changes = json.loads(path.read_bytes())
        except ValueError:
            changes = []
        words[-1:] = [part for change in changes for part in ("--set", change)]
    saved, code = sys.argv, 0
    sys.argv = ["ommatid", *words]
    try:
        with _captured() as output:
            try:
                app.main()
            except SystemExit as ended:
                code = int(ended.code or 0)
    finally:
        sys.argv = saved
    return code, *output()


@contextlib.contextmanager
def _captured() -> Generator[Callable[[], tuple[str, str]]]:
    """Capture stdout and stderr of this process, including those of C libraries."""
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


def command_for(result: Result, seed: int) -> str:
    """Return the command that repeats one input."""
    return f"python -m tests.fuzz --kind {shlex.quote(result.kind)} --seed {seed} --only {result.number}"


if __name__ == "__main__":
    _work(json.loads(sys.stdin.read()), int(sys.argv[1]), Path(sys.argv[2]))
