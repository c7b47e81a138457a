"""Error curves of a camera's stages from the results of `ommatid bench`, if they are beside a run's."""

from __future__ import annotations

from pathlib import Path

from ommatid.bench.table import BenchTable, Stage, bench_tables
from ommatid.scenes.setup import Setup
from ommatid.simulate.renderer.variant import choose

from .time_allocation import ErrorCurve


def bench_error_curves(folder: Path, setup: Setup) -> tuple[ErrorCurve, ErrorCurve] | None:
    """Return the curves of rendering and calibration from bench.json in the run's folder or its parent.

    Returns None if there is none of the same camera, sampler, variant and calibration method.
    """
    sampler, variant = setup.scene.render.sampler, choose(setup.scene.render.variant)
    for table in bench_tables(folder, setup.camera.describe()):
        render = _curve(table, "render", sampler, variant)
        calibrate = _curve(table, "calibrate", f"{setup.scene.calibration.method}, {sampler}", variant)
        if render is not None and calibrate is not None:
            return render, calibrate
    return None


def _curve(table: BenchTable, stage: Stage, way: str, variant: str) -> ErrorCurve | None:
    """Return the curve of a stage; None if fewer than two cells of it were measured."""
    wanted = (stage, way, variant)
    counted = [cell for cell in table.cells if cell.counted]
    cells = sorted(
        (cell.samples, cell.seconds.median, cell.mse.median)
        for cell in counted
        if (cell.stage, cell.way, cell.variant) == wanted and cell.mse is not None and cell.samples is not None
    )
    curves = [curve for curve in table.curves if (curve.stage, curve.way, curve.variant) == wanted]
    slopes = [curve.slope for curve in curves if curve.slope is not None]
    if len(cells) < 2 or not slopes:
        return None
    (few, few_seconds, mse), (many, many_seconds, _) = cells[0], cells[-1]
    floor = min(cell.mse.median for cell in counted if cell.mse is not None)
    each = max((many_seconds - few_seconds) / (many - few), 0.0)
    # The slope is that of a standard deviation; a variance decreases twice as fast.
    return ErrorCurve(max(mse - floor, 0.0), few, -2 * slopes[0], max(few_seconds - each * few, 0.0), each)
