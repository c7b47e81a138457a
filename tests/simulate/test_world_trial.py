"""Worlds are built in a process that may die, and neither plugins nor data come from the current folder."""

from __future__ import annotations

import os
import shutil
import struct
import subprocess
from contextlib import nullcontext
from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.setup import Setup
from ommatid.simulate.ground_truth import truth
from ommatid.simulate.renderer.variant import activate
from ommatid.simulate.renderer.worlds import trial
from ommatid.simulate.renderer.worlds.building import parse_world
from ommatid.simulate.renderer.worlds.checked_world import CheckedWorld, check_world_files

from .world_files import world

ENDS = {
    "signal": r"^w: Mitsuba's process died of signal 11 \(Segmentation fault\) while it built the file cup.ply",
    "code": r"^w: Mitsuba's process ended with code 3 while it built the file cup.ply; correct or remove it$",
    "hang": r"^w: Mitsuba takes longer than 1 s to build the file cup.ply; make it smaller$",
    "memory": r"^w needs more memory than the \S+ GB that are free; make it smaller$",
}


@pytest.fixture
def built(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Knowledge of this test alone, which begins without any world."""
    worlds = set[str]()
    monkeypatch.setattr(trial, "_built", worlds)
    return worlds


def checked(folder: Path, content: str) -> CheckedWorld:
    path = folder / "world.xml"
    path.write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    return check_world_files(path, "w")


@pytest.mark.parametrize("end", ENDS)
def test_the_file_is_named_that_ends_the_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: set[str], end: str
) -> None:
    monkeypatch.setattr(trial, "MODULE", "tests.simulate.dying_process")
    with pytest.raises(InputError, match=ENDS[end]):
        trial.try_world(checked(tmp_path, f"<!-- --><bsdf type='diffuse' id='{end}'/>"), "scalar_rgb", "w", seconds=1.0)
    assert not built


def test_a_world_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, built: set[str]) -> None:
    sphere = checked(tmp_path, '<shape type="sphere"/>')
    trial.try_world(sphere, "scalar_rgb", "w")
    assert len(built) == 1
    monkeypatch.setattr(trial, "MODULE", "tests.simulate.dying_process")
    trial.try_world(sphere, "scalar_rgb", "w")


def test_a_world_that_mitsuba_refuses_is_named_with_the_line(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r'w is no scene that Mitsuba can build: in world.xml \(line 1\): could not .* "x"'
    ):
        trial.try_world(checked(tmp_path, '<float name="a" value="x"/>'), "scalar_rgb", "w")


@pytest.mark.slow
def test_pictures_and_volumes_that_are_none_or_too_large_are_refused_in_one_sentence(tmp_path: Path) -> None:
    """Mitsuba reads them in the process that may die: nothing walks through their headers before."""
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 2**31 - 1, 10**6) + b"\x08\0\0\0\0"
    pictures = [png, b"BM" + b"\0" * 16 + struct.pack("<ii", 10**6, 10**6), b"P5\n1000000 1000000\n255\n", b"egg", b""]
    volumes = [b"VOL\3" + struct.pack("<5i", 1, 2**20, 2**20, 2**20, 1) + b"\0" * 24, b"egg"]
    named = '<string name="filename" value="f"/>'
    kinds = [f'<texture type="bitmap">{named}</texture>'] * 5 + [f'<volume type="gridvolume">{named}</volume>'] * 2
    for content, kind in zip((*pictures, *volumes), kinds, strict=True):
        (tmp_path / "f").write_bytes(content)
        with pytest.raises(InputError, match=r"^w[: ].*") as refused:
            trial.try_world(checked(tmp_path, kind), "scalar_rgb", "w")
        assert str(refused.value).isprintable()
        assert len(str(refused.value)) <= 300


@pytest.mark.parametrize(
    ("most", "sure", "endless"), [(-1, 20_000, True), (20_000, 30_000, True), (-1, 5, False), (20, 10**9, False)]
)
def test_paths_that_may_be_endless_are_refused(most: int, sure: int, endless: bool, tmp_path: Path) -> None:
    numbers = f'<integer name="max_depth" value="{most}"/><integer name="rr_depth" value="{sure}"/>'
    (tmp_path / "numbers.xml").write_text(f'<scene version="3.0.0">{numbers}</scene>', encoding="utf-8")
    integrator = '<integrator type="path"><include filename="numbers.xml"/></integrator>'
    found = checked(tmp_path, integrator)
    activate("scalar_rgb")
    with pytest.raises(RuntimeError, match="at most 10000 segments") if endless else nullcontext():
        parse_world(found.text, "scalar_rgb")


def test_no_library_of_the_current_folder_is_loaded(tmp_path: Path) -> None:
    """Neither under a new name nor in place of a plugin or a data file that Mitsuba ships."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    (tmp_path / "evil.c").write_text(
        "#include <fcntl.h>\n"
        f'__attribute__((constructor)) static void run(void) {{ creat("{tmp_path}/ran", 0600); }}\n',
        encoding="utf-8",
    )
    (tmp_path / "plugins").mkdir()
    library = tmp_path / "plugins" / "evil.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", str(library), str(tmp_path / "evil.c")], check=True)
    (tmp_path / "data").mkdir()
    os.mkfifo(tmp_path / "data" / "srgb.coeff")
    for name in (
        "cylinder",
        "point",
        "path",
        "independent",
        "hdrfilm",
        "diffuse",
        "bitmap",
        "area",
        "rectangle",
        "cone",
    ):
        shutil.copy(library, tmp_path / "plugins" / f"{name}.so")
    activate("scalar_rgb")
    described, camera = world(tmp_path, '<shape type="cylinder"/><emitter type="point"/>', variant="scalar_rgb")
    truth(Setup(described, camera))
    for kind in ("evil", "cone", "../evil", "../plugins/evil", str(library)[:-3]):
        described, camera = world(tmp_path, f'<shape type="{kind}"/>', variant="scalar_rgb")
        with pytest.raises(InputError, match="expected a plugin that Mitsuba ships"):
            truth(Setup(described, camera))
    assert not (tmp_path / "ran").exists()
