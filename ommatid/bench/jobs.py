"""The cells that `bench` measures for a scene: every sampler, calibration method and solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from time import perf_counter
from typing import Literal, TypeVar

import numpy as np

from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.assumptions import method_for
from ommatid.reconstruct.method_choice import MAX_DENSE_PIXELS
from ommatid.reconstruct.methods.method import EstimationTask
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.adaptive_render import AdaptiveRendering
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.calibration.point_sources import RENDERINGS
from ommatid.simulate.render import Rendering
from ommatid.simulate.renderer.variant import PREFERENCE, release, unusable_reason
from ommatid.simulate.sampling.seeds import repeat_seed

from . import reference
from .precision import ExactSolution, SolverSetting, exact_solution, solver_settings
from .reference import Reference, Samples
from .resources import Cost, measure_cost
from .scheduler import FEWER_REPEATS, REPEATS, Job, Repeat
from .table import AUTO, SkippedJob

Method = Literal["points", "transport"]
Result = TypeVar("Result")

SAMPLES = tuple(4**power for power in range(1, 8))  # per pixel, 4 to 16384
SAMPLERS: tuple[Sampler, ...] = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
# Orders of magnitude, for a first guess of durations:
RAYS_PER_SECOND = {"scalar_rgb": 5e6, "llvm_ad_mono": 3e7, "cuda_ad_mono": 3e8}
STARTUP = {"scalar_rgb": 0.02, "llvm_ad_mono": 0.03, "cuda_ad_mono": 0.05}  # seconds before the first ray
SUB_IMAGER_STARTUP = 0.005  # seconds per sub-imager that is rendered separately
ESTIMATES = 2  # per calibrated H: the first shows how much noise the uncertainty of H adds
STOPPING_ESTIMATES = 2  # in addition, where the calibration stops at a goal for that noise


@dataclass(frozen=True)
class Subject:
    """The scene that is measured, with its image, and the reference.

    time_limit : seconds after which no more estimates of the noise floor are made
    """

    setup: Setup
    reference: Reference
    time_limit: float = inf

    @property
    def scene(self) -> Scene:
        """The scene of the setup."""
        return self.setup.scene

    @property
    def camera(self) -> Camera:
        """The camera of the setup."""
        return self.setup.camera

    def changed(self, scene: Scene) -> Setup:
        """Return the setup with other settings of its stages."""
        return replace(self.setup, scene=scene)

    def noise(self, repeat: int) -> Setup:
        """Return the setup with the seed of the sensor's noise of a repeat, which all cells share."""
        render = self.scene.render.model_copy(update={"seed": self.seed("noise", repeat)})
        return self.changed(self.scene.model_copy(update={"render": render}))

    def seed(self, name: str, repeat: int) -> int:
        """Return the seed of the rays of a cell's repeat."""
        return repeat_seed(self.scene.render.seed, name, repeat)

    def stack(self, repeat: int) -> Stack:
        """Return exact light, recorded with the noise of a repeat."""
        return reference.record_light(self.noise(repeat), self.reference.light, self.reference)

    def mean_squared_error(self, image: FloatArray) -> float:
        """Return the mean squared error of an estimate, (N,)."""
        return float(np.mean(np.square(image - self.setup.image.ravel())))

    @property
    def is_large(self) -> bool:
        """True if the solver is a frame or tiles, which are slow for a different noise variance in every pixel."""
        return self.camera.unknowns > MAX_DENSE_PIXELS

    def rendering_mse(self, rendering: Rendering | AdaptiveRendering, repeat: int) -> float:
        """Return the mean squared error of the image from a rendering and exact H, normalised."""
        setup = self.noise(repeat)
        single_pass = isinstance(rendering, Rendering) and rendering.passes == 1  # with unknown variance
        if self.is_large or single_pass:
            stack = reference.record_light(setup, rendering.mean, self.reference)
        else:
            stack = reference.record_rendering(setup, rendering)
        return self.normalised(self._mse_with_exact_model(stack), repeat)

    def model_mse(self, model: Model, repeat: int) -> float:
        """Return the mean squared error of the image from exact light and a calibrated H, normalised.

        For large cameras the two are exchanged: light computed with the calibrated H, and an estimate with the exact
        one. To first order in the error dH of H both have the same error, A dH f.
        """
        if not self.is_large:
            return self.normalised(self.mean_squared_error(method_for(self.stack(repeat), model).image), repeat)
        light = model.forward(self.setup.image.ravel())
        stack = reference.record_light(self.noise(repeat), light, self.reference)
        return self.normalised(self._mse_with_exact_model(stack), repeat)

    def normalised(self, mse: float, repeat: int) -> float:
        """Return a mean squared error without the random deviation of the sensor's noise in a repeat from its median.

        This is the noise floor, times the ratio of `mse` to the error with exact light, exact H and the same noise.
        """
        own = self._exact_mse(repeat)
        return mse / own * self.noise_floor if own > 0 else mse

    def _mse_with_exact_model(self, stack: Stack) -> float:
        return self.mean_squared_error(method_for(stack, self.reference.model).image)

    def _exact_mse(self, repeat: int) -> float:
        if repeat not in self._exact_mses:
            self._exact_mses[repeat] = self._mse_with_exact_model(self.stack(repeat))
        return self._exact_mses[repeat]

    @cached_property
    def _exact_mses(self) -> dict[int, float]:
        return {}

    @cached_property
    def _floor_and_duration(self) -> tuple[float, float]:
        start, errors = perf_counter(), list[float]()
        while not errors or (len(errors) < REPEATS and perf_counter() - start < self.time_limit):
            errors.append(self._exact_mse(len(errors)))
        return float(np.median(errors)), (perf_counter() - start) / len(errors)

    @property
    def noise_floor(self) -> float:
        """Median of the mean squared error with exact light and exact H over repeats of the noise."""
        return self._floor_and_duration[0]

    @property
    def estimate_seconds(self) -> float:
        """Mean duration of an estimate with exact light and exact H."""
        return self._floor_and_duration[1]


def jobs(subject: Subject) -> tuple[list[Job], list[SkippedJob]]:
    """Return all cells, and those that cannot be measured on this machine or for this scene, with the reason."""
    reasons = {variant: unusable_reason(variant) for variant in PREFERENCE}
    working = [variant for variant in PREFERENCE if not reasons[variant]]
    left_out = [SkippedJob(what=variant, why=reason) for variant, reason in reasons.items() if reason]
    if not subject.camera.is_ideal_pinhole and "scalar_rgb" in working:
        working.remove("scalar_rgb")
        left_out.append(SkippedJob(what="scalar_rgb", why="lenses other than pinholes need a fast backend"))
    measurable = [*_renderings(subject, working), *_calibrations(subject, working)]
    try:
        measurable += _adaptive_jobs(subject, working)
    except InputError as error:
        left_out.append(SkippedJob(what="samples 'auto'", why=str(error)))
    estimates, unsolvable = _estimates(subject)
    return [*measurable, *estimates], [*left_out, *unsolvable]


@dataclass(frozen=True)
class JobSettings:
    """Samples per pixel of a cell: the number, None if it is adaptive, and its expectation.

    setting : the same as text
    """

    samples: int | None
    expected: int
    setting: str


def _fixed_samples(samples: int, sampler: Sampler) -> JobSettings:
    work = reference.sample_plan(samples, sampler)
    return JobSettings(work.total, work.total, f"{work.passes} pass{'es' if work.passes > 1 else ''} of {work.samples}")


def _adaptive_jobs(subject: Subject, variants: list[str]) -> list[Job]:
    """Return cells with samples "auto" and the scene's own sampler. Raises InputError for a scene without noise."""
    scene = subject.scene
    expected = reference.expected_samples(subject.setup, subject.reference)
    work = JobSettings(None, expected, AUTO)
    adaptive: list[Job] = []
    for variant in variants:
        adaptive.append(_rendering(subject, variant, scene.render.sampler, AUTO, work))
        methods: tuple[Method, ...] = () if variant.startswith("scalar") else ("points", "transport")
        adaptive += [_calibration(subject, variant, method, scene.render.sampler, AUTO, work) for method in methods]
    return adaptive


def _renderings(subject: Subject, variants: list[str]) -> list[Job]:
    by_name: dict[str, Job] = {}
    for variant in variants:
        for sampler in SAMPLERS:
            for samples in SAMPLES:
                job = _rendering(subject, variant, sampler, samples, _fixed_samples(samples, sampler))
                by_name.setdefault(job.name, job)  # several numbers may be rounded up to the same
    return list(by_name.values())


def _rendering(subject: Subject, variant: str, sampler: Sampler, samples: Samples, work: JobSettings) -> Job:
    name = f"render {sampler} {variant} {work.samples or AUTO}"

    def repeated(repeat: int) -> Repeat:
        scene = reference.with_rendering(subject.scene, sampler, variant, samples, subject.seed(name, repeat))
        rendering, cost = _measured(lambda: reference.render_light(subject.changed(scene)))
        error = reference.light_error(rendering, subject.reference)
        mse = subject.rendering_mse(rendering, repeat) if repeat < FEWER_REPEATS else None
        return Repeat(error, cost, mse, int(rendering.record()["samples"]))

    startup = STARTUP[variant]
    if samples == AUTO:
        startup += SUB_IMAGER_STARTUP * len(subject.camera.sub_imagers)
    rays = work.expected * subject.camera.measurements
    guess = startup + rays / RAYS_PER_SECOND[variant] + subject.estimate_seconds
    return Job("render", sampler, variant, work.samples, work.setting, guess, repeated)


def _calibrations(subject: Subject, variants: list[str]) -> list[Job]:
    own_sampler, by_name = subject.scene.render.sampler, dict[str, Job]()
    for variant in variants:
        transport: tuple[Sampler, ...] = () if variant.startswith("scalar") else SAMPLERS
        methods: list[tuple[Method, Sampler]] = [
            ("points", own_sampler),
            *(("transport", sampler) for sampler in transport),
        ]
        for method, sampler in methods:
            for samples in SAMPLES[1:]:  # the first is less than the number of passes, which a calibration refuses
                job = _calibration(subject, variant, method, sampler, samples, _fixed_samples(samples, sampler))
                by_name.setdefault(job.name, job)
    return list(by_name.values())


def _calibration(
    subject: Subject, variant: str, method: Method, sampler: Sampler, samples: Samples, work: JobSettings
) -> Job:
    way = f"{method}, {sampler}"
    name = f"calibrate {way} {variant} {work.samples or AUTO}"

    def repeated(repeat: int) -> Repeat:
        seed = subject.seed(name, repeat)
        scene = reference.with_calibration(subject.scene, method, sampler, variant, samples, seed)
        rule = for_stack(subject.stack(repeat)) if samples == AUTO else None
        model, cost = _measured(lambda: calibrate(subject.changed(scene), stopping_rule=rule))
        error = reference.model_error(model, subject.reference)
        mse = subject.model_mse(model, repeat) if repeat < FEWER_REPEATS else None
        return Repeat(error, cost, mse, int(model.record["samples"]))

    rendering = work.expected * subject.camera.measurements / RAYS_PER_SECOND[variant]
    solving = subject.estimate_seconds * (ESTIMATES + (STOPPING_ESTIMATES if samples == AUTO else 0))
    guess = 2 * STARTUP[variant] + rendering * (RENDERINGS if method == "points" else 1.0) + solving
    return Job("calibrate", way, variant, work.samples, work.setting, guess, repeated)


def _estimates(subject: Subject) -> tuple[list[Job], list[SkippedJob]]:
    solutions: dict[int, tuple[EstimationTask, ExactSolution]] = {}

    def solution(repeat: int) -> tuple[EstimationTask, ExactSolution]:
        if repeat not in solutions:
            task = method_for(subject.stack(repeat), subject.reference.model).task
            deviation = solutions[0][1].deviation if solutions else None
            solutions[repeat] = task, exact_solution(task, deviation)
        return solutions[repeat]

    def job(setting: SolverSetting) -> Job:
        def repeated(repeat: int) -> Repeat:
            task, exact = solution(repeat)
            image, cost = _measured(lambda: setting.image(task))
            return Repeat(exact.error(image), cost, subject.normalised(subject.mean_squared_error(image), repeat))

        return Job("reconstruct", setting.method, None, None, setting.setting, setting.guess, repeated)

    settings, unsolvable = solver_settings(solution(0)[0])
    return [job(setting) for setting in settings], [SkippedJob(what=what, why=why) for what, why in unsolvable]


def _measured(work: Callable[[], Result]) -> tuple[Result, Cost]:
    release()
    return measure_cost(work)
