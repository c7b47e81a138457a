"""The cells that `bench` measures for a scene: every sampler, calibration method and solver, with their cost."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf
from pathlib import Path
from time import perf_counter
from typing import Literal, TypeVar

import numpy as np

from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.assumptions import method_for
from ommatid.reconstruct.methods.method import EstimationTask
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import Sampler
from ommatid.simulate.adaptive_render import check_noise_target
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.renderer.variant import PREFERENCE, release, unusable_reason
from ommatid.simulate.sampling.passes import Rendering

from . import reference
from .precision import ExactSolution, SolverSetting, exact_solution, solver_settings
from .reference import Reference, Samples
from .table import AUTO, Cell, Quantiles, SkippedJob, Stage

Method = Literal["points", "transport"]
Result = TypeVar("Result")

SAMPLES = tuple(4**power for power in range(1, 8))  # per pixel, 4 to 16384
SAMPLERS: tuple[Sampler, ...] = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
REPEATS, FEWER_REPEATS = 5, 3  # with independent seeds; odd, so that the median is one of the values
LONG = 1.0  # seconds of a repeat, from which on FEWER_REPEATS are made
STATUS, CLEAR_REFS = Path("/proc/self/status"), Path("/proc/self/clear_refs")


@dataclass(frozen=True)
class Repeat:
    """Result of one repeat.

    seconds : on the wall's clock;  memory : peak of the whole process in bytes, None where it is not reported
    mse : mean squared error of the resulting image, None if not computed
    samples : per pixel, of a job with an adaptive number
    """

    error: float
    seconds: float
    memory: int | None
    mse: float | None
    samples: int | None = None


@dataclass(frozen=True)
class Job:
    """A cell to be measured; `work` runs the repeat of an index."""

    stage: Stage
    way: str
    variant: str | None
    samples: int | None
    setting: str
    work: Callable[[int], Repeat]

    @property
    def name(self) -> str:
        """Readable name."""
        return name_of(self)

    def measure(self, deadline: float = inf) -> Cell | None:
        """Return the cell, None if the time on the clock of `perf_counter` passes `deadline` before it is complete.

        Raises InputError where the cell cannot be measured.
        """
        repeats: list[Repeat] = []
        start = perf_counter()
        while len(repeats) < FEWER_REPEATS or (len(repeats) < REPEATS and perf_counter() - start < LONG * len(repeats)):
            if repeats and perf_counter() > deadline:
                return None
            repeats.append(self.work(len(repeats)))
        return cell_from_repeats(self, repeats)


def name_of(item: Job | Cell) -> str:
    """Return the readable name of a job or its cell, by which a cell that was measured before is found."""
    known = item.samples is not None and item.setting != AUTO  # adaptive: known only after the measurement
    samples = f"{item.samples} samples" if known else None
    return ", ".join(part for part in (f"{item.stage} {item.way}", item.variant, samples, item.setting) if part)


def cell_from_repeats(job: Job, repeats: Sequence[Repeat]) -> Cell:
    """Return the cell of a job: quantiles over its repeats, and the largest memory and number of samples."""
    errors = [repeat.error for repeat in repeats]
    mses = [repeat.mse for repeat in repeats if repeat.mse is not None]
    samples = [repeat.samples for repeat in repeats if repeat.samples is not None]
    memory = [repeat.memory for repeat in repeats if repeat.memory is not None]
    return Cell(
        stage=job.stage,
        way=job.way,
        variant=job.variant,
        samples=max(samples, default=None) if job.samples is None else job.samples,
        setting=job.setting,
        repeats=len(repeats),
        error=Quantiles.of(errors),
        seconds=Quantiles.of([repeat.seconds for repeat in repeats]),
        memory=max(memory, default=None),
        mse=Quantiles.of(mses) if mses else None,
        scatter=float(np.std(np.log(errors), ddof=1)) if len(errors) > 1 and min(errors) > 0 else None,
    )


@dataclass(frozen=True)
class Subject:
    """The scene that is measured, with its image, and the reference."""

    setup: Setup
    reference: Reference

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
        return derived_seed(self.scene.render.seed, Purpose.REPEAT, name, repeat)

    def stack(self, repeat: int) -> Stack:
        """Return exact light, recorded with the noise of a repeat."""
        return reference.record_light(self.noise(repeat), self.reference.light, self.reference)

    @property
    def noise_deviation(self) -> float:
        """Root mean square of the sensor's noise on exact light, in pixel values of f."""
        return float(np.sqrt(np.nanmean(np.square(self.stack(0).values - self.reference.light))))

    def mean_squared_error(self, image: FloatArray) -> float:
        """Return the mean squared error of an estimate, (N,)."""
        return float(np.mean(np.square(image - self.setup.image.ravel())))

    @property
    def is_large(self) -> bool:
        """True if the solver is a frame or tiles, which are slow for a different noise variance in every pixel."""
        return self.camera.unknowns > MOST_DENSE

    def rendering_mse(self, rendering: Rendering, repeat: int) -> float:
        """Return the mean squared error of the image from a rendering and exact H, normalised."""
        setup = self.noise(repeat)
        single_pass = rendering.passes == 1  # with unknown variance
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
        own = self._exact_mses[repeat]
        return mse / own * self.noise_floor if own > 0 else mse

    def _mse_with_exact_model(self, stack: Stack) -> float:
        return self.mean_squared_error(method_for(stack, self.reference.model).image)

    @cached_property
    def _exact_mses(self) -> list[float]:
        """Mean squared errors with exact light and exact H, by repeat of the noise."""
        return [self._mse_with_exact_model(self.stack(repeat)) for repeat in range(FEWER_REPEATS)]

    @property
    def noise_floor(self) -> float:
        """Median of the mean squared error with exact light and exact H over repeats of the noise."""
        return float(np.median(self._exact_mses))


def jobs(subject: Subject) -> tuple[list[Job], list[SkippedJob]]:
    """Return all cells, and those that cannot be measured on this machine or for this scene, with the reason.

    Solvers come first, and few samples before many, so that the curves of all ways grow together.
    """
    reasons = {variant: unusable_reason(variant) for variant in PREFERENCE}
    working = [variant for variant in PREFERENCE if not reasons[variant]]
    left_out = [SkippedJob(what=variant, why=reason) for variant, reason in reasons.items() if reason]
    if not subject.camera.is_ideal_pinhole and "scalar_rgb" in working:
        working.remove("scalar_rgb")
        left_out.append(SkippedJob(what="scalar_rgb", why="lenses other than pinholes need a fast backend"))
    counts: list[Samples] = [*SAMPLES]
    try:
        check_noise_target(subject.scene)
        counts.append(AUTO)
    except InputError as error:
        left_out.append(SkippedJob(what="samples 'auto'", why=str(error)))
    estimates, unsolvable = _estimates(subject)
    sampled = [job for samples in counts for job in _sampling(subject, working, samples)]
    by_name = {job.name: job for job in (*estimates, *sampled)}  # several numbers may be rounded up to the same
    return list(by_name.values()), [*left_out, *unsolvable]


def _sampling(subject: Subject, variants: Sequence[str], samples: Samples) -> list[Job]:
    """Return the renderings and calibrations with a number of samples; an adaptive one has the scene's own sampler.

    A calibration refuses fewer samples than it has passes.
    """
    own, listed = subject.scene.render.sampler, list[Job]()
    samplers = (own,) if samples == AUTO else SAMPLERS
    for variant in variants:
        slow = variant.startswith("scalar")
        listed += [_rendering(subject, variant, sampler, samples) for sampler in samplers]
        if samples == SAMPLES[0] or (slow and samples == AUTO):
            continue
        listed.append(_calibration(subject, variant, "points", own, samples))
        if not slow:
            listed += [_calibration(subject, variant, "transport", sampler, samples) for sampler in samplers]
    return listed


def _planned(samples: Samples, sampler: Sampler) -> tuple[int | None, str]:
    """Return the samples per pixel as the sampler takes them, None if they are adaptive, and the setting in words."""
    if samples == AUTO:
        return None, AUTO
    work = reference.sample_plan(samples, sampler)
    return work.total, f"{work.passes} pass{'es' if work.passes > 1 else ''} of {work.samples}"


def _rendering(subject: Subject, variant: str, sampler: Sampler, samples: Samples) -> Job:
    total, setting = _planned(samples, sampler)
    name = f"render {sampler} {variant} {total or AUTO}"

    def repeated(repeat: int) -> Repeat:
        scene = reference.with_rendering(subject.scene, sampler, variant, samples, subject.seed(name, repeat))
        rendering, seconds, memory = measured(lambda: reference.render_light(subject.changed(scene)))
        error = reference.light_error(rendering, subject.reference)
        mse = subject.rendering_mse(rendering, repeat) if repeat < FEWER_REPEATS else None
        return Repeat(error, seconds, memory, mse, int(rendering.record["samples"]))

    return Job("render", sampler, variant, total, setting, repeated)


def _calibration(subject: Subject, variant: str, method: Method, sampler: Sampler, samples: Samples) -> Job:
    total, setting = _planned(samples, sampler)
    way = f"{method}, {sampler}"
    name = f"calibrate {way} {variant} {total or AUTO}"

    def repeated(repeat: int) -> Repeat:
        seed = subject.seed(name, repeat)
        scene = reference.with_calibration(subject.scene, method, sampler, variant, samples, seed)
        rule = for_stack(subject.stack(repeat)) if samples == AUTO else None
        model, seconds, memory = measured(lambda: calibrate(subject.changed(scene), stopping_rule=rule))
        error = reference.model_error(model, subject.reference)
        mse = subject.model_mse(model, repeat) if repeat < FEWER_REPEATS else None
        return Repeat(error, seconds, memory, mse, int(model.record["samples"]))

    return Job("calibrate", way, variant, total, setting, repeated)


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
            image, seconds, memory = measured(lambda: setting.image(task))
            mse = subject.mean_squared_error(image)
            mse = subject.normalised(mse, repeat) if repeat < FEWER_REPEATS else None
            return Repeat(exact.error(image), seconds, memory, mse)

        return Job("reconstruct", setting.method, None, None, setting.setting, repeated)

    settings, unsolvable = solver_settings(solution(0)[0])
    return [job(setting) for setting in settings], unsolvable


def measured(work: Callable[[], Result]) -> tuple[Result, float, int | None]:
    """Return the result of `work`, its seconds, and its peak memory if the system reports it."""
    release()
    is_reset = reset_peak_memory()
    start = perf_counter()
    result = work()
    return result, perf_counter() - start, resident_memory("VmHWM") if is_reset else None


def reset_peak_memory() -> bool:
    """Reset the peak of the resident memory to its present value; return False where the system cannot.

    The peak comes from /proc and not from getrusage, whose ru_maxrss is inherited from the parent process and cannot
    be reset.
    """
    try:
        ctypes.CDLL(None).malloc_trim(0)  # return freed memory, which would hide as much of the work's memory
        CLEAR_REFS.write_text("5", encoding="ascii")
    except (OSError, AttributeError, TypeError):
        return False
    return True


def resident_memory(field: str) -> int | None:
    """Return a field of /proc/self/status in bytes: VmRSS, resident memory, or VmHWM, its peak; None without /proc."""
    try:
        lines = STATUS.read_text(encoding="ascii").splitlines()
        return next((1024 * int(line.split()[1]) for line in lines if line.startswith(f"{field}:")), None)
    except OSError:
        return None
