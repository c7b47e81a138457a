"""Error against time: this run among the settings that `ommatid bench` measured for the same camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from ommatid.bench.slopes import pareto_front
from ommatid.bench.table import BenchTable, Cell

from ..data import Run
from .charts import ChartAxis, ChartSeries, chart

COLOURS = {"render": 1, "calibrate": 2, "reconstruct": 3}


@dataclass(frozen=True)
class TimePoint:
    """Run time of a stage with some setting, and mean squared error of the image with it."""

    stage: str
    setting: str
    seconds: float
    mse: float


def time_curves(run: Run, bench: BenchTable | None) -> tuple[Markup | str, str]:
    """Return the figure and its words, both empty if there is no bench or no measured error."""
    mse = run.report.error.mse
    if bench is None or mse is None:
        return "", ""
    points = [point for cell in bench.cells if (point := _point(cell)) is not None]
    stages = run.report.stages.items()
    own = [TimePoint(name, "this run", stage.seconds, mse) for name, stage in stages if stage.seconds > 0]
    said = _words(points, own, bench.recommended.why)
    return (_figure(points, own, said), said) if points else ("", "")


def _point(cell: Cell) -> TimePoint | None:
    if cell.mse is None or min(cell.seconds.median, cell.mse.median) <= 0:
        return None
    samples = f"{cell.samples} samples" if cell.samples else ""
    setting = ", ".join(word for word in (cell.way, samples, cell.setting, cell.variant) if word)
    return TimePoint(cell.stage, setting, cell.seconds.median, cell.mse.median)


def _figure(measured: Sequence[TimePoint], run: Sequence[TimePoint], said: str) -> Markup:
    """Draw mean squared error against time, one colour per stage, with Pareto fronts and this run's points."""
    series: list[ChartSeries] = []
    for stage, colour in COLOURS.items():
        points = [point for point in measured if point.stage == stage]
        if not points:
            continue
        front = pareto_front(points, lambda point: point.seconds, lambda point: point.mse)
        own = [point for point in run if point.stage == stage]
        series.append(ChartSeries("", *_columns(front), "line", colour))
        series.append(ChartSeries(stage, *_columns(points), "dots", colour))
        series.append(ChartSeries("", *_columns(own), "rings", colour))
    axes = ChartAxis("time of the stage (s)", True), ChartAxis("mean squared error", True)
    return chart("effort", *axes, series, said)


def _columns(points: Sequence[TimePoint]) -> tuple[list[float], list[float]]:
    return [point.seconds for point in points], [point.mse for point in points]


def _words(measured: Sequence[TimePoint], run: Sequence[TimePoint], advice: str) -> str:
    """Return how this run compares with the measured settings, and the recommendation."""
    sentences = [f"The mean squared error of this run is {run[0].mse:.4g}"] if run else []
    for own in run:
        others = [point for point in measured if point.stage == own.stage]
        if others:
            sentences.append(_comparison(own, others))
    if advice:
        sentences.append(f"Recommendation of the bench: {advice.removesuffix('.')}")
    return ". ".join(sentences) + "."


def _comparison(own: TimePoint, others: list[TimePoint]) -> str:
    better = [point for point in others if point.seconds <= own.seconds and point.mse < own.mse]
    took = f"The {own.stage} stage took {own.seconds:.3g} s"
    if not better:
        return f"{took}; no measured setting is both faster and more accurate"
    best = min(better, key=lambda point: point.mse)
    return f'{took}; the setting "{best.setting}" gives {best.mse:.4g} in {best.seconds:.3g} s'
