"""Curves that `ommatid bench` has measured of the same camera, where its results stand beside a run's."""

from __future__ import annotations

import json
from pathlib import Path

from ommatid.bench.table import BenchTable, Stage, bench_files, read
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.simulate.renderer.variant import choose

from .time_allocation import ErrorCurve


def bench_error_curves(folder: Path, scene: Scene, camera: Camera) -> tuple[ErrorCurve, ErrorCurve] | None:
    """Of rendering and of calibration, from the file in the run's folder or the one above; None where none serves."""
    for path in bench_files(folder):
        try:
            table = read(path)
        except InputError:
            continue
        sampler, variant = scene.render.sampler, choose(scene.render.variant)
        found = (
            _curve(table, "render", sampler, variant),
            _curve(table, "calibrate", f"{scene.calibration.method}, {sampler}", variant),
        )
        same = table.camera == json.loads(json.dumps(camera.describe()))
        if same and found[0] is not None and found[1] is not None:
            return found[0], found[1]
    return None


def _curve(table: BenchTable, stage: Stage, way: str, variant: str) -> ErrorCurve | None:
    """None where the stage was not measured in that way."""
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
