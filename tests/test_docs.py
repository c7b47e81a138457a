"""Tests of the documentation: its commands and code run, and its tables agree with the program."""

from __future__ import annotations

import ast
import contextlib
import io
import json
import re
import shlex
import shutil
import tomllib
import zipfile
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest
import typer.main
from pydantic import BaseModel

from ommatid.cli.app import app
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes import scene
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.scenes.scene import Scene
from ommatid.scenes.tables.messages import known_keys
from ommatid.simulate.renderer.variant import unusable_reason

from . import commands_page
from .conftest import Command, shell
from .documentation import (
    PAGES,
    ROOT,
    Block,
    anchors,
    blocks,
    code_spans,
    headings,
    links,
    page_name,
    prose,
    section,
    sections,
    table_rows,
    text_of,
)
from .examples import GALLERY
from .modules import modules, tracked
from .printed_figures import agree, rounds_to

DOCS = ROOT / "docs"
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
PROGRAM: Any = typer.main.get_command(app)
COMMANDS: dict[str, Any] = dict(PROGRAM.commands)
# Commands that another test runs, named with a string that the test contains: they take too long to run twice.
TESTED_ELSEWHERE = {
    "stability": ("stability/test_stability.py", "write_stability"),
    "doctor": ("cli/test_commands.py", '"doctor"'),
}

# Options that shorten the commands of the pages: fewer samples and pixels, no correlation.
QUICK = ["--set", "render.samples=16", "--set", "calibration.samples=16"]
SCALAR = ["--set", "render.variant=scalar_rgb"]  # needs no compilation
STARTER_SHAPE, SMALL_SHAPE = "shape = [59, 59]", "shape = [19, 19]"
INDEPENDENT = ["--set", "prior.kind=independent", "--set", "prior.correlation_length="]
TILE = [
    *("--set", "target.shape=[19, 19]", "--set", "camera.lens.I.pixels=[5, 5]"),
    *("--set", "camera.lens.II.pixels=[3, 3]", "--set", "camera.lens.III.pixels=[4, 4]"),
]
SHORTER = {
    "run misaligned": [*QUICK, *INDEPENDENT, "--set", 'study.models=["ideal","true"]'],
    "run corridor": [*QUICK, *SCALAR, "--set", "target.shape=[19, 19]"],
    "bench": ["--within", "5 s"],
    "run tile19 -o sweep": [*QUICK, *SCALAR, "--set", "calibration.method=ideal", "--workers", "1"],
    "run tile19 -o auto": SCALAR,
    "run tile19 -o displaced": QUICK,
    "run tile19 -o within": [*SCALAR, "--within", "5 s"],
    "predict sensor": TILE,
    "predict tile19 --set camera.lens.II": QUICK,
    "predict tile19 --set camera.tolerance": QUICK,
    "predict tile19 -o tolerance": ["--no-rays"],
    "run": [*QUICK, *SCALAR],
    "render": [*QUICK, *SCALAR],
    "calibrate": [*QUICK, *SCALAR],
}


def shortened(arguments: list[str]) -> list[str]:
    """Return a command line with the options of SHORTER that apply to it."""
    command = " ".join(arguments)
    return [*arguments, *next((options for start, options in SHORTER.items() if command.startswith(start)), [])]


def needs_fast_backend(arguments: list[str]) -> bool:
    return any(word in argument for argument in arguments for word in ("misaligned", "camera.tolerance"))


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the gallery, mine.toml, and its finished run, which the pages assume."""
    folder = tmp_path_factory.mktemp("prepared")
    shutil.copytree(GALLERY, folder / "scenes", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    assert shell("init", "mine.toml", cwd=folder).code == 0
    reduce_starter(folder / "mine.toml")
    result = shell(*shortened(["run", "mine.toml"]), cwd=folder)
    assert result.code == 0, result.err
    return folder


def reduce_starter(path: Path) -> None:
    """Reduce the target of the starter scene to 19 x 19 pixels."""
    text = path.read_text(encoding="utf-8")
    assert text.count(STARTER_SHAPE) == 1
    path.write_text(text.replace(STARTER_SHAPE, SMALL_SHAPE), encoding="utf-8")


def check_imports(code: ast.Module) -> None:
    """What a page imports of the program exists."""
    for node in ast.walk(code):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("ommatid"):
            module = import_module(node.module or "")
            for each in node.names:
                if not hasattr(module, each.name):  # a module of the package that nothing has imported yet
                    import_module(f"{node.module}.{each.name}")


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_code_blocks_of_a_page_are_read(page: Path, tmp_path: Path, ommatid: Command) -> None:
    """The short form: commands are parsed, Python is compiled, scenes are read, and closed forms are computed.

    The closed forms are of cameras as designed: those with a tolerance take longer.
    """
    shutil.copytree(GALLERY, tmp_path / "scenes", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for block in blocks(page):
        if block.file_name is not None:
            (tmp_path / block.file_name).write_text(block.text, encoding="utf-8")
        if block.language == "sh":
            for line, comment in block.commands():
                program, *arguments = shlex.split(line)
                if program == "ommatid" and arguments[0] in COMMANDS:
                    COMMANDS[arguments[0]].make_context(arguments[0], arguments[1:])
                closed = arguments[0] == "predict" and "--no-rays" in arguments and arguments[1].startswith("tile")
                if closed and not needs_fast_backend(arguments):
                    run_command(line, comment, tmp_path, ommatid)
        elif block.language == "python":
            check_imports(ast.parse(block.text))
        elif block.language == "toml":
            parse_toml(block)
        else:
            assert block.language in ("text", "xml"), f"unknown language of a block: '{block.language}'"


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_code_blocks_of_a_page_run_in_order(page: Path, prepared: Path, tmp_path: Path, ommatid: Command) -> None:
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    if "ommatid init mine.toml" in text_of(page):
        (tmp_path / "mine.toml").unlink()
        shutil.rmtree(tmp_path / "out")
    namespace: dict[str, Any] = {}
    for block in blocks(page):
        if block.file_name is not None:
            (tmp_path / block.file_name).write_text(block.text, encoding="utf-8")
        if block.language == "sh":
            for command, comment in block.commands():
                run_command(command, comment, tmp_path, ommatid)
        elif block.language == "python":
            execute(block, namespace)
        elif block.language == "toml":
            parse_toml(block)
    for run in tmp_path.glob("*/*/run.json"):
        assert undocumented(run.parent) == []


def run_command(line: str, comment: str, folder: Path, ommatid: Command) -> None:
    """Run one line of a shell block, and check the number or the output that its comment states."""
    program, *arguments = shlex.split(line)
    if program == "make":
        assert re.search(rf"^{arguments[0]}:", MAKEFILE, flags=re.MULTILINE), line
        return
    assert program == "ommatid", f"{line}: only ommatid and make are run; use a text block for other programs"
    if arguments[0] in TESTED_ELSEWHERE:
        test, content = TESTED_ELSEWHERE[arguments[0]]
        assert content in (ROOT / "tests" / test).read_text(encoding="utf-8")
        return
    if needs_fast_backend(arguments) and unusable_reason("llvm_ad_mono"):
        return
    stated_error = re.match(r"([0-9][0-9.e-]*)(?:[,:]|$)", comment) if arguments[0] == "predict" else None
    command = [*shortened(arguments), *(["--json"] if stated_error else [])]
    result = shell(*command, cwd=folder) if "--workers" in arguments else ommatid(*command)
    assert result.code == 0, f"{line}: {result.err}"
    if stated_error:
        mse = json.loads(result.out)[0]["mse"]
        assert rounds_to(mse, stated_error[1]), f"{line}: stated {stated_error[1]}, computed {mse:.6g}"
    for output in re.findall(r"prints `([^`]+)`", comment):
        assert output in result.err, line
    if arguments[0] == "init":
        reduce_starter(folder / arguments[1])


def execute(block: Block, namespace: dict[str, Any]) -> None:
    """Run a Python block in the namespace of its page, and compare its output with the comments after `# ->`."""
    lines = block.text.splitlines()
    body = ast.parse(block.text).body
    ends = [node.lineno - 1 for node in body[1:]] + [len(lines)]
    for node, end in zip(body, ends, strict=True):
        stdout = io.StringIO()
        with contextlib.redirect_stdout(stdout):
            exec(compile(ast.Module([node], []), "a page", "exec"), namespace)
        stated = [line.split("# -> ", 1)[1] for line in lines[node.lineno - 1 : end] if "# -> " in line]
        if stated:
            printed = stdout.getvalue().splitlines()
            assert len(printed) == len(stated), printed
            for printed_line, stated_line in zip(printed, stated, strict=True):
                assert agree(printed_line, stated_line), f"printed: {printed_line}, stated: {stated_line}"


def parse_toml(block: Block) -> None:
    """Parse a TOML block as a scene, or as a part of tile19 that replaces the tables of that scene."""
    data = tomllib.loads(block.text)
    if not {"target", "camera"} <= data.keys():
        base = tomllib.loads((GALLERY / "tile19.toml").read_text(encoding="utf-8"))
        if "sensor" in data:  # a sensor excludes pinholes and [noise]
            del base["noise"]
            base["camera"]["lens"] = [{**lens, "aperture": "0.4 mm"} for lens in base["camera"]["lens"]]
        data = {**base, **data, "camera": {**base["camera"], **data.get("camera", {})}}
    derive(scene.parse(data, Path("a page")))


def undocumented(folder: Path) -> list[str]:
    """Return the files, channels, arrays and keys of a run that docs/files.md does not mention."""
    page = DOCS / "files.md"
    documented = set(code_spans(prose(page)))
    missing = [path.name for path in folder.iterdir() if path.name not in documented]
    for path in folder.glob("*.exr"):
        heading = "`stack.exr`" if path.stem == "stack" else "`estimate.exr` and `truth.exr`"
        parts = exr.read(path)
        names = {channel for part in parts for channel in part.channels}
        if path.stem == "stack":
            names |= {key for part in parts for key in part.record}
        missing += [f"{path.name}: {name}" for name in sorted(names - set(code_spans(section(page, heading))))]
    arrays = set(code_spans(section(page, "`model.npz`")))
    with zipfile.ZipFile(folder / "model.npz") as file:
        stored = [re.sub(r"^(views|kernels)\.[^.]+\.", r"\1.NAME.", name) for name in file.namelist()]
        missing += [name for name in stored if name.removesuffix(".npy") not in arrays]
    keys = {key for row in rows_of_run_json() for key in row}
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    return missing + [key for key in leaves(document) if not is_documented(key, keys)]


def rows_of_run_json() -> list[list[str]]:
    """Return the keys of every row of the table in docs/files.md: those on the left, then those below each of them."""
    rows = [list(map(code_spans, row)) for row in table_rows(section(DOCS / "files.md", "`run.json`"))]
    return [left + [f"{key}.{name}" for key in left for name in right] for left, right in rows]


def leaves(document: Any, prefix: str = "") -> Iterator[str]:
    """Yield every key of a JSON document in dotted form; the items of a list share their keys."""
    if isinstance(document, dict) and document:
        for key, value in document.items():  # type: ignore[reportUnknownVariableType]
            yield from leaves(value, f"{prefix}.{key}" if prefix else str(key))
    elif isinstance(document, list) and document and isinstance(document[0], dict):
        for item in document:  # type: ignore[reportUnknownVariableType]
            yield from leaves(item, prefix)
    else:
        yield prefix


DOCUMENTED_AS_ONE = (  # keys whose contents are not listed one by one
    *("versions", "model.fit.parameters", "model.fit.units", "depth.rms_disparity_by_type"),
    *("model.fit.structure", "model.fit.chances", "model.fit.chart", "model.fit.kernels"),
    *("stages.render.not_reached", "stages.calibrate.auto", "spent.chosen"),
)


def is_documented(key: str, keys: set[str]) -> bool:
    return key in keys or any(key.startswith(f"{parent}.") and parent in keys for parent in DOCUMENTED_AS_ONE)


def test_files_page_has_the_keys_of_run_json() -> None:
    """Of every field of the report; those of the stages and of the fitted numbers are the same for each."""
    known = {key for key, _ in fields(RunReport)}
    rows = [[re.sub(r"^(stages|diagnostics\.fit)\.\w+", r"\1", key) for key in row] for row in rows_of_run_json()]
    assert {row[0] for row in rows} <= known
    documented = {".".join(key.split(".")[:count]) for row in rows for key in row for count in range(1, 4)}
    assert known - documented == set()


def test_files_and_keys_of_a_run_are_documented(finished: Path) -> None:
    assert undocumented(finished) == []


@pytest.mark.parametrize("page", PAGES, ids=page_name)
def test_links_have_a_target(page: Path) -> None:
    for path, anchor in links(page):
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), path
        if anchor:
            assert anchor in anchors(target), f"{path}#{anchor}"


def test_every_page_is_in_the_index_and_fits_a_terminal() -> None:
    listed = {(DOCS / path).resolve() for path, _ in links(DOCS / "README.md")}
    for page in PAGES[1:]:
        assert page.name == "README.md" or page in listed, page.name
        assert len(headings(page)) == len(set(headings(page))), f"{page.name}: two headings have the same anchor"
        for line in text_of(page).splitlines():
            assert len(line) <= 140 or line.startswith("|"), f"{page.name}: {line}"


def test_every_page_is_in_the_navigation_of_the_site() -> None:
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").partition("\nnav:")[2]
    listed = re.findall(r"[\w./-]+\.md", navigation)
    pages = [path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")]
    notebooks = [path.with_suffix(".md").relative_to(DOCS).as_posix() for path in DOCS.glob("notebooks/*.py")]
    assert sorted(listed) == sorted(pages + notebooks)


def test_make_targets_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"make ([a-z]+)`", text_of(page)):
            assert re.search(rf"^{target}:", MAKEFILE, flags=re.MULTILINE), target
    assert "make test" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")


def test_every_gallery_scene_is_listed() -> None:
    listed = set(code_spans(section(DOCS / "camera.md", "The gallery")))
    assert listed == {path.stem for path in tracked("ommatid/scenes/*.toml")} - {"starter"}


def fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every key of the scene file with its pydantic field."""
    for name, field in model.model_fields.items():
        yield prefix + name, field
        for table in tables_in(field.annotation):
            yield from fields(table, f"{prefix}{name}.")


def tables_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [table for part in getattr(annotation, "__args__", ()) for table in tables_in(part)]


def documented_keys() -> dict[str, str]:
    """Return every key of docs/scene-file.md with its default as printed there; an empty text for tables."""
    keys: dict[str, str] = {}
    for heading, text in sections(DOCS / "scene-file.md"):
        table = code_spans(heading)[0].strip("[]") if code_spans(heading) else ""
        keys |= {table: ""} if table else {}
        for key, _, default in table_rows(text):
            keys[f"{table}.{code_spans(key)[0]}".lstrip(".")] = default
    return keys


def test_scene_file_page_has_exactly_the_known_keys() -> None:
    assert set(documented_keys()) == set(known_keys(Scene))


def test_scene_file_page_has_the_defaults() -> None:
    documented = documented_keys()
    compared = 0
    for key, field in fields(Scene):
        stated = documented[key]
        if field.is_required() and stated:
            assert stated.startswith("required"), key
        elif isinstance(field.default, bool | int | float | str):
            assert tomllib.loads(f"value = {stated.strip('`')}")["value"] == field.default, key
            compared += 1
    assert compared > 20


def test_starter_scene_has_every_key() -> None:
    starter = (GALLERY / "starter.toml").read_text(encoding="utf-8")
    for key in known_keys(Scene):
        last = key.rsplit(".", 1)[-1]
        assert re.search(rf"^(# )?\[*({re.escape(key)}|{last})\b", starter, flags=re.MULTILINE), key


def test_the_tables_of_the_commands_page_are_those_of_the_option_objects() -> None:
    """`python -m tests.commands_page` writes them anew."""
    text = text_of(commands_page.PAGE)
    assert commands_page.with_tables(text) == text
    parameters = [parameter for command in (PROGRAM, *COMMANDS.values()) for parameter in command.params]
    known = {option for parameter in parameters for option in (*parameter.opts, *parameter.secondary_opts)}
    for option in re.findall(r"(?<![\w-])--[a-z][a-z-]*", prose(commands_page.PAGE)):
        assert option in known, option


def test_messages_of_the_troubleshooting_page_occur_in_the_program() -> None:
    """The tables quote string literals of the program, with dots for the parts that vary."""
    literals: list[str] = []
    for path in modules().values():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.JoinedStr):
                parts = [part.value if isinstance(part, ast.Constant) else "..." for part in node.values]
                literals.append("".join(map(str, parts)))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                literals.append(node.value)
    program = "\n".join(literals)
    tables = [text for _, text in sections(DOCS / "troubleshooting.md") if "message" in text.split("---")[0]]
    messages = [cells[0] for text in tables for cells in table_rows(text)]
    assert len(messages) > 10
    for message in messages:
        for piece in message.split("..."):
            assert piece.strip(" '") in program, message


def test_names_of_the_api_page_exist() -> None:
    names = re.findall(r"^::: (\S+)$", text_of(DOCS / "api.md"), flags=re.MULTILINE)
    assert len(names) > 15
    for name in names:
        resolve_name(name)  # raises ImportError or AttributeError
