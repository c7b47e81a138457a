"""Imports between packages, names of classes, and what modules may hold: one test a rule, with a loop."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
import warnings
from pathlib import Path

from .modules import LINKED, ROOT, circles, imports, modules, tree

RENDERER = {"mitsuba", "drjit"}
DEEPEST = 38  # modules in a chain of imports
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


def test_imports_point_one_way() -> None:
    for module in modules():
        ours = {room(name) for name in imports(module) if package(name) == "ommatid"}
        if room(module) in BELOW:
            assert ours <= BELOW[room(module)] | {room(module)}, module
        if room(module) not in ("cli", "__main__"):
            assert "cli" not in ours, module
        assert "tests" not in {package(name) for name in imports(module)}, module


def test_only_the_renderer_imports_mitsuba() -> None:
    for module in modules():
        if not module.startswith("ommatid.simulate.renderer."):
            assert not {package(name) for name in imports(module)} & RENDERER, module


def test_only_one_module_imports_openexr() -> None:
    assert [name for name in modules() if "OpenEXR" in imports(name)] == ["ommatid.scenes.formats.exr"]


def test_only_one_module_begins_streams_of_random_numbers() -> None:
    """All others ask it for the stream of a purpose, and name NumPy's generators in types alone."""
    home = "ommatid.runtime.streams"
    for module, path in modules().items():
        if module == home:
            continue
        assert not imports(module) & {"random", "numpy.random"}, module
        nodes = list(ast.walk(tree(path)))
        named = {ast.unparse(node) for node in nodes if isinstance(node, ast.Attribute)}
        assert not {name for name in named if name.startswith("np.random.")} - {"np.random.Generator"}, module
        assert "np.random.Generator" not in {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
        names = {node.id for node in nodes if isinstance(node, ast.Name)}
        assert not {name for name in names if name.isupper() and "SEED" in name}, f"{module}: a private seed"


def test_no_modules_import_one_another_in_a_circle() -> None:
    assert circles() == []


def test_chains_of_imports_are_short() -> None:
    longest: dict[str, int] = {}

    def depth(name: str) -> int:
        if name not in longest:
            longest[name] = 1 + max((depth(other) for other in imports(name) & modules().keys()), default=0)
        return longest[name]

    assert {name: depth(name) for name in modules() if depth(name) > DEEPEST} == {}


def test_linked_folders_are_imported_as_part_of_ommatid() -> None:
    """`import scenes` works in a checkout, but would load every class twice."""
    for path in {*modules().values(), *ROOT.glob("tests/**/*.py")}:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Import):
                assert not {package(alias.name) for alias in node.names} & {*LINKED}, path
            elif isinstance(node, ast.ImportFrom) and not node.level:
                assert package(node.module or "") not in LINKED, path


def test_no_class_name_is_defined_twice() -> None:
    defined: dict[str, list[str]] = {}
    for module, path in modules().items():
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.ClassDef):
                defined.setdefault(node.name, []).append(module)
    assert {name: where for name, where in defined.items() if len(where) > 1} == {}


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
    nodes = list(ast.walk(tree(path)))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    texts = list[str | bytes]()
    for node in nodes:
        if isinstance(node, ast.JoinedStr):
            texts.append("".join(str(part.value) if isinstance(part, ast.Constant) else "x" for part in node.values))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str | bytes) and id(node) not in docstrings:
            texts.append(node.value)
    return texts


def test_packages_export_nothing() -> None:
    for name in [name for name, path in modules().items() if path.stem == "__init__"]:
        module = importlib.import_module(name)
        assert Path(str(module.__file__)).resolve() == modules()[name], "another package of this name is found first"
        body = tree(modules()[name]).body
        assert len(body) == 1 or name == "ommatid", f"{name}: a docstring and nothing else"


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
