"""Rendering until it is good enough: rounds of passes, a sub-imager at a time, until the variance of their mean lies
below a tenth of the sensor's in every pixel.

A round renders those pixels of a sub-imager that need it (a stock sensor renders all), and its means and variances are
its own: what was rendered before only says how many samples it takes. A pixel is done once its variance, as stated by
16 passes or more, is half of what is allowed, and rounds are planned for a quarter: so a variance that happens to be
stated too small lets no pixel pass that is not good enough, and few rounds need another. Through pinholes stratified
samples make it fall like 1 / samples^1.5, since only those at the edges of pixels of f err; where the grid of samples
fits these edges none do, but for rays that float32 rounds over an edge. A sub-imager's seeds are its own: what the
others need changes none of its numbers.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from math import ceil, inf, log
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances

from .noise_target import Allowed, allowed_variance
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

Vector = NDArray[np.float64]

DONE, AIM = 0.5, 0.25  # of what is allowed: where a pixel's variance lets it be, where a round's is planned to lie
LEAST = 256  # samples a pixel of a first round, at least
MOST = 2**20  # samples a pixel of a round, at most
MOST_EXACT = 2**16  # samples a pixel of a pass whose sums are float64
MOST_PASSES = 1024  # of all rounds of a sub-imager: they number its seeds
EXPONENTS = {"independent": 1.0}  # of the fall of the variance with the samples of a pass, before it is known
STRATIFIED = 1.5  # the same of all other samplers
STEEPEST = 2.0  # that is believed
LEAPS = (2.0, 64.0)  # from the samples of a round to those of the next

REACHED = "reached"  # how a sub-imager ends; else by what it could not go on:
TIME, SAMPLES, FLOAT32 = "render.time is over", "no more samples are taken", "float32 rounds as much"


@dataclass
class SubImagerProgress:
    """How far one sub-imager is.

    next, last : plans of the round that comes and of the one before
    spent : samples of all rounds for a pixel that was in each of them;  fewest : the same for one that was done first
    rays : of all rounds;  seeds : how many passes have had theirs
    scatter : variance of one pass of the last round, mean over the pixels that go on
    exponent : with which that falls as a pass grows;  ended : why it does not go on, "" while it does
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
    def read(kept: dict[str, Any]) -> SubImagerProgress:
        """Out of its fields, as JSON holds them."""
        plans = {name: Plan(**kept[name]) for name in ("next", "last")}
        return replace(SubImagerProgress(plans["next"], kept["exponent"]), **{**kept, **plans})

    def take(self, work: Plan, variance: Vector) -> None:
        """Take note of a round: its plan, and the variances of its pixels' means."""
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

    def foreseen(self, too_large: float, most: int) -> int:
        """Samples a pixel that divide the variance by `too_large`, at most so many of them in a pass."""
        each = self.last.samples * (too_large * self.last.passes / FEWEST_PASSES) ** (1 / self.exponent)
        total = FEWEST_PASSES * each
        if each > most:
            total = most * self.last.passes * too_large * (self.last.samples / most) ** self.exponent
        fewest, largest = (leap * self.last.total for leap in LEAPS)
        return ceil(min(max(total, fewest), largest))


@dataclass(frozen=True)
class AdaptiveRendering:
    """Light on every sensor pixel, (M,), and its variance, moderated and never below rounding, (M,).

    straight : whether light that bounces in a world was left out, since nothing there reflects any
    """

    mean: Vector
    variance: Vector
    how: dict[str, Any]
    straight: bool

    def stated(self, camera: Camera) -> Vector:
        """The variance as it is."""
        del camera
        return self.variance

    def record(self) -> dict[str, Any]:
        """What the stack's record says of it."""
        return self.how


def _mean(variance: Vector) -> float:
    known = variance[np.isfinite(variance)]
    return float(known.mean()) if known.size else 0.0


def render_until(
    setup: Setup,
    progress: Progress = no_progress,
    partial: Checkpoint | None = None,
    clock: Callable[[], float] = perf_counter,
) -> AdaptiveRendering:
    """Render until every sub-imager's variance is small beside the sensor's, or `render.time` is over.

    The first round is rendered whatever the time, so that every pixel has a value. Raises InputError where the scene
    has no noise to aim at, or if the variant asked for does not work here.
    """
    scene = setup.scene
    allowed, variant = allowed_variance(setup), choose(scene.render.variant)
    rig = Renderer(
        setup.simulated,
        variant,
        scene.render.sampler,
        around=None if scene.world is None else scene,
    )
    rig.set_target(setup.image)
    rounds = AdaptiveRounds(setup, rig, allowed)
    state = State() if partial is None else partial.state()
    rounds.resume(state)
    start = clock() - float(state.get("seconds", 0.0))
    limit = inf if scene.render.time is None else scene.render.time
    while going := rounds.going:
        for number, place in enumerate(going):
            left = (limit - (clock() - start)) / (len(going) - number)
            rounds.one_more(place, left, rounds.rays / max(clock() - start, 1e-9))
            if partial is not None:
                state = {**rounds.state(), "seconds": np.array(clock() - start)}  # whole, wherever the next one stops
                partial.offer(lambda state=state: state)
            progress(1 - len(rounds.going) / len(rounds.courses))
    progress(1.0)
    return AdaptiveRendering(rounds.mean, rounds.variance, {"variant": variant, **rounds.record()}, rig.straight)


class AdaptiveRounds:
    """The rounds of all sub-imagers: (M,) `mean` and `variance` of the last of each."""

    def __init__(self, setup: Setup, rig: Renderer, allowed: Allowed) -> None:
        """Before the first."""
        scene, camera = setup.scene, setup.camera
        self._scene, self._camera, self._rig, self._allowed = scene, camera, rig, allowed
        self._places = camera.slices()
        self.mean, self.variance = np.zeros(camera.measurements), np.zeros(camera.measurements)
        self._open = np.ones(camera.measurements, dtype=np.bool_)  # pixels that go on
        exponent = EXPONENTS.get(scene.render.sampler, STRATIFIED)
        self.courses = [SubImagerProgress(self._grid(place, LEAST), exponent) for place in range(len(self._places))]

    @property
    def going(self) -> list[int]:
        """The places of the sub-imagers that have not ended."""
        return [place for place, course in enumerate(self.courses) if not course.ended]

    @property
    def rays(self) -> int:
        """Of all rounds."""
        return sum(course.rays for course in self.courses)

    def one_more(self, place: int, seconds: float = inf, speed: float = inf) -> None:
        """The next round of a sub-imager, and whether and how it goes on after it.

        seconds : that it may take, at `speed` rays a second; where too little fits into them there is no round
        """
        course, start = self.courses[place], self._places[place].start
        which = np.flatnonzero(self._open[self._places[place]])
        work = course.next
        if course.rounds and seconds < inf:
            work = self._fitting(place, seconds * speed / which.size)
            if work.total < LEAPS[0] * course.last.total:
                self._end(place, TIME)
                return
        seed, first = self._scene.render.seed, course.seeds
        tally = Tally(which.size)
        for values in self._rig.expose_alone(
            place, which, work, lambda number: sampler_seeds(seed, "data", first + number, MOST_PASSES)(place)
        ):
            tally.add(values)
        floor = rounding_variance(tally.mean, self._rig.summed(work.samples))
        self.mean[start + which] = tally.mean
        self.variance[start + which] = np.maximum(shrink_variances(tally.variance, work.passes), floor)
        course.take(work, tally.variance)
        self._judge(place, start + which)

    def _fitting(self, place: int, samples: float) -> Plan:
        """The next round's plan, or one of about so many samples a pixel where that is less."""
        wanted = self.courses[place].next
        if samples >= wanted.total:
            return wanted
        less = self._grid(place, max(int(samples), 1), wanted.samples)
        return less if less.total < wanted.total else wanted

    def _judge(self, place: int, which: NDArray[np.intp]) -> None:
        """Which of the pixels go on that were rendered, and with what plan."""
        course, allowed = self.courses[place], self._allowed(self.mean)[which]
        # Below what rounding leaves no samples reach.
        fewest = self._rig.summed(self._grid(place, LEAST).samples)
        target = np.maximum(allowed, rounding_variance(self.mean[which], fewest) / AIM)
        self._open[which] = still = self.variance[which] > DONE * target  # of pixels without light nothing is known
        if not still.all() and not course.fewest:
            course.fewest = course.spent
        if not still.any():
            self._end(place, FLOAT32)
            return
        values, variance, target = self.mean[which][still], self.variance[which][still], target[still]
        course.scatter = _mean(variance) * course.last.passes
        most = MOST_EXACT if self._rig.summed(2) == 1 else min(samples_within(values, AIM * target), MOST_SAMPLES)
        total = course.foreseen(float((variance / (AIM * target)).max()), most)
        course.next = self._grid(place, min(total, MOST), most)
        if course.next.total < LEAPS[0] * course.last.total or course.seeds + course.next.passes > MOST_PASSES:
            self._end(place, SAMPLES)

    def _end(self, place: int, why: str) -> None:
        """No more rounds: the goal is reached, or not for this reason."""
        course, pixels = self.courses[place], self._places[place]
        beyond = self.variance[pixels] > self._allowed(self.mean)[pixels]
        course.ended, course.fewest = why if beyond.any() else REACHED, course.fewest or course.spent

    def _grid(self, place: int, samples: int, most: int = MOST_SAMPLES) -> Plan:
        """A plan that fits the edges of pixels of f, where the sampler can make use of it."""
        ratio = self._camera.sub_imagers[place].type.ratio
        return on_grid(samples, self._scene.render.sampler, cells_of(ratio), most)

    def state(self) -> State:
        """All of it, to be kept."""
        courses = json.dumps([asdict(course) for course in self.courses])
        mean, variance, still = self.mean.copy(), self.variance.copy(), self._open.copy()
        return {"mean": mean, "variance": variance, "open": still, "courses": np.array(courses)}

    def resume(self, state: State) -> None:
        """Go on where a kept one stopped, if there is one."""
        if state:
            self.mean, self.variance, self._open = state["mean"], state["variance"], state["open"]
            self.courses = [SubImagerProgress.read(one) for one in json.loads(str(state["courses"]))]

    def record(self) -> dict[str, Any]:
        """Samples a pixel of all rounds, rays of each sub-imager, and which missed the goal, and why."""
        subs = [sub.name for sub in self._camera.sub_imagers]
        missed = {name: one.ended for name, one in zip(subs, self.courses, strict=True) if one.ended != REACHED}
        return {
            "samples": max(course.spent for course in self.courses),
            "fewest_samples": min(course.fewest for course in self.courses),
            "rays": self.rays,
            "reached": not missed,
            "not_reached": missed,
            "spent": {name: course.rays for name, course in zip(subs, self.courses, strict=True)},
            "rounds": max(course.rounds for course in self.courses),
            "passes": max(course.seeds for course in self.courses),
            "first_seed": sampler_seeds(self._scene.render.seed, "data", 0, MOST_PASSES)(0),
        }
