"""Render what every sub-imager sees: passes with seeds of their own, their mean, its variance, then the sensor."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.camera import Camera
from scenes.files import digest, fingerprint
from scenes.moderate import moderate
from scenes.partial import Partial
from scenes.progress import Progress, no_progress
from scenes.scene import Scene, resolved
from scenes.stack import Stack
from scenes.versions import versions

from .passes import OverPasses, Tally, plan, rounding_variance
from .streams import sampler_seeds
from .variant import choose


@dataclass(frozen=True)
class Rendering(OverPasses):
    """Light on every sensor pixel, (M,): the mean of the passes, and the variance of that mean from their scatter."""

    mean: NDArray[np.float64]
    variance: NDArray[np.float64]


def made_from(scene: Scene, camera: Camera, image: NDArray[np.float64]) -> str:
    """Fingerprint of everything that the values of a stack depend on."""
    return fingerprint(
        {
            "camera": camera.describe(),
            "target": digest(image.astype(np.float32)),
            "noise": scene.noise.model_dump() if scene.noise else None,
            "render": scene.render.model_dump(),
            "versions": versions("mitsuba"),
        }
    )


def light(
    scene: Scene,
    camera: Camera,
    image: NDArray[np.float64],
    progress: Progress = no_progress,
    partial: Partial | None = None,
) -> Rendering:
    """Render the light alone, before the sensor. Raises InputError if the variant asked for does not work here.

    partial : where passes that are done are kept and found again
    """
    from .rig import Rig

    variant = choose(scene.render.variant)
    work = plan(scene.render.samples)
    rig = Rig(camera, variant, scene.render.sampler)
    rig.show(image)
    tally = Tally(camera.measurements)
    if partial is not None:
        tally.resume("light", partial.state())
    for number in range(tally.count, work.passes):
        values = np.empty(camera.measurements)
        for group in rig.groups:
            seed = sampler_seeds(scene.render.seed, "data", number, work.passes)
            values[rig.places(group)] = rig.expose(group, work.samples, seed)[0]
        tally.add(values)
        if partial is not None:
            partial.offer(lambda: tally.state("light"))
        progress((number + 1) / work.passes)
    return Rendering(
        passes=work.passes,
        samples=work.samples,
        variant=variant,
        first_seed=sampler_seeds(scene.render.seed, "data", 0, work.passes)(0),
        mean=tally.mean,
        variance=tally.variance,
    )


def render(
    scene: Scene,
    camera: Camera,
    image: NDArray[np.float64],
    progress: Progress = no_progress,
    partial: Partial | None = None,
) -> Stack:
    """Render and record the sub-images of `image`, (rows, columns).

    The variance of each pixel's mean is drawn towards its sub-image's and never below float32's rounding.
    Raises InputError if the variant asked for does not work here.
    """
    start = perf_counter()
    rendering = light(scene, camera, image, progress, partial)
    floor = rounding_variance(rendering.mean, rendering.samples)
    variance = np.concatenate([moderate(rendering.variance[place], rendering.passes) for place in camera.slices()])
    values = rendering.mean
    if scene.noise is not None:
        from .expose import expose, generators

        values = expose(values, scene.noise, generators(camera, scene.render.seed), camera.slices())
    record: dict[str, Any] = {
        "fingerprint": made_from(scene, camera, image),
        "truth": digest(image.astype(np.float32)),
        "seconds": perf_counter() - start,
        "seed": scene.render.seed,
        "sampler": scene.render.sampler,
        **rendering.record(),
        "versions": versions("mitsuba", "drjit", "OpenEXR"),
    }
    kept = resolved(scene, (camera.rows, camera.columns))
    return Stack(kept, camera, values, np.maximum(variance, floor), record)
