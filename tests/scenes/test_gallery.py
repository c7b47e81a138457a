"""Gallery scenes are found by name, unless a file has that name."""

from __future__ import annotations

from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import GALLERY, gallery_names, write_starter

from ..conftest import TINY, Command


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", gallery_names())
def test_a_name_reads_the_scene_with_all_its_files(name: str) -> None:
    scene = read(Path(name))
    assert scene.source == GALLERY / f"{name}.toml"
    assert Setup.from_scene(scene).image.shape == scene.target.shape
    if scene.world is not None:
        assert Path(scene.world.file).is_file()


def test_a_file_wins_over_the_gallery() -> None:
    Path("tile19").write_text(TINY, encoding="utf-8")
    assert read(Path("tile19")).title == "Tiny"
    assert read(Path("tile35")).title != "Tiny"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("tile9", ("tile9: no such scene file; did you mean 'tile19'?", "corridor, ", "`ommatid init tile9.toml`")),
        ("tile35.tml", ("did you mean 'tile35'?",)),
        ("zzz", ("zzz: no such scene file; the gallery has ", "`ommatid init zzz.toml`")),
        ("sub/tile19", ("sub/tile19: no such scene file; did you mean 'tile19'?",)),
        ("starter", ("starter: no such scene file",)),
    ],
)
def test_a_misspelt_name_lists_the_gallery(name: str, words: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as refused:
        read(Path(name))
    for word in words:
        assert word in str(refused.value)


def test_a_starter_is_a_scene_of_its_own() -> None:
    write_starter(Path("mine.toml"))
    assert Setup.from_scene(read(Path("mine.toml"))).image.ndim == 2
    with pytest.raises(InputError, match="exists already"):
        write_starter(Path("mine.toml"))


@pytest.mark.parametrize("command", ["run", "render", "predict", "show", "calibrate", "design", "bench", "export"])
def test_commands_list_the_gallery_and_take_its_names(command: str, ommatid: Command) -> None:
    listed = "".join(ommatid(command, "--help").out.split())
    assert ",".join(gallery_names()) in listed


def test_a_command_takes_a_name(ommatid: Command) -> None:
    ended = ommatid("show", "tile19")
    assert ended.code == 0
    assert "19 x 19" in ended.out
