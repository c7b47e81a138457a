"""Bench tables with given numbers, for tests that read what `ommatid bench` writes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from ommatid.bench.table import BenchTable, Cell, ConvergenceCurve, Quantiles, Recommendation, Stage
from ommatid.scenes.camera import Camera


def exactly(value: float) -> Quantiles:
    """Quantiles of a quantity without scatter."""
    return Quantiles(median=value, low=value, high=value)


def cell(stage: Stage = "render", **values: Any) -> Cell:
    """A cell of 16 independent samples with error, seconds and mean squared error 1, unless `values` say otherwise."""
    unit: dict[str, Any] = {
        "way": "independent",
        "variant": None,
        "samples": 16,
        "setting": "",
        "repeats": 5,
        "error": exactly(1.0),
        "seconds": exactly(1.0),
        "memory": None,
        "mse": exactly(1.0),
        "scatter": 0.05,
    }
    return Cell(stage=stage, **unit | values)


def bench_table(
    camera: Camera, cells: Iterable[Cell], curves: Iterable[ConvergenceCurve] = (), why: str = ""
) -> BenchTable:
    """The bench table of a camera with these cells and curves; `why` explains its recommendation."""
    return BenchTable(
        title="",
        scene="",
        fingerprint="",
        camera=json.loads(json.dumps(camera.describe())),
        machine={},
        versions={},
        against="the closed form",
        noise_deviation=1.0,
        budget=1.0,
        seconds=1.0,
        cells=tuple(cells),
        curves=tuple(curves),
        recommended=Recommendation(noise_floor=1.0, mse=None, reached=False, why=why),
        left_out=(),
    )
