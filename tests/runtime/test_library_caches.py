"""Runs say nothing about caches of libraries that cannot be written, and leave none behind."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ommatid.runtime import library_caches
from tests.conftest import shell

VARIABLES = ("DRJIT_CACHE_DIR", "MPLCONFIGDIR")
NO_HOME = "/dev/null/home"  # not even root can write below a device


@pytest.fixture
def bare(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine that names no cache, and whose temporary folder is empty."""
    for name in (*VARIABLES, "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def named() -> dict[str, str]:
    return {name: os.environ[name] for name in VARIABLES if name in os.environ}


def test_folders_that_can_be_written_are_left_alone(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    with library_caches.library_caches():
        assert named() == {}
    assert list(bare.iterdir()) == []


@pytest.mark.parametrize("home", [NO_HOME, "/dev/null", ""])
def test_a_temporary_folder_takes_the_place_of_a_home(bare: Path, monkeypatch: pytest.MonkeyPatch, home: str) -> None:
    monkeypatch.setenv("HOME", home)
    with library_caches.library_caches():
        assert set(named()) == set(VARIABLES)
        for folder in named().values():
            assert Path(folder).is_dir()
            assert bare in Path(folder).parents
    assert named() == {}
    assert list(bare.iterdir()) == []


def test_a_cache_that_the_user_names_is_kept(bare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", NO_HOME)
    monkeypatch.setenv("MPLCONFIGDIR", str(bare))
    with library_caches.library_caches():
        assert named()["MPLCONFIGDIR"] == str(bare)
    assert named() == {"MPLCONFIGDIR": str(bare)}


@pytest.mark.slow
def test_a_command_without_a_home_says_nothing_of_it(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (here / "temporary").mkdir()
    monkeypatch.setenv("TMPDIR", str(here / "temporary"))
    monkeypatch.setenv("HOME", NO_HOME)
    ended = shell("render", "tiny.toml", "-o", "out", cwd=here)
    assert ended.code == 0, ended.err
    assert ended.err.splitlines() == ["render: done, out/tiny/stack.exr"]
    assert list((here / "temporary").iterdir()) == []
    assert {path.name for path in here.iterdir()} == {"tiny.toml", "out", "temporary"}
