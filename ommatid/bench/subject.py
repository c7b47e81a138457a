"""The scene that `bench` measures: its true H and light, the settings of its stages, and the error of each setting.

Errors of renderings and calibrations are from the closed form, or else from a run with many more rays. Those of solvers
are from the exact solution, in posterior standard deviations of each pixel: the dense one, refined to fifteen digits,
or, for a frame, the same frame solved to a much higher accuracy. Every repeat has its own seed, and none of these
random streams is one of the scene's data or calibration.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple, cast

import numpy as np
from scipy import sparse

from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.assumptions import method_for
from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.frame.frame_method import FrameMethod
from ommatid.reconstruct.methods.dense_method import DenseMethod
from ommatid.reconstruct.methods.method import EstimationTask, Execution, Method
from ommatid.reconstruct.methods.tile_method import TileMethod
from ommatid.reconstruct.problem import Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.model import Model
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import Sampler, TilesTable
from ommatid.simulate.adaptive_render import check_noise_target, render_until
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ideal import exact_model, ideal_model, true_matrix
from ommatid.simulate.render import exposed, light
from ommatid.simulate.renderer.variant import PREFERENCE, unusable_reason
from ommatid.simulate.sampling.passes import FEWEST_PASSES, Plan, plan
from ommatid.simulate.sampling.samplers import fitting

from .cost import measured
from .table import AUTO, DENSE, Setting, Skipped

SAMPLES = tuple(4**power for power in range(1, 8))  # per pixel, 4 to 16384
SAMPLERS: tuple[Sampler, ...] = ("independent", "stratified", "multijitter", "orthogonal", "ldsampler")
SAMPLE_RATIO = 64  # reference samples per measured sample: the reference adds less than a hundredth of the error
MOST_RAYS = 2**27  # of a reference: about ten seconds where rays are traced through surfaces
TILE_SIZES = ((11, 2), (15, 3), (19, 4), (27, 6), (35, 8), (51, 12))  # sides, and widths of the border that is dropped
ACCURACIES = (1.0, 0.1, 0.01, 1e-3, 1e-4)  # estimator.accuracy of a frame
EXACT_ACCURACY = 1e-6  # of the exact solution for a frame, in posterior standard deviations
NOISES = 3  # repeats of the sensor's noise, over which mean squared errors of the image are compared

Solver = Callable[[EstimationTask], FloatArray]


class Repeat(NamedTuple):
    """Result of one repeat.

    seconds : on the wall's clock;  memory : peak of the whole process in bytes, None where it is not reported
    mse : mean squared error of the resulting image, None if not computed
    samples : per pixel, None of a solver
    """

    error: float
    seconds: float
    memory: int | None
    mse: float | None
    samples: int | None = None


class ExactSolution(NamedTuple):
    """Task of a repeat, its exact solution, (N,), and the posterior standard deviation of each pixel, (N,)."""

    task: EstimationTask
    image: FloatArray
    deviation: FloatArray

    def error(self, image: FloatArray) -> float:
        """Return the RMS difference in posterior standard deviations, at least the resolution of float64."""
        resolution = np.spacing(np.abs(self.image) + np.abs(image)) / self.deviation
        return float(np.sqrt(np.mean(np.square((image - self.image) / self.deviation) + np.square(resolution))))


@dataclass(frozen=True)
class Subject:
    """The scene that is measured, with its true H, or an estimate of it from very many rays.

    light : (M,) true values of the sensor pixels;  variance : (M,) their variance, 0 for a closed form
    against : how they were obtained
    """

    setup: Setup
    model: Model
    light: FloatArray
    variance: FloatArray
    against: str

    @classmethod
    def of(cls, setup: Setup) -> Subject:
        """Compute H in closed form where there is one, else from 64 times the rays, or as many as MOST_RAYS permits.

        Raises InputError if its backend does not work on this machine.
        """
        camera, image = setup.camera, setup.image.ravel()
        if setup.has_closed_form:
            if camera.has_box_footprints and camera.tolerance is None:
                model = ideal_model(setup.resolved, camera)
            else:
                model = exact_model(setup.resolved, camera, true_matrix(setup.simulated), "true")
            return cls(setup, model, model.forward(image), np.zeros(camera.measurements), "the closed form")
        samples = min(SAMPLE_RATIO * SAMPLES[-1], MOST_RAYS // camera.measurements)
        seed = derived_seed(setup.scene.render.seed, Purpose.REPEAT, "right", 0)
        rays = {"sampler": "multijitter", "variant": "auto", "seed": seed}
        model = calibrate(_changed(setup, rays, {"method": "transport", "samples": samples, "fit": None}))
        against = f"a reference of {model.record['samples']} samples"
        return cls(setup, model, model.forward(image), model.variance_from_model(image), against)

    @property
    def camera(self) -> Camera:
        """The camera of the setup."""
        return self.setup.camera

    def seed(self, name: str, repeat: int) -> int:
        """Return the seed of the rays of a setting's repeat."""
        return derived_seed(self.setup.scene.render.seed, Purpose.REPEAT, name, repeat)

    def recorded(self, light: FloatArray, repeat: int, variance: FloatArray | None = None) -> Stack:
        """Return light, (M,), as the sensor records it, with the noise of a repeat, which all settings share.

        variance : (M,) that is stated of the light; None: its mean squared error in all pixels, 0 for exact light
        """
        if variance is None:
            variance = np.broadcast_to(float(np.nanmean(np.square(light - self.light))), light.shape)
        return exposed(_changed(self.setup, {"seed": self.seed("noise", repeat)}), light, variance, {})

    @property
    def noise_deviation(self) -> float:
        """Root mean square of the sensor's noise on exact light, in pixel values of f."""
        return float(np.sqrt(np.nanmean(np.square(self.recorded(self.light, 0).values - self.light))))

    @property
    def noise_floor(self) -> float:
        """Median of the mean squared error with exact light and exact H over repeats of the noise."""
        return float(np.median(self._exact_mses))

    @cached_property
    def _exact_mses(self) -> list[float]:
        """Mean squared errors with exact light and exact H, by repeat of the noise."""
        stacks = (self.recorded(self.light, repeat) for repeat in range(NOISES))
        return [self._mean_squared_error(method_for(stack, self.model).image) for stack in stacks]

    def _mean_squared_error(self, image: FloatArray) -> float:
        return float(np.mean(np.square(image - self.setup.image.ravel())))

    def _mse(self, stack: Callable[[], Stack], model: Model, repeat: int) -> float | None:
        """Return the error of the image that is estimated from a stack, None beyond NOISES repeats."""
        return self._normalised(method_for(stack(), model).image, repeat) if repeat < NOISES else None

    def _normalised(self, image: FloatArray, repeat: int) -> float:
        """Return the mean squared error of an estimate, (N,), without the random deviation of the noise of a repeat.

        This is the noise floor, times the ratio of its error to that with exact light, exact H and the same noise.
        """
        mse, exact = self._mean_squared_error(image), self._exact_mses[repeat]
        return mse / exact * self.noise_floor if exact > 0 else mse

    @property
    def _is_large(self) -> bool:
        """True if the solver is a frame or tiles, which are slow for a different noise variance in every pixel."""
        return self.camera.unknowns > MOST_DENSE

    def measure(self, cell: Setting, repeat: int) -> Repeat:
        """Measure a repeat of a setting. Raises InputError where it cannot be measured."""
        work = {"render": self._render, "calibrate": self._calibrate, "reconstruct": self._reconstruct}
        return work[cell.stage](cell, repeat)

    def _render(self, cell: Setting, repeat: int) -> Repeat:
        """Measure a rendering; the image is estimated with exact H."""
        samples = cell.samples or AUTO
        seed = self.seed(f"render {cell.way} {cell.variant} {samples}", repeat)
        keys = {"sampler": cell.way, "variant": cell.variant, "samples": samples, "seed": seed}
        setup = _changed(self.setup, keys)
        work = None if cell.samples is None else sample_plan(cell.samples, cast(Sampler, cell.way))
        rendering, seconds, memory = measured(lambda: render_until(setup) if work is None else light(setup, work=work))
        squares = np.square(rendering.mean - self.light) - self.variance
        stated = None if self._is_large or rendering.passes == 1 else rendering.stated  # one pass: of unknown variance
        mse = self._mse(lambda: self.recorded(rendering.mean, repeat, stated), self.model, repeat)
        error = float(np.sqrt(max(np.nanmean(squares), 0.0)))
        return Repeat(error, seconds, memory, mse, int(rendering.record["samples"]))

    def _calibrate(self, cell: Setting, repeat: int) -> Repeat:
        """Measure a calibration; the image is estimated with it from exact light.

        For large cameras the two are exchanged: light computed with the calibrated H, and an estimate with the exact
        one. To first order in the error dH of H both have the same error, A dH f.
        """
        samples = cell.samples or AUTO
        seed = self.seed(f"calibrate {cell.way} {cell.variant} {samples}", repeat)
        keys = {"method": cell.way.split(", ")[0], "samples": samples, "fit": None}
        setup = _changed(self.setup, {"sampler": cell.sampler, "variant": cell.variant, "seed": seed}, keys)
        rule = for_stack(self.recorded(self.light, repeat)) if cell.samples is None else None
        model, seconds, memory = measured(lambda: calibrate(setup, stopping_rule=rule))
        difference = sparse.csr_array(model.matrix - self.model.matrix)
        squares = float(np.square(difference.data).sum()) - float(self.model.variance.sum())
        if self._is_large:
            image = self.setup.image.ravel()
            mse = self._mse(lambda: self.recorded(model.forward(image), repeat), self.model, repeat)
        else:
            mse = self._mse(lambda: self.recorded(self.light, repeat), model, repeat)
        error = float(np.sqrt(max(squares, 0.0) / self.model.entries))
        return Repeat(error, seconds, memory, mse, int(model.record["samples"]))

    def _reconstruct(self, cell: Setting, repeat: int) -> Repeat:
        exact, solver = self._exact(repeat), self.solvers[0][cell.way, cell.setting]
        image, seconds, memory = measured(lambda: solver(exact.task))
        mse = self._normalised(image, repeat) if repeat < NOISES else None
        return Repeat(exact.error(image), seconds, memory, mse)

    @cached_property
    def _solutions(self) -> dict[int, ExactSolution]:
        return {}

    def _exact(self, repeat: int) -> ExactSolution:
        """Return the exact solution of a repeat, whose deviations do not depend on the recorded values."""
        if repeat not in self._solutions:
            task = method_for(self.recorded(self.light, repeat), self.model).task
            settings = task.settings.model_copy(update={"method": "auto", "accuracy": EXACT_ACCURACY})
            kind: type[Method] = FrameMethod if self._is_large else DenseMethod
            method = kind(replace(task, settings=settings), Execution())
            if repeat == 0:
                variance = method.result({"noise": task.expected_noise}, None).expected.variance
                deviation: FloatArray = np.sqrt(variance)
            else:
                deviation = self._exact(0).deviation
            self._solutions[repeat] = ExactSolution(task, method.image, deviation)
        return self._solutions[repeat]

    @cached_property
    def solvers(self) -> tuple[dict[tuple[str, str], Solver], list[Skipped]]:
        """The solvers that can be measured, by method and setting, and those that cannot, with the reason."""
        found, left_out = dict[tuple[str, str], Solver](), list[Skipped]()
        task = method_for(self.recorded(self.light, 0), self.model).task
        has_frame = task.model.camera.is_sliding and bool((task.expected_noise > 0).all())
        if not self._is_large:
            found[DENSE, f"tolerance {task.settings.tolerance:g}"] = _dense_image
        elif has_frame:
            left_out.append(Skipped(what=DENSE, why=f"{task.model.unknowns} pixels, and the limit is {MOST_DENSE}"))
        else:
            why = "too many pixels for one dense problem, and a frame does not apply: there is no exact solution"
            return {}, [Skipped(what="reconstruct", why=why)]
        for size, overlap in TILE_SIZES:
            if size < min(task.shape):
                found["tiles", f"{size} less {overlap}"] = _tile_solver(TilesTable(size=size, overlap=overlap))
        for accuracy in ACCURACIES if has_frame else ():
            found["frame", f"accuracy {accuracy:g}"] = _frame_solver({"accuracy": accuracy})
        if not has_frame:
            why = "it needs noise in every measurement, and lens types with the same view everywhere"
            left_out.append(Skipped(what="frame", why=why))
        return found, left_out


def _changed(setup: Setup, render: Mapping[str, Any], calibration: Mapping[str, Any] = {}) -> Setup:
    """Return a setup with other values of keys of [render] and [calibration]."""
    scene = setup.scene
    tables = {
        "render": scene.render.model_copy(update=render),
        "calibration": scene.calibration.model_copy(update=calibration),
    }
    return replace(setup, scene=scene.model_copy(update=tables))


def _dense_image(task: EstimationTask) -> FloatArray:
    problem = Problem(task.model.matrix[task.used], task.prior_on(task.shape), task.expected_noise)
    return estimate(problem, task.recorded[task.used], task.settings.tolerance).image


def _tile_solver(tiles: TilesTable) -> Solver:
    return lambda task: TileMethod(replace(task, tiles=tiles), Execution()).image


def _frame_solver(keys: Mapping[str, Any]) -> Solver:
    return lambda task: FrameMethod(replace(task, settings=task.settings.model_copy(update=keys)), Execution()).image


def sample_plan(samples: int, sampler: Sampler) -> Plan:
    """Return passes and samples as renderings use them; too few samples for several passes make a single pass."""
    return plan(samples, sampler) if samples >= FEWEST_PASSES else Plan(1, fitting(sampler, samples))


def settings(subject: Subject) -> tuple[list[Setting], list[Skipped]]:
    """Return all settings, and those that cannot be measured on this machine or for this scene, with the reason.

    Solvers come first, and few samples before many, so that the curves of all ways grow together.
    """
    solvers, left_out = subject.solvers
    reasons = {variant: unusable_reason(variant) for variant in PREFERENCE}
    if not (subject.camera.is_ideal_pinhole or reasons["scalar_rgb"]):
        reasons["scalar_rgb"] = "lenses other than pinholes need a fast backend"
    left_out = [Skipped(what=variant, why=reason) for variant, reason in reasons.items() if reason] + left_out
    counts: list[int | None] = [*SAMPLES]
    try:
        check_noise_target(subject.setup.scene)
        counts.append(None)
    except InputError as error:
        left_out.append(Skipped(what="samples 'auto'", why=str(error)))
    found = [Setting(stage="reconstruct", way=way, setting=setting) for way, setting in solvers]
    variants = [variant for variant, reason in reasons.items() if not reason]
    found += [each for count in counts for each in _sampled(subject.setup.scene.render.sampler, variants, count)]
    return list(dict.fromkeys(found)), left_out  # several numbers may be rounded up to the same


def _sampled(own: Sampler, variants: list[str], samples: int | None) -> Iterator[Setting]:
    """Yield the renderings and calibrations with a number of samples; an adaptive one has the scene's own sampler.

    A calibration refuses fewer samples than it has passes.
    """

    def setting(way: str, sampler: Sampler, variant: str) -> Setting:
        stage = "render" if way == sampler else "calibrate"
        if samples is None:
            return Setting(stage=stage, way=way, variant=variant, setting=AUTO)
        work = sample_plan(samples, sampler)
        words = f"{work.passes} pass{'es' if work.passes > 1 else ''} of {work.samples}"
        return Setting(stage=stage, way=way, variant=variant, samples=work.total, setting=words)

    samplers = (own,) if samples is None else SAMPLERS
    for variant in variants:
        slow = variant.startswith("scalar")
        yield from (setting(sampler, sampler, variant) for sampler in samplers)
        if samples == SAMPLES[0] or (slow and samples is None):
            continue
        yield setting(f"points, {own}", own, variant)
        if not slow:
            yield from (setting(f"transport, {sampler}", sampler, variant) for sampler in samplers)
