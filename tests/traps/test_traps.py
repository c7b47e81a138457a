"""Commands in a folder of traps execute nothing of it; `python -m tests.traps` runs each in a process of its own."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ..fuzz.families.options import commands
from ..modules import ROOT
from .commands import COMMANDS, SLOW, ended, executed, trapped_folder
from .traps import LIBRARIES, make_traps

ALL = [(name, *words) for name, many in COMMANDS.items() for words in many]
IN_ONE_PROCESS = """
import json, os, sys
from ommatid.runtime.execution.interpreter import leave_current_folder
leave_current_folder()  # as the console script does
from tests.fuzz.verdicts import run_command
for words in json.loads(sys.argv[1]):
    done = run_command(words)
    print(json.dumps([words, done.code, done.err, os.listdir(sys.argv[2])]), flush=True)
"""
TIME_LIMIT = 300  # seconds, on a busy machine


@pytest.fixture(scope="module")
def trapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder, marks, count = trapped_folder(tmp_path_factory.mktemp("traps"))
    assert count >= 50
    return folder, marks


def test_every_command_is_tried() -> None:
    assert {*commands()} == {*COMMANDS, *SLOW}


@pytest.mark.slow
def test_no_command_executes_anything_of_the_current_folder(trapped: tuple[Path, Path]) -> None:
    """All commands in one process, which the imports of a start are too long for otherwise."""
    folder, marks = trapped
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "capture_output": True, "timeout": TIME_LIMIT}
    command = [sys.executable, "-P", "-c", IN_ONE_PROCESS, json.dumps(ALL), str(marks)]
    process = subprocess.run(command, cwd=folder, env=environment, check=True, **options)
    results = [json.loads(line) for line in process.stdout.splitlines()]
    assert [tuple(words) for words, *_ in results] == ALL
    assert [result for result in results if result[1] or result[3]] == []
    assert not [result for result in results if "matplotlib" in result[2]]


@pytest.mark.slow
def test_the_console_script_executes_nothing_and_neither_hangs_nor_replaces_traps(trapped: tuple[Path, Path]) -> None:
    folder, marks = trapped
    code, messages, _ = ended(("show", "tiny.toml"), folder)
    assert (code, messages, executed(marks)) == (0, "", [])
    code, messages, _ = ended(("render", "tiny.toml", "-o", "."), folder)
    assert (code in (0, 2), executed(marks)) == (True, []), messages
    assert (folder / "stack.exr").is_fifo()


def test_the_traps_work(tmp_path: Path) -> None:
    """A trap that is executed leaves its mark: a module, a package, a library and a script.

    Some systems have a `sitecustomize` of their own, which is imported before.
    """
    folder, marks = tmp_path / "traps", tmp_path / "marks"
    for each in (folder, marks):
        each.mkdir()
    make_traps(folder, marks)
    imported = (
        "import sys; here = sys.path.pop(0); import ctypes, glob; sys.path.insert(0, here)\n"
        "import simulate; sys.modules.pop('sitecustomize', None); import sitecustomize\n"
        "for file in glob.glob('plugins/*.so'): ctypes.CDLL('./' + file)"
    )
    subprocess.run([sys.executable, "-c", imported], cwd=folder, check=True)
    subprocess.run(["./git"], cwd=folder, check=True)
    compiled = {Path(name).name for name in LIBRARIES if name.startswith("plugins/")}
    assert {*executed(marks)} >= {"simulate", "sitecustomize", "git", *(compiled if shutil.which("cc") else ())}
