"""Files that a command finds in a folder of results: reports, tables, pages and interrupted work."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from ommatid.batch.sweep_row import SweepRow, write_rows
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read

from ...bench.tables import bench_table, cell
from .. import mutations
from ..damage import damaged
from ..family import RUN, SCENE, CommandCase, CommandFamily
from ..formats import npz_damaged

PARTIAL = f"{RUN}/.stack.exr.partial.npz"  # an interrupted rendering
TEXTS = (
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\u202eleft", "\x9b2J", "a\x00b", "\ud800", "x" * 100000, "=1+1",
    "<script>",
)  # fmt: skip
NESTED = ("[", '{"a":', "[[],")
NUMBERS = ("1" + "0" * 5000, "-" + "9" * 5000, "1e400", "-1e400", "NaN", "Infinity", "1e-400", "0.1" * 2)


def add_documents(folder: Path) -> None:
    """Add a sweep and a bench to the results in a folder."""
    report = json.loads((folder / RUN / "run.json").read_bytes())
    row = SweepRow(scene=SCENE, folder=Path(RUN).name, values={"noise.variance": "1e-2"}, mse=1.0, predicted_mse=2.0)
    write_rows(folder / "out/sweep.json", [row, row.model_copy(update={"mse": report["error"].get("mse")})])
    table = bench_table(derive(read(folder / SCENE)), [cell(), cell("calibrate"), cell("reconstruct", samples=None)])
    (folder / RUN / "bench.json").write_text(json.dumps(table.describe()), encoding="ascii")


def json_damaged(rng: Random, original: bytes) -> bytes:
    """Return a JSON document with extreme values, texts for numbers, deep nesting, repeated keys, or other bytes."""
    choice = rng.random()
    if choice < 0.15:
        return damaged(rng, original)
    if choice < 0.25:
        return _nested(rng, original)
    try:
        document = json.loads(original)
    except ValueError:
        return damaged(rng, original)
    if choice < 0.35:
        text = json.dumps(document)
        return rng.choice(
            (text.encode("utf-16"), b"\xef\xbb\xbf" + text.encode(), text.replace('"', '"\xff').encode("latin-1"), b"")
        )
    if choice < 0.6:
        document = mutations.record(rng, document)
        return json.dumps(document).encode()
    return _replaced(rng, document)


def _nested(rng: Random, original: bytes) -> bytes:
    """Put deep nesting in the place of a value."""
    start, depth = rng.choice(NESTED), rng.choice((50, 900, 10000, 200000))
    end = {"[": "]", '{"a":': "}", "[[],": "]"}[start]
    inner = (start * depth + "1" + end * depth * rng.choice((0, 1))).encode()
    places = [index + 1 for index, byte in enumerate(original) if byte == ord(":")]
    if not places:
        return inner
    at = rng.choice(places)
    return (
        original[:at] + inner + b"," + original[at:]
        if rng.random() < 0.2
        else original[:at] + inner + original[original.find(b",", at) :]
    )


def _replaced(rng: Random, document: Any) -> bytes:
    """Replace a value by a hostile text or number, written as JSON has it."""
    changed = mutations.replaced(rng, document, "@@")
    value = json.dumps(rng.choice(TEXTS)) if rng.random() < 0.5 else rng.choice(NUMBERS)
    return json.dumps(changed).replace('"@@"', value).encode()


def archive_damaged(rng: Random, original: bytes) -> bytes:
    """Return a damaged archive of arrays; a new one if there is none."""
    if not original:
        stream = io.BytesIO()
        np.savez(stream, fingerprint=np.array("x"), tried=np.array("[]"))
        original = stream.getvalue()
    return npz_damaged(rng, original)


def text_damaged(rng: Random, original: bytes) -> bytes:
    """Return a damaged text: other bytes, or controls."""
    data = damaged(rng, original)
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(TEXTS).encode(errors="surrogatepass") + data[at:]


def beside(
    name: str, file: str, damage: Callable[[Random, bytes], bytes], *commands: tuple[str, ...], share: float = 0.5
) -> CommandFamily:
    """Return the family of commands that find a damaged file in the folder of their results."""

    def case(rng: Random, folder: Path) -> CommandCase:
        path = folder / file
        original = path.read_bytes() if path.exists() else b""
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(damage(rng, original))
        return CommandCase(rng.choice(commands), outputs=("out", "new"), finished=("out",))

    return CommandFamily(f"results, {name}", case, commands, share)


REPORT, REPORT_ALL = ("report", RUN), ("report", "out", "--json")
AGAIN = ("run", SCENE, "-o", "out")
DOCUMENTS = (
    beside("run.json", f"{RUN}/run.json", json_damaged, REPORT, REPORT_ALL),
    beside(
        "bench.json",
        f"{RUN}/bench.json",
        json_damaged,
        REPORT,
        ("run", SCENE, "-o", "out", "--within", "1 h", "--dry-run"),
    ),
    beside("sweep.json", "out/sweep.json", json_damaged, REPORT_ALL),
    beside("report.html", f"{RUN}/report.html", text_damaged, REPORT, share=0.2),
    beside("scene.toml", f"{RUN}/scene.toml", text_damaged, REPORT, AGAIN, share=0.2),
    beside("interrupted rendering", PARTIAL, archive_damaged, ("render", SCENE, "-o", "out", "--force"), share=0.2),
)
