"""The README is true: its commands run, its keys and files are those of the program."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ommatid import app
from scenes.explain import known_keys
from scenes.scene import Scene

from .examples import GALLERY

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
OMMATID = Path(sys.executable).with_name("ommatid")
QUICK = ["--set", "render.samples=16", "--set", "calibration.samples=16", "--set", "render.variant=scalar_rgb"]


def commands() -> list[list[str]]:
    """Every line of the README's shell blocks that starts with ommatid, in order, comments left out."""
    blocks = re.findall(r"```sh\n(.*?)```", TEXT, flags=re.DOTALL)
    lines = [line.split("#")[0].split() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line and line[0] == "ommatid"]


ALONE = ("predict", "design", "paper", "stability")  # they need the gallery and nothing that another command wrote


def complaint(words: list[str], folder: Path) -> str:
    """What a command has to say against itself; nothing where it succeeds."""
    extra = QUICK if words[1] == "run" else []
    if any("misaligned" in word for word in words):  # no set of pinholes where they should be, so not on scalar_rgb
        extra = [*QUICK[:4], "--set", 'study.models=["ideal","true"]']
    ended = subprocess.run([str(OMMATID), *words[1:], *extra], cwd=folder, capture_output=True, text=True)
    return "" if ended.returncode == 0 else f"{' '.join(words)}: exit code {ended.returncode}, {ended.stderr}"


@pytest.fixture
def fresh(tmp_path: Path) -> Path:
    """An empty folder with the gallery in it."""
    shutil.copytree(GALLERY, tmp_path / "scenes", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    return tmp_path


def test_every_command_works_as_it_is_written(fresh: Path) -> None:
    """In their order; only samples are spared."""
    found = [words for words in CHAINED if not is_of_tile35(words)]
    assert len(found) >= 6
    for words in found:
        assert complaint(words, fresh) == ""
    made = {path.name for path in (fresh / "out" / "mine").iterdir()}
    listed = set(re.findall(r"`([a-z]+\.(?:png|exr|json|npz|toml|html))`", TEXT[TEXT.index("## The files of a run") :]))
    assert made <= listed
    assert {"overview.png", "run.json", "stack.exr", "model.npz", "scene.toml", "truth.exr"} <= listed


# What `stability` computes is tests/test_stability.py, case by case; a second time would be a minute for nothing.
STANDING = [
    words
    for words in commands()
    if "mine.toml" not in words
    and (words[1] in ALONE[:-1] or (words[1] == "run" and ("--workers" in words or "misaligned" in words[2])))
]


CHAINED = [words for words in commands() if words not in STANDING and words[1] != "stability"]


def is_of_tile35(words: list[str]) -> bool:
    return any("tile35" in word for word in words)


def test_the_commands_on_another_scene_work_as_they_are_written(fresh: Path) -> None:
    found = [words for words in CHAINED if is_of_tile35(words)]
    assert len(found) >= 2
    for words in found:
        assert complaint(words, fresh) == ""


@pytest.mark.parametrize("words", STANDING, ids=" ".join)
def test_every_command_that_stands_alone_works(words: list[str], fresh: Path) -> None:
    assert complaint(words, fresh) == ""


def test_the_numbers_beside_the_predictions_are_true() -> None:
    for line in TEXT.splitlines():
        claimed = re.match(r"ommatid (predict .*?)\s+# ([0-9.e-]+)[,:]", line)
        if claimed:
            ended = subprocess.run(
                [str(OMMATID), *claimed[1].split(), "--json"], cwd=ROOT, capture_output=True, text=True, check=True
            )
            assert json.loads(ended.stdout)["mse"] == pytest.approx(float(claimed[2]), rel=1e-3)


def test_the_two_commands_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for target in re.findall(r"make ([a-z]+)", TEXT):
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_every_key_is_explained() -> None:
    table = TEXT[TEXT.index("## The scene file") : TEXT.index("### Units and axes")]
    starter = (GALLERY / "starter.toml").read_text(encoding="utf-8")
    for key in known_keys(Scene):
        last = key.rsplit(".", 1)[-1]
        assert f"`{last}`" in table or f"[{key}]" in table, key
        assert re.search(rf"^(# )?\[*({re.escape(key)}|{last})\b", starter, flags=re.MULTILINE), key


def test_the_snippets_are_toml_that_the_program_reads() -> None:
    for block in re.findall(r"```toml\n(.*?)```", TEXT, flags=re.DOTALL):
        lens = tomllib.loads(block)["camera"]["lens"][0]
        assert set(lens) <= {key.rsplit(".", 1)[-1] for key in known_keys(Scene)}


def test_pictures_exist() -> None:
    for picture in re.findall(r"\]\(([^)]+\.png)\)", TEXT):
        assert (ROOT / picture).is_file()


@pytest.mark.parametrize(
    "command", [command.name or command.callback.__name__ for command in app.registered_commands if command.callback]
)
def test_every_command_is_listed_and_helps(command: str) -> None:
    assert f"`ommatid {command}" in TEXT
    ended = subprocess.run([str(OMMATID), command, "--help"], capture_output=True, text=True, check=True)
    assert "Usage" in ended.stdout
