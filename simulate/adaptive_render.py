"""Rendering with as many samples as the sensor's noise justifies: rounds of passes, one sub-imager at a time, until the
variance of their mean is below a tenth of the sensor's in every pixel.

A round renders those pixels of a sub-imager that need it (a stock sensor renders all), and its means and variances are
its own: earlier rounds only determine how many samples it takes. A pixel is done once its variance, estimated from 16
passes or more, is half of the allowed one, and rounds are planned for a quarter: so a variance that is underestimated
by chance lets no bad pixel pass, and few rounds need another. Through pinholes, stratified samples make the variance
fall like 1 / samples^1.5, since only those at the edges of pixels of f err; where the grid of samples fits these edges
none do, except rays that float32 rounds across an edge. The seeds of a sub-imager do not depend on the other ones.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from math import ceil, inf, log
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import posterior_variances

from .noise_target import allowed_variance
from .renderer.renderer import Renderer
from .renderer.variant import choose
from .sampling.checkpoint import Checkpoint, State
from .sampling.passes import (
    FEWEST_PASSES,
    MOST_SAMPLES,
    Plan,
    Tally,
    cells_of,
    on_grid,
    rounding_variance,
    samples_within,
)
from .sampling.seeds import sampler_seeds

DONE, AIM = 0.5, 0.25  # of the allowed variance: below which a pixel is done, and what a round is planned for
LEAST = 256  # samples per pixel of a first round, at least
MOST = 2**20  # samples per pixel of a round, at most
MOST_EXACT = 2**16  # samples per pixel of a pass whose sums are float64
MOST_PASSES = 1024  # of all rounds of a sub-imager: they number its seeds
EXPONENTS = {"independent": 1.0}  # of the fall of the variance with the samples of a pass, before it is measured
STRATIFIED = 1.5  # the same for all other samplers
STEEPEST = 2.0  # largest exponent that a measurement is trusted with
LEAPS = (2.0, 64.0)  # least and largest growth of the samples from one round to the next

REACHED = "reached"  # how a sub-imager ends; otherwise the reason why it could not:
TIME, SAMPLES, FLOAT32 = "render.time is over", "no more samples are taken", "float32 rounds as much"


@dataclass
class SubImagerProgress:
    """Progress of one sub-imager.

    next, last : plans of the next round and of the last one
    spent : samples of all rounds per pixel that was in each of them;  fewest : the same for the first pixel to be done
    rays : of all rounds;  seeds : number of passes so far
    scatter : variance of one pass of the last round, mean over the unfinished pixels
    exponent : of its fall with the samples of a pass;  ended : why the sub-imager ended, "" before that
    """

    next: Plan
    exponent: float
    last: Plan = field(default_factory=lambda: Plan(0, 0))
    rounds: int = 0
    spent: int = 0
    fewest: int = 0
    rays: int = 0
    seeds: int = 0
    scatter: float = 0.0
    ended: str = ""

    @staticmethod
    def from_json(values: dict[str, Any]) -> SubImagerProgress:
        """Create the progress from its fields in JSON's types."""
        fields: dict[str, Any] = {**values, **{name: Plan(**values[name]) for name in ("next", "last")}}
        return SubImagerProgress(**fields)

    def add_round(self, work: Plan, variance: FloatArray) -> None:
        """Account for a round, from its plan and the variances of its pixels' means."""
        scatter = _mean(variance) * work.passes
        if self.scatter > 0 and scatter > 0 and work.samples > self.last.samples:
            fall = log(self.scatter / scatter) / log(work.samples / self.last.samples)
            self.exponent = min(max(fall, 1.0), STEEPEST)
        self.last, self.rounds = work, self.rounds + 1
        self.spent, self.seeds, self.rays = (
            self.spent + work.total,
            self.seeds + work.passes,
            self.rays + work.total * variance.size,
        )

    def predicted_samples(self, factor: float, most: int) -> int:
        """Predict the samples per pixel that divide the variance by `factor`, in passes of at most `most`."""
        each = self.last.samples * (factor * self.last.passes / FEWEST_PASSES) ** (1 / self.exponent)
        total = FEWEST_PASSES * each
        if each > most:
            total = most * self.last.passes * factor * (self.last.samples / most) ** self.exponent
        fewest, largest = (leap * self.last.total for leap in LEAPS)
        return ceil(min(max(total, fewest), largest))


@dataclass(frozen=True)
class AdaptiveRendering:
    """Light on every sensor pixel, (M,), and its variance, shrunk and never below rounding, (M,).

    direct_only : True if interreflections in a world were left out, since nothing there reflects
    """

    mean: FloatArray
    variance: FloatArray
    details: dict[str, Any]
    direct_only: bool

    def stated_variance(self, camera: Camera) -> FloatArray:
        """Return the variance."""
        del camera
        return self.variance

    def record(self) -> dict[str, Any]:
        """Return the entries for the stack's record."""
        return self.details


def _mean(variance: FloatArray) -> float:
    known = variance[np.isfinite(variance)]
    return float(known.mean()) if known.size else 0.0


def render_until(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    clock: Callable[[], float] = perf_counter,
) -> AdaptiveRendering:
    """Render until every sub-imager's variance is small compared with the sensor's, or `render.time` is over.

    The first round is rendered whatever the time, so that every pixel has a value. Raises InputError if the sensor
    adds no noise, or if the requested variant does not work here.
    """
    scene = setup.scene
    allowed, variant = allowed_variance(setup), choose(scene.render.variant)
    world = None if scene.world is None else scene
    renderer = Renderer(setup.world.simulated, variant, scene.render.sampler, world=world)
    renderer.set_target(setup.world.image)
    rounds = AdaptiveRounds(setup, renderer, allowed)
    state = State() if checkpoint is None else checkpoint.state()
    rounds.resume(state)
    start = clock() - float(state.get("seconds", 0.0))
    limit = inf if scene.render.time is None else scene.render.time
    while unfinished := rounds.unfinished:
        for number, index in enumerate(unfinished):
            left = (limit - (clock() - start)) / (len(unfinished) - number)
            rounds.render_round(index, left, rounds.rays / max(clock() - start, 1e-9))
            if checkpoint is not None:
                # A whole state, so that an interruption within the next round finds it unchanged.
                state = {**rounds.state(), "seconds": np.array(clock() - start)}
                checkpoint.offer(lambda state=state: state)
            progress(1 - len(rounds.unfinished) / len(rounds.sub_imagers))
    progress(1.0)
    details = {"variant": variant, **rounds.record()}
    return AdaptiveRendering(rounds.mean, rounds.variance, details, renderer.direct_only)


class AdaptiveRounds:
    """The rounds of all sub-imagers: (M,) `mean` and `variance` of the last round of each."""

    def __init__(self, setup: Setup, renderer: Renderer, allowed: Callable[[FloatArray], FloatArray]) -> None:
        """Plan the first rounds. allowed : from the light, (M,), to the allowed variance, (M,)."""
        self._scene, self._camera, self._renderer, self._allowed = setup.scene, setup.camera, renderer, allowed
        self._slices = setup.camera.slices()
        self.mean, self.variance = np.zeros(setup.camera.measurements), np.zeros(setup.camera.measurements)
        self._open = np.ones(setup.camera.measurements, dtype=np.bool_)  # pixels that are not done
        exponent = EXPONENTS.get(setup.scene.render.sampler, STRATIFIED)
        self.sub_imagers = [SubImagerProgress(self._grid(index, LEAST), exponent) for index in range(len(self._slices))]

    @property
    def unfinished(self) -> list[int]:
        """Indices of the sub-imagers that have not ended."""
        return [index for index, sub in enumerate(self.sub_imagers) if not sub.ended]

    @property
    def rays(self) -> int:
        """Rays of all rounds."""
        return sum(sub.rays for sub in self.sub_imagers)

    def render_round(self, index: int, seconds: float = inf, speed: float = inf) -> None:
        """Render the next round of a sub-imager and plan the one after it, or end it.

        seconds : time limit of the round at `speed` rays per second; too little for a useful round ends it instead
        """
        sub, start = self.sub_imagers[index], self._slices[index].start
        pixels = np.flatnonzero(self._open[self._slices[index]])
        work = sub.next
        if sub.rounds and seconds < inf:
            work = self._affordable(index, seconds * speed / pixels.size)
            if work.total < LEAPS[0] * sub.last.total:
                self._end(index, TIME)
                return
        seed, first = self._scene.render.seed, sub.seeds
        tally = Tally(pixels.size)
        for values in self._renderer.expose_alone(
            index, pixels, work, lambda number: sampler_seeds(seed, "data", first + number, MOST_PASSES)(index)
        ):
            tally.add(values)
        floor = rounding_variance(tally.mean, self._renderer.float32_samples(work.samples))
        self.mean[start + pixels] = tally.mean
        self.variance[start + pixels] = np.maximum(posterior_variances(tally.variance, work.passes), floor)
        sub.add_round(work, tally.variance)
        self._plan_next(index, start + pixels)

    def _affordable(self, index: int, samples: float) -> Plan:
        """Return the next round's plan, or one of about `samples` per pixel if that is less."""
        wanted = self.sub_imagers[index].next
        if samples >= wanted.total:
            return wanted
        less = self._grid(index, max(int(samples), 1), wanted.samples)
        return less if less.total < wanted.total else wanted

    def _plan_next(self, index: int, rows: IntArray) -> None:
        """Determine which of the rendered pixels are not done, and the plan of their next round."""
        sub, allowed = self.sub_imagers[index], self._allowed(self.mean)[rows]
        # No number of samples gets below the rounding.
        fewest = self._renderer.float32_samples(self._grid(index, LEAST).samples)
        target = np.maximum(allowed, rounding_variance(self.mean[rows], fewest) / AIM)
        self._open[rows] = still = self.variance[rows] > DONE * target  # False for NaN: pixels that receive no light
        if not still.all() and not sub.fewest:
            sub.fewest = sub.spent
        if not still.any():
            self._end(index, FLOAT32)
            return
        values, variance, target = self.mean[rows][still], self.variance[rows][still], target[still]
        sub.scatter = _mean(variance) * sub.last.passes
        float64 = self._renderer.float32_samples(2) == 1
        most = MOST_EXACT if float64 else min(samples_within(values, AIM * target), MOST_SAMPLES)
        total = sub.predicted_samples(float((variance / (AIM * target)).max()), most)
        sub.next = self._grid(index, min(total, MOST), most)
        if sub.next.total < LEAPS[0] * sub.last.total or sub.seeds + sub.next.passes > MOST_PASSES:
            self._end(index, SAMPLES)

    def _end(self, index: int, why: str) -> None:
        """End a sub-imager: its target is reached, or it is not for the reason `why`."""
        sub, rows = self.sub_imagers[index], self._slices[index]
        beyond = self.variance[rows] > self._allowed(self.mean)[rows]
        sub.ended, sub.fewest = why if beyond.any() else REACHED, sub.fewest or sub.spent

    def _grid(self, index: int, samples: int, most: int = MOST_SAMPLES) -> Plan:
        """Return a plan that fits the edges of pixels of f, where the sampler can make use of it."""
        ratio = self._camera.sub_imagers[index].type.ratio
        return on_grid(samples, self._scene.render.sampler, cells_of(ratio), most)

    def state(self) -> State:
        """Return the arrays of a checkpoint."""
        courses = json.dumps([asdict(sub) for sub in self.sub_imagers])
        mean, variance, still = self.mean.copy(), self.variance.copy(), self._open.copy()
        return {"mean": mean, "variance": variance, "open": still, "courses": np.array(courses)}

    def resume(self, state: State) -> None:
        """Continue from a checkpoint, if it is not empty."""
        if state:
            self.mean, self.variance, self._open = state["mean"], state["variance"], state["open"]
            self.sub_imagers = [SubImagerProgress.from_json(values) for values in json.loads(str(state["courses"]))]

    def record(self) -> dict[str, Any]:
        """Return samples per pixel, rays of each sub-imager, and the sub-imagers that missed the target, with why."""
        named = {sub.name: progress for sub, progress in zip(self._camera.sub_imagers, self.sub_imagers, strict=True)}
        missed = {name: sub.ended for name, sub in named.items() if sub.ended != REACHED}
        return {
            "samples": max(sub.spent for sub in self.sub_imagers),
            "fewest_samples": min(sub.fewest for sub in self.sub_imagers),
            "rays": self.rays,
            "reached": not missed,
            "not_reached": missed,
            "spent": {name: sub.rays for name, sub in named.items()},
            "rounds": max(sub.rounds for sub in self.sub_imagers),
            "passes": max(sub.seeds for sub in self.sub_imagers),
            "first_seed": sampler_seeds(self._scene.render.seed, "data", 0, MOST_PASSES)(0),
        }
