"""index.html of a batch: every scene with its error, what failed and why, and measured against predicted error of all.

Where the batch is a sweep, `sweep.json` beside it lists the folders with the `values` of the keys that were varied.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from fractions import Fraction
from math import isfinite
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ommatid.batch.sweep_row import NUMBERS, read_rows
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.result_files import PICTURE
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, fingerprint, write_text
from ommatid.runtime.versions import versions

from .cached import REPORT, own_files, read_stamp

INDEX = "index.html"


@dataclass(frozen=True)
class BatchEntry:
    """A scene of a batch: what became of it, or why nothing did; numbers that are not known are None."""

    name: str
    title: str
    link: str = ""
    picture: str = ""
    mse: float | None = None
    predicted: float | None = None
    low: float | None = None
    high: float | None = None
    psnr: float | None = None
    ssim: float | None = None
    seconds: float | None = None
    failure: str = ""

    @property
    def agrees(self) -> bool | None:
        """Whether the measured error is one that theory expects; None where that cannot be told."""
        if self.mse is None or self.low is None or self.high is None:
            return None
        return self.low <= self.mse <= self.high


@dataclass(frozen=True)
class SweepTable:
    """Keys that were varied, and a row a scene: its page's link, the keys' values, measured and predicted error.

    The link is empty where the scene failed.
    """

    keys: tuple[str, ...]
    rows: list[tuple[str, tuple[str, ...], float | None, float | None]]


def cached_index(output: Path, folders: Mapping[Path, str]) -> bool:
    """Whether index.html of a batch had to be written; nothing is where the batch left no folder.

    folders : of the batch, in order, each with why it failed, else an empty text; other runs in `output` come after
    Raises DeniedError for a disk that is full.
    """
    if not output.is_dir():
        return False
    more = sorted(path.parent for path in output.glob(f"*/{REPORT}") if path.parent not in folders)
    found = [_entry(folder, folders.get(folder, "")) for folder in (*folders, *more)]
    swept = sweep_of(output / NUMBERS)
    told = [[asdict(entry) for entry in found], None if swept is None else asdict(swept)]
    stamp = fingerprint([told, versions("bokeh"), own_files()])
    name = output.resolve().name
    return cached(output / INDEX, stamp, read_stamp, lambda: page(found, swept, name, stamp), write_text)[1]


def _entry(folder: Path, failure: str) -> BatchEntry:
    if failure:
        return BatchEntry(folder.name, folder.name, failure=failure)
    try:
        run = run_json.read(folder)
        given = run.error.expected_given_truth
        return BatchEntry(
            name=folder.name,
            title=run.title or folder.name,
            link=quote(f"{folder.name}/{REPORT}"),
            picture=quote(f"{folder.name}/{PICTURE}"),
            mse=run.error.mse,
            predicted=run.error.predicted_mse,
            low=None if given is None else given.low,
            high=None if given is None else given.high,
            psnr=run.error.psnr,
            ssim=run.error.ssim,
            seconds=sum(stage.seconds for stage in run.stages.values()),
        )
    except InputError as wrong:
        return BatchEntry(folder.name, folder.name, failure=str(wrong))


def sweep_of(path: Path) -> SweepTable | None:
    """What sweep.json tells; None where there is none, or none that can be read."""
    try:
        listed = read_rows(path)
    except InputError:
        return None
    keys = tuple(dict.fromkeys(key for row in listed for key in row.values))
    rows = [
        (
            "" if row.failed is not None or row.folder is None else quote(f"{Path(row.folder).name}/{REPORT}"),
            tuple(str(row.values.get(key, "")) for key in keys),
            row.mse,
            row.predicted_mse,
        )
        for row in listed
    ]
    return SweepTable(keys, rows) if keys and rows else None


def page(entries: list[BatchEntry], swept: SweepTable | None, name: str, stamp: str) -> str:
    """The index as HTML; without figures where there is nothing to compare."""
    from .document import fill

    figures = _figures(entries, swept)
    content = {"entries": entries, "swept": swept, "title": f"Batch: {name}", "stamp": stamp, "words": words(entries)}
    content |= {"drawn": {drawn.name for drawn in figures}, "document": ""}
    if figures:
        from . import plots

        content["document"] = plots.document(figures)
    return fill("index.html", content)


def words(entries: list[BatchEntry]) -> str:
    """The batch in a sentence."""
    done = [entry for entry in entries if not entry.failure]
    told = [f"{len(done)} of {len(entries)} scenes are done"]
    judged = [entry for entry in done if entry.agrees is not None]
    if judged:
        agreeing = sum(bool(entry.agrees) for entry in judged)
        told.append(f"the error of {agreeing} of {len(judged)} is what theory expects of their picture")
    return "; ".join(told) + "."


def _figures(entries: list[BatchEntry], swept: SweepTable | None) -> list[Any]:
    known = [entry for entry in entries if entry.mse and entry.predicted]
    drawn = [_measured_against_predicted(known)] if len(known) > 1 else []
    series = _series(swept) if swept is not None else {}
    return [*drawn, _swept(swept.keys[0], series)] if swept is not None and series else drawn


def _measured_against_predicted(entries: list[BatchEntry]) -> Any:
    from . import plots

    drawn = plots.chart(
        "scenes",
        ("predicted mean squared error", "measured mean squared error"),
        x_axis_type="log",
        y_axis_type="log",
    )
    ends = [min(entry.predicted or 0 for entry in entries), max(entry.predicted or 0 for entry in entries)]
    drawn.line(ends, ends, line_dash="6 4", line_color=plots.SOFT)
    columns = {name: [getattr(entry, name) for entry in entries] for name in ("title", "mse", "predicted")}
    columns["low"] = [entry.low or entry.mse for entry in entries]
    columns["high"] = [entry.high or entry.mse for entry in entries]
    data = plots.source(columns, "scenes")
    drawn.segment(
        "predicted", "low", "predicted", "high", source=data, line_width=9, line_alpha=0.35, line_color=plots.SOFT
    )
    marks = drawn.scatter("predicted", "mse", source=data, size=10, color=plots.MARK)
    tips = [("scene", "@title"), ("predicted", "@predicted{%.4g}"), ("measured", "@mse{%.4g}")]
    plots.hover(drawn, [marks], tips, {"@predicted": "printf", "@mse": "printf"})
    return drawn


def _series(swept: SweepTable) -> dict[str, list[tuple[float, float, float]]]:
    """Value of the first key, measured and predicted error of what did not fail, a series a choice of the others.

    None where the first key's values are no numbers above 0, or only one.
    """
    found: dict[str, list[tuple[float, float, float]]] = {}
    for _, values, mse, predicted in swept.rows:
        if not predicted:
            continue
        number = _number(values[0])
        if number is None:
            return {}
        others = ", ".join(f"{key} {value}" for key, value in zip(swept.keys[1:], values[1:], strict=True))
        found.setdefault(others or "measured", []).append((number, mse or predicted, predicted))
    several = len({number for series in found.values() for number, _, _ in series}) > 1
    return {name: sorted(series) for name, series in found.items()} if several else {}


def _number(text: str) -> float | None:
    try:
        found = float(Fraction(text))
    except (ValueError, ZeroDivisionError):
        return None
    return found if isfinite(found) and found > 0 else None


def _swept(key: str, series: dict[str, list[tuple[float, float, float]]]) -> Any:
    from . import plots

    drawn = plots.chart("sweep", (key, "mean squared error"), x_axis_type="log", y_axis_type="log")
    for place, (name, points) in enumerate(series.items()):
        columns = dict(zip(("value", "mse", "predicted"), map(list, zip(*points, strict=True)), strict=True))
        data, colour = plots.source({**columns, "series": [name] * len(points)}, ""), plots.SERIES[place % 8]
        drawn.line("value", "predicted", source=data, line_color=colour, line_dash="6 4", legend_label=name)
        marks = drawn.scatter("value", "mse", source=data, color=colour, size=9, legend_label=name)
        tips = [("", "@series"), (key, "@value"), ("measured", "@mse{%.4g}"), ("predicted", "@predicted{%.4g}")]
        plots.hover(drawn, [marks], tips, {"@predicted": "printf", "@mse": "printf"})
    plots.legend(drawn, "top_left")
    return drawn
