"""The wheel holds the whole program once, under one name, and works where the repository is not."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import pytest

from .modules import ROOT, modules

pytest.importorskip("hatchling", reason="the wheel is built by hatchling, of the [dev] dependencies")

# Put in front of a command: the repository, which the editable installation adds, is taken off the path again.
AWAY = f"""
import sys
sys.path[:] = [path for path in sys.path if path not in ("", {str(ROOT)!r})]
sys.path.insert(0, "WHEEL")
import ommatid
assert ommatid.__file__.startswith("WHEEL"), ommatid.__file__
"""
DATA = ("*.toml", "worlds/*", "lenses/*", "spectra/*")  # of the gallery, beside its modules
QUICK = ("render.samples=16", "calibration.method=ideal", "render.variant=scalar_rgb", "target.shape=[19, 19]")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = f"from hatchling.build import build_wheel; build_wheel({str(folder)!r})"
    subprocess.run([sys.executable, "-c", build], cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def names(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return [name for name in archive.namelist() if not name.endswith("/")]


def run(unpacked: Path, script: str, cwd: Path, *arguments: str) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    script = AWAY.replace("WHEEL", str(unpacked)) + script
    command = [sys.executable, "-c", script, *arguments]
    ended = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout


def test_it_installs_one_name(wheel: Path) -> None:
    tops = {name.split("/")[0] for name in names(wheel)}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"ommatid"}


def test_every_file_is_in_it_once(wheel: Path) -> None:
    assert {name: count for name, count in Counter(names(wheel)).items() if count > 1} == {}
    python = [name for name in names(wheel) if name.endswith(".py")]
    assert sorted(python) == sorted(path.relative_to(ROOT).as_posix() for path in modules().values())


def test_the_gallery_and_the_templates_are_in_it(wheel: Path) -> None:
    files = {path for pattern in DATA for path in (ROOT / "ommatid" / "scenes").glob(pattern)}
    files |= {path for path in (ROOT / "ommatid").glob("*/templates/*") if path.is_file()}
    assert {".toml", ".xml", ".dat", ".html", ".css", ".js"} <= {path.suffix for path in files}
    expected = {path.relative_to(ROOT).as_posix() for path in files} | {"ommatid/py.typed"}
    assert expected - set(names(wheel)) == set()


@pytest.mark.slow
def test_it_works_in_an_empty_folder(unpacked: Path, tmp_path: Path) -> None:
    """The commands of the first page, on the scene of `init` and on a gallery scene."""
    main = "from ommatid.__main__ import main\nmain()"
    changes = [word for change in QUICK for word in ("--set", change)]
    run(unpacked, main, tmp_path, "init", "mine.toml")
    run(unpacked, main, tmp_path, "run", "mine.toml", "tile19", "-o", "out", "--workers", "1", *changes)
    for name in ("mine", "tile19"):
        assert (tmp_path / "out" / name / "report.html").is_file()
    assert str(ROOT) not in (tmp_path / "out" / "tile19" / "scene.toml").read_text(encoding="utf-8")
