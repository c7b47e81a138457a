"""Tables of a page: stages, skipped effects, geometry, all numbers, seeds and versions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ommatid.analysis import depth_error, study
from ommatid.analysis.summary import describe, sections
from ommatid.reconstruct.output.facts import baseline_rows, facts, on_topic, skipped_words
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables import toml

from .data import Run

ELSEWHERE = "left out", "  from ", "MSE "  # beginnings of facts that other tables of the page show


@dataclass(frozen=True)
class PageTable:
    """A caption, the column headers, and rows whose first cell is the row header."""

    caption: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def stages(run: Run) -> PageTable:
    """Return time and method of every stage, how a time limit was used, and what more samples would bring."""
    return PageTable("Stages of this run", ("stage", "time"), [fact.row for fact in on_topic(run.report, "stage")])


def skipped(run: Run) -> PageTable:
    """Return the effects and computations that were skipped, with the reasons."""
    rows = [(skipped.what, skipped_words(skipped.why, skipped.bound)) for skipped in run.report.skipped]
    return PageTable("Skipped effects", ("effect", "reason"), rows)


def geometry(scene: Scene, camera: Camera) -> tuple[PageTable, list[tuple[str, ...]]]:
    """Return a table of the lens types, and names and values of the other dimensions."""
    (_, dimensions), (_, lenses), *_ = sections(describe(Setup(scene, camera), "", None))
    header, *rows = lenses
    return PageTable("Lens types", header, rows), list(dimensions)


def numbers(run: Run) -> PageTable:
    """Return the facts that the page does not show elsewhere."""
    rows = [
        (fact.name.strip(), fact.words)
        for fact in facts(run.report)
        if fact.topic is None and not fact.name.startswith(ELSEWHERE)
    ]
    return PageTable("Other numbers", ("quantity", "value"), rows)


def further(run: Run) -> list[tuple[str, PageTable]]:
    """Return names and tables of error against distance and of the study, where the run has them."""
    tables: list[tuple[str, PageTable]] = []
    if run.report.depth:
        rows = depth_error.rows(run.report.depth)
        tables.append(("Depth", PageTable("Error against distance", ("distance", "error"), rows)))
    if run.report.study:
        rows = study.rows(run.report.study)
        tables.append(("Study", PageTable("The same stack with other models of H", ("H", "error"), rows)))
    return tables


def baselines(report: RunReport) -> PageTable:
    """Return the errors of the estimate and of the baselines, the least first."""
    header = ("method", "mean squared error", "PSNR", "SSIM", "time")
    return PageTable("The same stack by other methods", header, baseline_rows(report))


def origins(run: Run) -> list[PageTable]:
    """Return seeds and versions, which are needed to repeat the run."""
    seeds = [(name, "none" if seed is None else str(seed)) for name, seed in run.report.seeds]
    versions = list(run.report.versions.items())
    return [
        PageTable("Seeds", ("random numbers", "seed"), seeds),
        PageTable("Versions", ("package", "version"), versions),
    ]


def made(report: RunReport) -> list[tuple[str, str]]:
    """Return date, command and host of a run, as far as run.json has them."""
    known = [("date", report.date), ("command", " ".join(report.command)), ("host", report.host)]
    return [(name, value) for name, value in known if value]


def scene_text(scene: Scene) -> str:
    """Return a scene as the text of a scene file, defaults included."""
    return toml.dumps(scene.plain())
