"""Rendering of all sub-images: the mean of passes with seeds of their own, its variance, and the sensor's recording.

A stack is reused from its file while its fingerprint matches the scene. Those of given images are H f with the noise of
the scene's sensor, where nothing is rendered.
"""

from __future__ import annotations

from dataclasses import replace
from operator import index
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy import ndimage

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError, shortened_repr
from ommatid.runtime.files import cached, digest, fingerprint
from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.runtime.versions import versions
from ommatid.scenes import stack
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.optics.negligible import negligible_shot_noise
from ommatid.scenes.recording import Recording
from ommatid.scenes.scene import TRUTH, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.shrinkage import posterior_variances_among
from ommatid.scenes.stack import STRAIGHT, Stack
from ommatid.scenes.tables.sensor import SensorTable

from .renderer.variant import choose, release
from .sampling.checkpoint import Checkpoint, open_checkpoint
from .sampling.passes import Plan, Rendering, plan, rounding_variance
from .world_view import rendered_world

NEIGHBOURHOOD = 5  # pixels, whose variances tell what to expect of the one in their middle


def stated_variance(camera: Camera, mean: FloatArray, variance: FloatArray, work: Plan) -> FloatArray:
    """Return the variance of a mean over passes, (M,), shrunk among pixels with like neighbours.

    It is never below float32's rounding, and 0 of pixels that no light reaches, whose reading is not a number.
    """
    stated, known = np.empty_like(variance), np.nan_to_num(variance, nan=0.0)
    for lens_type, rows in zip(camera.types, camera.type_slices(), strict=True):
        images = known[rows].reshape(lens_type.count, *lens_type.pixels)
        around = np.concatenate([mean_of_neighbours(image).ravel() for image in images])
        shrunk = posterior_variances_among(known[rows], around, work.passes)
        stated[rows] = np.maximum(shrunk, rounding_variance(np.nan_to_num(mean[rows], nan=0.0), work.samples))
    return stated


def mean_of_neighbours(image: FloatArray) -> FloatArray:
    """Return the mean of the other pixels in the neighbourhood of each pixel of an image, as far as it lies inside."""
    sums, counts = (
        NEIGHBOURHOOD**2 * ndimage.uniform_filter(values, NEIGHBOURHOOD, mode="constant")
        for values in (image, np.ones_like(image))
    )
    return (sums - image) / np.maximum(counts - 1, 1)


def made_from(setup: Setup) -> str:
    """Return the fingerprint of everything that the values of a stack depend on."""
    scene, world = setup.scene, dict[str, Any]()
    if scene.world is not None:
        from .renderer.world import describe

        world = {"world": describe(scene)}
    return fingerprint(
        {
            **world,
            "camera": setup.camera.describe(),
            "simulated": setup.world.simulated.describe(),
            "target": digest(setup.picture.astype(np.float32)),
            "noise": scene.noise.model_dump() if scene.noise else None,
            "sensor": scene.sensor.model_dump() if scene.sensor else None,
            "render": scene.render.model_dump(exclude_none=True),
            "versions": versions("mitsuba"),
        }
    )


def light(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    work: Plan | None = None,
) -> Rendering:
    """Render the light alone, before the sensor, with the given number of samples.

    work : passes and their samples; None: as the scene's `render.samples` asks
    Raises InputError if the requested variant does not work here, ValueError if the samples are "auto".
    """
    scene = setup.scene
    if work is None and scene.render.samples == "auto":
        raise ValueError("expected a number of samples, got 'auto', which `render_until` renders")
    variant = choose(scene.render.variant)  # before Mitsuba is loaded
    from .renderer.renderer import Renderer

    work = plan(scene.render.sample_count, scene.render.sampler) if work is None else work
    renderer = Renderer(setup.world.simulated, variant, scene.render.sampler, world=rendered_world(setup))
    renderer.set_target(setup.world.image)
    mean, variance = renderer.mean_of_passes("data", scene.render.seed, work, progress, checkpoint)
    mean *= setup.camera.received
    variance *= np.square(setup.camera.received)
    record = work.record(variant, scene.render.seed, "data")
    stated = variance if work.passes == 1 else stated_variance(setup.camera, mean, variance, work)
    return Rendering(mean, variance, stated, record, renderer.direct_only)


def render(
    setup: Setup,
    progress: Progress = no_progress,
    checkpoint: Checkpoint | None = None,
    truth: FloatArray | None = None,
) -> Stack:
    """Render and record the sub-images of the setup's image on its target.

    truth : image that the estimate is compared with; None: the image on the target
    Raises InputError if the requested variant does not work here.
    """
    scene, world, start = setup.scene, rendered_world(setup), perf_counter()
    if scene.render.samples == "auto":
        from .adaptive_render import render_until

        rendering = render_until(setup, progress, checkpoint)
    else:
        rendering = light(setup, progress, checkpoint)
    release()  # some hundred bytes per reading of a large frame, while it is reconstructed
    record: dict[str, Any] = {
        "fingerprint": made_from(setup),
        "truth": digest((setup.image if truth is None else truth).astype(np.float32)),
        "seconds": perf_counter() - start,
        "seed": scene.render.seed,
        "sampler": scene.render.sampler,
        **rendering.record,
        **({STRAIGHT: True} if rendering.direct_only else {}),
        **({} if world is None or world.world is None else {"white": world.world.white}),
        "versions": versions("mitsuba", "drjit", "OpenEXR"),
    }
    return exposed(setup, rendering.mean, rendering.stated, record)


def exposed(setup: Setup, light: FloatArray, variance: FloatArray, record: dict[str, Any]) -> Stack:
    """Record light, (M,), of known variance by the scene's sensor; its noise follows from the scene's seed."""
    scene, camera, values = setup.scene, setup.camera, light
    if scene.sensor is not None:
        recording = _recording(setup, scene.sensor, light)
        return Stack(setup.resolved, camera, recording.values, variance, record, recording)
    if scene.noise is not None:
        from .sensors import expose, generators

        values = expose(values, scene.noise, generators(camera, scene.render.seed), camera.slices())
    return Stack(setup.resolved, camera, values, variance, record)


def _recording(setup: Setup, sensor: SensorTable, light: FloatArray) -> Recording:
    from ommatid.scenes.optics.radiometry import electrons

    from .sensors import record

    dark = np.isnan(light)  # no light can reach these pixels, so their flat frame marks them as dead
    response = np.where(dark, 0.0, electrons(setup.scene, setup.camera))
    shot = negligible_shot_noise(setup.scene, setup.camera) is None
    return record(np.where(dark, 0.0, light), response, sensor, setup.camera, setup.scene.render.seed, shot)


def observed_stacks(setup: Setup, model: Model, images: FloatArray, seed: int) -> list[Stack]:
    """Return the stacks of images, (..., rows, columns) on the grid of H, in the order of the leading axes.

    seed : of the noise; the stream of an image follows from the seed and its number
    Raises InputError for other shapes, values or seeds.
    """
    _check(images, setup, model)
    pictures = images.reshape(-1, *model.camera.shape)
    return [_observed(setup, model, picture, _seed(seed, number)) for number, picture in enumerate(pictures)]


def _check(images: FloatArray, setup: Setup, model: Model) -> None:
    shape = model.camera.shape
    if images.shape[-2:] != shape:
        raise InputError(
            f"images: expected [..., {shape[0]}, {shape[1]}], the grid of H, got {list(images.shape)}; set"
            " target.shape of the scene to the shape of your images, and calibrate it"
        )
    if not np.isfinite(images).all():
        raise InputError("images: expected finite values, got NaN or infinity; replace them by numbers")
    if setup.scene.sensor is not None and (images < 0).any():
        raise InputError(f"images: a [sensor] counts electrons, expected values of 0 or more, got {images.min():g}")


def _seed(seed: int, number: int) -> int:
    try:
        return derived_seed(index(seed), Purpose.OBSERVATION, number)
    except (TypeError, ValueError) as error:
        raise InputError(f"seed: expected a whole number of 0 or more, got {shortened_repr(seed)}") from error


def _observed(setup: Setup, model: Model, image: FloatArray, seed: int) -> Stack:
    start, scene = perf_counter(), setup.scene
    light = model.forward(image)
    light = light if scene.sensor is None else np.maximum(light, 0.0)  # entries of a calibrated H may be negative
    seeded = replace(setup, scene=with_tables(scene, render=scene.render.model_copy(update={"seed": seed})))
    record = {"method": "observed", "seed": seed, "seconds": perf_counter() - start, "versions": versions()}
    return exposed(seeded, light, np.zeros(light.size), record)


def cached_stack(path: Path, setup: Setup, progress: Progress) -> tuple[Stack, bool]:
    """Return the stack at `path` as it is on disk, and True if it had to be rendered.

    The truth of a world is stored beside the stack. Raises what `render` raises.
    """
    truth = setup.image
    if setup.scene.world is not None:
        from .ground_truth import cached_truth

        truth = cached_truth(path.with_name(TRUTH), setup)
    wanted = made_from(setup)
    with open_checkpoint(path, wanted) as checkpoint:
        result, made = cached(
            path, wanted, _read_stack, lambda: render(setup, progress, checkpoint, truth), stack.write
        )
    record = {**result.record, "truth": digest(truth.astype(np.float32))}
    if result.scene.plain() != setup.resolved.plain() or result.record != record:
        # The estimator's tables or the truth may have changed; the values have not.
        stack.write(path, replace(result, scene=setup.resolved, record=record))
        result = stack.read(path)
    return result, made


def _read_stack(path: Path) -> tuple[Stack, str | None]:
    result = stack.read(path)
    return result, result.record.get("fingerprint")
