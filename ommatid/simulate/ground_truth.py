"""The truth of a world: its image through an ideal camera in the centre of the array.

A pinhole at the origin, whose pixels are those of f: each is the mean over its square on the target's plane. It is
rendered with the same integrator as the sub-images, with separate seeds, and with more samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import cached, digest, fingerprint
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.exr import read
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.setup import Setup

from .renderer.variant import choose
from .renderer.world import describe
from .sampling.passes import plan
from .world_view import ideal_camera, rendered_world, views

FINER = 3  # depth is the median of 3 x 3 points of a pixel
TRUER = 4  # times the samples of a sensor pixel, whose own noise changes the estimate by far more


@dataclass(frozen=True)
class Truth:
    """Image of a world through an ideal pinhole in the array's centre, (rows, columns) each.

    variance : of that mean, by its scatter over passes
    depth : distance along z of the nearest surface, median over the pixel, NaN where there is none
    """

    image: FloatArray
    variance: FloatArray
    depth: FloatArray
    samples: int


def truth(setup: Setup) -> Truth:
    """Render the image that an estimate is compared with; its seeds are neither those of data nor of calibration.

    Raises InputError for a world that cannot be built, or a variant that does not work here.
    """
    scene, camera = setup.scene, setup.camera
    variant = choose(scene.render.variant)  # before Mitsuba is loaded
    from .renderer.renderer import Renderer

    work = plan(TRUER * scene.render.sample_count, scene.render.sampler)
    renderer = Renderer(ideal_camera(camera).world, variant, scene.render.sampler, world=rendered_world(setup))
    renderer.set_target(setup.world.image)
    mean, variance = renderer.mean_of_passes("truth", scene.render.seed, work)
    depth = _depth(renderer.staged, camera)
    return Truth(
        image=mean.reshape(camera.shape),
        variance=variance.reshape(camera.shape),
        depth=np.where(np.isfinite(depth), depth, np.nan),
        samples=work.total,
    )


def _depth(world: Any, camera: Camera) -> FloatArray:
    """Return the depth, (rows, columns), that rays from the array's centre meet; infinite where they meet nothing."""
    from .renderer.worlds.building import depths_met

    origins, directions = views(ideal_camera(camera), camera.shape)
    beside = camera.target_pitch * ((np.arange(FINER) + 0.5) / FINER - 0.5)
    moves = [(x, y, 0.0) for x in beside.tolist() for y in beside.tolist()]
    points = [depths_met(world.scene, world.placement, origins, directions + move) for move in moves]
    return np.asarray(np.median(points, axis=0)).reshape(camera.shape)


def truth_from(setup: Setup) -> str:
    """Return the fingerprint of everything that the truth depends on. Raises InputError."""
    camera = setup.camera.describe()
    return fingerprint(
        {
            **{name: camera[name] for name in ("target.shape", "target.pixel_pitch", "target.distance")},
            "picture": digest(setup.picture.astype(np.float32)),
            "world": describe(setup.scene),
            "render": setup.scene.render.model_dump(exclude_none=True),
            "versions": versions("mitsuba"),
        }
    )


def cached_truth(path: Path, setup: Setup) -> FloatArray:
    """Return the truth at `path`, rendered if it is missing or its fingerprint differs."""
    made_from = truth_from(setup)

    def write(path: Path, new: Truth) -> None:
        record = {"fingerprint": made_from, "samples": new.samples, "variance": float(new.variance.mean())}
        write_truth(path, new.image, new.depth, record)

    return cached(path, made_from, _read_truth, lambda: truth(setup), write)[0]


def _read_truth(path: Path) -> tuple[FloatArray, str | None]:
    (part,) = read(path)
    return part.channels["Y"].astype(np.float64), part.record.get("fingerprint")
