"""The process that reads the inputs of a campaign one by one and prints one result per line."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import signal
import sys
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from random import Random
from time import process_time

from .families import FAMILIES
from .family import CommandFamily, FileType, fingerprint
from .sandbox import Sandbox
from .verdicts import REFUSED, VALID, VERDICTS, PeakMemory, children, command_verdict, read_verdict, run_command

CPU_LIMIT = 10.0  # seconds of work on an input of a few kilobytes
TIME_LIMIT = 60.0  # seconds, on a busy machine; of a process that waits for nothing
ADDRESSES = 3 << 30  # bytes of address space beyond those at the start
COMMAND_EVERY = 20  # one of so many contents is also given to the command line, and every valid one


@dataclass(frozen=True)
class Result:
    """The result of one input: a verdict, or a description of the error in the program; and the processor time."""

    kind: str
    number: int
    verdict: str
    seconds: float

    @property
    def wrong(self) -> bool:
        """True if the program has an error."""
        return self.verdict not in VERDICTS


class ContentReader:
    """Reads damaged contents of one type of file."""

    def __init__(self, file_type: FileType, sandbox: Sandbox, folder: Path) -> None:
        """Read the originals, which imports what is needed."""
        self._type, self._sandbox, self._path = file_type, sandbox, folder / file_type.file
        self._originals = file_type.originals(folder)
        self._contents: list[str] = []
        for original in self._originals:
            self._path.write_bytes(original)
            self._contents.append(fingerprint(file_type.read(self._path)))
        if file_type.command:
            run_command(self._words(""))
        sandbox.restore()

    def verdict(self, seed: int, number: int) -> str:
        """Return the verdict on one input, without what it did to the folder."""
        file_type = self._type
        index, content = file_type.input(seed, number, self._originals)
        self._path.write_bytes(content)
        expected = None if file_type.expected is None else file_type.expected(content)
        before = self._sandbox.entries()
        verdict = read_verdict(
            lambda: file_type.read(self._path), self._contents[index], expected, sealed=file_type.sealed
        )
        changes = self._sandbox.changes(before)
        if changes and verdict in VERDICTS:
            return f"reading left {', '.join(changes)[:300]}"
        if file_type.command and verdict in VERDICTS and (number % COMMAND_EVERY == 0 or verdict == VALID):
            words = self._words("--json" if number % 2 else "")
            ended = run_command(words)
            by_command = command_verdict(ended, words)
            if by_command not in VERDICTS:
                return f"the command on a file that is {verdict}: {by_command}"
            if by_command == VALID and verdict == REFUSED:
                return f"the command takes a file that the library refuses; it reported {ended.err[:300]!r}"
            changes = self._sandbox.changes(before) if by_command == REFUSED else []
            if changes:
                return f"the refused command left {', '.join(changes)[:300]}"
        return verdict

    def _words(self, json_option: str) -> list[str]:
        words = [word.replace("{file}", self._path.name) for word in self._type.command]
        words = [word for word in words if word != "--json" or json_option]
        if "{sets}" in words:
            try:
                changes = json.loads(self._path.read_bytes())
            except ValueError:
                changes = []
            index = words.index("{sets}")
            words[index : index + 1] = [part for change in changes for part in ("--set", change)]
        return words


class CommandRunner:
    """Runs hostile command lines, each in a folder restored before."""

    def __init__(self, family: CommandFamily, sandbox: Sandbox, folder: Path) -> None:
        """Run the harmless command lines, which imports what is needed."""
        self._family, self._sandbox, self._folder = family, sandbox, folder
        for words in family.harmless:
            run_command(words)
        sandbox.restore()

    def verdict(self, seed: int, number: int) -> str:
        """Return the verdict on one command line."""
        case = self._family.case(Random(f"{self._family.name} {seed} {number}"), self._folder)
        before, alive = self._sandbox.entries(), children()
        ended = run_command(case.words)
        verdict = command_verdict(ended, case.words)
        faults: list[str] = [] if verdict in VERDICTS else [verdict]
        if verdict in VERDICTS and case.refused is not None and case.refused != (verdict == REFUSED):
            faults.append(f"expected {'a refusal' if case.refused else 'a result'}, got {verdict}: {ended.err[:300]!r}")
        changes = self._sandbox.changes(before)
        allowed = case.finished if ended.code == 2 else case.outputs
        strange = [name for name in changes if not name.startswith(allowed)]
        strange += [name for name in changes if name == case.kept and ended.code == 2]
        if strange:
            faults.append(f"left {', '.join(strange)[:300]}")
        if children() - alive:
            faults.append("left a process running")
        if faults:
            return f"{'; '.join(faults)}   <- ommatid {' '.join(map(repr, case.words))[:300]}"
        return verdict


def work(inputs: list[tuple[str, int]], seed: int, folder: Path) -> None:
    """Read inputs in this process and print one result per line."""
    warnings.simplefilter("error")
    warnings.simplefilter("ignore", ResourceWarning)  # decoders leave files open
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    os.chdir(folder)
    sandbox, messages = Sandbox(folder), os.dup(2)  # which stays where commands change the other
    for name, numbers in groupby(inputs, key=lambda pair: pair[0]):
        _limit_addresses(resource.RLIM_INFINITY)
        reader = opened(FAMILIES[name], sandbox, folder)
        _limit_addresses(ADDRESSES)
        for _, number in numbers:
            print(json.dumps(asdict(_result(reader.verdict, name, seed, number, messages))), flush=True)
            sandbox.restore()


def opened(family: FileType | CommandFamily, sandbox: Sandbox, folder: Path) -> ContentReader | CommandRunner:
    """Return what tries the inputs of a family in a folder."""
    if isinstance(family, FileType):
        return ContentReader(family, sandbox, folder)
    return CommandRunner(family, sandbox, folder)


def _result(verdict_on: Callable[[int, int], str], name: str, seed: int, number: int, messages: int) -> Result:
    faulthandler.dump_traceback_later(TIME_LIMIT, exit=True, file=messages)
    signal.setitimer(signal.ITIMER_PROF, CPU_LIMIT)  # ends the process, even inside C code
    memory, start = PeakMemory(), process_time()
    verdict = verdict_on(seed, number)
    seconds = process_time() - start
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    faulthandler.cancel_dump_traceback_later()
    return Result(name, number, (verdict in VERDICTS and memory.excess()) or verdict, seconds)


def _limit_addresses(beyond: int) -> None:
    """Limit the address space of the process relative to what it has now."""
    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    taken = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (hard if beyond == resource.RLIM_INFINITY else taken + beyond, hard))


if __name__ == "__main__":
    work(json.loads(sys.stdin.read()), int(sys.argv[1]), Path(sys.argv[2]))
