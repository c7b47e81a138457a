"""The files of a reconstruction: estimate.exr, which holds its report, too, and the pictures beside it."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.workers import Workers
from ommatid.runtime.files import UNREADABLE, cached, digest, fingerprint, write_whole
from ommatid.runtime.input_files import open_input
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.versions import origin
from ommatid.scenes.constants import WHITE
from ommatid.scenes.formats import exr
from ommatid.scenes.formats.picture import averaged
from ommatid.scenes.model import Model
from ommatid.scenes.scene import TRUTH, WORLD_PICTURE, with_changes
from ommatid.scenes.stack import Stack

from ..methods.method import Prepared
from ..restore import Reconstruction, check_camera, restore
from .estimate_formats import format_file
from .overview import OVERVIEW, write_overview
from .report import report_of
from .run_json import RUN, RegionReport, RunReport

Region = tuple[tuple[int, int], tuple[int, int]]  # row and column of the corner, rows and columns

ESTIMATE, PICTURE, STACK, BASELINES = "estimate.exr", "estimate.png", "stack.exr", "baselines.exr"
PNG_END = b"IEND\xaeB`\x82"
ESTIMATOR_TABLES = ("prior", "estimator", "tiles")


def with_estimator_changes(stack: Stack, overrides: list[str], path: Path) -> Stack:
    """Return a stack with other keys of its scene's estimator. Raises InputError for any other key.

    overrides : as KEY=VALUE;  path : of the stack, for error messages
    """
    if not overrides:
        return stack
    scene = with_changes(stack.scene.plain(), path, overrides, ())
    for override in overrides:
        table = override.partition("=")[0].split(".")[0].strip()
        if table not in ESTIMATOR_TABLES:
            raise InputError(
                f"--set: [{table}] is already recorded in {path}; here only {', '.join(ESTIMATOR_TABLES)} can be set"
            )
    changes = {table: getattr(scene, table) for table in ESTIMATOR_TABLES}
    return replace(stack, scene=stack.scene.model_copy(update=changes))


def truth_beside(path: Path, stack: Stack) -> FloatArray | None:
    """Read the target, (N,), from truth.exr in the stack's folder; None unless it is the one that was rendered.

    Where the world is finer than f and its picture stands beside it, that: (pixels of the world,).
    """
    truth = _channel(path.parent / TRUTH)
    if truth is None or digest(truth) != stack.record.get("truth"):
        return None
    world = None if stack.camera.detail == 1 or stack.scene.world is not None else _channel(path.parent / WORLD_PICTURE)
    if world is None or world.shape != stack.camera.world.shape:
        return truth.astype(np.float64).ravel()
    average = averaged(world.astype(np.float64), stack.camera.detail).astype(np.float32)
    return (world if np.array_equal(average, truth) else truth).astype(np.float64).ravel()


def _channel(path: Path) -> Float32Array | None:
    try:
        return exr.read(path)[0].channels["Y"]
    except (InputError, KeyError):
        return None


def reconstruct(
    stack: Stack,
    model: Model,
    truth: FloatArray | None,
    names: tuple[Path, Path],
    workers: Workers | None = None,
    progress: Progress = no_progress,
    prepared: Prepared | None = None,
    current: str = "",
    regions: Sequence[Region] = (),
) -> tuple[Reconstruction, RunReport]:
    """Return the reconstruction and the content of run.json, with its origin and the means over `regions`.

    names : of the files of stack and model, for error messages;  prepared : what frames of this model share
    current : fingerprint of everything that the result depends on
    Raises InputError if stack and model do not belong together.
    """
    check_camera(stack.camera, model, names)
    restoration = restore(stack, model, truth, workers, progress, prepared)
    means = tuple(
        RegionReport(corner=corner, size=size, mean=mean, deviation=deviation)
        for corner, size in regions
        for mean, deviation in [restoration.region(corner, size)]
    )
    added = {"fingerprint": current, **origin(), **({"regions": means} if means else {})}
    return restoration, report_of(stack, model, restoration).with_changes(**added)


def write_estimate(path: Path, restoration: Reconstruction, record: dict[str, Any]) -> None:
    """Write the maps of a reconstruction. Raises MachineError."""
    exr.write(path, [exr.Part("estimate", maps_of(restoration), record)])


def maps_of(restoration: Reconstruction) -> dict[str, Float32Array]:
    """Return `estimate`, `variance` (diagonal of Eq. 5) and, where it is known, `truth`: (rows, columns)."""
    channels = {"estimate": restoration.estimate, "variance": restoration.expected.variance}
    if restoration.truth is not None:
        channels["truth"] = restoration.truth
    return {name: values.reshape(restoration.shape).astype(np.float32) for name, values in channels.items()}


def read_estimate(path: Path) -> exr.Part:
    """Read what `write_estimate` wrote. Raises InputError for another file, and for values that no estimate has."""
    part = exr.read(path)[0]
    for name in ("estimate", "variance"):
        values = part.channels.get(name, np.zeros((0, 0), dtype=np.float32))
        if not np.isfinite(values).all() or (name == "variance" and values.min(initial=0.0) < 0):
            raise InputError(
                f"{path}: expected a finite estimate and variances of at least 0, got others; run the scene again"
            )
    return part


def check_run_folder(folder: Path) -> tuple[Path, ...]:
    """Return the files of a finished run in a folder. Raises InputError for a folder without them."""
    for name in (ESTIMATE, STACK, RUN):
        if not (folder / name).is_file():
            raise InputError(f"{folder}: expected the folder of a run, got one without {name}; run a scene first")
    return tuple(folder / name for name in (ESTIMATE, STACK, RUN))


def write_picture(path: Path, estimate: FloatArray) -> None:
    """Write an estimate, (rows, columns), as 8-bit PNG, one pixel each; values outside 0 to 255 are clipped."""
    from PIL import Image

    picture = Image.fromarray(np.clip(np.round(estimate), 0, WHITE).astype(np.uint8))
    write_whole(path, partial(picture.save, format="PNG"))


def write_results(folder: Path, stack: Stack, restoration: Reconstruction, report: RunReport) -> None:
    """Write the estimate and its pictures, the estimate last: where it is, all are there. Raises MachineError.

    Those of an earlier result are removed first, so that nothing of two results is ever in a folder.
    """
    if any((folder / name).exists() for name in (ESTIMATE, RUN)):
        formats = [format_file(folder / ESTIMATE, name).name for name in ("npy", "tiff16")]
        for name in (*formats, BASELINES, RUN, ESTIMATE):  # the estimate last: it tells that there was one
            (folder / name).unlink(missing_ok=True)
    write_picture(folder / PICTURE, restoration.estimate.reshape(restoration.shape))
    write_overview(folder, stack, maps_of(restoration), report)
    write_estimate(folder / ESTIMATE, restoration, record_of(report))


def record_of(report: RunReport) -> dict[str, Any]:
    """Return what an estimate's file says of it: by its fingerprint it is known to be up to date."""
    return {"title": report.title, "fingerprint": report.fingerprint, "report": report.plain()}


def read_report(path: Path) -> RunReport:
    """Read the report in an estimate's file. Raises InputError for another file, ValueError or KeyError without one."""
    report = RunReport.model_validate(read_estimate(path).record["report"])
    json.dumps(report.plain(), allow_nan=False)  # as run.json is written
    return report


def fingerprint_of(stack: Stack, model: Model, truth: FloatArray | None, regions: Sequence[Region] = ()) -> str:
    """Fingerprint of everything that a result depends on; truth : the target, None if it is not known."""
    entries = () if model.stored is None else (model.stored.data, model.stored.indices, model.stored.indptr)
    fitted = () if model.fitted is None else model.fitted.determining
    arrays = (stack.values, stack.rendering_variance, *entries, model.variance, model.batches, *fitted)
    of_estimate = fingerprint([digest(*arrays), [stack.record, model.record], stack.scene.plain(), truth is not None])
    return fingerprint([of_estimate, regions]) if regions else of_estimate


def read_results(folder: Path) -> tuple[RunReport, str | None]:
    """Return the report of the estimate in a folder, and its fingerprint if the pictures beside it are whole."""
    report = read_report(folder / ESTIMATE)
    return report, report.fingerprint if all(_is_whole(folder / name) for name in (PICTURE, OVERVIEW)) else None


def check_results(folder: Path, fingerprint: str) -> None:
    """Raise InputError unless a folder holds a whole estimate of this fingerprint, with its pictures."""
    try:
        made_from = read_results(folder)[1]
    except InputError:
        raise
    except UNREADABLE:
        made_from = None
    if made_from != fingerprint:
        raise InputError(
            f"{folder}: {ESTIMATE} or a picture of it is damaged or of another result than {RUN}; run the scene again"
        )


def _is_whole(picture: Path) -> bool:
    """Return True if a PNG file has its end: a copy that was cut short has none."""
    with open_input(picture) as stream:
        stream.seek(-len(PNG_END), os.SEEK_END)
        return stream.read() == PNG_END


def cached_results(
    folder: Path,
    stack: Stack,
    model: Model,
    names: tuple[Path, Path],
    progress: Progress = no_progress,
    workers: Workers | None = None,
    regions: tuple[Region, ...] = (),
    force: bool = False,
) -> tuple[RunReport, bool]:
    """Return the report of the estimate in a folder, and True if it was made: if needed, or by `force`."""
    truth = truth_beside(names[0], stack)
    current = fingerprint_of(stack, model, truth, regions)

    def make() -> tuple[Reconstruction, RunReport]:
        return reconstruct(stack, model, truth, names, workers, progress, None, current, regions)

    return cached(folder, current, read_results, make, lambda _, made: write_results(folder, stack, *made), force)
