"""The tables of a page: what ran, what was left out, geometry, seeds, versions, and what the run printed."""

from __future__ import annotations

from dataclasses import dataclass

from ommatid.analysis import depth_error, run_table, study
from ommatid.analysis.summary import describe as show
from ommatid.analysis.summary import skipped_words
from ommatid.reconstruct.output.run_json import StageReport
from ommatid.scenes.setup import Setup

from .data import Run

GAP = "\N{NO-BREAK SPACE}"


@dataclass(frozen=True)
class PageTable:
    """A caption, the names of columns, and rows whose first cell is their header."""

    caption: str
    header: tuple[str, ...]
    rows: list[tuple[str, ...]]


def plan(run: Run) -> PageTable:
    """What ran, how, and how long."""
    stages = run.description.stages
    total = sum(stage.seconds for stage in stages.values()) or 1.0
    rows = [
        (name, _how(name, stage, run), f"{stage.seconds:.3g}{GAP}s", f"{100 * stage.seconds / total:.0f}{GAP}%")
        for name, stage in stages.items()
    ]
    return PageTable("What ran", ("stage", "how", "time", "share"), rows)


def more_time(run: Run) -> PageTable | None:
    """What more samples would take and bring; None where nothing was rendered.

    The estimator is taken as it is. Of less noise another follows, which leans less on the prior and errs less.
    """
    spent = run.description.spent
    if not spent.more:
        return None
    here = ("as here", sum(spent.stages.values()), run.description.error.predicted_mse)
    known = [here, *((f"{more.times} times as many", more.seconds, more.predicted_mse) for more in spent.more)]
    rows = [(name, f"{seconds:.3g}{GAP}s", f"{mse:.4g}") for name, seconds, mse in known]
    rows.append(("without end", "", f"{spent.noise_alone:.4g}"))
    return PageTable("What more samples would bring", ("samples", "time", "squared error of this estimator"), rows)


def given_time(run: Run) -> str:
    """What became of the time that a run was given; nothing where it was given none."""
    spent = run.description.spent
    if spent.within is None:
        return ""
    chosen = ", ".join(f"{key} = {value}" for key, value in spent.chosen.items())
    taken = f"took {spent.seconds:.3g}{GAP}s with what it measured beforehand"
    return f"The run was given {spent.within:g}{GAP}s and {taken}; it chose {chosen}."


def _how(name: str, stage: StageReport, run: Run) -> str:
    told = [] if stage.method is None else [stage.method]
    if stage.samples is not None:
        told.append(run_table.samples_of(stage))
    told += [value for value in (stage.sampler, stage.variant) if value is not None]
    if name == "reconstruct":
        solver = run.description.solver
        told.append(f"{solver.method}: {solver.why}")
    return ", ".join(told)


def skipped(run: Run) -> PageTable:
    """What was not computed, and why."""
    rows = [(skip.what, skipped_words(skip.why, skip.bound)) for skip in run.description.skipped]
    return PageTable("What was left out", ("what", "why"), rows)


def geometry(run: Run) -> tuple[PageTable, list[tuple[str, str]]]:
    """A row a lens type, and the rest in names and values."""
    described = show(Setup(run.stack.scene, run.stack.camera), "", None)
    header = ("lens type", "magnification", "array", "pixels of a sub-image", "sees rows", "sees columns")
    header += ("focal length", "sensor behind lens", "measurements")
    rows = [
        (
            kind["name"],
            kind["magnification"],
            _times(kind["array"]),
            _times(kind["pixels"]),
            _range(kind["sees_rows"]),
            _range(kind["sees_columns"]),
            f"{kind['focal_length']:.4g} mm",
            f"{kind['sensor_depth']:.4g} mm",
            str(kind["measurements"]),
        )
        for kind in described["lens_types"]
    ]
    target, camera = described["target"], run.stack.camera
    facts = [
        ("target", f"{target['rows']} × {target['columns']} pixels, {target['height']:g} × {target['width']:g} mm"),
        ("distance", f"{target['distance']:g} mm"),
        ("pitch of sensor pixels", f"{1000 * camera.pixel_pitch:g} µm"),
        ("pitch of lenses", f"{camera.lens_pitch:g} mm"),
        *(
            (f"pixels seen by {count} lens types", str(seen))
            for count, seen in described["pixels_seen_by_fewer_types"].items()
        ),
        *(("edge", words) for words in described["where"]),
    ]
    return PageTable("Lens types", header, rows), facts


def _times(pair: list[int]) -> str:
    return f"{pair[0]}{GAP}×{GAP}{pair[1]}"


def _range(ends: list[float]) -> str:
    return f"{ends[0]:g} to {ends[1]:g}"


def numbers(run: Run) -> PageTable:
    """The table that `run` prints, without what stands elsewhere on the page."""
    rows = [
        (name.strip(), value)
        for name, value in run_table.rows(run.description)
        if not name.startswith("left out") and not name.startswith("    from ")
    ]
    return PageTable("The run in numbers", ("what", "how much"), list(rows))


def further(run: Run) -> list[PageTable]:
    """Error against distance, and the study, where there are any."""
    found: list[PageTable] = []
    if run.description.depth:
        rows = depth_error.rows(run.description.depth)
        found.append(PageTable("Error against distance", ("distance", "error"), list(rows)))
    if run.description.study:
        caption = "The same stack with other ideas of H"
        found.append(PageTable(caption, ("H", "error"), list(study.rows(run.description.study))))
    return found


def origins(run: Run) -> list[PageTable]:
    """Seeds and versions, from which the run can be repeated."""
    seeds = [(name, "none" if seed is None else str(seed)) for name, seed in run.description.seeds]
    versions = [(name, release) for name, release in run.description.versions.items()]
    return [PageTable("Seeds", ("of", "seed"), seeds), PageTable("Versions", ("package", "release"), versions)]
