"""The cells that `bench` measures of a scene: every sampler, method and way, with what each repeat of one does."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from time import perf_counter
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.assumptions import method_for
from ommatid.reconstruct.method_choice import DENSE
from ommatid.reconstruct.methods.method import EstimationTask
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Sampler, Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.simulate.adaptive_render import AdaptiveRendering
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.point_sources import RENDERINGS
from ommatid.simulate.render import Rendering
from ommatid.simulate.renderer.variant import PREFERENCE, release, unusable_reason
from ommatid.simulate.sampling.seeds import repeat_seed

from . import reference
from .precision import ExactSolution, SolverSetting, exact_solution, settings
from .reference import Reference, Samples
from .resources import Cost, measure_cost
from .scheduler import FEWER, REPEATS, Job, Repeat
from .table import AUTO, SkippedJob

Image = NDArray[np.float64]
Method = Literal["points", "transport"]
Result = TypeVar("Result")

SAMPLES = tuple(4**power for power in range(1, 8))  # a pixel, 4 to 16384
SAMPLERS: tuple[Sampler, ...] = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
RAYS = {"scalar_rgb": 5e6, "llvm_ad_mono": 3e7, "cuda_ad_mono": 3e8}  # a second, about: only an order to begin with
READY = {"scalar_rgb": 0.02, "llvm_ad_mono": 0.03, "cuda_ad_mono": 0.05}  # seconds before the first ray, about
TWICE = 2  # estimates that a calibrated H takes: its uncertainty adds noise that the first one shows
JUDGING = 2  # more of them, where an H is judged by what its uncertainty adds
BY_ITSELF = 0.005  # seconds that a sub-imager takes which is rendered by itself, about


@dataclass(frozen=True)
class Subject:
    """The scene that is measured: its camera, its target, and what is right of both.

    patience : seconds after which no more estimates are made of what the noise alone leaves
    """

    setup: Setup
    reference: Reference
    patience: float = inf

    @property
    def scene(self) -> Scene:
        """The scene."""
        return self.setup.scene

    @property
    def camera(self) -> Camera:
        """Its camera."""
        return self.setup.camera

    def noise(self, repeat: int) -> Setup:
        """The setup with the sensor's noise of a repeat, which all cells share."""
        return self._seeded("noise", repeat)

    def seed(self, name: str, repeat: int) -> int:
        """Of the rays of a cell's repeat."""
        return repeat_seed(self.scene.render.seed, name, repeat)

    def stack(self, repeat: int) -> Stack:
        """Exact light, recorded."""
        return reference.stack_of_light(self.noise(repeat), self.reference.light, self.reference)

    def squares(self, image: Image) -> float:
        """Mean squared error of an estimate, (N,)."""
        return float(np.mean(np.square(image - self.setup.image.ravel())))

    @property
    def large(self) -> bool:
        """Whether the estimate is one of a frame or of tiles, which noise of its own in every pixel would slow down."""
        return self.camera.unknowns > DENSE

    def of_rendering(self, rendering: Rendering | AdaptiveRendering, repeat: int) -> float:
        """Mean squared error of the estimate from a rendering and exact H, freed of this noise's luck."""
        setup = self.noise(repeat)
        once = isinstance(rendering, Rendering) and rendering.passes == 1  # whose variance nobody knows
        if self.large or once:
            return self._brought(reference.stack_of_light(setup, rendering.mean, self.reference), repeat)
        return self._brought(reference.stack_of(setup, rendering), repeat)

    def of_model(self, model: Model, repeat: int) -> float:
        """Mean squared error of the estimate from exact light with a calibrated H, freed of this noise's luck.

        Where that is large the two change places: light through the calibrated H and an estimate with the exact one,
        which to first order in the error of H are wrong by the same, A dH f.
        """
        if not self.large:
            return self.freed(self.squares(method_for(self.stack(repeat), model).image), repeat)
        light = model.forward(self.setup.image.ravel())
        return self._brought(reference.stack_of_light(self.noise(repeat), light, self.reference), repeat)

    def _brought(self, stack: Stack, repeat: int) -> float:
        return self.freed(self.squares(method_for(stack, self.reference.model).image), repeat)

    def freed(self, squares: float, repeat: int) -> float:
        """A mean squared error with the noise of a repeat as it would be with noise of middling luck.

        It is that of the floor, times what it is more than exact light and exact H make of the same noise.
        """
        own = self._own(repeat)
        return squares / own * self.floor if own > 0 else squares

    def _own(self, repeat: int) -> float:
        """Mean squared error with exact light and exact H and the noise of a repeat."""
        if repeat not in self._known:
            self._known[repeat] = self.squares(method_for(self.stack(repeat), self.reference.model).image)
        return self._known[repeat]

    @cached_property
    def _known(self) -> dict[int, float]:
        return {}

    @cached_property
    def _alone(self) -> tuple[list[float], float]:
        start, found = perf_counter(), list[float]()
        while not found or (len(found) < REPEATS and perf_counter() - start < self.patience):
            found.append(self._own(len(found)))
        return found, (perf_counter() - start) / len(found)

    @property
    def solving(self) -> float:
        """Seconds that each of them took."""
        return self._alone[1]

    @property
    def floor(self) -> float:
        """Their median: what the noise alone leaves."""
        return float(np.median(self._alone[0]))

    def _seeded(self, what: str, repeat: int) -> Setup:
        render = self.scene.render.model_copy(update={"seed": self.seed(what, repeat)})
        return replace(self.setup, scene=self.scene.model_copy(update={"render": render}))


def jobs(subject: Subject) -> tuple[list[Job], list[SkippedJob]]:
    """All cells, and what cannot be measured here, with the reason."""
    working = [variant for variant in PREFERENCE if not unusable_reason(variant)]
    left_out = [SkippedJob(variant, unusable_reason(variant)) for variant in PREFERENCE if variant not in working]
    if not subject.camera.is_ideal_pinhole and "scalar_rgb" in working:
        working.remove("scalar_rgb")
        left_out.append(SkippedJob("scalar_rgb", "lenses that are more than pinholes need a fast backend"))
    found = [*_renderings(subject, working), *_calibrations(subject, working)]
    try:
        found += _as_needed(subject, working)
    except InputError as error:
        left_out.append(SkippedJob("samples 'auto'", str(error)))
    estimates, refused = _estimates(subject)
    return [*found, *estimates], [*left_out, *refused]


@dataclass(frozen=True)
class JobSettings:
    """How many samples a pixel a cell takes: `taken`, unless only the cell can tell, and about how many to begin with.

    setting : the same for people
    """

    taken: int | None
    about: int
    setting: str


def _counted(asked: int, sampler: Sampler) -> JobSettings:
    work = reference.work_of(asked, sampler)
    return JobSettings(work.total, work.total, f"{work.passes} pass{'es' if work.passes > 1 else ''} of {work.samples}")


def _as_needed(subject: Subject, variants: list[str]) -> list[Job]:
    """With samples "auto" and the scene's own sampler. Raises InputError where there is no noise to compare with."""
    scene = subject.scene
    work = JobSettings(None, reference.foreseen_samples(subject.setup, subject.reference), AUTO)
    found: list[Job] = []
    for variant in variants:
        found.append(_rendering(subject, variant, scene.render.sampler, AUTO, work))
        methods: tuple[Method, ...] = () if variant.startswith("scalar") else ("points", "transport")
        found += [_calibration(subject, variant, method, scene.render.sampler, AUTO, work) for method in methods]
    return found


def _renderings(subject: Subject, variants: list[str]) -> list[Job]:
    found: dict[str, Job] = {}
    for variant in variants:
        for sampler in SAMPLERS:
            for asked in SAMPLES:
                job = _rendering(subject, variant, sampler, asked, _counted(asked, sampler))
                found.setdefault(job.name, job)  # where several counts are rounded up to one
    return list(found.values())


def _rendering(subject: Subject, variant: str, sampler: Sampler, asked: Samples, work: JobSettings) -> Job:
    name = f"render {sampler} {variant} {work.taken or AUTO}"

    def one(repeat: int) -> Repeat:
        scene = reference.with_rendering(subject.scene, sampler, variant, asked, subject.seed(name, repeat))
        rendering, cost = _costed(lambda: reference.rendered(replace(subject.setup, scene=scene)))
        error = reference.error_of_light(rendering, subject.reference)
        mse = subject.of_rendering(rendering, repeat) if repeat < FEWER else None
        return Repeat(error, cost, mse, int(rendering.record()["samples"]))

    ready = READY[variant] + (BY_ITSELF * len(subject.camera.sub_imagers) if asked == AUTO else 0.0)
    guess = ready + work.about * subject.camera.measurements / RAYS[variant] + subject.solving
    return Job("render", sampler, variant, work.taken, work.setting, guess, one)


def _calibrations(subject: Subject, variants: list[str]) -> list[Job]:
    own, found = subject.scene.render.sampler, dict[str, Job]()
    for variant in variants:
        rays: tuple[Sampler, ...] = () if variant.startswith("scalar") else SAMPLERS
        methods: list[tuple[Method, Sampler]] = [("points", own), *(("transport", sampler) for sampler in rays)]
        for method, sampler in methods:
            for asked in SAMPLES[1:]:  # fewer than there are passes cannot be asked for
                job = _calibration(subject, variant, method, sampler, asked, _counted(asked, sampler))
                found.setdefault(job.name, job)
    return list(found.values())


def _calibration(
    subject: Subject, variant: str, method: Method, sampler: Sampler, asked: Samples, work: JobSettings
) -> Job:
    way = f"{method}, {sampler}"
    name = f"calibrate {way} {variant} {work.taken or AUTO}"

    def one(repeat: int) -> Repeat:
        seed = subject.seed(name, repeat)
        scene = reference.with_calibration(subject.scene, method, sampler, variant, asked, seed)
        rule = for_stack(subject.stack(repeat)) if asked == AUTO else None
        model, cost = _costed(lambda: calibrate(replace(subject.setup, scene=scene), stopping_rule=rule))
        error = reference.error_of_model(model, subject.reference)
        mse = subject.of_model(model, repeat) if repeat < FEWER else None
        return Repeat(error, cost, mse, int(model.record["samples"]))

    each = work.about * subject.camera.measurements / RAYS[variant]
    solving = subject.solving * (TWICE + JUDGING if asked == AUTO else TWICE)
    guess = 2 * READY[variant] + each * (RENDERINGS if method == "points" else 1.0) + solving
    return Job("calibrate", way, variant, work.taken, work.setting, guess, one)


def _estimates(subject: Subject) -> tuple[list[Job], list[SkippedJob]]:
    answers: dict[int, tuple[EstimationTask, ExactSolution]] = {}

    def answer(repeat: int) -> tuple[EstimationTask, ExactSolution]:
        if repeat not in answers:
            task = method_for(subject.stack(repeat), subject.reference.model).task
            known = answers[0][1].deviation if answers else None
            answers[repeat] = task, exact_solution(task, known)
        return answers[repeat]

    def job(setting: SolverSetting) -> Job:
        def one(repeat: int) -> Repeat:
            task, right = answer(repeat)
            image, cost = _costed(lambda: setting.image(task))
            return Repeat(right.error(image), cost, subject.freed(subject.squares(image), repeat))

        return Job("reconstruct", setting.method, None, None, setting.setting, setting.guess, one)

    found, refused = settings(answer(0)[0])
    return [job(setting) for setting in found], [SkippedJob(*one) for one in refused]


def _costed(work: Callable[[], Result]) -> tuple[Result, Cost]:
    release()
    return measure_cost(work)
