"""Error curves from the results of `ommatid bench` for the same camera, if they are beside a run's results."""

from __future__ import annotations

from pathlib import Path

from ommatid.bench.table import BenchTable, Stage, bench_tables
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.simulate.renderer.variant import choose

from .time_allocation import ErrorCurve


def bench_error_curves(folder: Path, scene: Scene, camera: Camera) -> tuple[ErrorCurve, ErrorCurve] | None:
    """Return the curves of rendering and calibration from the run's folder or its parent, None if there are none."""
    sampler, variant = scene.render.sampler, choose(scene.render.variant)
    for table in bench_tables(folder, camera.describe()):
        render = _curve(table, "render", sampler, variant)
        calibrate = _curve(table, "calibrate", f"{scene.calibration.method}, {sampler}", variant)
        if render is not None and calibrate is not None:
            return render, calibrate
    return None


def _curve(table: BenchTable, stage: Stage, way: str, variant: str) -> ErrorCurve | None:
    """Return the error curve of one method of a stage, None if fewer than two of its cells were measured."""
    counted = [one for one in table.cells if one.counted]
    cells = sorted(
        (one.samples, one.seconds.median, one.mse.median)
        for one in counted
        if (one.stage, one.way, one.variant) == (stage, way, variant)
        and one.mse is not None
        and one.samples is not None
    )
    alike = [one.slope for one in table.curves if (one.stage, one.way, one.variant) == (stage, way, variant)]
    slopes = [slope for slope in alike if slope is not None]
    if len(cells) < 2 or not slopes:
        return None
    (few, before, mse), (many, after, _) = cells[0], cells[-1]
    floor = min(one.mse.median for one in counted if one.mse is not None)
    each = max((after - before) / (many - few), 0.0)
    # Twice the slope: of a variance, not of a deviation.
    return ErrorCurve(max(mse - floor, 0.0), few, -2 * slopes[0], max(before - each * few, 0.0), each)
