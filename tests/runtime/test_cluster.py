"""Clusters: encrypted ones, other servers at the address, other versions, and a scheduler that is lost."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import socket
import subprocess
import warnings
from collections.abc import Callable, Generator
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
from dask import config
from distributed import LocalCluster, Security

from ommatid.batch.remote import SILENT as SILENT_OBSERVER
from ommatid.batch.remote import RunObserver
from ommatid.pipeline.batches import Batch, batch_members, run_batch
from ommatid.pipeline.stages import render
from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.execution import workers
from ommatid.runtime.execution.cluster import SILENT, Cluster, cluster_workers, worker_pool
from ommatid.runtime.progress import no_progress
from ommatid.scenes.setup import Setup

from ..conftest import TINY, Command
from ..runs import content, differences

VERSIONS = {"ommatid": "1"}


def versions() -> dict[str, str]:
    return VERSIONS


def lost_on_a_worker(asked: list[None] = []) -> dict[str, str]:  # noqa: B006  # by this process first
    if asked:
        raise ConnectionResetError("Connection reset by peer")
    asked.append(None)
    return VERSIONS


def squared(number: int) -> int:
    return number**2


def endless(number: int) -> int:
    return endless(number + 1) + 1


@contextmanager
def started(**options: Any) -> Generator[LocalCluster]:
    """A cluster in this process, which starts in a fraction of a second."""
    start: Any = LocalCluster
    fixed = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "memory_limit": 0, "silence_logs": SILENT}
    quiet = {"dashboard_address": "127.0.0.1:0", "scheduler_kwargs": {"dashboard": False}, "host": "127.0.0.1"}
    with start(**{"protocol": "tcp://", **fixed, **quiet, **options}) as cluster:
        yield cluster


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Generator[None]:  # of the workers' files
    monkeypatch.chdir(tmp_path)
    yield
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # Dask leaves the sockets of lost connections open
        gc.collect()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE", 0.5)
    monkeypatch.setattr(workers, "ANSWER", 0.5)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two authorities, a and b, and a certificate of each with its key."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    folder = tmp_path_factory.mktemp("certificates")
    new = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2")

    def openssl(*words: str) -> None:
        subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True)

    for name in "ab":
        openssl(
            "req", "-x509", *new, "-subj", f"/CN=authority-{name}", "-keyout", f"{name}-ca.key", "-out", f"{name}-ca"
        )
        openssl("req", *new, "-subj", "/CN=member", "-keyout", f"{name}-key", "-out", f"{name}.csr")
        authority = ("-CA", f"{name}-ca", "-CAkey", f"{name}-ca.key", "-CAcreateserial", "-days", "2")
        openssl("x509", "-req", "-in", f"{name}.csr", *authority, "-out", f"{name}-cert")
    return folder


@pytest.fixture(scope="module")
def encrypted(files: Path) -> Generator[str]:
    """Address of a cluster that admits clients with certificates of authority a."""
    names = {
        f"tls_{role}_{part}": str(files / f"a-{part}")
        for role in ("scheduler", "worker", "client")
        for part in ("cert", "key")
    }
    with (
        config.set({"temporary-directory": str(files)}),
        started(
            security=Security(tls_ca_file=str(files / "a-ca"), **names, require_encryption=True), protocol="tls://"
        ) as cluster,
    ):
        yield cluster.scheduler_address


def settings(files: Path, authority: str = "a", member: str = "a") -> Any:
    """Dask's own configuration, with an authority and the certificate of another or the same."""
    names = {"ca-file": f"{authority}-ca", "client.cert": f"{member}-cert", "client.key": f"{member}-key"}
    return config.set({f"distributed.comm.tls.{key}": str(files / name) for key, name in names.items()})


# --- TLS


@pytest.mark.slow
def test_a_scene_is_rendered_on_an_encrypted_cluster_with_the_files_of_dasks_configuration(
    encrypted: str, files: Path, ommatid: Command
) -> None:
    assert encrypted.startswith("tls://")
    Path("tiny.toml").write_text(TINY, encoding="utf-8")
    with settings(files):
        ended = ommatid("render", "tiny.toml", "-o", "out", "--scheduler", encrypted)
    assert ended.code == 0, ended.err
    assert Path("out/tiny/stack.exr").is_file()


@pytest.mark.slow
def test_strangers_are_refused_on_both_sides(encrypted: str, files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "PATIENCE", 6.0)  # on a busy machine it takes a second to tell the certificates apart
    own = {"authority": "a", "member": "a"}
    for address, names, message in (
        (encrypted, {**own, "authority": "b"}, "no encrypted scheduler answers there that accepts the certificate"),
        (encrypted, {**own, "member": "b"}, "no encrypted scheduler answers there that accepts the certificate"),
        (encrypted, {**own, "member": "none"}, "Dask's configuration names files that cannot be used"),
        (encrypted, {}, "expected certificates in Dask's configuration"),
        (encrypted.replace("tls://", "tcp://"), {}, "no scheduler answers there"),
    ):
        configured = settings(files, **names) if names else nullcontext()
        with configured, pytest.raises(InputError, match=message) as refused, worker_pool(Cluster(address)):
            pass
        assert str(refused.value).startswith(f"--scheduler {address}: ")
        assert len(str(refused.value)) < 300


# --- other servers


def silent(connection: socket.socket) -> None:
    del connection


def http(connection: socket.socket) -> None:
    connection.sendall(b"HTTP/1.1 400 Bad Request\r\nConnection: close\r\n\r\n")
    connection.close()


@pytest.mark.usefixtures("impatient")
@pytest.mark.parametrize("behaviour", [http, pytest.param(silent, marks=pytest.mark.slow)])
def test_another_server_is_refused_in_one_sentence(behaviour: Callable[[socket.socket], None]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        connections: list[socket.socket] = []

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connections.append(server.accept()[0])
                    with suppress(OSError):
                        behaviour(connections[-1])

        Thread(target=serve, daemon=True).start()
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        with pytest.raises(InputError, match="no scheduler answers there"), worker_pool(Cluster(address)):
            pass
        for connection in connections:
            connection.close()


class HangingClient:
    """A client whose scheduler is connected and does not answer, such as a stopped process."""

    def __init__(self) -> None:
        self.end = Event()

    def get_executor(self, **options: Any) -> Any:
        del options
        return self

    def submit(self, *task: Any) -> Future[Any]:
        del task
        return Future()

    def nthreads(self) -> dict[str, int]:
        self.end.wait(30)
        return {}

    def run(self, *question: Any, **options: Any) -> dict[str, Any]:
        del question, options
        return self.nthreads()


@pytest.mark.usefixtures("impatient")
def test_a_scheduler_that_stops_answering_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    client = HangingClient()

    @contextmanager
    def connected(cluster: Cluster) -> Generator[HangingClient]:
        del cluster
        yield client
        client.end.set()

    monkeypatch.setattr("ommatid.runtime.execution.cluster._connected", connected)
    with cluster_workers(Cluster("tcp://h:1")) as pool:
        with pytest.raises(MachineError, match="connection to the scheduler was lost"):
            pool.map(squared, range(2), no_progress, 2)
        with pytest.raises(InputError, match="not all workers answered"):
            pool.check_versions(versions)


# --- workers


def test_a_worker_that_joins_later_with_another_version_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with started() as cluster, worker_pool(Cluster(cluster.scheduler_address)) as pool:
        pool.check_versions(versions)
        with pytest.raises(MachineError, match=r"the worker \S+ was lost; repeat the command"):
            pool.check_versions(lost_on_a_worker)
        assert pool.map(squared, range(2), no_progress, 2) == [0, 1]
        monkeypatch.setattr(f"{__name__}.VERSIONS", {"ommatid": "2"})  # what the worker says from now on
        with pytest.raises(InputError, match=r"the worker \S+ has ommatid 2, here 1; install the same versions"):
            pool.map(squared, range(2), no_progress, 2)


def test_a_task_of_endless_recursion_ends() -> None:
    """Dask waits for ever for an error whose traceback it cannot send."""
    with started() as cluster, worker_pool(Cluster(cluster.scheduler_address)) as pool:
        ((_, result),) = pool.each(endless, [0])
        with pytest.raises(RuntimeError, match="RecursionError: maximum recursion"):
            result()


def die_once(folder: Path, setup: Setup, output: Path, observer: RunObserver) -> dict[str, Any]:
    """Render a scene; the first worker that has rendered scene b is killed before it says so."""
    described = render(setup, output, observer)
    if setup.scene.source.stem == "b" and not (folder / "died").exists():
        (folder / "died").write_text(str(os.getpid()), encoding="ascii")
        os.kill(os.getpid(), signal.SIGKILL)
    return described


@pytest.mark.slow
def test_a_batch_gives_the_same_bits_though_one_of_two_workers_is_killed(tmp_path: Path) -> None:
    for name in "abc":
        Path(f"{name}.toml").write_text(TINY, encoding="utf-8")

    def files(name: str, cluster: Cluster | None = None) -> dict[str, Any]:
        members = batch_members([Path(f"{scene}.toml") for scene in "abc"], Path(name), None, (), ())
        batch = Batch(partial(die_once, tmp_path), lambda _: SILENT_OBSERVER, lambda _, description: description)
        assert run_batch(batch, members, lambda error: pytest.fail(str(error)), cluster, 1).exit_code == 0
        return content(Path(name))

    with started(n_workers=2, processes=True) as cluster:
        shared = files("shared", Cluster(cluster.scheduler_address))
    assert int(Path("died").read_text(encoding="ascii")) != os.getpid()
    assert differences(shared, files("alone")) == []


@pytest.mark.slow
@pytest.mark.usefixtures("impatient")
def test_a_lost_scheduler_ends_a_batch_and_keeps_what_is_finished(
    monkeypatch: pytest.MonkeyPatch, ommatid: Command
) -> None:
    for name in "abc":
        Path(f"{name}.toml").write_text(TINY, encoding="utf-8")
    collect: Any = Batch.collect
    command = "render", "a.toml", "b.toml", "c.toml", "-o", "out"
    with config.set({"distributed.comm.timeouts.connect": "0.5s"}), started() as cluster:

        def collect_and_lose(*arguments: Any) -> Any:
            description = collect(*arguments)
            cluster.close()
            return description

        monkeypatch.setattr(Batch, "collect", collect_and_lose)
        ended = ommatid(*command, "--scheduler", cluster.scheduler_address)
    *done, last = ended.err.splitlines()
    assert ended.code == 1
    assert done == ["render: done, out/a/stack.exr"]
    assert (
        last == "ommatid: b.toml and 1 more: the connection to the scheduler was lost; " + workers.LOST.split("; ")[1]
    )
    assert {path.parent.name for path in Path("out").glob("*/stack.exr")} == {"a"}
    repeated = ommatid(*command, "--workers", "1")
    assert (repeated.code, repeated.err.count("up to date"), repeated.err.count(": done")) == (0, 1, 2)
