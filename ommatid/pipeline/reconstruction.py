"""A reconstruction from the files of a stack and a model, written together with its picture."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from ommatid.reconstruct.output import figures, result_files
from ommatid.reconstruct.output.run_json import RegionReport, RunReport
from ommatid.reconstruct.restore import check_region
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import check_output
from ommatid.runtime.pool import check_options, worker_pool
from ommatid.runtime.progress import Progress
from ommatid.runtime.versions import versions
from ommatid.runtime.workers import Workers
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.scene import TRUTH

Region = tuple[tuple[int, int], tuple[int, int]]


def reconstruct_files(
    stack: Path,
    model: Path,
    output: Path,
    changes: Sequence[str],
    lenses: Sequence[str],
    regions: Sequence[Region],
    progress: Progress,
    scheduler: str = "",
    workers: int | None = None,
) -> RunReport:
    """Reconstruct a stack with a model, and write the estimate (OpenEXR) and its picture.

    Returns the content of run.json, with the means of `regions`: row and column of the corner, rows and columns.
    Raises InputError for wrong files and options, MachineError for a full disk.
    """
    if output.suffix == ".png":
        raise InputError(f"{output}: expected the name of an OpenEXR file, such as {output.with_suffix('.exr')}")
    check_options(scheduler, workers)
    check_output(output, stack, model, stack.parent / TRUTH)
    recorded, calibrated = stack_file.read(stack), model_file.read(model)
    if lenses:
        recorded, calibrated = recorded.restrict(tuple(lenses)), calibrated.restrict(tuple(lenses))
    for region in regions:
        check_region(*region, recorded.camera.shape)
    recorded = result_files.with_estimator_changes(recorded, list(changes), stack)
    truth = result_files.truth_beside(stack, recorded)
    with _tile_workers(scheduler, workers) as pool:
        result, report = result_files.reconstruct(recorded, calibrated, truth, (stack, model), pool, progress)
    averages = tuple(
        RegionReport(corner=corner, size=size, mean=mean, deviation=deviation)
        for corner, size in regions
        for mean, deviation in [result.region(corner, size)]
    )
    if averages:
        report = report.with_changes(region=averages[0], regions=averages)
    result_files.write_estimate(output, result, {"title": recorded.scene.title})
    figures.write_estimate(output.with_suffix(".png"), result.estimate.reshape(result.shape))
    return report


@contextmanager
def _tile_workers(scheduler: str, count: int | None) -> Generator[Workers | None]:
    """Yield workers for the tiles of a frame; None where threads of this process solve them."""
    if not scheduler and count is None:
        yield None
        return
    with worker_pool(scheduler, count) as workers:
        workers.check_versions(partial(versions, "scipy"))
        yield workers
