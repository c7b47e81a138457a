"""A pilot: how uncertain a calibration leaves H, and a rendering its light, with given samples, from few rays.

Rays are traced as for a calibration by transport, with seeds that neither data nor calibration uses, on the same grids
of samples but in fewer passes: what n passes leave is 1/n of the variance of one. Where that is still too much work the
grids are smaller, and variances are extrapolated. A rendering with as many samples has the same law as a calibration:
the reading of a pass is the row of H of that pass, applied to the picture. A world with depth has no such rows: its
light is rendered, with half the passes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.errors import MachineError
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import shrink_variances

from ..calibrate import LEAST, plans_of, rendered_model
from ..render import light
from ..renderer.variant import choose, unusable_reason
from ..sampling.passes import BATCHES, Plan, Plans, SampleLaw, plan
from ..sampling.samplers import fitting
from .responses import positions_of, same_plans

MOST_RAYS = 2**26  # of a pilot: some seconds
FEWEST_SAMPLES = 16  # per pixel in a pass
MOST_PER_PIXEL = 2**16  # samples of a pilot for H itself
SCALAR = "only Mitsuba's scalar backend works here, which traces no single rays"


@dataclass(frozen=True)
class Pilot:
    """H by a pilot.

    factor : (M,) variances with all samples of its plans, relative to those of the pilot
    extrapolated : True if these follow from fewer samples per pass
    """

    model: Model
    factor: FloatArray
    extrapolated: bool

    def rendering_variance(self, image: FloatArray) -> FloatArray:
        """Return the variance of an image's rendering, (N,), with all samples: (M,), shrunk as a rendering's is.

        It counts the rays that miss the target too, whose number is part of a reading's error.
        """
        model, count = self.model, len(self.model.batches)
        rows = np.repeat(np.arange(model.measurements), np.diff(model.matrix.indptr))
        seen = image[model.matrix.indices]
        scatter = np.zeros(model.measurements)
        for batch in model.batches:
            scatter += np.square(np.bincount(rows, weights=batch * seen, minlength=model.measurements))
        scatter /= count * (count - 1)
        shrunk = [shrink_variances(scatter[pixels], count) for pixels in model.camera.slices()]
        return self.factor * np.concatenate(shrunk)

    def around(self, matrix: sparse.csr_array, factor: float = 1.0) -> Model:
        """Return an H that deviates from the true one as H by all samples does, with the variances of its entries.

        matrix : (M, N) the true H;  factor : on the variances, of yet other numbers of samples
        An estimator that takes it for exact errs as one does that takes a calibrated H; noise added to the readings of
        the true H would be another error.
        """
        model, both = self.model, (self.model.matrix, matrix)
        one, other = (sparse.csr_array((np.ones(h.nnz), h.indices, h.indptr), shape=h.shape) for h in both)
        joined = sparse.csr_array(one + other)
        cells = positions_of(joined)
        at, at_true = (np.searchsorted(cells, positions_of(h)) for h in both)
        scale = factor * self.factor[cells // model.unknowns]
        found, true, variance = np.zeros((3, cells.size))
        batches: Float32Array = np.zeros((len(model.batches), cells.size), dtype=np.float32)
        found[at], variance[at], batches[:, at] = model.matrix.data, model.variance, model.batches
        true[at_true] = matrix.data
        joined.data = true + np.sqrt(scale) * (found - true)
        batches *= np.sqrt(scale).astype(np.float32)
        return replace(model, stored=joined, variance=variance * scale, batches=batches)


def reason_against(setup: Setup) -> str:
    """Return why no pilot can be traced here, or ""."""
    try:
        if choose("auto").startswith("scalar"):
            return SCALAR
    except MachineError:
        return "Mitsuba is not installed, or cannot be loaded"
    if setup.camera.measurements * BATCHES * FEWEST_SAMPLES > 2 * MOST_RAYS:
        return f"{setup.camera.measurements} sensor pixels are too many for a pilot"
    return ""


def calibration_plans(setup: Setup) -> Plans:
    """Return the samples that the scene's calibration takes, by lens type; of "auto" those of its first round."""
    scene = setup.scene
    if scene.calibration.samples == "auto":
        return plans_of(setup, LEAST, float64=True)
    return same_plans(setup)


def rendering_plans(setup: Setup) -> Plans:
    """Return the samples that the scene's rendering takes, by lens type; of "auto" those of its first round."""
    render = setup.scene.render
    if render.samples == "auto":
        return plans_of(setup, LEAST, float64=False)
    work = plan(render.samples, render.sampler)
    return {lens_type.name: work for lens_type in setup.camera.types}


def best_plans(setup: Setup, plans: Plans) -> Plans:
    """Return plans for an H that is known as well as a pilot allows, at least as well as by `plans`."""
    affordable = min(MOST_RAYS // setup.camera.measurements, MOST_PER_PIXEL)
    work = plan(max(affordable, LEAST), setup.scene.render.sampler)
    return {name: work if work.total > wanted.total else wanted for name, wanted in plans.items()}


def setup_of_pilot(setup: Setup, **calibration: Any) -> Setup:
    """Return the setup of a calibration by rays with seeds of its own and some other settings.

    Raises InputError if only Mitsuba's scalar backend works.
    """
    scene = setup.scene
    changed = scene.calibration.model_copy(update={"method": "transport", **calibration})
    render = scene.render.model_copy(
        update={"seed": derived_seed(scene.render.seed, Purpose.PILOT), "variant": _fast_variant(scene.render.variant)}
    )
    return replace(setup, scene=with_tables(scene, calibration=changed, render=render))


def pilot(setup: Setup, plans: Plans) -> Pilot:
    """Trace a pilot for the samples of `plans`, entry by entry. Raises InputError as `setup_of_pilot` does."""
    scene = setup.scene
    traced = _affordable(setup, plans)
    model = rendered_model(setup_of_pilot(setup, fit="none"), plans=traced, float64=scene.calibration.samples == "auto")
    few = not any(lens.optics.draws_more for lens in setup.simulated.types)
    law = SampleLaw.expected(scene.render.sampler) if few else SampleLaw()
    return Pilot(model, *_factor(setup.camera, traced, plans, law))


def world_variance(setup: Setup, plans: Plans) -> tuple[FloatArray, bool]:
    """Return the variance of a rendering of the scene's world, (M,), with the samples of `plans`, from half the passes.

    And True if it follows from fewer samples per pass. Paths through a world scatter as independent rays do. Raises
    InputError as `setup_of_pilot` does, or where the world cannot be built.
    """
    few = min(_affordable(setup, plans).values(), key=lambda work: work.samples)
    few = Plan(BATCHES, few.samples)
    rendering = light(setup_of_pilot(setup), work=few)
    factor, extrapolated = _factor(setup.camera, dict.fromkeys(plans, few), plans, SampleLaw())
    return factor * rendering.stated, extrapolated


def _factor(camera: Camera, traced: Plans, plans: Plans, law: SampleLaw) -> tuple[FloatArray, bool]:
    """Return the variances with the samples of `plans` over those of `traced`, (M,), and True if samples differ."""
    rows = np.empty(camera.measurements)
    for lens_type, pixels in zip(camera.types, camera.type_slices(), strict=True):
        rows[pixels] = law.ratio(traced[lens_type.name], plans[lens_type.name])
    return rows, any(traced[name].samples < work.samples for name, work in plans.items())


def _fast_variant(requested: str) -> str:
    """Return the scene's variant, or the fastest that works here if that traces no single rays."""
    usable = requested != "auto" and not requested.startswith("scalar") and not unusable_reason(requested)
    return requested if usable else choose("auto")


def _affordable(setup: Setup, plans: Plans) -> Plans:
    """Return the plans with the fewest passes that a model needs, and smaller grids where rays are still too many."""
    camera, sampler = setup.camera, setup.scene.render.sampler
    if _rays(camera, plans) <= MOST_RAYS:
        return plans
    fewer = {name: Plan(BATCHES, work.samples) for name, work in plans.items()}
    share = MOST_RAYS / _rays(camera, fewer)
    if share >= 0.5:
        return fewer
    return {
        name: Plan(BATCHES, min(work.samples, fitting(sampler, max(int(share * work.samples), FEWEST_SAMPLES))))
        for name, work in fewer.items()
    }


def _rays(camera: Camera, plans: Plans) -> int:
    return sum(lens_type.measurements * plans[lens_type.name].total for lens_type in camera.types)
