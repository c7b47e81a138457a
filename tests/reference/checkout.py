"""One checkout and its finished cases: an interpreter, caches and a working folder that the other does not share."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

from .cases import Case, Words

ROOT = Path(__file__).resolve().parents[2]
DONE = "done.json"
MATRIX = "H.npz"
INHERITED = ("PATH", "LANG", "LC_ALL", "DRJIT_LIBLLVM_PATH", "LD_LIBRARY_PATH")
VERSIONS = """
import importlib.metadata, pathlib, sys
import ommatid
needed = ("numpy", "scipy", "mitsuba", "drjit", "OpenEXR", "scikit-image")
print(pathlib.Path(ommatid.__file__).resolve().parent)
print(sys.version, *(importlib.metadata.version(name) for name in needed))
"""


class NoCheckoutError(Exception):
    """A name that is neither a folder with a checkout nor a revision, or a checkout that cannot be run."""


@dataclass(frozen=True)
class Done:
    """How a case ended: the folder, the exit code of its last command, its last words, and processor seconds."""

    folder: Path
    code: int
    message: str
    seconds: float
    reused: bool = False


@dataclass(frozen=True)
class Checkout:
    """A folder with the program, the interpreter that runs it, and the folder of its results and caches."""

    folder: Path
    python: Path
    store: Path
    settings: Words = ()  # KEY=VALUE of every run, to see what a comparison notices

    @cached_property
    def environment(self) -> dict[str, str]:
        """Variables of the processes: nothing of the user, one thread of linear algebra, caches of its own."""
        home = self.store / "home"
        inherited = {name: os.environ[name] for name in INHERITED if name in os.environ}
        caches = {"XDG_CACHE_HOME": "cache", "XDG_CONFIG_HOME": "config", "XDG_DATA_HOME": "data"}
        caches |= {"MPLCONFIGDIR": "matplotlib", "TMPDIR": "tmp"}
        for name in caches.values():
            (home / name).mkdir(parents=True, exist_ok=True)
        own = {variable: str(home / name) for variable, name in caches.items()}
        # Before all installed packages, so that a borrowed interpreter imports this checkout, too.
        return {**inherited, **own, "HOME": str(home), "PYTHONPATH": str(self.folder), "OPENBLAS_NUM_THREADS": "1"}

    @cached_property
    def identity(self) -> str:
        """Hash of the program's files and of the versions of its libraries: results of the same can be used again."""
        said = subprocess.run(
            [self.python, "-P", "-c", VERSIONS], cwd=self.store, env=self.environment, capture_output=True, text=True
        )
        where, _, versions = said.stdout.partition("\n")
        if said.returncode:
            raise NoCheckoutError(f"{self.python} cannot import {self.folder}: {last_line(said.stderr)}")
        if Path(where) != (self.folder / "ommatid").resolve():
            raise NoCheckoutError(f"{self.python} imports {where} in place of {self.folder}")
        digest = hashlib.sha256((versions + " ".join(self.settings)).encode())
        for name, _, files in sorted(os.walk(self.folder / "ommatid", followlinks=True)):
            if "__pycache__" not in name:
                for file in sorted(files):
                    path = Path(name, file)
                    digest.update(str(path.relative_to(self.folder)).encode() + path.read_bytes())
        return digest.hexdigest()[:16]

    def run(self, case: Case) -> Done:
        """Run the commands of a case in an empty folder, and export its H; a finished case is not run again."""
        folder = self.store / case.name
        key = json.dumps([asdict(case), self.identity])
        if (folder / DONE).exists():
            kept = json.loads((folder / DONE).read_text(encoding="utf-8"))
            if kept["key"] == key:
                return Done(folder, kept["code"], kept["message"], kept["seconds"], reused=True)
        emptied(folder)
        case.write(folder)
        code, message, seconds = 0, "", 0.0
        for words in (*case.commands, ("export", f"{case.result}/model.npz", "-o", MATRIX)):
            more = [part for setting in self.settings for part in ("--set", setting)] if words[0] == "run" else []
            code, message, spent = self.command((*words, *more), folder)
            seconds += spent
            if code:
                break
        ended = {"code": code, "message": message, "seconds": seconds}
        (folder / DONE).write_text(json.dumps({"key": key, **ended}), encoding="utf-8")
        return Done(folder, code, message, seconds)

    def command(self, words: Words, folder: Path) -> tuple[int, str, float]:
        """Run one command: its exit code, the last line of its messages, and its processor seconds."""
        messages = folder / "messages.txt"
        with messages.open("w", encoding="utf-8") as file:
            process = subprocess.Popen(
                [self.python, "-P", "-m", "ommatid", *words],
                cwd=folder,
                env=self.environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
        message = last_line(messages.read_text(encoding="utf-8", errors="replace"))
        return process.returncode, f"{words[0]}: {message}", usage.ru_utime + usage.ru_stime


def last_line(text: str) -> str:
    """The last line that holds something."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "no message")


def emptied(folder: Path) -> None:
    """Make a folder, or empty the one that an interrupted run left."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def found(name: str, python: str | None, scratch: Path) -> tuple[Path, Path]:
    """Folder and interpreter of a checkout; a revision of this repository is checked out into a folder in `scratch`.

    Without `python`, the interpreter is that of the checkout's .venv, or for a revision that of this checkout.
    """
    folder = Path(name).resolve()
    if not (folder / "ommatid").is_dir():
        folder = revision(name, scratch)
    if python is not None:
        return folder, Path(python).absolute()
    own = [place / ".venv" / "bin" / "python" for place in ((folder, ROOT) if scratch in folder.parents else (folder,))]
    interpreter = next((path for path in own if path.exists()), None)
    if interpreter is None:
        raise NoCheckoutError(f"{folder} has no .venv/bin/python: create it, or name an interpreter with --python")
    return folder, interpreter


def revision(name: str, scratch: Path) -> Path:
    """Check out a revision of this repository; its own clone, so that an interrupted run leaves nothing in this one."""

    def git(*words: str) -> str:
        ended = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True)
        if ended.returncode:
            raise NoCheckoutError(
                f"{name!r} is neither a folder with a checkout nor a revision: {last_line(ended.stderr)}"
            )
        return ended.stdout.strip()

    commit = git("rev-parse", "--verify", "--quiet", "--end-of-options", f"{name}^{{commit}}")
    folder = scratch / commit
    if not folder.exists():
        git("clone", "--quiet", "--shared", "--no-checkout", str(ROOT), str(folder))
        git("-C", str(folder), "checkout", "--quiet", "--detach", commit)
    return folder
