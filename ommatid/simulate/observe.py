"""Stacks of given images, H f with the noise of the scene's sensor, where nothing is rendered."""

from __future__ import annotations

from dataclasses import replace
from operator import index
from time import perf_counter

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError, shortened_repr
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.runtime.versions import versions
from ommatid.scenes.model import Model
from ommatid.scenes.scene import with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack

from .render import exposed


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
