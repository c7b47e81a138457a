"""Runs within a given time: one with few samples, then others with as many as the rest of the time allows.

All of them are ordinary runs in the scene's own folder but for page and run.json, which follow the last one: after an
interruption the next command goes on from what is there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any, Literal

from ommatid.batch.remote import RunObserver
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.run_json import STAGES, RequestedTime, TimeReport
from ommatid.runtime.errors import InputError
from ommatid.runtime.input_files import read_text
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables import toml

from . import stages
from .stages import StageResults, finish, write_page

FEW = 256  # samples per pixel of the first run
MOST = 2**20  # samples per pixel of either stage
RESERVE = 0.15  # fraction of the remaining time that is held in reserve, since times vary
COMPILATION = 1.0  # seconds that Mitsuba takes for a number of samples that it has not met
FIRST_ROUND = 3.0  # cost of the first round of 'auto', in runs with FEW samples
LEAST_FACTOR = 2.0  # by which a further run has to raise the samples of a stage
NEGLIGIBLE = 0.005  # share of the expected error that rendering and calibration may leave
KEYS = ("render.samples", "calibration.samples")

Clock = Callable[[], float]
Samples = int | Literal["auto"]


@dataclass(frozen=True)
class TimeBudget:
    """The stages of scenes that have `seconds` together, counted from `started`, with the least expected errors.

    They run one after the other in this process. Each has an equal share of the time that is left, so that a scene that
    fails leaves its share to the others.

    folders : of the scenes, in the order in which they are run;  say : takes a message if a run took longer
    force : True to make again what is up to date;  baselines : True to compare with other methods, in further time
    """

    seconds: float
    folders: Sequence[Path]
    started: float
    say: Callable[[str], None]
    clock: Clock = perf_counter
    force: bool = False
    baselines: bool = False

    def __call__(self, setup: Setup, folder: Path, observer: RunObserver) -> dict[str, Any]:
        """Run a scene, and return its description; a repeated run is known by the request, as shares vary."""
        clock, request = self.clock, RequestedTime(seconds=self.seconds, scenes=len(self.folders))
        begun = self.started if request.scenes == 1 else clock()
        seconds = (self.seconds - (begun - self.started)) / (request.scenes - self.folders.index(folder))
        force = self.force
        earlier = None if force else _earlier_run(folder, setup, request)
        if earlier is not None:
            results = stages.results(_with_samples(setup, *_samples_of(earlier)), folder, observer)
            return self._finished(results, earlier, folder, observer)
        samples: tuple[Samples, Samples] = (FEW, FEW)
        page = 0.0
        while True:
            start = clock()
            results = stages.results(_with_samples(setup, *samples), folder, observer, force)
            force = False
            wall = clock() - start
            if page == 0.0 and seconds - (clock() - begun) > 2 * wall:  # as long as the final one will take
                start = clock()
                write_page(results, folder, observer)
                page = clock() - start
            rest = (1 - RESERVE) * (seconds - (clock() - begun)) - page
            more = _more_samples(results, samples, wall, rest - COMPILATION)
            if more is None:
                break
            samples = more
        total = clock() - begun + page  # the final page is still to be written
        if total > seconds:
            fewest = ", the fewest possible" if samples == (FEW, FEW) else ""
            counts = f"{samples[0]} and {samples[1]} samples per pixel{fewest}"
            self.say(f"{folder}: took {total:.1f} s of {seconds:g} s with {counts}")
        chosen: dict[str, Samples] = dict(zip(KEYS, samples, strict=True))
        limit = {"within": seconds, "asked": request, "seconds": total, "chosen": chosen}
        return self._finished(results, results.report.spent.model_copy(update=limit), folder, observer)

    def _finished(
        self, results: StageResults, spent: TimeReport, folder: Path, observer: RunObserver
    ) -> dict[str, Any]:
        """Write page and run.json of results with these times, and return the content of run.json."""
        timed = replace(results, report=results.report.with_changes(spent=spent))
        return finish(timed, folder, observer, self.baselines).plain()


def _more_samples(
    results: StageResults, samples: tuple[Samples, Samples], wall: float, seconds: float
) -> tuple[Samples, Samples] | None:
    """Return the samples of a further run of these seconds, None where it would bring little.

    wall : seconds of the last run
    Where grids of samples fit the pixels' edges, 'auto' reaches the noise floor at once, if its first round fits.
    The true image of a world is rendered outside the stages, with samples in proportion to those of rendering.
    """
    report, known = results.report, results.report.stages
    times = [known[stage].seconds for stage in STAGES]
    other = max(wall - sum(times), known["reconstruct"].seconds)
    if results.stack.scene.world is not None:
        times[0] += other - known["reconstruct"].seconds
        other = known["reconstruct"].seconds
    parts = [report.error.budget.get(part, 0.0) for part in STAGES.values()]
    render, calibrate = samples
    if sum(parts) <= NEGLIGIBLE * report.error.predicted_mse or render == "auto" or calibrate == "auto":
        return None
    if _needs_few_samples(results.stack):
        return ("auto", "auto") if seconds > FIRST_ROUND * sum(times) + 2 * other else None
    factors = allocate(parts, times, seconds - other, report.fall)
    more = min(int(factors[0] * render), MOST), min(int(factors[1] * calibrate), MOST)
    return more if more[0] >= LEAST_FACTOR * render or more[1] >= LEAST_FACTOR * calibrate else None


def _needs_few_samples(stack: Stack) -> bool:
    """Return True if grids of samples fit the pixels' edges, and the sensor has noise."""
    scene, noise = stack.scene, stack.scene.noise
    noisy = noise is not None and noise.variance + noise.quantisation_variance != 0
    return stack.camera.has_box_footprints and scene.world is None and scene.render.sampler == "multijitter" and noisy


def allocate(parts: Sequence[float], times: Sequence[float], seconds: float, fall: float) -> tuple[float, float]:
    """Return the factors x >= 1 on the samples of two stages with the least error within a time.

    parts, times : of the stages with the present samples;  fall : exponent with which their parts fall
    The error sum P x^-a with sum t x = T is least where x is proportional to (P / t)^(1 / (1 + a)).
    """
    weights = [(part / time) ** (1 / (1 + fall)) if time > 0 else 0.0 for part, time in zip(parts, times, strict=True)]
    total = sum(weight * time for weight, time in zip(weights, times, strict=True))
    first, second = (weight * max(seconds, 0.0) / total if total > 0 else 1.0 for weight in weights)
    if first < 1:
        first, second = 1.0, (seconds - times[0]) / times[1] if weights[1] else 1.0
    elif second < 1:
        first, second = (seconds - times[1]) / times[0] if weights[0] else 1.0, 1.0
    return max(first, 1.0), max(second, 1.0)


def _with_samples(setup: Setup, rendering: Samples, calibration: Samples) -> Setup:
    """Set the numbers of samples, and remove the time limit of rendering."""
    render = setup.scene.render.model_copy(update={"samples": rendering, "time": None})
    calibrate = setup.scene.calibration.model_copy(update={"samples": calibration})
    return replace(setup, scene=with_tables(setup.scene, render=render, calibration=calibrate))


def _samples_of(spent: TimeReport) -> tuple[Samples, Samples]:
    return spent.chosen[KEYS[0]], spent.chosen[KEYS[1]]


def _earlier_run(folder: Path, setup: Setup, requested: RequestedTime) -> TimeReport | None:
    """Return the times of the run in `folder` if it was of the same scene with the same request."""
    try:
        earlier = run_json.read(folder).spent
        scene = _with_samples(setup, *_samples_of(earlier)).resolved.plain()
        same_scene = toml.loads(read_text(folder / "scene.toml")) == scene
    except (InputError, OSError, ValueError, KeyError):
        return None
    return earlier if same_scene and earlier.asked == requested else None
