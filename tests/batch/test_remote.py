"""Worlds that are sent to other machines with their scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from skimage.io import imsave

from ommatid.batch.batch import prepare
from ommatid.batch.remote import SceneOutcome, carry_out, outcome_of, packed, unpack, write_inside
from ommatid.pipeline.stages import open_scene, run
from ommatid.runtime.errors import InputError
from ommatid.scenes.formats import exr

from ..conftest import TINY, Command
from ..runs import assert_same_content, content

WALL = """<scene version="3.0.0"><shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/>
<scale value="6"/><translate z="1000"/></transform><emitter type="area"><texture type="bitmap" name="radiance">
<string name="filename" value="{picture}"/></texture></emitter></shape></scene>"""
DEEP = TINY.replace('image = "photo:camera"\norigin = [100, 230]\n', "").replace(
    "[noise]", '[world]\nfile = "places/world.xml"\nwhite = "auto"\n\n[noise]'
)
OUTSIDE_TOO = ("--allow-outside",)  # the picture lies beside the folder of the world's file


@pytest.fixture
def deep(here: Path) -> Path:
    """A scene whose world includes a file of its own folder, which names a picture of another one."""
    (here / "places").mkdir()
    (here / "pictures").mkdir()
    imsave(here / "pictures" / "wall.png", np.arange(0, 256, 4, dtype=np.uint8).reshape(8, 8), check_contrast=False)
    (here / "places" / "world.xml").write_text(
        '<scene version="3.0.0"><include filename="wall.xml"/></scene>', encoding="utf-8"
    )
    (here / "places" / "wall.xml").write_text(WALL.format(picture="../pictures/wall.png"), encoding="utf-8")
    (here / "deep.toml").write_text(DEEP.replace("samples = 16\nfit", 'method = "ideal"\nfit'), encoding="utf-8")
    return here / "deep.toml"


def test_a_world_gives_the_same_results_on_a_machine_without_its_files(deep: Path, here: Path) -> None:
    folder, alone, setup = here / "out", here / "alone", open_scene(deep, OUTSIDE_TOO)
    assert outcome_of(lambda observer: run(setup, alone, observer)).error is None
    prepare(setup, folder)
    package = packed(setup, folder)
    for name in ("places", "pictures"):
        (here / name).rename(here / f"moved {name}")
    outcome = carry_out(run, package)
    assert outcome.error is None
    unpack(outcome, folder)
    assert_same_content(folder, content(alone))
    assert {path.name for path in folder.iterdir()} == {path.name for path in alone.iterdir()}
    truth = exr.read(folder / "truth.exr")[0].channels["Y"]
    assert np.ptp(truth) > 100, "the picture of the wall is seen"


@pytest.mark.slow
def test_a_scene_with_a_world_is_rendered_on_a_cluster(deep: Path, here: Path, address: str, ommatid: Command) -> None:
    ended = ommatid("render", str(deep), *OUTSIDE_TOO, "-o", "out", "--scheduler", address)
    assert ended.code == 0, ended.err
    assert {path.name for path in (here / "out" / "deep").iterdir()} == {"scene.toml", "truth.exr", "stack.exr"}


def test_messages_about_a_world_name_the_users_files(deep: Path, here: Path) -> None:
    (here / "places" / "wall.xml").write_text('<scene version="3.0.0"></scene>', encoding="utf-8")
    folder, setup = here / "out" / "deep", open_scene(deep, OUTSIDE_TOO)
    prepare(setup, folder)
    outcome = carry_out(run, packed(setup, folder))
    assert isinstance(outcome.error, InputError)
    assert f"world.file: {here / 'places' / 'world.xml'}" in str(outcome.error)


def test_a_file_with_an_absolute_name_is_refused(deep: Path, here: Path) -> None:
    picture = here / "pictures" / "wall.png"
    (here / "places" / "wall.xml").write_text(WALL.format(picture=picture), encoding="utf-8")
    with pytest.raises(InputError, match=r"deep\.toml: world\.file: names .*wall\.png, which other machines"):
        packed(open_scene(deep, OUTSIDE_TOO), here / "out")


OUTSIDE = ("../x", "a/../../x", "/elsewhere/x", "..", "", "a/b/../../../x")


def test_no_file_of_another_machine_is_written_outside_its_folder(tmp_path: Path) -> None:
    folder = tmp_path / "inside"
    folder.mkdir()
    good = {"run.json": b"1", "b": b"2"}
    for name in OUTSIDE:
        with pytest.raises(InputError, match="expected one inside this folder"):
            unpack(SceneOutcome({**good, name: b"3"}, {}, {}), folder)
        with pytest.raises(InputError, match="expected one inside this folder"):
            unpack(SceneOutcome(good, {}, {}, removed=(name,)), folder)
        with pytest.raises(InputError, match="expected one inside this folder"):
            write_inside(folder, {**good, name: b"3"})
    assert [*tmp_path.iterdir()] == [folder]
    assert [*folder.iterdir()] == []


def test_a_package_that_leads_out_of_a_workers_folder_is_refused(
    deep: Path, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(here / "scratch"))
    (here / "scratch").mkdir()
    setup = open_scene(deep, OUTSIDE_TOO)
    package = packed(setup, here / "out")
    assert package.world
    outcome = carry_out(run, replace(package, world={**package.world, "../../escaped": b"x"}))
    assert isinstance(outcome.error, InputError)
    for changes in ({"files": {"../escaped": b"x"}}, *({"world_file": name} for name in OUTSIDE if name)):
        with pytest.raises(InputError, match="expected one inside this folder"):
            carry_out(run, replace(package, **changes))
    assert [*(here / "scratch").iterdir()] == []
