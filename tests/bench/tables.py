"""Bench tables with given numbers, for tests that read what `ommatid bench` writes."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from ommatid.bench.table import BenchTable, Cell, ConvergenceCurve, Recommendation, Stage
from ommatid.scenes.camera import Camera


def cell(stage: Stage = "render", **values: Any) -> Cell:
    """A cell of 16 independent samples with error, seconds and mean squared error 1, unless `values` say otherwise.

    These have no scatter, so that their quantiles are equal.
    """
    unit: dict[str, Any] = {
        **{"way": "independent", "samples": 16, "setting": "", "repeats": 5, "memory": None, "scatter": 0.05},
        **{"error": 1.0, "error_unit": "", "seconds": 1.0, "mse": 1.0},
        **values,
    }
    ends = {f"{name}_{end}": unit[name] for name in ("error", "seconds", "mse") for end in ("low", "high")}
    return Cell(stage=stage, **ends | unit)


def bench_table(
    camera: Camera, cells: Iterable[Cell], curves: Iterable[ConvergenceCurve] = (), why: str = ""
) -> BenchTable:
    """The bench table of a camera with these cells and curves; `why` explains its recommendation."""
    return BenchTable(
        title="",
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
        recommended=Recommendation(noise_floor=1.0, why=why),
        left_out=(),
    )
