"""Tables of a page: stages, effect of more samples, skipped effects, geometry, all numbers, seeds and versions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ommatid.analysis import depth_error, study
from ommatid.analysis.lens_table import lens_rows
from ommatid.analysis.summary import describe
from ommatid.reconstruct.output.facts import baseline_rows, facts, samples_of, skipped_words
from ommatid.reconstruct.output.run_json import RunReport, StageReport
from ommatid.reconstruct.output.verdict_words import is_trusted
from ommatid.scenes.camera import Camera
from ommatid.scenes.geometry.optical_terms import optical_terms
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables import toml

from .data import Run

ELSEWHERE = "left out", "  from ", "MSE "  # beginnings of facts that other tables of the page show
NBSP = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class PageTable:
    """A caption, the column headers, and rows whose first cell is the row header."""

    caption: str
    header: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]


def stages(run: Run) -> PageTable:
    """Return method and time of every stage."""
    known = run.report.stages
    total = run.report.seconds or 1.0
    rows = [
        (name, _method(name, stage, run), _seconds(stage.seconds), f"{100 * stage.seconds / total:.0f}{NBSP}%")
        for name, stage in known.items()
    ]
    return PageTable("Stages of this run", ("stage", "method", "time", "share"), rows)


def _method(name: str, stage: StageReport, run: Run) -> str:
    words = [] if stage.method is None else [stage.method]
    if stage.samples is not None:
        words.append(samples_of(stage))
    words += [value for value in (stage.sampler, stage.variant) if value is not None]
    if name == "reconstruct":
        words.append(f"{run.report.solver.method}: {run.report.solver.why}")
    return ", ".join(words)


def _seconds(value: float) -> str:
    return f"{value:.3g}{NBSP}s"


def more_samples(run: Run) -> PageTable | None:
    """Return run time and predicted error with more samples, None if nothing was rendered or the run is not trusted.

    The error is that of this run's estimator. The optimal one for less noise relies less on the prior and is better.
    """
    more_samples = run.report.more_samples
    if not more_samples or not is_trusted(run.report):
        return None
    present = ("as in this run", run.report.seconds, run.report.error.predicted_mse)
    known = [present, *((f"{more.times} times as many", more.seconds, more.predicted_mse) for more in more_samples)]
    rows = [(name, _seconds(seconds), f"{mse:.4g}") for name, seconds, mse in known]
    rows.append(("unlimited", "", f"{run.report.noise_alone:.4g}"))
    header = ("samples", "time", "mean squared error with this estimator")
    return PageTable("Predicted error with more samples", header, rows)


def time_limit(run: Run) -> str:
    """Return how a run with a time limit used it, or an empty string."""
    spent = run.report.spent
    if spent.within is None:
        return ""
    chosen = ", ".join(f"{key} = {value}" for key, value in spent.chosen.items())
    return (
        f"Time limit: {spent.within:g}{NBSP}s. The run took {_seconds(spent.seconds or 0.0)}"
        f" including trial measurements, and chose {chosen}."
    )


def skipped(run: Run) -> PageTable:
    """Return the effects and computations that were skipped, with the reasons."""
    rows = [(skipped.what, skipped_words(skipped.why, skipped.bound)) for skipped in run.report.skipped]
    return PageTable("Skipped effects", ("effect", "reason"), rows)


def geometry(scene: Scene, camera: Camera) -> tuple[PageTable, list[tuple[str, str]]]:
    """Return a table of the lens types, and names and values of the other dimensions."""
    described, terms = describe(Setup(scene, camera), "", None), optical_terms(scene, camera)
    types = described["lens_types"]
    target = described["target"]
    facts = [
        ("target", f"{target['rows']} × {target['columns']} pixels, {target['height']:g} × {target['width']:g} mm"),
        ("distance of the target", f"{target['distance']:g} mm"),
        ("area of the sensor that records", f"{terms.sensor_area:.4g} mm², {camera.measurements} pixels"),
        ("pitch of the sensor pixels", f"{1000 * camera.pixel_pitch:g} µm"),
        ("pitch of the lenses", f"{camera.lens_pitch:g} mm"),
        *(
            (f"pixels seen by only {count} of {len(camera.types)} lens types", str(pixels))
            for count, pixels in described["pixels_seen_by_fewer_types"].items()
        ),
        *(("edge of the target", words) for words in described["where"]),
    ]
    return PageTable("Lens types", ("lens type", *(lens["name"] for lens in types)), lens_rows(types)), facts


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


def held_out(rows: Sequence[tuple[str, str]]) -> PageTable:
    """Return the numbers of the held-out check below its verdict and its prior, which the page shows elsewhere."""
    return PageTable("Largest deviations", ("quantity", "value"), [(name.strip(), value) for name, value in rows[2:]])


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
