"""The best result that fits into a time: two runs with few samples, then one with as many as the rest of it holds.

All of them are ordinary runs in the scene's own folder, so that a whole result stands there whatever happens.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

import numpy as np

from ommatid.batch.remote import RunObserver, Stages
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.run_json import ErrorReport, RequestedTime, RunReport, TimeReport
from ommatid.reconstruct.output.time_spent import STAGES
from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file, stack
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene, with_tables
from ommatid.scenes.setup import Setup

from . import bench_curves, stages, time_allocation

FEW = (256, 1024)  # samples of the runs that measure
MOST = 2**20  # samples of either stage
SPARE = 0.15  # of the time that is left: kept back, since measured times vary
KEYS = ("render.samples", "calibration.samples")
ROUND = 3.0  # times the least samples: what a first round of 'auto' takes
COMPILED = 1.0  # seconds for a number of samples that Mitsuba has not met

Clock = Callable[[], float]
Samples = int | Literal["auto"]


@dataclass(frozen=True)
class TimeRequest:
    """Seconds that several scenes have together, and how many these are."""

    seconds: float
    scenes: int = 1


def shared_time(
    seconds: float, folders: Sequence[Path], started: float, say: Callable[[str], None], clock: Clock = perf_counter
) -> Stages:
    """What is done of each of several scenes that have `seconds` together from `started` on: alike of what is left.

    folders : of the scenes, in the order in which they are done; one that fails leaves its share to the others
    """
    asked = TimeRequest(seconds, len(folders))

    def does(setup: Setup, folder: Path, watch: RunObserver) -> dict[str, Any]:
        begun = started if asked.scenes == 1 else clock()
        rest = (seconds - (begun - started)) / (asked.scenes - folders.index(folder))
        return run_within(setup, folder, watch, rest, say, clock, begun, asked)

    return does


def run_within(
    setup: Setup,
    folder: Path,
    watch: RunObserver,
    seconds: float,
    say: Callable[[str], None],
    clock: Clock = perf_counter,
    begun: float | None = None,
    asked: TimeRequest | None = None,
) -> dict[str, Any]:
    """What `run` does of a scene with the samples that bring most within `seconds`, and says of it.

    say : hears where even the least did not fit;  begun : when the time began to count, absent: now
    asked : what these seconds are a share of, which differs from run to run; absent: of nothing else
    """
    scene, camera = setup.scene, setup.camera
    begun = clock() if begun is None else begun
    told = asdict(TimeRequest(seconds) if asked is None else asked)
    again = _again(folder, setup, told)
    if again is not None:
        repeated = with_samples(setup, again.chosen[KEYS[0]], again.chosen[KEYS[1]])
        description = stages.results(repeated, folder, watch)
        same = again.model_dump(include={"within", "asked", "seconds", "chosen"})
        return _told(camera, folder, watch, description, same)
    few = _measured(with_samples(setup, FEW[0], FEW[0]), folder, watch, clock)
    chosen: tuple[Samples, Samples] = (FEW[0], FEW[0])
    page = _page(camera, folder, watch, clock) if seconds - (clock() - begun) > 2 * few.wall else 0.0
    description, left = few.description, (1 - SPARE) * (seconds - (clock() - begun)) - page
    sampled = sum(few.seconds(stage) for stage in STAGES)
    rest = max(few.wall - sampled, few.seconds("reconstruct"))
    if _needs_little(scene, camera):
        if left > ROUND * sampled + few.seconds("reconstruct") + rest:
            chosen = "auto", "auto"
            description = stages.results(with_samples(setup, *chosen), folder, watch)
    elif (curves := _of_bench(folder, scene, camera)) is not None or left > 2 * few.wall:
        if curves is None:
            more = _measured(with_samples(setup, FEW[1], FEW[1]), folder, watch, clock)
            chosen, description, curves = (FEW[1], FEW[1]), more.description, _curves(scene, few, more)
            left = (1 - SPARE) * (seconds - (clock() - begun)) - page
        division = _better(description.error, curves, left - rest - COMPILED)
        if division is not None:
            chosen = division.render, division.calibrate
            description = stages.results(with_samples(setup, *chosen), folder, watch)
    total = clock() - begun + page  # the last one is still to come
    if total > seconds:
        what = "even the least" if chosen[0] == FEW[0] else "this"
        say(f"{folder}: {what}, {chosen[0]} and {chosen[1]} samples a pixel, took {total:.1f} s of {seconds:g} s")
    spent = {"within": seconds, "asked": told, "seconds": total, "chosen": dict(zip(KEYS, chosen, strict=True))}
    return _told(camera, folder, watch, description, spent)


def with_samples(setup: Setup, rendering: Samples, calibration: Samples) -> Setup:
    """The setup with these numbers of samples, and no time that would end a stage."""
    scene = setup.scene
    render = scene.render.model_copy(update={"samples": rendering, "time": None})
    calibrate = scene.calibration.model_copy(update={"samples": calibration})
    return replace(setup, scene=with_tables(scene, render=render, calibration=calibrate))


def _needs_little(scene: Scene, camera: Camera) -> bool:
    """Whether grids of samples fit the edges of pixels of f, so that 'auto' comes to the noise floor at once."""
    noise = scene.noise
    silent = noise is None or noise.variance + noise.quantisation_variance == 0
    return camera.has_box_footprints and scene.world is None and scene.render.sampler == "multijitter" and not silent


@dataclass(frozen=True)
class MeasuredRun:
    """A run: what it says of itself, what it took, and variances that the stages' parts of the error go with."""

    description: RunReport
    wall: float
    variance: dict[str, float]

    def seconds(self, stage: str) -> float:
        """What a stage took, when it was done."""
        return self.description.stages[stage].seconds

    @property
    def beside(self) -> float:
        """What it took beside its stages, seconds."""
        return max(self.wall - sum(self.seconds(stage) for stage in (*STAGES, "reconstruct")), 0.0)


def _measured(setup: Setup, folder: Path, watch: RunObserver, clock: Clock) -> MeasuredRun:
    start = clock()
    description = stages.results(setup, folder, watch)
    wall = clock() - start
    found = model_file.read(folder / "model.npz")
    spread = found.prior_variance_from_model(np.ones(found.unknowns)) if found.variance.any() else np.zeros(1)
    light = stack.read(folder / "stack.exr").variance
    return MeasuredRun(description, wall, {"render": float(np.nanmean(light)), "calibrate": float(np.nanmean(spread))})


def _better(
    error: ErrorReport, curves: tuple[time_allocation.ErrorCurve, time_allocation.ErrorCurve], seconds: float
) -> time_allocation.TimeAllocation | None:
    """The best division of these seconds, if it promises less than this error."""
    floor = error.predicted_mse - sum(error.budget[part] for part in STAGES.values())
    found = time_allocation.allocate_time(*curves, floor, seconds, (MOST, MOST))
    return found if found is not None and found.predicted_mse < error.predicted_mse else None


def _page(camera: Camera, folder: Path, watch: RunObserver, clock: Clock) -> float:
    """Show what stands there, and the seconds that it took, as it will in the end."""
    start = clock()
    stages.write_page(camera, folder, watch)
    return clock() - start


def _of_bench(
    folder: Path, scene: Scene, camera: Camera
) -> tuple[time_allocation.ErrorCurve, time_allocation.ErrorCurve] | None:
    """Curves from the samples on that have been taken: `bench` begins with fewer than a scene can ask for."""
    found = bench_curves.bench_error_curves(folder, scene, camera)
    return None if found is None else (found[0].from_on(FEW[0]), found[1].from_on(FEW[0]))


def _curves(
    scene: Scene, few: MeasuredRun, more: MeasuredRun
) -> tuple[time_allocation.ErrorCurve, time_allocation.ErrorCurve]:
    found: list[time_allocation.ErrorCurve] = []
    for stage, part in STAGES.items():
        if stage == "calibrate" and scene.calibration.method == "ideal":
            found.append(time_allocation.ErrorCurve(0.0, FEW[0], 1.0, 0.0, 0.0))
            continue
        # What a world truly looks like is rendered with more samples when its sub-images are.
        truth = stage == "render" and scene.world is not None
        taken = [one.seconds(stage) + (one.beside if truth else 0.0) for one in (few, more)]
        ends = [(n, s, one.variance[stage]) for n, s, one in zip(FEW, taken, (few, more), strict=True)]
        found.append(time_allocation.error_curve(ends[0], ends[1], more.description.error.budget[part]))
    return found[0], found[1]


def _again(folder: Path, setup: Setup, asked: dict[str, Any]) -> TimeReport | None:
    """What an earlier run within the same time spent, if it was of the same scene among as many."""
    try:
        old = run_json.read(folder).spent
        now = with_samples(setup, old.chosen[KEYS[0]], old.chosen[KEYS[1]]).resolved.plain()
        same = old.asked == RequestedTime(**asked) and tomllib.loads((folder / "scene.toml").read_text("utf-8")) == now
    except (InputError, OSError, ValueError, KeyError):
        return None
    return old if same else None


def _told(
    camera: Camera, folder: Path, watch: RunObserver, report: RunReport, within: dict[str, Any]
) -> dict[str, Any]:
    """The description with what was spent, in run.json and on the run's page as well."""
    report = report.with_changes(spent=TimeReport.model_validate({**report.spent.plain(), **within}))
    run_json.write(folder, report)
    stages.write_page(camera, folder, watch)
    return report.plain()
