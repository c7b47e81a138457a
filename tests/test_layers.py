"""Imports between packages, sizes of modules and folders, and names of classes."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
import warnings
from collections import Counter
from pathlib import Path

import pytest

from .modules import LINKED, ROOT, circles, existing, imports, modules

RENDERER = {"mitsuba", "drjit"}
LONGEST = 300  # lines of a module
LARGEST = 12  # modules of a folder, `__init__` not counted
# The packages that a package may import beside itself; those not listed may import all but `cli`.
BELOW = {
    "runtime": set[str](),
    "scenes": {"runtime"},
    "figures": {"runtime", "scenes"},
    "simulate": {"runtime", "scenes"},
    "reconstruct": {"runtime", "scenes", "figures"},
}


def room(module: str) -> str:
    """The package inside ommatid; empty for `ommatid` itself and for other distributions."""
    parts = module.split(".")
    return parts[1] if parts[0] == "ommatid" and len(parts) > 1 else ""


def package(module: str) -> str:
    """The top-level package of a module."""
    return module.partition(".")[0]


@pytest.mark.parametrize("module", modules())
def test_imports_point_one_way(module: str) -> None:
    ours = {room(name) for name in imports(module) if package(name) == "ommatid"}
    if room(module) in BELOW:
        assert ours <= BELOW[room(module)] | {room(module)}
    if room(module) not in ("cli", "__main__"):
        assert "cli" not in ours
    assert "tests" not in {package(name) for name in imports(module)}


@pytest.mark.parametrize("module", modules())
def test_only_the_renderer_imports_mitsuba(module: str) -> None:
    if not module.startswith("ommatid.simulate.renderer."):
        assert not {package(name) for name in imports(module)} & RENDERER


def test_only_one_module_imports_openexr() -> None:
    assert [name for name in modules() if "OpenEXR" in imports(name)] == ["ommatid.scenes.formats.exr"]


def test_no_modules_import_one_another_in_a_circle() -> None:
    assert circles() == []


@pytest.mark.parametrize("path", sorted({*modules().values(), *ROOT.glob("tests/**/*.py")}), ids=str)
def test_linked_folders_are_imported_as_part_of_ommatid(path: Path) -> None:
    """`import scenes` works in a checkout, but would load every class twice."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            assert not {package(alias.name) for alias in node.names} & {*LINKED}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            assert package(node.module or "") not in LINKED


@pytest.mark.parametrize("module", modules())
def test_no_module_is_long(module: str) -> None:
    assert len(modules()[module].read_text(encoding="utf-8").splitlines()) <= LONGEST


def test_no_class_name_is_defined_twice() -> None:
    defined: dict[str, list[str]] = {}
    for module, path in modules().items():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                defined.setdefault(node.name, []).append(module)
    assert {name: where for name, where in defined.items() if len(where) > 1} == {}


def test_no_folder_has_many_modules() -> None:
    inside = Counter(path.parent for path in modules().values() if path.stem != "__init__")
    assert {folder: count for folder, count in inside.items() if count > LARGEST} == {}


def test_no_regular_expression_needs_a_newer_python_than_3_11() -> None:
    """`re` before Python 3.11.5 leaves a possessive repetition or an atomic group half-way when it fails."""
    parser = importlib.import_module("re._parser")
    found = dict[str, list[str | bytes]]()
    for module, path in modules().items():
        for text in _texts(path) if "re" in imports(module) else []:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    parsed = repr(parser.parse(text))
                except (parser.error, OverflowError):  # no regular expression
                    continue
            if "POSSESSIVE_REPEAT" in parsed or "ATOMIC_GROUP" in parsed:
                found.setdefault(module, []).append(text)
    assert found == {}


def _texts(path: Path) -> list[str | bytes]:
    """All literals of a module but docstrings; of f-strings with a letter for what they format."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    texts = list[str | bytes]()
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            texts.append("".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str | bytes) and id(node) not in docstrings:
            texts.append(node.value)
    return texts


def test_names_of_modules_that_do_not_exist_are_errors() -> None:
    with pytest.raises(ModuleNotFoundError):
        existing("ommatid.scenes.camera", "ommatid.scenes.no_such_module")


@pytest.mark.parametrize("name", [name for name, path in modules().items() if path.stem == "__init__"])
def test_packages_export_nothing(name: str) -> None:
    module = importlib.import_module(name)
    assert Path(str(module.__file__)).resolve() == modules()[name], "another package of this name is found first"
    body = ast.parse(modules()[name].read_text(encoding="utf-8")).body
    assert len(body) == 1 or name == "ommatid", "a docstring and nothing else"


def test_reconstruct_works_where_mitsuba_does_not_exist() -> None:
    names = [name for name in modules() if room(name) == "reconstruct"]
    script = (
        "import sys, importlib\n"
        "sys.modules['mitsuba'] = sys.modules['drjit'] = sys.modules['ommatid.simulate'] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_command_line_imports_nothing_heavy() -> None:
    """`ommatid --help` takes under 0.3 s if it loads none of these, which can be tested on any machine."""
    script = "import sys, ommatid.cli.app; print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT, capture_output=True, text=True)
    heavy = {"numpy", "scipy", "mitsuba", "drjit", "pydantic", "pint", "skimage", "matplotlib", "OpenEXR", "psutil"}
    assert not heavy & set(ended.stdout.split())
