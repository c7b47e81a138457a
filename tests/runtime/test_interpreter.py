"""Processes of this program: they import and open nothing of the current folder that no argument names."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from ommatid.figures.camera_drawing import camera_drawing
from ommatid.figures.saving import svg_text
from ommatid.runtime.execution.interpreter import CONFIGURATIONS, import_path, python_command, python_environment
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read

from ..conftest import TINY
from ..modules import ROOT, imports, modules

# Writes the process number, and everything of the folder WATCHED that the process opens, lists, loads or starts.
WATCH = """
import os, sys
log, watched = os.open(os.environ["WATCH_LOG"], os.O_WRONLY | os.O_APPEND), os.environ["WATCHED"]
os.write(log, f"process {os.getpid()}\\n".encode())
def hook(event, arguments):
    if event in {"open", "os.listdir", "os.scandir", "ctypes.dlopen", "subprocess.Popen", "os.exec"} and arguments:
        path = os.curdir if arguments[0] is None and event.startswith("os.") else arguments[0]
        if isinstance(path, (str, bytes)):
            whole = os.path.join(os.getcwd(), os.fsdecode(path))
            if os.path.normpath(whole).startswith(watched) and os.sep in whole:
                if event in {"open", "os.listdir", "os.scandir"} or os.sep in os.fsdecode(path):
                    os.write(log, f"{event} {os.fsdecode(path)}\\n".encode())
sys.addaudithook(hook)
"""
TRAPS = ("json", "numpy", "signal", "pathlib", "re", "typer", "simulate", "scenes", "ommatid_x", "typing", "__future__")
SETTINGS = {"matplotlibrc": "axes.facecolor: red\nfont.size: 31\n"}


@pytest.fixture(scope="module")
def hostile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder whose modules leave a file `trapped` when they are imported, and whose settings would be obeyed."""
    folder = tmp_path_factory.mktemp("hostile")
    for name in TRAPS:
        (folder / f"{name}.py").write_text("open('trapped', 'a').write(__name__)\nraise SystemExit(9)\n")
    for name, text in SETTINGS.items():
        (folder / name).write_text(text)
    return folder


def run(command: Sequence[str], folder: Path, **variables: str) -> str:
    """Run a command in a folder, and return what it prints. Nothing of the folder may have been imported."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | variables
    ended = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr
    assert not (folder / "trapped").exists()
    return ended.stdout


@pytest.mark.slow
def test_workers_in_a_hostile_folder_open_only_what_was_named(hostile: Path, tmp_path: Path) -> None:
    for name in ("a.toml", "b.toml"):
        (tmp_path / name).write_text(TINY, encoding="utf-8")
    (tmp_path / "watch").mkdir()
    (tmp_path / "watch" / "sitecustomize.py").write_text(WATCH, encoding="utf-8")
    (tmp_path / "log").touch()
    watched = {"WATCH_LOG": str(tmp_path / "log"), "WATCHED": str(hostile), "PYTHONPATH": str(tmp_path / "watch")}
    scenes, output = [str(tmp_path / "a.toml"), str(tmp_path / "b.toml")], str(tmp_path / "out")
    command = [sys.executable, "-P", "-m", "ommatid", "render", *scenes, "-o", output, "--workers", "2"]
    run(command, hostile, **watched)
    events = (tmp_path / "log").read_text(encoding="utf-8").splitlines()
    assert sum(event.startswith("process") for event in events) == 4, "this one, two that work, multiprocessing's own"
    assert [event for event in events if not event.startswith("process")] == []


def test_the_module_ommatid_is_run_in_a_hostile_folder(hostile: Path) -> None:
    """Python's own start of `-m` imports some ten other modules first, which no program can prevent."""
    assert run([sys.executable, "-m", "ommatid", "--version"], hostile, PYTHONPATH=str(ROOT)).startswith("ommatid ")


@pytest.mark.parametrize(
    "python_path", [f".{os.pathsep}x", *(pytest.param(one, marks=pytest.mark.slow) for one in ("", os.pathsep))]
)
def test_a_process_finds_the_same_modules_without_the_current_folder(
    python_path: str, hostile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(hostile)
    monkeypatch.setenv("PYTHONPATH", python_path)
    monkeypatch.setattr(sys, "path", ["", str(hostile), *sys.path, "relative"])
    command = python_command("import ommatid; print(json.dumps([sys.path, sys.flags.safe_path, sys.argv[1:]]))", "x y")
    ended = subprocess.run(command, env=python_environment(), capture_output=True, text=True, check=True)
    path, safe, arguments = json.loads(ended.stdout)
    assert path == import_path()
    assert not any(Path(entry).samefile(hostile) for entry in path if Path(entry).exists())
    assert (safe, arguments) == (True, ["x y"])


def test_the_current_folder_is_left_under_all_its_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inside, link = tmp_path / "inside", tmp_path / "link"
    inside.mkdir()
    link.symlink_to(inside)
    monkeypatch.chdir(inside)
    names = ["", ".", "..", "inside", str(inside), f"{inside}/.", f"{tmp_path}/link", f"{tmp_path}/gone", str(tmp_path)]
    monkeypatch.setattr(sys, "path", names)
    assert import_path() == [f"{tmp_path}/gone", str(tmp_path), str(ROOT)]


@pytest.mark.slow
def test_settings_in_the_current_folder_are_ignored(hostile: Path) -> None:
    code = "import matplotlib; print(matplotlib.rcParams['font.size'])"
    assert run(python_command(code), hostile) == "10.0\n"
    assert set(SETTINGS) == CONFIGURATIONS


def test_figures_do_not_depend_on_settings(tmp_path: Path) -> None:
    import matplotlib

    (tmp_path / "tiny.toml").write_text(TINY, encoding="utf-8")
    scene = read(tmp_path / "tiny.toml")
    changed: Any = {"axes.facecolor": "red", "font.size": 31, "lines.linewidth": 9, "svg.fonttype": "path"}
    plain = svg_text(camera_drawing(scene, derive(scene)), "camera")
    with matplotlib.rc_context(changed):
        assert svg_text(camera_drawing(scene, derive(scene)), "camera") == plain
        assert matplotlib.rcParams["font.size"] == 31


def test_other_modules_start_no_python() -> None:
    """multiprocessing's processes, and Python started by `-c`, would have the current folder on their path."""
    for name, path in modules().items():
        assert "multiprocessing" not in imports(name) or name.endswith(".execution.workers"), name
        text = path.read_text(encoding="utf-8")
        safe = name.endswith(".execution.interpreter") or text.count("sys.executable") == text.count('executable, "-P"')
        assert safe, name
