"""Batches on processes and clusters: the same files and messages as of one process, and a clean end by Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from ommatid.batch.remote import SceneOutcome, carry_out, packed, unpack
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup

from ..conftest import TINY, Command, Ended, interpreter, shell
from ..runs import FILES, assert_same_content, content, numbers

SEEDS = (1, 2, 3)


def write_scenes(folder: Path) -> list[str]:
    for seed in SEEDS:
        text = TINY.replace("[render]", f"[render]\nseed = {seed}")
        (folder / f"seed{seed}.toml").write_text(text, encoding="utf-8")
    return [f"seed{seed}.toml" for seed in SEEDS]


@pytest.fixture
def scenes(here: Path) -> list[str]:
    return write_scenes(here)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    """Output folder and messages of a batch that one process did."""
    folder = tmp_path_factory.mktemp("alone")
    ended = shell("run", *write_scenes(folder), "-o", "out", "--json", "--workers", "1", cwd=folder)
    assert ended.code == 0, ended.err
    return folder / "out", ended


def documents(out: str) -> list[dict[str, Any]]:
    return [numbers(document) for document in json.loads(out)]


def with_address(options: list[str], request: pytest.FixtureRequest) -> list[str]:
    """Options with the address of the cluster, which is started for those that need it."""
    return [request.getfixturevalue(option) if option == "address" else option for option in options]


ON_A_CLUSTER = pytest.param(["--scheduler", "address"], marks=pytest.mark.slow)


@pytest.mark.parametrize("options", [["--workers", "3"], ON_A_CLUSTER])
def test_a_batch_gives_the_same_files_wherever_it_is_done(
    options: list[str],
    scenes: list[str],
    here: Path,
    request: pytest.FixtureRequest,
    alone: tuple[Path, Ended],
    ommatid: Command,
) -> None:
    folder, expected = alone
    shared = ommatid("run", *scenes, "-o", "out", "--json", *with_address(options, request))
    assert shared.code == 0, shared.err
    assert sorted(shared.err.splitlines()) == sorted(expected.err.splitlines())
    assert documents(shared.out) == documents(expected.out)
    assert all(document["command"][:2] == ["ommatid", "run"] for document in json.loads(shared.out))
    names = [Path(scene).stem for scene in scenes]
    for name in names:
        assert {path.name for path in (here / "out" / name).iterdir()} == FILES
        assert_same_content(here / "out" / name, content(folder / name))
    estimates = {(folder / name / "estimate.png").read_bytes() for name in names}
    assert len(estimates) == len(scenes), "seeds differ, and so do the pictures: the comparison can fail"


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--workers", "2"], ON_A_CLUSTER])
def test_failures_of_scenes_are_independent_and_their_messages_the_same(
    options: list[str], here: Path, scenes: list[str], request: pytest.FixtureRequest, ommatid: Command
) -> None:
    (here / "bad.toml").write_text(TINY.replace('"1/3"', "2"), encoding="utf-8")
    large = TINY.replace("origin = [100, 230]\n", "").replace("shape = [12, 12]\n", "shape = [512, 512]\n")
    large = large.replace("pixels = [3, 3]", 'pixels = "fit"').replace('"0.5 mm"', '"9 mm"')
    (here / "large.toml").write_text(large + '\n[estimator]\nmemory = "20 MB"\n', encoding="utf-8")
    batch = ("run", scenes[0], "bad.toml", "large.toml", "missing.toml", scenes[1], "--json")
    alone = ommatid(*batch, "-o", "alone", "--workers", "1")
    shared = ommatid(*batch, "-o", "shared", *with_address(options, request))
    assert alone.code == shared.code == 2
    messages = [
        [re.sub(r"[\d.]+ GB", "some GB", line) for line in ended.err.splitlines() if line.startswith("ommatid: ")]
        for ended in (alone, shared)
    ]
    assert len(messages[0]) == 3
    assert sorted(messages[0]) == sorted(messages[1])
    assert [document.get("exit_code", 0) for document in json.loads(shared.out)] == [0, 2, 2, 2, 0]
    assert [document["scene"] for document in json.loads(shared.out)] == list(batch[1:-1])


# --- commands that are stopped

LONG = TINY.replace("[calibration]\nsamples = 16", "[calibration]\nsamples = 16777216")
STOPPED = "ommatid: stopped; finished files stay, the next run carries on from them\n"
LIMIT = 120  # seconds after which a command that does not stop is killed, and its test fails


@contextmanager
def started(*arguments: str, before: str = "", **environment: str) -> Generator[subprocess.Popen[str]]:
    """Start a command in a process group of its own, as in a terminal; afterwards kill what is left of the group."""
    with subprocess.Popen(
        [*interpreter(before), *arguments],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as command:
        limit = threading.Timer(LIMIT, lambda: os.killpg(command.pid, signal.SIGKILL))
        limit.start()
        try:
            yield command
            command.wait()
        finally:
            limit.cancel()
            with suppress(ProcessLookupError):
                os.killpg(command.pid, signal.SIGKILL)


def wait_for(path: Path) -> None:
    for _ in range(100 * LIMIT):
        if path.exists():
            return
        time.sleep(0.01)
    raise TimeoutError(f"{path} does not appear")


@pytest.mark.slow
def test_ctrl_c_keeps_finished_files_and_leaves_no_processes(here: Path, scenes: list[str]) -> None:
    (here / "long.toml").write_text(LONG, encoding="utf-8")
    scratch = here / "scratch"
    scratch.mkdir()
    with started("run", scenes[0], "long.toml", "-o", "out", "--workers", "2", TMPDIR=str(scratch)) as command:
        assert command.stderr is not None
        for stage in ("render", "calibrate", "reconstruct", "report"):
            assert command.stderr.readline().startswith(f"{stage}: done")
        children = psutil.Process(command.pid).children(recursive=True)
        wait_for(here / "out" / "long" / "stack.exr")
        with suppress(ProcessLookupError):
            for _ in range(5):  # as an impatient user does, and the group of a terminal
                os.killpg(command.pid, signal.SIGINT)
                time.sleep(0.1)
        messages = command.stderr.read()
    assert command.returncode == 1
    assert messages == STOPPED
    assert len(children) >= 2
    assert psutil.wait_procs(children, timeout=30)[1] == []
    assert {path.name for path in (here / "out" / "seed1").iterdir()} == FILES
    left = {path.name for path in (here / "out" / "long").iterdir()}
    assert left - {".model.npz.partial.npz"} == {"scene.toml", "truth.exr", "stack.exr"}
    assert list(scratch.iterdir()) == []


@pytest.mark.slow
def test_a_batch_whose_process_dies_keeps_what_is_finished(here: Path, scenes: list[str]) -> None:
    """As where memory runs out: one sentence, and the scenes that were finished."""
    (here / "long.toml").write_text(LONG, encoding="utf-8")
    with started("run", scenes[0], "long.toml", "-o", "out", "--workers", "2") as command:
        assert command.stderr is not None
        for stage in ("render", "calibrate", "reconstruct", "report"):
            assert command.stderr.readline().startswith(f"{stage}: done")
        wait_for(here / "out" / "long" / "stack.exr")
        for process in psutil.Process(command.pid).children():
            if "spawn_main" in " ".join(process.cmdline()):
                process.kill()
        messages = command.stderr.read()
    assert re.fullmatch(
        r"ommatid: long.toml: a process died, .*; finished results stay, repeat the command .*\n", messages
    )
    assert command.returncode == 1
    assert {path.name for path in (here / "out" / "seed1").iterdir()} == FILES


# --- scenes sent to another machine


def stops_after_one_file(_: Any, folder: Path, observer: Any) -> dict[str, Any]:
    (folder / "stack.exr").write_bytes(b"light")
    observer.done("render", True)
    raise InputError(f"{folder / 'model.npz'}: is damaged; calibrate again")


def test_files_made_before_a_failure_come_back_and_its_message_names_the_users_folder(here: Path) -> None:
    (here / "out").mkdir()
    (here / "out" / "kept.txt").write_text("mine", encoding="utf-8")
    package = packed(Setup.from_scene(read(here / "tiny.toml")), here / "out")
    outcome = carry_out(stops_after_one_file, package)
    assert outcome.files == {"stack.exr": b"light"}
    assert outcome.done == {"render": True}
    assert isinstance(outcome.error, InputError)
    assert str(outcome.error) == f"{here / 'out' / 'model.npz'}: is damaged; calibrate again"


def test_run_json_is_written_last(tmp_path: Path) -> None:
    (tmp_path / "estimate.exr").mkdir()
    outcome = SceneOutcome({"run.json": b"{}", "stack.exr": b"1", "estimate.exr": b"2"}, {}, {})
    with pytest.raises(InputError, match=r"estimate\.exr: expected the name of a file"):
        unpack(outcome, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"stack.exr", "estimate.exr"}
