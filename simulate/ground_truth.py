"""What a world truly looks like: what an ideal camera in the array's centre sees of it through the pixels of f.

A pinhole at the origin, whose pixels are those of f: each is the mean over its square on the target's plane. It is
rendered with the same integrator as the sub-images, with seeds of its own, and with more samples.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.files import cached, digest, fingerprint
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.exr import read
from ommatid.scenes.formats.picture import write_truth
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from .renderer.variant import choose
from .renderer.world import describe
from .sampling.passes import Plan, Tally, plan
from .sampling.samplers import filling

FINER = 3  # depth is the median of 3 x 3 points of a pixel
TRUER = 4  # times the samples of a sensor pixel: what a sensor pixel's noise does to the estimate is far larger still
MOST_RAYS = 2**22  # at once


@dataclass(frozen=True)
class Truth:
    """What an ideal pinhole in the array's centre sees through each pixel of f, (rows, columns) each.

    variance : of that mean by its scatter over passes
    depth : distance along z of the nearest surface, median over the pixel, NaN where there is none
    """

    image: NDArray[np.float64]
    variance: NDArray[np.float64]
    depth: NDArray[np.float64]
    samples: int


def ideal_camera(camera: Camera, finer: int = 1) -> Camera:
    """A pinhole in the array's centre whose pixels are those of f, or `finer` x `finer` of them to one of f."""
    whole = LensType(
        "truth", Fraction(1, finer), (1, 1), (camera.rows * finer, camera.columns * finer), Fraction(1), (0, 0)
    )
    return replace(camera, types=(whole,), wavelength=None, tolerance=None, lens_columns=None)


def truth(setup: Setup) -> Truth:
    """Render what the estimate is compared with; its seeds are neither those of data nor of calibration.

    Raises InputError for a world that cannot be built, or a variant that does not work here.
    """
    from .renderer.renderer import Renderer

    scene, camera = setup.scene, setup.camera
    variant, work = choose(scene.render.variant), _plan(scene, camera)
    rig = Renderer(ideal_camera(camera), variant, scene.render.sampler, around=scene)
    rig.set_target(setup.image)
    start = int(np.random.SeedSequence(scene.render.seed, spawn_key=(zlib.crc32(b"truth"),)).generate_state(1)[0])
    tally = Tally(camera.unknowns)
    for number in range(work.passes):
        (group,) = rig.groups
        tally.add(rig.expose(group, work.samples, lambda _, number=number: (start + number) % 2**32)[0])
    shape = camera.rows, camera.columns
    depth = rig.depths(ideal_camera(camera, FINER), start).reshape(camera.rows, FINER, camera.columns, FINER)
    middle = np.median(depth, axis=(1, 3))
    return Truth(
        image=tally.mean.reshape(shape),
        variance=tally.variance.reshape(shape),
        depth=np.where(np.isfinite(middle), middle, np.nan),
        samples=work.total,
    )


def _plan(scene: Scene, camera: Camera) -> Plan:
    """TRUER times the samples of a sensor pixel, in passes of a size that memory holds."""
    work = plan(TRUER * scene.render.sample_count, scene.render.sampler)
    most = max(1, MOST_RAYS // camera.unknowns)
    if work.samples <= most:
        return work
    each = filling(scene.render.sampler, most)
    return Plan(ceil(work.total / each), each)


def truth_from(setup: Setup) -> str:
    """Fingerprint of everything that the truth depends on. Raises InputError."""
    described = setup.camera.describe()
    kept = {name: described[name] for name in ("target.shape", "target.pixel_pitch", "target.distance")}
    return fingerprint(
        {
            **kept,
            "picture": digest(setup.image.astype(np.float32)),
            "world": describe(setup.scene),
            "render": setup.scene.render.model_dump(exclude_none=True),
            "versions": versions("mitsuba"),
        }
    )


def cached_truth(path: Path, setup: Setup) -> NDArray[np.float64]:
    """The truth as `path` holds it, rendered where it is not there or was made from something else."""
    wanted = truth_from(setup)

    def write_made(path: Path, made: Truth) -> None:
        record = {"fingerprint": wanted, "samples": made.samples, "variance": float(made.variance.mean())}
        write_truth(path, made.image, made.depth, record)

    return cached(path, wanted, _read_truth, lambda: truth(setup), write_made)[0]


def _read_truth(path: Path) -> tuple[NDArray[np.float64], str | None]:
    (part,) = read(path)
    return part.channels["Y"].astype(np.float64), part.record.get("fingerprint")
