"""The documentation is true: its commands and code run, its tables hold what the program has, no more and no less."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main
from pydantic import BaseModel

from ommatid.cli.app import app
from ommatid.scenes import scene
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.messages import known_keys
from ommatid.simulate.renderer.variant import unusable_reason

from .conftest import Command, shell
from .documentation import (
    PAGES,
    ROOT,
    Block,
    anchors,
    blocks,
    headings,
    links,
    marked,
    name_of,
    prose,
    rows,
    section,
    sections,
    text_of,
)
from .examples import GALLERY
from .modules import modules

DOCS = ROOT / "docs"
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
COMMANDS: dict[str, Any] = dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
# Commands that other tests run: seconds that need not be spent twice.
ELSEWHERE = {
    "stability": ("stability/test_stability.py", "write_stability"),
    "doctor": ("cli/test_commands.py", '"doctor"'),
}

# What is spared where pages are run: samples, pixels, a prior's correlations, diffraction.
QUICK = ["--set", "render.samples=16", "--set", "calibration.samples=16"]
SLOW_BACKEND = ["--set", "render.variant=scalar_rgb"]  # which compiles nothing
STARTER, SMALL = "shape = [59, 59]", "shape = [19, 19]"
INDEPENDENT = ["--set", "prior.kind=independent", "--set", "prior.correlation_length="]
SPARED = {
    "run scenes/misaligned.toml": [*QUICK, *INDEPENDENT, "--set", 'study.models=["ideal","true"]'],
    "run scenes/corridor.toml": [*QUICK, *SLOW_BACKEND, "--set", "target.shape=[19, 19]"],
    "bench": ["--seconds", "5"],
    "run scenes/tile19.toml -o sweep": [*QUICK, *SLOW_BACKEND, "--set", "calibration.method=ideal", "--workers", "1"],
    "run scenes/tile19.toml -o auto": SLOW_BACKEND,
    "run scenes/tile19.toml -o within": [*SLOW_BACKEND, "--within", "5 s"],
    "predict scenes/sensor.toml": ["--set", "camera.wavelength="],
    "run": [*QUICK, *SLOW_BACKEND],
    "render": [*QUICK, *SLOW_BACKEND],
    "calibrate": [*QUICK, *SLOW_BACKEND],
}


def spared(words: list[str]) -> list[str]:
    """A command with less to do, where it has much."""
    return [*words, *next((more for start, more in SPARED.items() if " ".join(words).startswith(start)), [])]


def needs_the_fast_backend(words: list[str]) -> bool:
    return any("misaligned" in word for word in words)


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What pages begin with: the gallery, mine.toml, and its finished run."""
    folder = tmp_path_factory.mktemp("prepared")
    shutil.copytree(GALLERY, folder / "scenes", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    assert shell("init", "mine.toml", cwd=folder).code == 0
    make_smaller(folder / "mine.toml")
    ended = shell(*spared(["run", "mine.toml"]), cwd=folder)
    assert ended.code == 0, ended.err
    return folder


def make_smaller(starter: Path) -> None:
    text = starter.read_text(encoding="utf-8")
    assert text.count(STARTER) == 1
    starter.write_text(text.replace(STARTER, SMALL), encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_works_as_it_is_written(
    page: Path, prepared: Path, tmp_path: Path, ommatid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its blocks in their order, in one folder."""
    folder = shutil.copytree(prepared, tmp_path / "here")
    monkeypatch.chdir(folder)
    if "ommatid init mine.toml" in text_of(page):
        (folder / "mine.toml").unlink()
        shutil.rmtree(folder / "out")
    names: dict[str, Any] = {}
    for block in blocks(page):
        if block.saved is not None:
            (folder / block.saved).write_text(block.text, encoding="utf-8")
        if block.language == "sh":
            for line, comment in block.lines():
                follow(line, comment, folder, ommatid)
        elif block.language == "python":
            execute(block, names)
        elif block.language == "toml":
            read_toml(block)
        else:
            assert block.language in ("text", "xml"), "every block says what it is"
    for made in folder.glob("*/*/run.json"):
        assert undocumented(made.parent) == []


def follow(line: str, comment: str, folder: Path, ommatid: Command) -> None:
    """Run a line of a block, and hold what its comment says of it against what it does."""
    program, *words = shlex.split(line)
    if program == "make":
        assert re.search(rf"^{words[0]}:", MAKEFILE, flags=re.MULTILINE), line
        return
    assert program == "ommatid", f"{line}: what is not ours to run belongs into a block of text"
    if words[0] in ELSEWHERE:
        test, there = ELSEWHERE[words[0]]
        assert there in (ROOT / "tests" / test).read_text(encoding="utf-8")
        return
    if needs_the_fast_backend(words) and unusable_reason("llvm_ad_mono"):
        return
    claimed = re.match(r"([0-9][0-9.e-]*)[,:]", comment) if words[0] == "predict" else None
    asked = [*spared(words), *(["--json"] if claimed else [])]
    ended = shell(*asked, cwd=folder) if "--workers" in words else ommatid(*asked)
    assert ended.code == 0, f"{line}: {ended.err}"
    if claimed:
        assert json.loads(ended.out)["mse"] == pytest.approx(float(claimed[1]), rel=1e-3), line
    for said in re.findall(r"prints `([^`]+)`", comment):
        assert said in ended.err, line
    if words[0] == "init":
        make_smaller(folder / words[1])


def execute(block: Block, names: dict[str, Any]) -> None:
    """Run a block of Python in the page's namespace, and compare what it prints with what it shows."""
    lines = block.text.splitlines()
    body = ast.parse(block.text).body
    ends = [node.lineno - 1 for node in body[1:]] + [len(lines)]
    for node, end in zip(body, ends, strict=True):
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            exec(compile(ast.Module([node], []), "a page", "exec"), names)
        shown = [line.split("# -> ", 1)[1] for line in lines[node.lineno - 1 : end] if "# -> " in line]
        if shown:
            told = printed.getvalue().splitlines()
            assert len(told) == len(shown), told
            for one, other in zip(told, shown, strict=True):
                assert alike(one, other), f"printed: {one}, shown: {other}"


NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e-?\d+)?")


def alike(printed: str, shown: str) -> bool:
    """Whether two lines differ in nothing but digits beyond those shown."""
    if NUMBER.sub("#", printed) != NUMBER.sub("#", shown.rstrip()):
        return False
    pairs = zip(NUMBER.findall(printed), NUMBER.findall(shown), strict=True)
    return all(abs(float(one) - float(other)) <= last_place(other) for one, other in pairs)


def last_place(number: str) -> float:
    """One unit of the last digit that is written; of whole numbers none."""
    digits, _, power = number.partition("e")
    decimals = len(digits.partition(".")[2])
    return 10.0 ** (int(power or 0) - decimals) if decimals or power else 0.0


def test_numbers_are_compared_to_the_digits_that_are_shown() -> None:
    assert alike("2.7925345 361", "2.793 361")
    assert not alike("2.7905345 361", "2.793 361")
    assert not alike("2.793 362", "2.793 361")
    assert not alike("2.793 mm", "2.793 m")


def read_toml(block: Block) -> None:
    """As a scene, or as a part of the paper's smallest tile in place of what that has."""
    data = tomllib.loads(block.text)
    if not {"target", "camera"} <= data.keys():
        base = tomllib.loads((GALLERY / "tile19.toml").read_text(encoding="utf-8"))
        if "sensor" in data:  # which pinholes have nothing for
            del base["noise"]
            base["camera"]["lens"] = [{**lens, "aperture": "0.4 mm"} for lens in base["camera"]["lens"]]
        data = {**base, **data, "camera": {**base["camera"], **data.get("camera", {})}}
    derive(scene.parse(data, Path("a page")))


def undocumented(folder: Path) -> list[str]:
    """Files of a run, channels, arrays and keys that the page of files does not name."""
    page = DOCS / "files.md"
    named = set(marked(prose(page)))
    found = [path.name for path in folder.iterdir() if path.name not in named]
    for path in folder.glob("*.exr"):
        text = section(page, "`stack.exr`" if path.stem == "stack" else "`estimate.exr` and `truth.exr`")
        parts = exr.read(path)
        kept = {channel for part in parts for channel in part.channels}
        if path.stem == "stack":
            kept |= {key for part in parts for key in part.record}
        found += [f"{path.name}: {name}" for name in sorted(kept - set(marked(text)))]
    arrays = set(marked(section(page, "`model.npz`")))
    listed = subprocess.run(
        [sys.executable, "-m", "zipfile", "-l", str(folder / "model.npz")], check=True, capture_output=True, text=True
    )
    found += [name for name in re.findall(r"^(\S+)\.npy", listed.stdout, flags=re.MULTILINE) if name not in arrays]
    keys = set(marked(section(page, "`run.json`")))
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return found + [key for key in leaves(document) if not explained(key, keys)]


def leaves(document: Any, prefix: str = "") -> Iterator[str]:
    """Every key of a JSON document in dotted form, once for the tables of a list."""
    if isinstance(document, dict) and document:
        for key, value in document.items():  # type: ignore[reportUnknownVariableType]
            yield from leaves(value, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(document, list) and document and isinstance(document[0], dict):
        for one in document:  # type: ignore[reportUnknownVariableType]
            yield from leaves(one, prefix)
    else:
        yield prefix


WHOLE = (  # explained as one
    *("versions", "model.fit.parameters", "model.fit.units", "depth.rms_disparity_by_type"),
    *("stages.render.not_reached", "stages.calibrate.auto", "spent.stages", "spent.chosen"),
)


def explained(key: str, keys: set[str]) -> bool:
    return key in keys or any(key.startswith(f"{whole}.") and whole in keys for whole in WHOLE)


def test_what_is_not_documented_is_found(finished: Path, tmp_path: Path) -> None:
    """The check of the page of files sees a file and a key too many."""
    folder = shutil.copytree(finished, tmp_path / "run")
    assert undocumented(folder) == []
    (folder / "extra.png").touch()
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    document["error"]["another"] = 1
    (folder / "run.json").write_text(json.dumps(document), encoding="utf-8")
    assert undocumented(folder) == ["extra.png", "error.another"]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page: Path) -> None:
    for path, anchor in links(page):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        if anchor:
            assert anchor in anchors(target), f"{path}#{anchor}"


def test_every_page_is_in_the_index_and_reads_well_in_a_terminal() -> None:
    listed = {(DOCS / path).resolve() for path, _ in links(DOCS / "README.md")}
    for page in PAGES[1:]:
        assert page.name == "README.md" or page in listed, page.name
        assert len(headings(page)) == len(set(headings(page))), "links need anchors of their own"
        for line in text_of(page).splitlines():
            assert len(line) <= 140 or line.startswith("|"), f"{page.name}: {line}"


def test_the_two_commands_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"make ([a-z]+)`", text_of(page)):
            assert re.search(rf"^{target}:", MAKEFILE, flags=re.MULTILINE), target
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_the_gallery_is_listed() -> None:
    listed = set(marked(section(DOCS / "camera.md", "The gallery")))
    assert listed == {path.stem for path in GALLERY.glob("*.toml")} - {"starter"}


def fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every key of the scene file with what is declared of it."""
    for name, field in model.model_fields.items():
        yield prefix + name, field
        for inner in tables_in(field.annotation):
            yield from fields(inner, f"{prefix}{name}.")


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in getattr(annotation, "__args__", ()) for table in tables_in(part)]


def described_keys() -> dict[str, str]:
    """Every key on the page of the scene file, with what stands there as its default; of tables nothing."""
    found: dict[str, str] = {}
    for heading, text in sections(DOCS / "scene-file.md"):
        table = marked(heading)[0].strip("[]") if marked(heading) else ""
        found |= {table: ""} if table else {}
        for key, _, default in rows(text):
            found[f"{table}.{marked(key)[0]}".lstrip(".")] = default
    return found


def test_the_page_of_the_scene_file_has_every_key_and_no_other() -> None:
    assert set(described_keys()) == set(known_keys(Scene))


def test_the_page_of_the_scene_file_tells_the_defaults() -> None:
    described = described_keys()
    checked = 0
    for key, field in fields(Scene):
        told = described[key]
        if field.is_required() and told:
            assert told.startswith("required"), key
        elif isinstance(field.default, bool | int | float | str):
            default = tomllib.loads(f"value = {told.strip('`')}")["value"]
            assert default == field.default, key
            checked += 1
    assert checked > 20


def test_the_scene_to_start_from_has_every_key() -> None:
    starter = (GALLERY / "starter.toml").read_text(encoding="utf-8")
    for key in known_keys(Scene):
        last = key.rsplit(".", 1)[-1]
        assert re.search(rf"^(# )?\[*({re.escape(key)}|{last})\b", starter, flags=re.MULTILINE), key


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_command_and_option_is_listed_and_helps(command: str, ommatid: Command) -> None:
    page = DOCS / "commands.md"
    assert f"`ommatid {command}" in text_of(page).split("## ")[0]
    own = next(text for heading, text in sections(page) if f"`{command}`" in heading)
    listed = " ".join(marked(own + section(page, "Options of many commands"))).replace("=", " ").split()
    for parameter in COMMANDS[command].params:
        for option in (*parameter.opts, *parameter.secondary_opts):
            assert not option.startswith("-") or option in listed, option
    assert "Usage" in ommatid(command, "--help").out


def test_the_page_of_commands_has_no_option_too_many() -> None:
    known = {
        option for one in COMMANDS.values() for some in one.params for option in (*some.opts, *some.secondary_opts)
    }
    for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", prose(DOCS / "commands.md")):
        assert option in known | {"--help"}, option


def test_messages_are_those_of_the_program() -> None:
    """Every table of messages quotes them, with dots for what changes."""
    said: list[str] = []
    for path in modules().values():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "..." for part in node.values]
                said.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                said.append(node.value)
    everything = "\n".join(said)
    tables = [text for _, text in sections(DOCS / "troubleshooting.md") if "message" in text.split("---")[0]]
    messages = [line[0] for text in tables for line in rows(text)]
    assert len(messages) > 10
    for message in messages:
        for piece in message.split("..."):
            assert piece.strip(" '") in everything, message
