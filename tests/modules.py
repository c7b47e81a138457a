"""The program's modules and their imports, read from the source."""

from __future__ import annotations

import ast
import subprocess
from functools import cache
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parent.parent
LINKED = ("scenes", "simulate", "reconstruct")  # packages to which symbolic links at the top lead


def tracked(pattern: str) -> list[Path]:
    """Files of the repository that match a pattern from its top, `**` included; without git, all files that do."""
    command = ["git", "ls-files", "-z", f":(glob){pattern}"]
    try:
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return sorted(path for path in ROOT.glob(pattern) if path.is_file())
    return sorted(path for name in listed.split("\0") if name and (path := ROOT / name).is_file())


@cache
def modules() -> dict[str, Path]:
    """Paths of all modules by the name under which they are imported."""
    return {_name(path): path for path in sorted((ROOT / "ommatid").glob("**/*.py"))}


@cache
def tree(path: Path) -> ast.Module:
    """Syntax tree of a file of Python."""
    return ast.parse(path.read_text(encoding="utf-8"))


def existing(*names: str) -> set[str]:
    """The names themselves. Raises ModuleNotFoundError if one does not exist, for instance after a renaming."""
    for name in names:
        if find_spec(name) is None:
            raise ModuleNotFoundError(name)
    return set(names)


@cache
def imports(name: str) -> frozenset[str]:
    """Everything that a module imports, also inside functions: own modules by full name, others as written."""
    path = modules()[name]
    imported: set[str] = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = _absolute(name, path, node)
            full_names = {f"{base}.{alias.name}" for alias in node.names}
            imported |= {full if full in modules() else base for full in full_names}
    return frozenset(imported - {name})


def circles() -> list[list[str]]:
    """Groups of modules that import one another in a circle (Tarjan's strongly connected components)."""
    index: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    groups: list[list[str]] = []

    def visit(name: str) -> None:
        index[name] = lowest[name] = len(index)
        stack.append(name)
        for other in imports(name) & modules().keys():
            if other not in index:
                visit(other)
            if other in stack:
                lowest[name] = min(lowest[name], lowest[other])
        if lowest[name] == index[name]:
            start = stack.index(name)
            group, stack[start:] = stack[start:], []
            groups.extend([group] if len(group) > 1 else [])

    for name in modules():
        if name not in index:
            visit(name)
    return groups


def _absolute(name: str, path: Path, node: ast.ImportFrom) -> str:
    if not node.level:
        return node.module or ""
    package = name if path.stem == "__init__" else name.rpartition(".")[0]
    parts = package.split(".")[: len(package.split(".")) - node.level + 1]
    return ".".join([*parts, *([node.module] if node.module else [])])


def _name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
