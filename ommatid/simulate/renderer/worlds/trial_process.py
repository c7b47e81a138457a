"""The process that tries worlds: it reads their texts from stdin, builds them, and may die.

Every line of stdin is a JSON object {variant, text, files, memory}; the answers are JSON lines too: {"at": FILE} before
each file, and {"built": true} or {"reason": TEXT} at the end. It ends with its stdin, or when nothing came for a while.
"""

# pyright: basic
from __future__ import annotations

import json
import os
import resource
import select
import signal
from typing import Any

IDLE = 20  # seconds without a world after which the process ends
MESHES = ("ply", "obj", "serialized")


def main() -> None:
    """Answer until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent ends this process
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # libraries print there

    def answer(**words: object) -> None:
        print(json.dumps(words), file=answers, flush=True)

    with os.fdopen(0, "rb", buffering=0, closefd=False) as stdin:
        while select.select([stdin], [], [], IDLE)[0]:
            line = _line(stdin)
            if not line:
                break
            try:
                _try_world(json.loads(line), answer)
                answer(built=True)
            except (RuntimeError, TypeError, ValueError, MemoryError) as error:
                answer(reason=str(error) or type(error).__name__)


def _line(stdin: Any) -> bytes:
    parts = list[bytes]()
    while not parts or not parts[-1].endswith(b"\n"):
        part = stdin.read(2**20)
        if not part:
            return b""
        parts.append(part)
    return b"".join(parts)


def _try_world(world: dict[str, Any], answer: Any) -> None:
    from ..variant import activate
    from .building import parse_world

    activate(world["variant"])
    import mitsuba as mi

    _limit_memory(world["memory"])
    for path, plugin in world["files"]:
        answer(at=path)
        if plugin in MESHES:
            mi.load_dict({"type": plugin, "filename": os.path.realpath(path)})
        elif plugin == "bitmap":
            mi.Bitmap(os.path.realpath(path))
    answer(at="")
    built = parse_world(world["text"], world["variant"]).build()
    built.bbox()


def _limit_memory(more: int | None) -> None:
    """Let this process take so many more bytes, and no more."""
    if more is None:
        return
    import psutil

    size = psutil.Process().memory_info().data
    _, hard = resource.getrlimit(resource.RLIMIT_DATA)
    limit = size + more if hard == resource.RLIM_INFINITY else min(size + more, hard)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, hard))
