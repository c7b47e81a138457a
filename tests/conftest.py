"""A tiny scene, one finished run of it, and the command line as a user meets it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import settings

from ommatid.cli import app as program

settings.register_profile("any machine", deadline=None)  # no test depends on how fast a machine is
settings.load_profile("any machine")

TINY = """
title = "Tiny"

[target]
image = "photo:camera"
origin = [100, 230]
shape = [12, 12]
pixel_pitch = "1 mm"
distance = "1 m"

[camera]
pixel_pitch = "6 um"
lens_pitch = "0.5 mm"

[[camera.lens]]
name = "I"
magnification = "1/3"
array = [3, 3]
pixels = [3, 3]

[noise]
variance = 1e-2

[render]
samples = 16
variant = "scalar_rgb"

[calibration]
samples = 16
"""


@dataclass(frozen=True)
class Ended:
    """What a command left behind: its exit code, stdout and stderr."""

    code: int
    out: str
    err: str


Command = Callable[..., Ended]


def shell(*arguments: str | Path, cwd: Path, before: str = "") -> Ended:
    """Run a command in a process of its own; `before` is Python that runs there first."""
    start = ["-c", f"{before}\nfrom ommatid.cli.app import main\nmain()"] if before else ["-m", "ommatid"]
    command = [sys.executable, *start, *map(str, arguments)]
    # Unbuffered, output cannot come late, and so not where it does not belong: users have it buffered.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    return Ended(ended.returncode, ended.stdout, ended.stderr)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of one finished run of the tiny scene; it is shared, so nobody writes to it."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "tiny.toml").write_text(TINY, encoding="utf-8")
    ended = shell("run", "tiny.toml", "-o", "out", cwd=folder)
    assert ended.code == 0, ended.err
    return folder / "out" / "tiny"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with tiny.toml in it and nothing else."""
    (tmp_path / "tiny.toml").write_text(TINY, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def kept(here: Path, finished: Path) -> Path:
    """A copy of the finished run at out/tiny of the current folder, where a run of tiny.toml would have put it."""
    return shutil.copytree(finished, here / "out" / "tiny")


@pytest.fixture
def ommatid(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Run a command in this process: a second of imports less than in a new one, and warnings become failures."""

    def call(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["ommatid", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            program.main()
        out, err = capfd.readouterr()
        assert isinstance(ended.value.code, int)
        return Ended(ended.value.code, out, err)

    return call
