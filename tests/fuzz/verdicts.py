"""The verdict on one input: what a library call or a command did with it, and everything that it must not do."""

from __future__ import annotations

import contextlib
import json
import os
import re
import sys
import tempfile
import traceback
import unicodedata
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from ommatid.runtime.errors import InputError

from .family import fingerprint

REFUSED, UNCHANGED, VALID = "refused", "read unchanged", "valid, but different"
SEVERAL = "run", "render", "predict"  # commands on several scenes, which print a document of one that is refused, too
VERDICTS = (REFUSED, UNCHANGED, VALID)
LONGEST_MESSAGE = 500  # characters of an error of the library
LONGEST_SENTENCE = 1000  # characters of a line that a command writes to stderr
MEMORY = 1 << 30  # bytes that the process may need beyond those at the start
ROOT = Path(__file__).parent.parent.parent
KEPT_PROCESSES = ("resource_tracker", "worlds.trial")  # that end when this one ends
NOT_PRINTABLE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})  # general categories of Unicode
LIBRARY_NOISE = re.compile(r"\w*Warning: |^\d{4}-\d\d-\d\d .* (WARN|ERROR) |Traceback|Exception ignored|^  File ", re.M)


@dataclass(frozen=True)
class CommandEnd:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


def read_verdict(read: Callable[[], object], unchanged: str, expected: object = None, sealed: bool = False) -> str:
    """Return the verdict on what `read` returns or raises.

    unchanged : fingerprint of the undamaged content;  expected : the only value that is right, None if any is
    sealed : True if a checksum reveals every change
    """
    try:
        content = read()
    except InputError as error:
        message = str(error)
        if len(message) > LONGEST_MESSAGE:
            return f"a message of {len(message)} characters: {message[:300]!r}"
        return unprintable(message) or REFUSED
    except BaseException as error:
        return f"{type(error).__name__}: {str(error)[:300]!r} ({_location(error)})"
    if expected is not None and expected != content:
        return "another content than an independent decoder reads"
    if fingerprint(content) == unchanged:
        return UNCHANGED
    return "a change that the checksum does not reveal" if sealed else VALID


def _location(error: BaseException) -> str:
    """File and line of the innermost frame in this repository."""
    own = [
        f"{Path(frame.filename).name}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if ROOT in Path(frame.filename).parents and ".venv" not in Path(frame.filename).parts
    ]
    return own[-1] if own else ""


def unprintable(text: str) -> str:
    """Say which characters of a message would act on a terminal; empty if there are none."""
    acting = sorted({character for character in text if _acts(character)})
    return f"characters {acting[:5]!r} in {text[:300]!r}" if acting else ""


def _acts(character: str) -> bool:
    return character != "\n" and unicodedata.category(character) in NOT_PRINTABLE


def command_verdict(ended: CommandEnd, words: Sequence[str]) -> str:
    """Return REFUSED or VALID for a command that behaved, else a description of what it did wrong."""
    code, out, err = ended.code, ended.out, ended.err
    lines = err.splitlines()
    if "ommatid: unexpected" in err:
        return f"unexpected: {next(line for line in lines if 'unexpected' in line)[:300]!r}"
    faults = [unprintable(out), unprintable(err)]
    if LIBRARY_NOISE.search(err):
        faults.append(f"a message of a library: {err[:300]!r}")
    if max(map(len, lines), default=0) > LONGEST_SENTENCE:
        faults.append(f"a sentence of {max(map(len, lines))} characters: {max(lines, key=len)[:200]!r}")
    if code == 2:
        last = ("ommatid: ", "warning: ", *(("job ",) if "--job" in words else ()))  # which says what all jobs did
        if not lines or not lines[-1].startswith(last) or (out and words[0] not in SEVERAL):
            faults.append(f"refused with {err[:300]!r} and printed {out[:60]!r}")
    elif code not in (0, 3):
        faults.append(f"ended with {code}: {err[:300]!r}")
    elif "--json" in words:
        try:
            json.loads(out)
        except ValueError:
            faults.append(f"not JSON: {out[:200]!r}")
    return "; ".join(filter(None, faults)) or (REFUSED if code == 2 else VALID)


def run_command(words: Sequence[str]) -> CommandEnd:
    """Run a command line in this process."""
    from ommatid.cli import app

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
    return CommandEnd(code, *output())


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


class PeakMemory:
    """The largest resident memory of this process and of its ended children, from a start on."""

    def __init__(self) -> None:
        """Forget the largest value so far."""
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        self._start = _status("VmRSS")

    def excess(self) -> str:
        """Say how much memory was needed if that is too much; else empty."""
        needed = _status("VmHWM") - self._start
        return f"{needed / 1e9:.2f} GB of memory" if needed > MEMORY else ""


def _status(key: str) -> int:
    text = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
    return int(text.partition(f"{key}:")[2].split()[0]) * 1024


def children() -> set[int]:
    """Return the processes that this one has started and that still run; those that have ended have no command line."""
    found: set[int] = set()
    for child in psutil.Process().children():
        with contextlib.suppress(psutil.Error):  # of those that have ended meanwhile
            line = " ".join(child.cmdline())
            if line and not any(name in line for name in KEPT_PROCESSES):
                found.add(child.pid)
    return found
