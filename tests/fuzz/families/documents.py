"""Files that a command finds in a folder of results: reports, tables, pages and interrupted work."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

from ommatid.batch.sweep_row import SweepRow, write_rows
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read

from ...bench.tables import bench_table, cell
from .. import mutations
from ..damage import Engine, damaged, words_exchanged
from ..family import PARTIAL, RUN, SCENE, CommandCase, CommandFamily
from ..formats import npz_damaged

TEXTS = (
    "\x1b[31mred\x1b[0m", "\x1b]0;title\x07", "\u202eleft", "\x9b2J", "a\x00b", "\ud800", "x" * 100000, "=1+1",
    "<script>",
)  # fmt: skip
NUMBERS = ("1" + "0" * 5000, "-" + "9" * 5000, "1e400", "-1e400", "NaN", "Infinity", "1e-400", "0.1" * 2)
words = words_exchanged(rb"[\s:,\[\]{}]+", *NUMBERS, *map(json.dumps, TEXTS), *mutations.DEEP)


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
    if choice < 0.1:
        text = original.decode()
        return rng.choice(
            (text.encode("utf-16"), b"\xef\xbb\xbf" + original, text.replace('"', '"\xff').encode("latin-1"), b"")
        )
    return json.dumps(mutations.record(rng, json.loads(original))).encode() if choice < 0.4 else words(rng, original)


def text_damaged(rng: Random, original: bytes) -> bytes:
    """Return a damaged text: other bytes, or controls."""
    data = damaged(rng, original)
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.choice(TEXTS).encode(errors="surrogatepass") + data[at:]


def beside(name: str, file: str, damage: Engine, *commands: tuple[str, ...], share: float = 0.5) -> CommandFamily:
    """Return the family of commands that find a damaged file in the folder of their results."""

    def case(rng: Random, folder: Path) -> CommandCase:
        path = folder / file
        path.write_bytes(damage(rng, path.read_bytes() if path.exists() else b""))
        return CommandCase(rng.choice(commands), outputs=("out", "new"), finished=("out",))

    return CommandFamily(f"results, {name}", case, commands, share)


REPORT, REPORT_ALL = ("report", RUN), ("report", "out", "--json")
AGAIN = ("run", SCENE, "-o", "out")
DOCUMENTS = (
    beside("run.json", f"{RUN}/run.json", json_damaged, REPORT, REPORT_ALL),
    beside("bench.json", f"{RUN}/bench.json", json_damaged, REPORT, (*AGAIN, "--within", "1 h", "--dry-run")),
    beside("sweep.json", "out/sweep.json", json_damaged, REPORT_ALL),
    beside("report.html", f"{RUN}/report.html", text_damaged, REPORT, share=0.2),
    beside("scene.toml", f"{RUN}/scene.toml", text_damaged, REPORT, AGAIN, share=0.2),
    beside("interrupted rendering", PARTIAL, npz_damaged, ("render", SCENE, "-o", "out", "--force"), share=0.2),
)
