"""Surroundings of a run that must not change its result, and what the result is."""

from __future__ import annotations

import os
import re
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.conftest import TINY, interpreter
from tests.modules import ROOT
from tests.runs import content

# Wall clock of 2001 that goes back by an hour whenever it is read.
BACKWARDS = "import itertools, time\ntime.time = (1e9 - 3600.0 * n for n in itertools.count()).__next__\n"
VARYING = {
    r"[0-9a-f]{64}": "fingerprint",
    r"\d{4}-\d\d-\d\dT[\d:+]+": "date",
    r"<(td|dd)>[\d.e+-]+\s(s|ms|min|%)(?=\s|<)": "time",
    r"(?<=[ (])[\d.e+-]+\ss(?=[,.)<])": "time",
    r"<code>ommatid run .*?</code>": "command",
}
OF_THE_MACHINE = ("versions", "fingerprint", "sha256", "seal")


@dataclass(frozen=True)
class Variation:
    """Surroundings of a run: variables, Python code before it, and shell commands."""

    name: str
    variables: Mapping[str, str] = field(default_factory=dict[str, str])
    before: str = ""
    shell: str = ""
    folder: str = "."


# What cannot be told together: threads and processors, streams, homes and locales.
VARIATIONS = (
    Variation("again"),
    Variation("1 thread", {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}),
    Variation("1 processor", before="import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"),
    Variation("locale C without UTF-8", {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}),
    Variation("closed streams", shell="exec <&- >&- 2>&-;"),
    Variation("no home", {"HOME": "/dev/null/home"}),
    Variation("a path of 3900 bytes", folder="/".join(["d" * 200] * 18)),
)
EVERYTHING = Variation(
    "everything at once",
    {"OMP_NUM_THREADS": "2", "OPENBLAS_NUM_THREADS": "2", "TZ": "Pacific/Kiritimati", "PYTHONHASHSEED": "7"}
    | {"LC_ALL": "tr_TR.UTF-8", "TERM": "dumb", "NO_COLOR": "1", "COLUMNS": "10", "PYTHONOPTIMIZE": "2"},
    before=BACKWARDS,
    shell="umask 077; ulimit -n 64;",
    folder="größe #1 100% ? 'x' \"y\"/" + "/".join(["d" * 200] * 16),
)


def run(variation: Variation, base: Path, options: Sequence[str] = ()) -> Path:
    """Run the tiny scene below `base`, and return the folder of its result. Raises CalledProcessError if it fails."""
    folder = base / variation.folder
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tiny.toml").write_text(TINY, encoding="utf-8")
    words = [*interpreter(variation.before), "run", "tiny.toml", "-o", "out", *options]
    command = ["sh", "-c", f'{variation.shell} exec "$@"', "sh", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variation.variables}
    subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return folder / "out" / "tiny"


def result(folder: Path) -> dict[str, Any]:
    """Everything that a run wrote, without times, dates, the command and versions."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    for pattern, word in VARYING.items():
        page = re.sub(pattern, word, page)
    return {name: _plain(value) for name, value in content(folder).items()} | {"report.html": page}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items() if key not in OF_THE_MACHINE}  # pyright: ignore
    return [_plain(inner) for inner in value] if isinstance(value, list) else value  # pyright: ignore
