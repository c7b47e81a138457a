"""Error against time: this run on the curves of a bench of the same camera, or the seconds of its stages alone.

The curves stand in bench.json: a list of `cells`, each a stage done in one way with its `seconds` and the mean squared
error of the reconstruction, `mse`, that this brings, both with their median.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ommatid.analysis.pareto import pareto_front
from ommatid.bench.table import bench_files

from . import plots
from .data import Run

COLOURS = {"render": "#d9660b", "calibrate": "#1b9e77", "reconstruct": "#7570b3"}
MARKS = {"render": "circle", "calibrate": "triangle", "reconstruct": "square"}


@dataclass(frozen=True)
class TimePoint:
    """A setting of a stage: what it took and what error it brought."""

    stage: str
    setting: str
    seconds: float
    mse: float


@dataclass(frozen=True)
class TimeCurves:
    """A bench's points and those of this run, and in words what the bench recommends."""

    points: list[TimePoint]
    run: list[TimePoint]
    advice: str


def bench_of(folder: Path, camera: dict[str, Any]) -> dict[str, Any] | None:
    """bench.json in a run's folder or the one above, if it is whole and of the same camera; else None."""
    for path in bench_files(folder):
        try:
            found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            same = found["camera"] == json.loads(json.dumps(camera))
        except (OSError, ValueError, KeyError, TypeError):
            continue
        if same:
            return found
    return None


def time_curves(run: Run, bench: dict[str, Any] | None) -> TimeCurves | None:
    """A bench as curves, with this run on them; None where there is no bench or it tells nothing."""
    mse = run.description.error.mse
    if bench is None or mse is None:
        return None
    try:
        points = [point for cell in bench["cells"] if (point := _point(cell)) is not None]
        advice = str(bench.get("recommended", {}).get("why", ""))
    except (KeyError, TypeError, AttributeError, ValueError):
        return None
    stages = run.description.stages
    here = [TimePoint(name, "this run", stage.seconds, mse) for name, stage in stages.items() if stage.seconds > 0]
    return TimeCurves(points, here, advice) if points else None


def _point(cell: dict[str, Any]) -> TimePoint | None:
    if not cell.get("mse") or not cell.get("seconds"):
        return None
    seconds, mse = float(cell["seconds"]["median"]), float(cell["mse"]["median"])
    if min(seconds, mse) <= 0:
        return None
    samples = f"{cell['samples']} samples" if cell.get("samples") else ""
    told = [str(cell.get("way") or ""), samples, str(cell.get("setting") or ""), str(cell.get("variant") or "")]
    return TimePoint(str(cell["stage"]), ", ".join(word for word in told if word), seconds, mse)


def figure(found: TimeCurves) -> Any:
    """Mean squared error against seconds, a colour a stage, with each stage's front and this run's points."""
    drawn = plots.chart("effort", ("seconds of the stage", "mean squared error"), x_axis_type="log", y_axis_type="log")
    marks: list[Any] = []
    for stage, colour in COLOURS.items():
        points = [point for point in found.points if point.stage == stage]
        here = [point for point in found.run if point.stage == stage]
        if not points:
            continue
        edge = pareto_front(points, lambda point: point.seconds, lambda point: point.mse)
        drawn.line(
            [point.seconds for point in edge], [point.mse for point in edge], line_color=colour, line_width=2,
            legend_label=stage,
        )  # fmt: skip
        for listed, more in ((points, {"size": 7, "alpha": 0.75}), (here, {"size": 18})):
            marker = MARKS[stage] if listed is points else "star"
            marks.append(
                drawn.scatter(
                    "seconds", "mse", source=_source(listed), marker=marker, color=colour, legend_label=stage, **more
                )
            )
    tips = [("stage", "@stage"), ("setting", "@setting"), ("seconds", "@seconds{%.3g}"), ("error", "@mse{%.4g}")]
    plots.hover(drawn, marks, tips, {"@seconds": "printf", "@mse": "printf"})
    plots.legend(drawn, "top_right")
    return drawn


def _source(points: list[TimePoint]) -> Any:
    return plots.source({name: [getattr(point, name) for point in points] for name in TimePoint.__annotations__}, "")


def words(found: TimeCurves) -> str:
    """Where this run lies among the bench's settings, and what the bench recommends."""
    told = [f"This run's mean squared error is {found.run[0].mse:.4g}"] if found.run else []
    told += [_place(own, [point for point in found.points if point.stage == own.stage]) for own in found.run]
    return ". ".join(sentence for sentence in told if sentence) + "." + (f" {found.advice}" if found.advice else "")


def _place(own: TimePoint, others: list[TimePoint]) -> str:
    if not others:
        return ""
    taken = f"{own.stage.capitalize()} took {own.seconds:.3g} s"
    better = [point for point in others if point.seconds <= own.seconds and point.mse < own.mse]
    if not better:
        return f"{taken}, and nothing that was measured is both faster and better"
    best = min(better, key=lambda point: point.mse)
    return f"{taken}; {best.setting} brought {best.mse:.4g} in {best.seconds:.3g} s"
