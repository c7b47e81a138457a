"""Places of results: kinds of files, names of folders, and folders that one process uses at a time."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import stat
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.files import make_folder, write_text
from ommatid.runtime.outputs.kinds import LONGEST, SUFFIXES, check_folder, check_name, check_output, shortened_name
from ommatid.runtime.outputs.occupied import LOCK, occupied

FIFO = stat.S_IFIFO


def make_fifo(path: Path) -> None:
    os.mkfifo(path)


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(os.path.relpath(path))


def make_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o600, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("only root makes devices")


def link_to(target: str) -> Callable[[Path], None]:
    return lambda path: path.symlink_to(target)


IN_THE_WAY = {
    "a FIFO": make_fifo,
    "a socket": make_socket,
    "a device": make_device,
    "a folder": Path.mkdir,
    "links in a circle": lambda path: path.symlink_to(path.name),  # pyright: ignore[reportUnknownLambdaType, reportUnknownMemberType]
}


@pytest.mark.parametrize("kind", IN_THE_WAY)
def test_only_regular_files_are_replaced(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "result.json"
    IN_THE_WAY[kind](path)
    before = path.lstat()
    with pytest.raises(InputError, match=rf"result.json: expected .*got {kind}"):
        write_text(path, "{}")
    assert (path.lstat().st_mode, path.lstat().st_ino) == (before.st_mode, before.st_ino)
    assert [inside.name for inside in tmp_path.iterdir()] == [path.name]


def test_a_link_is_replaced_and_its_target_stays(tmp_path: Path) -> None:
    target, path = tmp_path / "mine.txt", tmp_path / "result.json"
    target.write_text("mine", encoding="utf-8")
    path.symlink_to(target)
    write_text(path, "{}")
    assert (target.read_text(encoding="utf-8"), path.is_symlink(), path.read_text(encoding="utf-8")) == (
        "mine",
        False,
        "{}",
    )


def test_nothing_is_written_among_devices() -> None:
    for path in ("/dev/null", "/dev/a.npz", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1", "/sys/a.npz"):
        with pytest.raises(InputError, match=r"expected|would"):
            check_output(Path(path))


def test_a_folder_with_a_fifo_in_place_of_a_result_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    check_folder(tmp_path)  # no result has this name
    for suffix in SUFFIXES:
        fifo = tmp_path / f".part{suffix}"
        os.mkfifo(fifo)
        with pytest.raises(InputError, match=rf"{suffix}: expected a regular file, got a FIFO; remove it"):
            make_folder(tmp_path)
        fifo.unlink()


def test_names_that_no_file_or_folder_can_have_are_the_users_to_correct(tmp_path: Path) -> None:
    for name in ("a" * 256, "a" * 5000, f"{'a' * 300}/b", "a\udcff", "a\udcff/b"):
        for check in (check_output, make_folder):
            with pytest.raises(InputError, match=r"at most 255 bytes|in UTF-8") as refused:
                check(tmp_path / name)
            assert len(str(refused.value)) < 700
    for name in ("", ".", "..", "...", ".hidden", "a/b", "a\\b", "a\nb", "a\x1b[2J", "a\u202eb", "\udcff", "é" * 101):
        with pytest.raises(InputError, match=r"scene.toml: its results are named after it, and its name .*; rename it"):
            check_name(name, "scene.toml")


@given(st.text(max_size=120) | st.text("./\\a é\0", max_size=8))
def test_an_accepted_name_is_one_folder_inside_its_parent(name: str) -> None:
    try:
        check_name(name, name)
    except InputError:
        return
    path = Path("parent") / name
    assert (path.parent, path.name) == (Path("parent"), name)
    assert len(os.fsencode(name)) <= LONGEST


@given(st.text(min_size=1, max_size=400), st.text(min_size=1, max_size=400))
def test_shortened_names_stay_different(name: str, other: str) -> None:
    assert len(shortened_name(name).encode(errors="surrogateescape")) <= LONGEST
    assert (shortened_name(name) == shortened_name(other)) == (name == other)


def tree(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def use(folder: Path, name: str, error: BaseException) -> None:
    """Write a file as the program does, in a folder of its own, and fail."""
    with occupied(folder, "stack.exr"):
        write_text(folder / name, "")
        raise error


def test_a_refusal_leaves_what_was_there(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b" / "c"
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "mine.txt").touch()
    with pytest.raises(InputError, match="wrong"):
        use(folder, "scene.toml", InputError("wrong"))
    assert tree(tmp_path) == {"a", "a/mine.txt"}
    folder.mkdir(parents=True)
    (folder / "scene.toml").write_text("earlier", encoding="utf-8")
    with pytest.raises(InputError, match="wrong"):
        use(folder, "truth.exr", InputError("wrong"))
    assert tree(tmp_path) == {"a", "a/mine.txt", "a/b", "a/b/c", "a/b/c/scene.toml"}


def test_a_refusal_leaves_what_others_saved_meanwhile(tmp_path: Path) -> None:
    def work() -> None:
        with occupied(tmp_path):
            write_text(tmp_path / "run.json", "")
            (tmp_path / "notes.txt").write_text("of the user, saved meanwhile", encoding="utf-8")
            raise InputError("wrong")

    with pytest.raises(InputError, match="wrong"):
        work()
    assert tree(tmp_path) == {"notes.txt"}


@pytest.mark.parametrize("error", [MachineError("full"), KeyboardInterrupt()])
def test_interrupted_work_stays(error: BaseException, tmp_path: Path) -> None:
    folder = tmp_path / "a"
    with pytest.raises(type(error)):
        use(folder, ".stack.exr.partial.npz", error)
    assert tree(tmp_path) == {"a", "a/.stack.exr.partial.npz"}


def test_a_refusal_after_the_first_stage_keeps_its_result(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    for _ in range(2):  # also where it is made again
        with pytest.raises(InputError, match="late"):
            use(folder, "stack.exr", InputError("late"))
        assert tree(tmp_path) == {"a", "a/stack.exr"}


def test_a_second_process_waits_and_says_so(tmp_path: Path) -> None:
    folder, order, waits = tmp_path / "a", list[str](), threading.Event()

    def second() -> None:
        def say(sentence: str) -> None:
            order.append(sentence)
            waits.set()

        with occupied(folder, say=say):
            order.append("second")

    thread = threading.Thread(target=second)
    with occupied(folder):
        thread.start()
        assert waits.wait(30)
        order.append("first")
        shutil.rmtree(folder)  # as after a refusal
    thread.join(30)
    assert order == [f"{folder}: another process is writing there; waiting for its end", "first", "second"]
    assert tree(tmp_path) == set()


def test_a_killed_process_frees_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    child = os.fork()
    if not child:
        with occupied(folder):
            (folder / "half").touch()
            os.kill(os.getpid(), signal.SIGKILL)
    os.waitpid(child, 0)
    assert tree(folder) == {LOCK, "half"}
    with occupied(folder, say=pytest.fail):
        pass
    assert tree(folder) == {"half"}


def make_text(path: Path) -> None:
    path.write_text("mine", encoding="utf-8")


@pytest.mark.parametrize("make", [make_fifo, make_text, link_to("/dev/null"), link_to("mine.txt"), Path.mkdir])
def test_a_lock_file_of_another_kind_is_refused(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / LOCK)
    with pytest.raises(InputError, match="expected a lock file"), occupied(tmp_path):
        pass
    assert tree(tmp_path) == {LOCK}
