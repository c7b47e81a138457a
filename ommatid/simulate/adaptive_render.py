"""Rendering with as many samples as the sensor's noise justifies: rounds of passes, one sub-imager at a time, until the
variance of their mean is below a tenth of the sensor's in every pixel.

A round renders those pixels of a sub-imager that need it (a stock sensor renders all), and its means and variances are
its own: earlier rounds only determine how many samples it takes. A pixel is done once its variance, estimated from 16
passes or more, is half of the allowed one, and rounds are planned for a quarter: so a variance that is underestimated
by chance lets no bad pixel pass, and few rounds need another. A round takes at most four times the samples of the last
one: few pixels need as many as the worst one, and the others are done before. Through pinholes, stratified samples make
the variance fall like 1 / samples^1.5, since only those at the edges of pixels of f err. Where a grid of samples fits
these edges none do: such sub-imagers begin with two passes of that grid, one sample per pixel of f (`sampling.passes`),
and are done where these agree. Through displaced pinholes the averages of the picture over each pixel are exact
(`renderer.averages`). Behind lenses points are Sobol's (`renderer.draws`) unless another sampler than the default is
asked for. Behind thin lenses the picture is averaged over each pixel exactly (`renderer.averages`), and only the point
spread is sampled. Behind surfaces a ray has four numbers and more: measured, the variance of Sobol's points is 1.5 to
1.8 times lower than multijitter's at 256 samples in a pass, 1.9 to 2.3 times at 1024 and 3.1 to 3.3 times at 4096, in
the same time. The seeds of a sub-imager do not depend on the other ones.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from math import ceil, exp, inf
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from ommatid.runtime.arrays import FloatArray, IntArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.constants import WHITE
from ommatid.scenes.recording import expected_recording_of, flat_values
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import posterior_variances

from .renderer.variant import choose
from .sampling.checkpoint import Checkpoint, State
from .sampling.passes import (
    AVERAGED,
    LEAPS,
    MOST_SAMPLES,
    Plan,
    Rendering,
    SampleLaw,
    Tally,
    cells_of,
    exact_plan,
    on_grid,
    rounding_variance,
    samples_within,
)
from .sampling.samplers import SOBOL
from .world_view import rendered_world

if TYPE_CHECKING:
    from .renderer.renderer import Points, Renderer

DONE, AIM = 0.5, 0.25  # of the allowed variance: below which a pixel is done, and what a round is planned for
LEAST = 256  # samples per pixel of a first round, at least
MOST_FIRST = 2**14  # and at most
DARK = WHITE / 16  # light whose noise counts for it
MOST = 2**20  # samples per pixel of a round, at most,
LEAP = 4  # and relative to the last one
MOST_EXACT = 2**16  # samples per pixel of a pass whose sums are float64
MOST_PASSES = 1024  # of all rounds of a sub-imager: they number its seeds
TABULATED = 1e-5  # of the light of a white target, deviation by the tables that rays of a point spread are drawn from
REACHED = "reached"  # how a sub-imager ends; otherwise the reason why it could not:
TIME, SAMPLES, FLOAT32 = "render.time is over", "no more samples are taken", "float32 rounds as much"
AllowedVariance = Callable[[FloatArray, slice], FloatArray]  # of light on some measurements, and their slice
SHARE = 0.1  # of the sensor's variance
QUANTILES = np.linspace(0, 1, 11)  # of pixels, from which rays are predicted
LONG = 60.0  # s, from which the cost of the rounds is said
TIMED = 2**20  # rays whose time tells the speed: fewer take the time of compilation
WORTH = 0.5  # of the planned rays, below which fewer samples are offered


def render_until(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    clock: Callable[[], float] = perf_counter,
) -> Rendering:
    """Render until every sub-imager's variance is small compared with the sensor's, or `render.time` is over.

    The first round is rendered whatever the time, so that every pixel has a value. Raises InputError if the sensor
    adds no noise, or if the requested variant does not work here.
    """
    scene = setup.scene
    allowed, variant = allowed_variance(setup), choose(scene.render.variant)  # before Mitsuba is loaded
    from .renderer.renderer import Renderer

    renderer = Renderer(setup.world.simulated, variant, scene.render.sampler, world=rendered_world(setup))
    renderer.set_target(setup.world.image)
    rounds = AdaptiveRounds(setup, renderer, allowed)
    state = State() if checkpoint is None else checkpoint.state()
    rounds.resume(state)
    start = clock() - float(state.get("seconds", 0.0))

    def save() -> None:
        if checkpoint is not None:
            checkpoint.offer(lambda: {**rounds.state(), "seconds": np.array(clock() - start)})

    limit, warned = inf if scene.render.time is None else scene.render.time, False
    while unfinished := rounds.unfinished:
        every = all(rounds.sub_imagers[index].rounds for index in unfinished)
        if limit == inf and not warned and every and rounds.rays > TIMED:
            warned = _warn_of_cost(rounds, rounds.rays / max(clock() - start, 1e-9))
        for number, index in enumerate(unfinished):
            left = (limit - (clock() - start)) / (len(unfinished) - number)
            rounds.render_round(index, left, rounds.rays / max(clock() - start, 1e-9))
            save()
            progress(1 - len(rounds.unfinished) / len(rounds.sub_imagers))
    progress(1.0)
    record, received = {"variant": variant, **rounds.record()}, setup.camera.received
    variance = np.square(received) * rounds.variance
    return Rendering(received * rounds.mean, variance, variance, record, renderer.direct_only)


def _warn_of_cost(rounds: AdaptiveRounds, speed: float) -> bool:
    """Log what the next rounds cost at `speed`, rays per second, where that is long; return True if it was logged."""
    rays, (enough, all_rays) = rounds.planned_rays, rounds.enough
    if rays / speed < LONG:
        return False
    sentence = (
        f"render.samples = 'auto' takes about {rays / speed / 60:.0f} min more ({rays:.1e} rays), until the rendering's"
        " variance is a tenth of the sensor's in every pixel"
    )
    if all_rays < WORTH * rays:
        sentence += f"; on average it is with render.samples = {enough}, in {all_rays / speed / 60:.1g} min"
    logging.getLogger(__name__).warning("%s; render.time limits it", sentence)
    return True


class AdaptiveRounds:
    """The rounds of all sub-imagers: (M,) `mean` and `variance` of the last round of each."""

    def __init__(self, setup: Setup, renderer: Renderer, allowed: AllowedVariance) -> None:
        """Plan the first rounds. allowed : from light on some measurements, and their slice, to its variance."""
        self._scene, self._camera, self._renderer, self._allowed = setup.scene, setup.camera, renderer, allowed
        self._slices = setup.camera.slices()
        self.mean, self.variance = np.zeros(setup.camera.measurements), np.zeros(setup.camera.measurements)
        self._open = np.ones(setup.camera.measurements, dtype=np.bool_)  # pixels that are not done
        law = SampleLaw.expected(setup.scene.render.sampler)
        self._world, flat, sampler = setup.world.simulated, setup.scene.world is None, setup.scene.render.sampler
        exact = (exact_plan(self._world, index, sampler, fast=renderer.is_fast) for index in range(len(self._slices)))
        self._exact = [plan if flat else None for plan in exact]
        quasi_random = flat and renderer.is_fast and sampler == "multijitter"
        self._sobol = [quasi_random and sub.type.optics.draws_more for sub in self._world.sub_imagers]
        plans = [self._first(index) if plan is None else plan for index, plan in enumerate(self._exact)]
        self.sub_imagers = [SubImagerProgress(work, law) for work in plans]

    @property
    def unfinished(self) -> list[int]:
        """Indices of the sub-imagers that have not ended."""
        return [index for index, sub in enumerate(self.sub_imagers) if not sub.ended]

    @property
    def rays(self) -> int:
        """Rays of all rounds."""
        return sum(sub.rays for sub in self.sub_imagers)

    @property
    def planned_rays(self) -> float:
        """Rays of all rounds to come, as predicted."""
        return sum(self.sub_imagers[index].left for index in self.unfinished)

    @property
    def enough(self) -> tuple[int, float]:
        """Samples per pixel with which the mean variance is the allowed one, and the rays of all pixels with these."""
        most = 1
        for index in self.unfinished:
            rows, sub = self._slices[index], self.sub_imagers[index]
            allowed = mean_of_known(self._allowed(self.mean[rows], rows))
            factor = mean_of_known(self.variance[rows]) / allowed if allowed else 0.0
            most = max(most, sub.law.samples(max(factor, AIM), sub.last, MOST_SAMPLES))
        return most, float(most) * self.mean.size

    def render_round(self, index: int, seconds: float = inf, speed: float = inf) -> None:
        """Render the next round of a sub-imager and plan the one after it, or end it.

        seconds : time limit of the round at `speed` rays per second; too little for a useful round ends it instead
        """
        sub, start = replace(self.sub_imagers[index]), self._slices[index].start
        pixels = np.flatnonzero(self._open[self._slices[index]])
        work = sub.next
        if sub.rounds and seconds < inf:
            work = self._affordable(index, seconds * speed / pixels.size)
            if work.total < LEAPS[0] * sub.last.total:
                self._end(sub, index, TIME)
                self.sub_imagers[index] = sub
                return
        seed, numbers = self._scene.render.seed, range(sub.seeds, sub.seeds + work.passes)
        seeds = [sampler_seeds(seed, "data", number, MOST_PASSES) for number in numbers]
        chosen, points = self._renderer.sub_imagers([index], pixels), self._points(index, sub)
        tally = Tally.of(self._renderer.expose(chosen, work.samples, seeds, points)[0])
        floor = self._floor(index, tally.mean, work.samples)
        exact, variance = points in ("averages", "grid"), tally.variance
        stated = variance if exact else posterior_variances(variance, work.passes)
        self.mean[start + pixels], self.variance[start + pixels] = tally.mean, np.maximum(stated, floor)
        sub.add_round(work, np.zeros(pixels.size) if exact else variance)
        if exact:
            still = (variance > floor) & (points == "grid")
        else:  # False for NaN: pixels that receive no light
            still = self.variance[start + pixels] > DONE * self._target(index, pixels)
        if not still.all() and not sub.fewest:
            sub.fewest = sub.spent
        if not still.any():
            self._end(sub, index, FLOAT32)
        elif exact:
            sub.next = self._first(index)
            sub.left = float(sub.next.total * still.sum())
        else:
            self._plan_next(sub, index, pixels[still])
        # An interruption before this leaves a state from which the round is repeated.
        self._open[start + pixels], self.sub_imagers[index] = still, sub

    def _points(self, index: int, sub: SubImagerProgress) -> Points:
        """Return where the rays of the next round start."""
        exact = None if sub.rounds else self._exact[index]
        if exact is not None:
            return "averages" if exact == AVERAGED else "grid"
        return "sobol" if self._sobol[index] else "sampler"

    def _affordable(self, index: int, samples: float) -> Plan:
        """Return the next round's plan, or one of about `samples` per pixel if that is less."""
        wanted = self.sub_imagers[index].next
        if samples >= wanted.total:
            return wanted
        less = self._grid(index, max(int(samples), 1), wanted.samples)
        return less if less.total < wanted.total else wanted

    def _target(self, index: int, pixels: IntArray) -> FloatArray:
        """Return the allowed variance of some pixels; no number of samples gets below the rounding."""
        rows = self._slices[index]
        floor = self._floor(index, self.mean[rows][pixels], self._grid(index, LEAST).samples)
        return np.maximum(self._allowed(self.mean[rows], rows)[pixels], floor / AIM)

    def _plan_next(self, sub: SubImagerProgress, index: int, pixels: IntArray) -> None:
        """Plan the next round of a sub-imager, of the pixels that are not done, or end it."""
        rows, target = self._slices[index], AIM * self._target(index, pixels)
        values, variance = self.mean[rows][pixels], self.variance[rows][pixels]
        sub.scatter = mean_of_known(variance) * sub.last.passes
        most = MOST_EXACT if self._renderer.is_fast else min(samples_within(values, target), MOST_SAMPLES)
        factors = np.quantile(variance / target, QUANTILES)
        totals = [sub.law.samples(float(factor), sub.last, most) for factor in factors]
        sub.left = float(np.mean(totals)) * values.size
        sub.next = self._grid(index, min(totals[-1], LEAP * sub.last.total, MOST), most)
        if sub.next.total < LEAPS[0] * sub.last.total or sub.seeds + sub.next.passes > MOST_PASSES:
            self._end(sub, index, SAMPLES)

    def _floor(self, index: int, values: FloatArray, samples: int) -> FloatArray:
        """Return the variance that no number of samples goes below: float32's rounding, and tables of point spreads."""
        floor = rounding_variance(values, self._renderer.float32_samples(samples))
        diffracts = self._sobol[index] and self._world.wavelengths
        return np.maximum(floor, (TABULATED * WHITE) ** 2) if diffracts else floor

    def _end(self, sub: SubImagerProgress, index: int, why: str) -> None:
        """End a sub-imager: its target is reached, or it is not for the reason `why`."""
        rows = self._slices[index]
        beyond = self.variance[rows] > self._allowed(self.mean[rows], rows)
        sub.ended, sub.fewest = why if beyond.any() else REACHED, sub.fewest or sub.spent

    def _first(self, index: int) -> Plan:
        """Return the plan of a first round, whose scatter shows every edge that matters.

        Of the strata of a pass a strip of width q beyond an edge of the picture is seen by g samples with probability
        q, and is R q / g of the reading, with g x g strata and a contrast R. That none of the n = 16 g^2 samples sees
        it has the probability exp(-16 g q), and its square times that is at most (R / (8 g^2))^2 / e^2. With a time
        limit, which holds from the second round on, the first one is short.
        """
        if self._sobol[index] or self._scene.render.time is not None:
            return self._grid(index, LEAST)
        rows = self._slices[index]
        allowed = self._allowed(np.broadcast_to(DARK, rows.stop - rows.start), rows)
        aim = AIM * min((float(each) for each in allowed if each > 0), default=inf)
        seen = 2 * WHITE / (exp(1) * aim**0.5)
        return self._grid(index, min(max(LEAST, ceil(seen)), MOST_FIRST, MOST))

    def _grid(self, index: int, samples: int, most: int = MOST_SAMPLES) -> Plan:
        """Return a plan that fits the edges of pixels of f or Sobol's points, where the sampler can make use of it."""
        sampler = SOBOL if self._sobol[index] else self._scene.render.sampler
        return on_grid(samples, sampler, cells_of(self._camera.sub_imagers[index].type), most)

    def state(self) -> State:
        """Return the arrays of a checkpoint."""
        courses = json.dumps([asdict(sub) for sub in self.sub_imagers])
        return {"mean": self.mean, "variance": self.variance, "open": self._open, "courses": np.array(courses)}

    def resume(self, state: State) -> None:
        """Continue from a checkpoint, if it is not empty."""
        if state:
            self.mean, self.variance, self._open = state["mean"], state["variance"], state["open"]
            self.sub_imagers = [SubImagerProgress.from_json(values) for values in json.loads(str(state["courses"]))]

    def record(self) -> dict[str, Any]:
        """Return samples per pixel, rays of each sub-imager, and the sub-imagers that missed the target, with why."""
        named = {sub.name: progress for sub, progress in zip(self._camera.sub_imagers, self.sub_imagers, strict=True)}
        missed = {name: sub.ended for name, sub in named.items() if sub.ended != REACHED}
        samplers = sorted({SOBOL if sobol else self._scene.render.sampler for sobol in self._sobol})
        return {
            "sampler": " and ".join(samplers),
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


@dataclass
class SubImagerProgress:
    """Progress of one sub-imager.

    next, last : plans of the next round and of the last one
    left : rays of all rounds to come, as predicted
    spent : samples of all rounds per pixel that was in each of them;  fewest : the same for the first pixel to be done
    rays : of all rounds;  seeds : number of passes so far
    scatter : variance of one pass of the last round, mean over the unfinished pixels;  law : of its fall
    ended : why the sub-imager ended, "" before that
    """

    next: Plan
    law: SampleLaw
    last: Plan = field(default_factory=lambda: Plan(0, 0))
    left: float = 0.0
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
        plans = {name: Plan(**values[name]) for name in ("next", "last")}
        fields: dict[str, Any] = {**values, **plans, "law": SampleLaw(**values["law"])}
        return SubImagerProgress(**fields)

    def add_round(self, work: Plan, variance: FloatArray) -> None:
        """Account for a round, from its plan and the variances of its pixels' means."""
        scatter = mean_of_known(variance) * work.passes
        if self.scatter > 0 and scatter > 0 and work.samples > self.last.samples:
            self.law = SampleLaw.measured(self.scatter / scatter, work.samples / self.last.samples)
        self.last, self.rounds = work, self.rounds + 1
        self.spent, self.seeds, self.rays = (
            self.spent + work.total,
            self.seeds + work.passes,
            self.rays + work.total * variance.size,
        )


def mean_of_known(variance: FloatArray) -> float:
    """Return the mean of the variances of pixels that receive light."""
    known = variance[np.isfinite(variance)]
    return float(known.mean()) if known.size else 0.0


def check_noise_target(scene: Scene) -> None:
    """Raise InputError if the sensor adds no noise that a rendering could be compared with."""
    noise = scene.noise
    silent = noise is None or noise.variance + noise.quantisation_variance == 0
    if scene.sensor is None and silent:
        raise InputError(
            "render.samples 'auto' renders until its own variance is a tenth of the sensor's, and this scene's sensor"
            " adds none; set noise.variance above 0, add a [sensor], or give render.samples a number"
        )


def allowed_variance(setup: Setup) -> AllowedVariance:
    """Return the function from light on open parts, and the slice of these, to the allowed variance of its rendering.

    NaN where a pixel receives no light. Raises InputError if the sensor adds no noise.
    """
    check_noise_target(setup.scene)
    sensor, noise, received = setup.scene.sensor, setup.scene.noise, setup.camera.received
    if sensor is None:
        known = 0.0 if noise is None else noise.variance + noise.quantisation_variance
        return lambda _, rows: SHARE * known / np.square(received[rows])
    from ommatid.scenes.optics.radiometry import electrons

    response = electrons(setup.scene, setup.camera)
    level = flat_values(sensor, setup.camera, response)

    def of_sensor(light: FloatArray, rows: slice) -> FloatArray:
        values = received[rows] * np.maximum(np.nan_to_num(light), 0.0)
        expected = expected_recording_of(sensor, level[rows], response[rows], values)
        return SHARE * expected.noise_variance(values) / np.square(received[rows])

    return of_sensor
