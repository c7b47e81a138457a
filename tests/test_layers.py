"""Who may import whom: scenes neither half, reconstruct neither simulate nor Mitsuba, nobody Mitsuba but simulate,
and both halves only the chain that joins them."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
RENDERER = {"mitsuba", "drjit"}
FORBIDDEN = {
    "scenes": {"simulate", "reconstruct", "chain", "ommatid", "tests"} | RENDERER,
    "simulate": {"reconstruct", "chain", "ommatid", "tests"},
    "reconstruct": {"simulate", "chain", "ommatid", "tests"} | RENDERER,
    "chain": {"ommatid", "tests"} | RENDERER,
}
MODULES = [(package, path) for package in FORBIDDEN for path in sorted((ROOT / package).glob("**/*.py"))]


def imports(path: Path) -> set[str]:
    """Top-level packages that a module imports anywhere in it, relative imports left out."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            found.add(node.module.split(".")[0])
    return found


@pytest.mark.parametrize(("package", "path"), MODULES, ids=lambda value: getattr(value, "stem", value))
def test_imports_point_one_way(package: str, path: Path) -> None:
    assert not imports(path) & FORBIDDEN[package]


def test_only_one_module_imports_openexr() -> None:
    assert [path.name for _, path in MODULES if "OpenEXR" in imports(path)] == ["exr.py"]


@pytest.mark.parametrize("package", sorted(FORBIDDEN))
def test_the_packages_are_ours_and_export_nothing(package: str) -> None:
    module = importlib.import_module(package)
    assert module.__file__ == str(ROOT / package / "__init__.py"), "another package of this name is in the way"
    body = ast.parse((ROOT / package / "__init__.py").read_text(encoding="utf-8")).body
    assert len(body) == 1, "a docstring and nothing else"


def test_reconstruct_works_where_mitsuba_does_not_exist() -> None:
    paths = [path.relative_to(ROOT).with_suffix("") for package, path in MODULES if package == "reconstruct"]
    names = [".".join(path.parts) for path in paths]
    script = (
        "import sys, importlib\n"
        "sys.modules['mitsuba'] = sys.modules['drjit'] = sys.modules['simulate'] = None\n"
        f"for name in {names!r}: importlib.import_module(name)\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_the_front_door_imports_nothing_heavy() -> None:
    """`ommatid --help` in under 0.3 s: what it loads decides, and that can be tested on any machine."""
    script = "import sys, ommatid; print(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", script], check=True, cwd=ROOT, capture_output=True, text=True)
    heavy = {"numpy", "scipy", "mitsuba", "drjit", "pydantic", "pint", "skimage", "matplotlib", "OpenEXR"}
    assert not heavy & set(ended.stdout.split())
