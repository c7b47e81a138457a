"""Work shared among processes and machines: the same results whoever did it, and whoever died meanwhile."""

from __future__ import annotations

import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Iterator
from concurrent.futures import Executor, Future
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
from distributed import LocalCluster

from ommatid.batch import remote as parcel
from ommatid.runtime import pool, workers
from ommatid.runtime.dask_cluster import NEVER
from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.pool import worker_pool as open_pool
from ommatid.scenes import model_file, scene
from ommatid.scenes.formats import exr
from ommatid.scenes.setup import Setup

from ..cli.test_commands import FILES, numbers, without
from ..conftest import TINY, Command, Ended, shell

SEEDS = (1, 2, 3)


# --- what workers are asked to do: functions of a module, for they travel by name


def digits(seed: int) -> list[float]:
    """Something that depends on its item alone, down to the last bit."""
    return np.random.default_rng(seed).normal(size=100).cumsum().tolist()


def digits_and_worker(seed: int) -> tuple[list[float], int]:
    return digits(seed), os.getpid()


def meets_the_other(folder: Path, item: int) -> int:
    """Ends when both items are begun, and so by two workers: their process numbers."""
    (folder / str(item)).touch()
    for _ in range(6000):
        if (folder / str(1 - item)).exists():
            return os.getpid()
        time.sleep(0.01)
    raise TimeoutError("one worker does nothing")


def digits_of_one_that_dies_once(flag: Path, seed: int) -> list[float]:
    """Whoever comes first to item 3 is killed there, as by a machine that runs out of memory."""
    if seed == 3:
        try:
            flag.touch(exist_ok=False)
        except FileExistsError:
            return digits(seed)
        os.kill(os.getpid(), signal.SIGKILL)
    return digits(seed)


def deadly(seed: int) -> list[float]:
    if seed == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return digits(seed)


def refuses(item: type[Exception] | None) -> str:
    if item is not None:
        raise item("the picture is upside down; turn it")
    return "fine"


def own_number() -> dict[str, str]:
    return {"python": "3", "numpy": str(os.getpid())}


def same_everywhere() -> dict[str, str]:
    return {"python": sys.version}


class NotThere:
    """A function of a module that the worker does not have: it cannot even be read there."""

    def __call__(self) -> dict[str, str]:
        return {}

    def __reduce__(self) -> tuple[Any, ...]:
        return importlib.import_module, ("no_such_module_anywhere",)


# --- kinds of workers


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Generator[str]:
    """A cluster of two workers that somebody else started."""
    start: Any = LocalCluster
    with start(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        scheduler_kwargs={"dashboard": False},
        local_directory=str(tmp_path_factory.mktemp("dask")),
        memory_limit=0,
        silence_logs=NEVER,
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE", 0.3)


@pytest.mark.parametrize("kind", [{}, {"threads": 3}, {"count": 2}, {"scheduler": "address"}], ids=str)
def test_results_come_in_the_order_of_the_items(kind: dict[str, Any], address: str) -> None:
    seen: list[float] = []
    options: dict[str, Any] = {**kind, "scheduler": address} if "scheduler" in kind else kind
    with open_pool(**options) as pool:
        found = pool.map(digits_and_worker, range(8), seen.append, 8)
    assert [values for values, _ in found] == [digits(seed) for seed in range(8)]
    assert seen == [(count + 1) / 8 for count in range(8)]
    here = {number for _, number in found} == {os.getpid()}
    assert here == (not kind or "threads" in kind)


def test_alone_one_item_is_done_after_the_other() -> None:
    told: list[str] = []

    def items() -> Iterator[int]:
        for item in range(3):
            told.append(f"item {item}")
            yield item

    def work(item: int) -> int:
        told.append(f"work {item}")
        return item

    with open_pool() as alone:
        for ended in alone.each(work, items()):
            told.append(f"ended {ended.result()}")
    assert told == [f"{what} {item}" for item in range(3) for what in ("item", "work", "ended")]


def test_threads_work_at_the_same_time() -> None:
    together = threading.Barrier(3)
    with open_pool(threads=3) as pool:
        assert pool.map(lambda _: together.wait(timeout=30) >= 0, range(3), lambda _: None, 3) == [True] * 3


@pytest.mark.parametrize("kind", [InputError, MachineError, ZeroDivisionError])
@pytest.mark.parametrize("remote", [False, True])
def test_a_failure_is_the_same_here_and_there(kind: type[Exception], remote: bool, address: str) -> None:
    with open_pool(address if remote else "") as pool:
        with pytest.raises(kind, match=r"^the picture is upside down; turn it$"):
            pool.map(refuses, [None, kind, None], lambda _: None, 3)
        ended = {one.index: one for one in pool.each(refuses, [None, kind, None])}
        assert (ended[0].result(), ended[2].result()) == ("fine", "fine")
        with pytest.raises(kind, match="upside down"):
            ended[1].result()


def test_an_item_may_be_large(address: str) -> None:
    """Dask warns of large items, which are no mistake here; and warnings are failures."""
    with open_pool(address) as pool:
        [size] = pool.map(len, [bytes(20_000_000)], lambda _: None, 1)
    assert size == 20_000_000


def test_one_of_two_workers_is_killed_and_nothing_is_lost(tmp_path: Path) -> None:
    flag = tmp_path / "died"
    with open_pool(count=2) as pool:
        found = pool.map(partial(digits_of_one_that_dies_once, flag), range(8), lambda _: None, 8)
    assert flag.exists()
    assert found == [digits(seed) for seed in range(8)]


def test_what_kills_every_worker_is_given_up_and_the_others_are_done(capfd: pytest.CaptureFixture[str]) -> None:
    with open_pool(count=2) as pool:
        ended = {one.index: one for one in pool.each(deadly, range(4))}
    assert [ended[place].result() for place in (0, 2, 3)] == [digits(seed) for seed in (0, 2, 3)]
    with pytest.raises(MachineError, match="every worker that tried it died"):
        ended[1].result()
    assert capfd.readouterr().err == ""


def test_workers_on_this_machine_talk_to_nobody_else_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("scratch", "meeting"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "scratch"))
    before = dict(os.environ)
    with open_pool(count=2) as pool:
        pids = pool.map(partial(meets_the_other, tmp_path / "meeting"), range(2), lambda _: None, 2)
        processes = [psutil.Process(pid) for pid in pids]
        assert [process.net_connections("inet") for process in processes] == [[], []]
        shares = [process.cpu_affinity() for process in processes]
        assert set().union(*shares) == set(psutil.Process().cpu_affinity())
        assert len(psutil.Process().cpu_affinity()) < 2 or not set(shares[0]) & set(shares[1])
    assert not any(process.is_running() for process in processes)
    assert list((tmp_path / "scratch").iterdir()) == []
    assert dict(os.environ) == before


# --- what is refused


class Nobody(Executor):
    """Takes work and never does it."""

    def __init__(self, *, cancelled: bool = False) -> None:
        self.cancelled = cancelled

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        del fn, args, kwargs
        future: Future[Any] = Future()
        if self.cancelled:
            future.cancel()
            future.set_running_or_notify_cancel()
        return future


@pytest.mark.usefixtures("impatient")
def test_nobody_waits_for_workers_that_have_left() -> None:
    with pytest.raises(MachineError, match="no workers are left"):
        workers.Workers(Nobody(), lambda: 0).map(digits, range(2), lambda _: None, 2)


def test_a_scheduler_that_goes_away_is_named() -> None:
    with pytest.raises(MachineError, match="scheduler was lost"):
        workers.Workers(Nobody(cancelled=True), lambda: 1).map(digits, range(2), lambda _: None, 2)


def test_workers_that_would_give_other_results_are_refused(address: str) -> None:
    with open_pool(address) as pool:
        pool.check_versions(same_everywhere)
        with pytest.raises(InputError, match=rf"--scheduler {address}: .* numpy \d+, here {os.getpid()}; make them"):
            pool.check_versions(own_number)
        with pytest.raises(InputError, match=r"no_such_module_anywhere.*install the same version of ommatid"):
            pool.check_versions(NotThere())


@pytest.mark.usefixtures("impatient")
def test_a_scheduler_without_workers_is_refused() -> None:
    start: Any = LocalCluster
    options = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}}
    with (
        start(n_workers=0, host="127.0.0.1", silence_logs=NEVER, **options) as cluster,
        pytest.raises(InputError, match=r"--scheduler .*has no workers; start some with `dask worker tcp://"),
        open_pool(cluster.scheduler_address),
    ):
        pass


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--scheduler", "tcp://127.0.0.1:8786", "--workers", "2"), "--scheduler and --workers: expected one of them"),
        (("--scheduler", "127.0.0.1:8786"), "expected an address such as tcp://"),
        (("--scheduler", "tcp://127.0.0.1"), "expected an address such as tcp://"),
        (("--scheduler", "tcp://127.0.0.1:123456"), "expected an address such as tcp://"),
        (("--scheduler", "http://127.0.0.1:80"), "expected an address such as tcp://"),
        (("--scheduler", "tcp://127.0.0.1:1"), "--scheduler tcp://127.0.0.1:1: no scheduler answers there"),
        (("--workers", "0"), "--workers"),
        (("--workers", "many"), "--workers"),
    ],
)
def test_options_are_refused_in_one_sentence(
    options: tuple[str, ...], sentence: str, here: Path, ommatid: Command
) -> None:
    ended = ommatid("render", here / "tiny.toml", "-o", "out", *options)
    assert (ended.code, ended.out) == (2, "")
    [line] = ended.err.splitlines()
    assert line.startswith("ommatid: ")
    assert sentence in line


def test_without_dask_the_option_says_what_to_install(
    here: Path, ommatid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pool, "find_spec", lambda _: None)
    ended = ommatid("run", here / "tiny.toml", "-o", "out", "--scheduler", "tcp://127.0.0.1:8786")
    assert ended.code == 2
    expected = "needs Dask, which is not installed; run: pip install 'ommatid[cluster]'"
    assert ended.err == f"ommatid: --scheduler: {expected}\n"
    assert not (here / "out").exists()


def test_without_the_option_no_cluster_is_touched(here: Path) -> None:
    scenes = write_scenes(here)
    ended = shell("render", *scenes, "-o", "out", "--workers", "2", cwd=here, before=without("distributed"))
    assert ended.code == 0, ended.err


# --- batches


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
    """A batch that one process did: its folder, and what it said."""
    folder = tmp_path_factory.mktemp("alone")
    ended = shell("run", *write_scenes(folder), "-o", "out", "--json", "--workers", "1", cwd=folder)
    assert ended.code == 0, ended.err
    return folder / "out", ended


def timeless(record: dict[str, Any]) -> dict[str, Any]:
    """A record without what depends on the clock: seconds, and the fingerprints of what holds them."""
    return {key: value for key, value in record.items() if key not in ("seconds", "fingerprint", "sha256")}


def content(folder: Path) -> dict[str, Any]:
    """All that the files of a run say, but for how long it took."""
    run = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    found: dict[str, Any] = {"run.json": numbers(run)}
    for path in folder.glob("*.exr"):
        for part in exr.read(path):
            record = {**part.record, "record": timeless(part.record.get("record", {}))}
            found[f"{path.name}/{part.name}"] = timeless(record)
            found |= {f"{path.name}/{part.name}/{name}": pixels.tobytes() for name, pixels in part.channels.items()}
    with np.load(folder / "model.npz", allow_pickle=False) as file:
        found |= {name: (file[name].dtype, file[name].tobytes()) for name in file.files if name != "ommatid"}
    found["model"] = timeless(model_file.read(folder / "model.npz").record)
    # The overview's picture of a run shows seconds nowhere, and estimate.png none either: byte for byte.
    found |= {name: (folder / name).read_bytes() for name in ("scene.toml", "estimate.png", "overview.png")}
    return found


def documents(out: str) -> list[dict[str, Any]]:
    return [numbers(document) for document in json.loads(out)]


@pytest.mark.parametrize("kind", [[], ["--workers", "3"], ["--scheduler", "address"]], ids=" ".join)
def test_a_batch_gives_the_same_files_wherever_it_is_done(
    kind: list[str], scenes: list[str], here: Path, address: str, alone: tuple[Path, Ended], ommatid: Command
) -> None:
    folder, said = alone
    options = [address if option == "address" else option for option in kind]
    shared = ommatid("run", *scenes, "-o", "out", "--json", *options)
    assert shared.code == 0, shared.err
    assert sorted(shared.err.splitlines()) == sorted(said.err.splitlines())
    assert documents(shared.out) == documents(said.out)
    estimates: set[bytes] = set()
    for name in scenes:
        there, here_too = here / "out" / Path(name).stem, folder / Path(name).stem
        assert {path.name for path in there.iterdir()} == FILES
        found, expected = content(there), content(here_too)
        assert found.keys() == expected.keys()
        assert [name for name in found if found[name] != expected[name]] == []
        estimates.add(found["estimate.png"])
    assert len(estimates) == len(scenes), "seeds differ, so do the pictures: the comparison can tell"


def test_what_is_up_to_date_here_is_not_done_again_there(
    scenes: list[str], here: Path, address: str, alone: tuple[Path, Ended], ommatid: Command
) -> None:
    shutil.copytree(alone[0], here / "out")
    (here / "out" / "seed2" / "model.npz").unlink()
    made = [path for path in (here / "out").glob("*/*") if path.name not in ("scene.toml", "truth.exr")]
    before = {path: path.stat().st_mtime_ns for path in made}
    ended = ommatid("run", *scenes, "-o", "out", "--scheduler", address)
    said = [line for line in ended.err.splitlines() if "up to date" not in line]
    report = Path("out") / "seed2" / "report.html"
    assert said == ["calibrate: done", "reconstruct: done", f"report: done, {report}"]
    changed = {path for path in before if path.stat().st_mtime_ns != before[path]}
    # What the new model was made from is as before, but the time that it took: run.json says another, estimate.exr
    # another fingerprint, and so does the page. The picture is the same, and stays.
    assert {path.relative_to(here / "out").parts for path in changed} == {
        ("seed2", "estimate.exr"),
        ("seed2", "run.json"),
        ("seed2", "report.html"),
    }


@pytest.mark.parametrize("kind", [["--workers", "2"], ["--scheduler", "address"]], ids=" ".join)
def test_in_a_batch_each_scene_fails_for_itself_and_in_the_same_words(
    kind: list[str], here: Path, scenes: list[str], address: str, ommatid: Command
) -> None:
    (here / "bad.toml").write_text(TINY.replace('"1/3"', "2"), encoding="utf-8")
    large = TINY.replace("origin = [100, 230]\n", "").replace("shape = [12, 12]\n", "shape = [512, 512]\n")
    large = large.replace("pixels = [3, 3]", 'pixels = "fit"').replace('"0.5 mm"', '"9 mm"')
    (here / "large.toml").write_text(large + '\n[estimator]\nmemory = "20 MB"\n', encoding="utf-8")
    batch = ("run", scenes[0], "bad.toml", "large.toml", "missing.toml", scenes[1], "--json")
    options = [address if option == "address" else option for option in kind]
    alone, shared = ommatid(*batch, "-o", "alone", "--workers", "1"), ommatid(*batch, "-o", "shared", *options)
    assert alone.code == shared.code == 2
    told = [
        [re.sub(r"[\d.]+ GB", "some GB", line) for line in ended.err.splitlines() if line.startswith("ommatid: ")]
        for ended in (alone, shared)
    ]
    assert len(told[0]) == 3
    assert sorted(told[0]) == sorted(told[1])
    assert [one.get("exit_code", 0) for one in json.loads(shared.out)] == [0, 2, 2, 2, 0]
    assert [one["scene"] for one in json.loads(shared.out)] == list(batch[1:-1])


def test_render_alone_can_be_shared_too(scenes: list[str], here: Path, address: str, ommatid: Command) -> None:
    ended = ommatid("render", *scenes, "-o", "out", "--scheduler", address, "--json")
    assert ended.code == 0, ended.err
    for one, name in zip(json.loads(ended.out), scenes, strict=True):
        folder = here / "out" / Path(name).stem
        assert one["file"] == str(Path("out") / folder.name / "stack.exr")
        assert {path.name for path in folder.iterdir()} == {"scene.toml", "truth.exr", "stack.exr"}


LONG = TINY.replace("[calibration]\nsamples = 16", "[calibration]\nsamples = 16777216")
STOPPED = "ommatid: stopped; finished files stay, the next run carries on from them\n"
LIMIT = 120  # seconds, after which a command that does not stop is killed, and its test fails


@contextmanager
def started(*arguments: str, before: str = "", **environment: str) -> Generator[subprocess.Popen[str]]:
    """A command in a group of processes of its own, all of which a terminal's Ctrl-C reaches; none outlives it."""
    start = ["-c", f"{before}\nfrom ommatid.cli.app import main\nmain()"] if before else ["-m", "ommatid"]
    with subprocess.Popen(
        [sys.executable, *start, *arguments],
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
    raise TimeoutError(f"{path} does not come")


def test_ctrl_c_keeps_what_is_finished_and_leaves_no_processes(here: Path, scenes: list[str]) -> None:
    (here / "long.toml").write_text(LONG, encoding="utf-8")
    scratch = here / "scratch"
    scratch.mkdir()
    with started("run", scenes[0], "long.toml", "-o", "out", "--workers", "2", TMPDIR=str(scratch)) as command:
        assert command.stderr is not None
        for stage in ("render", "calibrate", "reconstruct", "report"):
            assert command.stderr.readline().startswith(f"{stage}: done")
        children = psutil.Process(command.pid).children(recursive=True)
        wait_for(here / "out" / "long" / "stack.exr")
        os.killpg(command.pid, signal.SIGINT)
        said = command.stderr.read()
    assert command.returncode == 1
    assert said == STOPPED
    assert len(children) >= 2
    assert psutil.wait_procs(children, timeout=30)[1] == []
    assert {path.name for path in (here / "out" / "seed1").iterdir()} == FILES
    left = {path.name for path in (here / "out" / "long").iterdir()}
    assert left - {".model.npz.partial.npz"} == {"scene.toml", "truth.exr", "stack.exr"}
    assert list(scratch.iterdir()) == []


# Collections of garbage that take long, once there is a file "flag": a callback in which Ctrl-C is lost.
SWALLOWING = """
import gc, pathlib, sys, time
def slow(phase, info):
    if pathlib.Path("flag").exists() and phase == "start":
        pathlib.Path("flag").unlink()
        print("in the callback", file=sys.stderr, flush=True)
        time.sleep(60)
gc.callbacks.append(slow)
gc.set_threshold(1)
"""


def test_ctrl_c_that_a_callback_swallows_is_noticed(here: Path, scenes: list[str]) -> None:
    """Python prints and drops what a callback of the garbage collector raises."""
    (here / "long.toml").write_text(LONG, encoding="utf-8")
    with started("run", scenes[0], "long.toml", "-o", "out", "--workers", "2", before=SWALLOWING) as command:
        assert command.stderr is not None
        wait_for(here / "out" / "long" / "stack.exr")
        (here / "flag").touch()
        while command.stderr.readline() != "in the callback\n":
            pass
        os.kill(command.pid, signal.SIGINT)
        said = command.stderr.read()
    assert "Exception ignored in: <function slow" in said, "else nothing was swallowed"
    assert said.endswith(STOPPED)
    assert command.returncode == 1


def test_workers_end_when_the_command_is_killed(here: Path) -> None:
    for name in ("one", "two"):
        (here / f"{name}.toml").write_text(LONG, encoding="utf-8")
    with started("run", "one.toml", "two.toml", "-o", "out", "--workers", "2") as command:
        for name in ("one", "two"):
            wait_for(here / "out" / name / "stack.exr")
        children = psutil.Process(command.pid).children(recursive=True)
        command.kill()
    assert len(children) >= 2
    assert psutil.wait_procs(children, timeout=30)[1] == []


# --- parcels


def stops_after_one_file(*arguments: Any) -> dict[str, Any]:
    folder, watch = arguments[3:]
    (folder / "stack.exr").write_bytes(b"light")
    watch.done("render", True)
    raise InputError(f"{folder / 'model.npz'}: is damaged; calibrate again")


def test_what_was_made_before_a_failure_comes_back_and_the_failure_names_the_users_folder(here: Path) -> None:
    (here / "out").mkdir()
    (here / "out" / "kept.txt").write_text("mine", encoding="utf-8")
    described = scene.read(here / "tiny.toml")
    sent = parcel.packed(Setup.from_scene(described), here / "out")
    outcome = parcel.carry_out(stops_after_one_file, sent)
    assert outcome.files == {"stack.exr": b"light"}
    assert outcome.done == {"render": True}
    assert isinstance(outcome.error, InputError)
    assert str(outcome.error) == f"{here / 'out' / 'model.npz'}: is damaged; calibrate again"


def test_run_json_is_not_there_unless_everything_else_is(tmp_path: Path) -> None:
    (tmp_path / "estimate.exr").mkdir()
    outcome = parcel.SceneOutcome({"run.json": b"{}", "stack.exr": b"1", "estimate.exr": b"2"}, {}, {})
    with pytest.raises(InputError, match=r"estimate\.exr: expected the name of a file"):
        parcel.unpack(outcome, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"stack.exr", "estimate.exr"}
