"""Gallery scenes are found by name, unless a file has that name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import GALLERY, gallery_names, write_starter

from ..conftest import TINY, Command
from ..modules import tracked
from ..runs import document


def test_the_gallery_has_the_scenes_of_the_repository() -> None:
    assert {*gallery_names(), "starter"} == {path.stem for path in tracked("ommatid/scenes/*.toml")}


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


def test_init_copies_a_scene_of_the_gallery_with_its_files(ommatid: Command) -> None:
    Path("copy").mkdir()
    for name, files in (("corridor", ["worlds/corridor.xml"]), ("doublet", ["lenses/doublet.toml"]), ("tile19", [])):
        file = Path("copy") / f"{name}.toml"
        written = document(ommatid("init", file, "--from", name, "--json"))
        assert written["files"] == [str(file), *(f"copy/{other}" for other in files)]
        assert read(file).plain() == read(GALLERY / f"{name}.toml").plain() | without_paths(file)
    assert ommatid("init", "copy/again.toml", "--from", "corridor").code == 0
    Path("copy/worlds/corridor.xml").write_text("<scene/>", encoding="utf-8")
    for arguments, words in (
        (("copy/third.toml", "--from", "corridor"), "differs from the file of 'corridor'"),
        (("copy/third.toml", "--from", "tile18"), "expected a scene of the gallery, corridor"),
    ):
        ended = ommatid("init", *arguments)
        assert ended.code == 2
        assert words in ended.err
    assert not Path("copy/third.toml").exists()


def without_paths(file: Path) -> dict[str, Any]:
    """The tables of a copied scene that name files, whose folder differs from the gallery's."""
    return {key: value for key, value in read(file).plain().items() if key == "world"}


def test_init_lists_the_gallery(ommatid: Command) -> None:
    listed = ommatid("init").out.splitlines()
    assert [line.split()[0] for line in listed] == gallery_names()
    assert "The paper's 19 x 19 tile, three lens types" in next(line for line in listed if "tile19" in line)
    assert [scene["name"] for scene in document(ommatid("init", "--json"))] == gallery_names()


@pytest.mark.parametrize("command", ["run", "render", "predict", "show", "calibrate", "design", "bench", "export"])
def test_commands_list_the_gallery_and_take_its_names(command: str, ommatid: Command) -> None:
    listed = "".join(ommatid(command, "--help").out.split())
    assert ",".join(gallery_names()) in listed
