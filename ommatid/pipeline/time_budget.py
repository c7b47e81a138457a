"""Runs within a given time: two runs with few samples, then one with as many as the rest of the time allows.

All of them are ordinary runs in the scene's own folder but for page and run.json, which follow the last one: after an
interruption the next command goes on from what is there.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ommatid.batch.batch import Member
from ommatid.batch.remote import RunObserver, Stages
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.run_json import STAGES, ErrorReport, RequestedTime, RunReport, TimeReport
from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import read_text
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables import toml

from . import stages
from .stages import StageResults, finish, write_page
from .time_allocation import ErrorCurve, TimeAllocation, allocate_time, error_curve

FEW, MORE = 256, 1024  # samples per pixel of the two measuring runs
MOST = 2**20  # samples per pixel of either stage
RESERVE = 0.15  # fraction of the remaining time that is held in reserve, since times vary
FIRST_ROUND = 3.0  # cost of the first round of 'auto', in runs with FEW samples
COMPILATION = 1.0  # seconds that Mitsuba takes for a number of samples that it has not met
KEYS = ("render.samples", "calibration.samples")

Clock = Callable[[], float]
Samples = int | Literal["auto"]
Curves = tuple[ErrorCurve, ErrorCurve]


def stages_within(
    seconds: float,
    members: Sequence[Member],
    started: float,
    say: Callable[[str], None],
    scheduler: str = "",
    workers: int | None = None,
) -> Stages:
    """Choose the stages of `run` for scenes that have a time together, and run one after the other in this process.

    Raises InputError if `scheduler` or `workers` are given.
    """
    if scheduler or workers is not None:
        raise InputError("--within divides the time of this machine's one process; leave out --scheduler and --workers")
    return shared_time(seconds, [member.folder for member in members], started, say)


def check_within(setup: Setup, folder: Path) -> None:
    """Raise InputError for what would stop a run within a time after some work. Nothing is written."""
    stages.check_run(_with_samples(setup, FEW, FEW), folder)


def shared_time(
    seconds: float, folders: Sequence[Path], started: float, say: Callable[[str], None], clock: Clock = perf_counter
) -> Stages:
    """Create the stages of scenes that have `seconds` together, counted from `started`.

    folders : of the scenes, in the order in which they are run
    Each scene has an equal share of the time that is left, so that a scene that fails leaves its share to the others.
    """
    request = RequestedTime(seconds=seconds, scenes=len(folders))

    def run(setup: Setup, folder: Path, observer: RunObserver) -> dict[str, Any]:
        begun = started if request.scenes == 1 else clock()
        share = (seconds - (begun - started)) / (request.scenes - folders.index(folder))
        return run_within(setup, folder, observer, share, say, clock, begun, request)

    return run


def run_within(
    setup: Setup,
    folder: Path,
    observer: RunObserver,
    seconds: float,
    say: Callable[[str], None],
    clock: Clock = perf_counter,
    begun: float | None = None,
    request: RequestedTime | None = None,
) -> dict[str, Any]:
    """Run a scene with the samples that give the least expected error within `seconds`, and return its description.

    say : takes a message if the run took longer
    begun : when the time began to count; None: now
    request : the request that `seconds` are a share of; it identifies a repeated run, as shares vary
    """
    begun = clock() if begun is None else begun
    requested = RequestedTime(seconds=seconds, scenes=1) if request is None else request
    earlier = _earlier_run(folder, setup, requested)
    if earlier is not None:
        results = stages.results(_with_samples(setup, *_samples_of(earlier.chosen)), folder, observer)
        same = earlier.model_dump(include={"within", "asked", "seconds", "chosen"})
        return _finish(results, folder, observer, same)

    few = _measured_run(setup, FEW, folder, observer, clock)
    results, chosen = few.results, (FEW, FEW)
    page = _page_seconds(few.results, folder, observer, clock) if seconds - (clock() - begun) > 2 * few.wall else 0.0

    def left() -> float:
        return (1 - RESERVE) * (seconds - (clock() - begun)) - page

    remaining = left()
    if _needs_few_samples(setup):
        chosen, results = _adaptive_run(setup, folder, observer, few, remaining)
    elif remaining > 2 * few.wall:
        more = _measured_run(setup, MORE, folder, observer, clock)
        results, chosen = more.results, (MORE, MORE)
        allocation = _better(results.report.error, _fitted_curves(setup, few, more), left() - few.other - COMPILATION)
        if allocation is not None:
            chosen = allocation.render, allocation.calibrate
            results = stages.results(_with_samples(setup, *chosen), folder, observer)
    total = clock() - begun + page  # the final page is still to be written
    if total > seconds:
        fewest = ", the fewest possible" if chosen[0] == FEW else ""
        samples = f"{chosen[0]} and {chosen[1]} samples per pixel{fewest}"
        say(f"{folder}: took {total:.1f} s of {seconds:g} s with {samples}")
    spent = {"within": seconds, "asked": requested, "seconds": total, "chosen": dict(zip(KEYS, chosen, strict=True))}
    return _finish(results, folder, observer, spent)


def _with_samples(setup: Setup, rendering: Samples, calibration: Samples) -> Setup:
    """Set the numbers of samples, and remove the time limit of rendering."""
    render = setup.scene.render.model_copy(update={"samples": rendering, "time": None})
    calibrate = setup.scene.calibration.model_copy(update={"samples": calibration})
    return replace(setup, scene=with_tables(setup.scene, render=render, calibration=calibrate))


def _needs_few_samples(setup: Setup) -> bool:
    """Return True if grids of samples fit the pixels' edges, so that 'auto' reaches the noise floor at once."""
    scene, noise = setup.scene, setup.scene.noise
    noisy = noise is not None and noise.variance + noise.quantisation_variance != 0
    return setup.camera.has_box_footprints and scene.world is None and scene.render.sampler == "multijitter" and noisy


@dataclass(frozen=True)
class MeasuredRun:
    """A run and its duration.

    wall : seconds;  variance : of each stage's result, proportional to its part of the error
    """

    results: StageResults
    wall: float
    variance: dict[str, float]

    @property
    def report(self) -> RunReport:
        """Return the report of its stages."""
        return self.results.report

    def seconds(self, stage: str) -> float:
        """Return the time of a stage."""
        return self.report.stages[stage].seconds

    @property
    def sampled(self) -> float:
        """Seconds of the stages that take samples."""
        return sum(self.seconds(stage) for stage in STAGES)

    @property
    def other(self) -> float:
        """Seconds that do not depend on the number of samples."""
        return max(self.wall - self.sampled, self.seconds("reconstruct"))

    @property
    def outside_stages(self) -> float:
        """Seconds outside all stages."""
        return max(self.wall - self.sampled - self.seconds("reconstruct"), 0.0)


def _samples_of(chosen: Mapping[str, Samples]) -> tuple[Samples, Samples]:
    return chosen[KEYS[0]], chosen[KEYS[1]]


def _measured_run(setup: Setup, samples: int, folder: Path, observer: RunObserver, clock: Clock) -> MeasuredRun:
    start = clock()
    results = stages.results(_with_samples(setup, samples, samples), folder, observer)
    wall, model = clock() - start, results.model
    from_model = model.prior_variance_from_model(np.ones(model.unknowns)) if model.variance.any() else np.zeros(1)
    light = float(np.nanmean(results.stack.rendering_variance))
    return MeasuredRun(results, wall, {"render": light, "calibrate": float(np.nanmean(from_model))})


def _adaptive_run(
    setup: Setup, folder: Path, observer: RunObserver, few: MeasuredRun, remaining: float
) -> tuple[tuple[Samples, Samples], StageResults]:
    """Run with 'auto' if its first round fits into the remaining seconds, else keep the run with few samples."""
    if remaining <= FIRST_ROUND * few.sampled + few.seconds("reconstruct") + few.other:
        return (FEW, FEW), few.results
    return ("auto", "auto"), stages.results(_with_samples(setup, "auto", "auto"), folder, observer)


def _better(error: ErrorReport, curves: Curves, seconds: float) -> TimeAllocation | None:
    """Return the best allocation of these seconds if its predicted error is below the present one."""
    floor = error.predicted_mse - sum(error.budget[part] for part in STAGES.values())
    allocation = allocate_time(*curves, floor, seconds, (MOST, MOST))
    return allocation if allocation is not None and allocation.predicted_mse < error.predicted_mse else None


def _page_seconds(results: StageResults, folder: Path, observer: RunObserver, clock: Clock) -> float:
    """Write the page of the present results, and return the seconds that it took, as the final one will."""
    start = clock()
    write_page(results, folder, observer)
    return clock() - start


def _fitted_curves(setup: Setup, few: MeasuredRun, more: MeasuredRun) -> Curves:
    curves: list[ErrorCurve] = []
    for stage, part in STAGES.items():
        if stage == "calibrate" and setup.scene.calibration.method == "ideal":
            curves.append(ErrorCurve(part=0.0, samples=FEW, exponent=1.0, fixed=0.0, each=0.0))
            continue
        # The true image of a world is rendered outside the stages, with samples in proportion to those of rendering.
        with_truth = stage == "render" and setup.scene.world is not None
        points = [
            (samples, run.seconds(stage) + (run.outside_stages if with_truth else 0.0), run.variance[stage])
            for samples, run in ((FEW, few), (MORE, more))
        ]
        curves.append(error_curve(points[0], points[1], more.report.error.budget[part]))
    return curves[0], curves[1]


def _earlier_run(folder: Path, setup: Setup, requested: RequestedTime) -> TimeReport | None:
    """Return the times of the run in `folder` if it was of the same scene with the same request."""
    try:
        earlier = run_json.read(folder).spent
        scene = _with_samples(setup, *_samples_of(earlier.chosen)).resolved.plain()
        same_scene = toml.loads(read_text(folder / "scene.toml")) == scene
    except (InputError, OSError, ValueError, KeyError):
        return None
    return earlier if same_scene and earlier.asked == requested else None


def _finish(results: StageResults, folder: Path, observer: RunObserver, spent: dict[str, Any]) -> dict[str, Any]:
    """Write page and run.json with the request and the times, and return the description."""
    report = results.report.with_changes(spent=TimeReport.model_validate(spent))
    return finish(replace(results, report=report), folder, observer).plain()
