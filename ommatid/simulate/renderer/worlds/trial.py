"""Worlds are built once in a process of their own, which may die; only then in this one.

Mitsuba trusts its files: a damaged one may end the process, take all memory, or never end. The process reads a JSON
object {variant, text, files, memory} from stdin, and answers by JSON lines: {"at": FILE} before each file, and
{"built": true} or {"reason": TEXT} at the end.
"""

# pyright: basic
from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.interpreter import python_command, python_environment
from ommatid.runtime.files import fingerprint
from ommatid.runtime.machine import free_memory
from ommatid.runtime.printable import printable

from .checked_world import CheckedWorld, reason_of, signature

LONGEST = 600.0  # seconds that a world may take
RESERVE = 100_000_000  # bytes that a world may take even if less are free
SHOWN = 100
MODULE = __name__  # of the `main` that a process runs
PICTURES = ("bitmap", "envmap", "projector")
MESHES = ("ply", "obj", "serialized")
FARTHEST = 1e30  # of a vertex


_built: set[str] = set()  # fingerprints of worlds that another process built


def try_world(world: CheckedWorld, variant: str, where: str, seconds: float = LONGEST) -> None:
    """Build a checked world in another process, once for the same files.

    where : start of messages, the scene file and the world's
    Raises InputError if Mitsuba refuses it, or if that process dies or does not end.
    """
    named = [[str(path), plugin] for path, plugin in world.checked.items()]
    files = [[*names, *signature(Path(names[0]))] for names in named]
    key = fingerprint([world.text, files, variant])
    if key in _built:
        return
    most = max(free_memory(), RESERVE)
    task = {"variant": variant, "text": world.text, "files": named, "memory": most}
    reason = _reason(task, where, seconds)
    if reason is not None:
        if "bad_alloc" in reason or "MemoryError" in reason or "out of memory" in reason.lower():
            raise InputError(f"{where} needs more memory than the {most / 1e9:.3g} GB that are free; make it smaller")
        raise InputError(f"{where} is no scene that Mitsuba can build: {reason_of(reason, world)}")
    _built.add(key)


def _reason(task: dict[str, Any], where: str, seconds: float) -> str | None:
    """Return why Mitsuba refuses a world, None if it builds it. Raises InputError if the process dies of it."""
    code = None
    try:
        ended = subprocess.run(
            python_command(f"from {MODULE} import main; main()"),
            input=json.dumps(task).encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            cwd="/",
            env=python_environment(),
            timeout=seconds,
            check=False,
        )
        answers, code = ended.stdout, ended.returncode
    except subprocess.TimeoutExpired as late:
        answers = late.stdout or b""
    at = ""
    for line in answers.split(b"\n")[:-1]:
        words = json.loads(line)
        if "at" not in words:
            return None if words.get("built") else str(words.get("reason"))
        at = str(words["at"])
    if code is None:
        raise InputError(f"{where}: Mitsuba takes longer than {seconds:g} s to build {_shown(at)}; make it smaller")
    raise InputError(f"{where}: {_death(code)} while it built {_shown(at)}; correct or remove it")


def _death(code: int) -> str:
    if code >= 0:
        return f"Mitsuba's process ended with code {code}"
    return f"Mitsuba's process died of signal {-code} ({signal.strsignal(-code)})"


def _shown(at: str) -> str:
    return f"the file {printable(Path(at).name, SHOWN)}" if at else "the world"


def main() -> None:
    """Try the world of stdin."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries print there

    def answer(**words: object) -> None:
        print(json.dumps(words), file=answers, flush=True)

    try:
        _try_world(json.loads(sys.stdin.read()), answer)
        answer(built=True)
    except (RuntimeError, TypeError, ValueError, MemoryError) as error:
        answer(reason=str(error) or type(error).__name__)


def _try_world(world: dict[str, Any], answer: Any) -> None:
    from ..variant import activate
    from .building import parse_world

    activate(world["variant"])
    import mitsuba as mi

    _limit_memory(world["memory"])
    for path, plugin in world["files"]:
        answer(at=path)
        if plugin in MESHES:
            _check_meshes(os.path.realpath(path), plugin)
        elif plugin in PICTURES:
            mi.Bitmap(os.path.realpath(path))
    answer(at="")
    built = parse_world(world["text"], world["variant"]).build()
    built.bbox()


def _check_meshes(path: str, plugin: str) -> None:
    """Read the meshes of a file, and check what Mitsuba trusts: indices and positions of vertices. Raises RuntimeError.

    Without normals at the vertices, which Mitsuba would compute by unchecked indices.
    """
    import mitsuba as mi

    for index in count():
        several = {"shape_index": index} if plugin == "serialized" else {}
        try:
            mesh = mi.load_dict({"type": plugin, "filename": path, "face_normals": True, **several})
        except RuntimeError:
            if index:  # no further mesh, or none that can be read, which the world will say if it names it
                return
            raise
        content = mi.traverse(mesh)
        faces, positions = np.array(content["faces"]), np.array(content["vertex_positions"])
        if not faces.size or int(faces.max()) >= positions.size // 3:
            raise RuntimeError(f"{Path(path).name}: expected faces of existing vertices")
        if not (np.abs(positions) < FARTHEST).all():
            raise RuntimeError(f"{Path(path).name}: expected finite positions of vertices")
        if not several:
            return


def _limit_memory(more: int) -> None:
    """Let this process take so many more bytes, and no more."""
    import psutil

    size = psutil.Process().memory_info().data
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = size + more if hard == resource.RLIM_INFINITY else min(size + more, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
