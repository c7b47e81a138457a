"""A folder and an environment of its own for every test, a tiny scene, one finished run of it, and the command line."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis.database import DirectoryBasedExampleDatabase

from ommatid.cli import app as program

ROOT = Path(__file__).parent.parent
EXAMPLES = DirectoryBasedExampleDatabase(ROOT / ".hypothesis" / "examples")
settings.register_profile("any machine", deadline=None, database=EXAMPLES)  # no test depends on the machine's speed
settings.load_profile("any machine")

USERS_SETTINGS = ("OMMATID_", "DASK_", "DISTRIBUTED_", "MPL", "MATPLOTLIB", "NUMBA_", "DRJIT_", "MI_", "PYTHONPATH")


def files_of_others() -> set[str]:
    """Files in the checkout that git neither tracks nor ignores."""
    command = ["git", "status", "--porcelain", "--untracked-files=all"]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return {line for line in ended.stdout.splitlines() if line.startswith("??")}


def pytest_sessionstart(session: pytest.Session) -> None:
    """List the files of others; in the process that ends last, when tests run in several."""
    if not hasattr(session.config, "workerinput"):
        session.config.stash[BEFORE] = files_of_others()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail if the tests left something in the checkout that .gitignore does not name."""
    left = files_of_others() - session.config.stash.get(BEFORE, files_of_others())
    if left and session.exitstatus == pytest.ExitCode.OK:
        print("\nleft in the checkout by the tests:", *sorted(left), sep="\n")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


BEFORE = pytest.StashKey[set[str]]()
TINY = """
title = "Tiny"

[target]
image = "photo:camera"
origin = [100, 230]
shape = [12, 12]
pixel_pitch = "1 mm"
distance = "1 m"

[prior]
kind = "independent"

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
fit = "none"
"""


@dataclass(frozen=True)
class Ended:
    """Exit code and output of a command."""

    code: int
    out: str
    err: str


Command = Callable[..., Ended]


def interpreter(before: str = "") -> list[str]:
    """Command of a new interpreter that runs ommatid; `before` is Python code that runs first."""
    start = ["-c", f"{before}\nfrom ommatid.cli.app import main\nmain()"] if before else ["-m", "ommatid"]
    return [sys.executable, *start]


def shell(*arguments: str | Path, cwd: Path, before: str = "") -> Ended:
    """Run a command in a new process."""
    # Without buffering, output could not appear late, and so not in the wrong place: users have it buffered.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    command = [*interpreter(before), *map(str, arguments)]
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    return Ended(ended.returncode, ended.stdout, ended.stderr)


@pytest.fixture(scope="session", autouse=True)
def own_environment(tmp_path_factory: pytest.TempPathFactory) -> Generator[None]:
    """Settings and a current folder without those of the user, for fixtures that several tests share."""
    folder = tmp_path_factory.mktemp("own")
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in os.environ if name.startswith(USERS_SETTINGS) and name != "DRJIT_LIBLLVM_PATH"]:
            patch.delenv(name)
        for name in ("DASK_CONFIG", "DASK_ROOT_CONFIG", "XDG_CONFIG_HOME"):
            patch.setenv(name, str(folder / "settings"))
        patch.chdir(folder)
        yield


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A current folder that is empty: what lies in the checkout changes no result, and nothing is left there."""
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="session")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a finished run of the tiny scene. It is shared: tests must not write to it."""
    folder = tmp_path_factory.mktemp("finished")
    (folder / "tiny.toml").write_text(TINY, encoding="utf-8")
    ended = shell("run", "tiny.toml", "-o", "out", cwd=folder)
    assert ended.code == 0, ended.err
    return folder / "out" / "tiny"


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """The current folder, which holds only tiny.toml."""
    (tmp_path / "tiny.toml").write_text(TINY, encoding="utf-8")
    return tmp_path


@pytest.fixture
def kept(here: Path, finished: Path) -> Path:
    """A copy of the finished run in out/tiny of the current folder, the output folder of `run tiny.toml -o out`."""
    return shutil.copytree(finished, here / "out" / "tiny")


@pytest.fixture
def ommatid(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Run a command in this process, which saves the imports and turns warnings into failures."""

    def call(*arguments: str | Path) -> Ended:
        monkeypatch.setattr(sys, "argv", ["ommatid", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            program.main()
        out, err = capfd.readouterr()
        assert isinstance(ended.value.code, int)
        return Ended(ended.value.code, out, err)

    return call


@pytest.fixture(scope="session")
def address(tmp_path_factory: pytest.TempPathFactory) -> Generator[str]:
    """Address of a cluster of two workers."""
    from distributed import LocalCluster

    from ommatid.runtime.execution.cluster import SILENT

    start: Any = LocalCluster
    with start(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        local_directory=str(tmp_path_factory.mktemp("dask")),
        memory_limit=0,
        silence_logs=SILENT,
    ) as cluster:
        yield cluster.scheduler_address
