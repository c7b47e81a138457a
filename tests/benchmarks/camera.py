"""The whole camera in one go against Mitsuba's own sensors, which know one sub-imager or one lens type each."""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import read
from ommatid.simulate.renderer.plugins import film, scene_of, stock_sensor, target_of, texture_of
from ommatid.simulate.renderer.renderer import Renderer

from .alternation import Row, alternate

SAMPLES = (256, 1024)  # of one pass of a scene that asks for 4096, and of many a rendering without passes
SAMPLER = "multijitter"
REPEATS = 9
AIM = 3.0

Reader = Callable[[int], NDArray[np.float64]]  # a seed in, what the sensor pixels read out, (M,)


def camera_rows(scene_file: Path, variant: str, samples: int) -> list[Row]:
    """One row for each of Mitsuba's own ways, against the fastest of ours that the variant allows."""
    scene = read(scene_file)
    camera = derive(scene)
    picture = load(scene)
    ours = _ours(camera, picture, variant, samples)
    loop, batches = _loop(camera, picture, samples), _batches(camera, picture, samples)
    stock = f"{len(camera.sub_imagers)} `perspective` sensors, one by one"
    if variant.startswith("scalar"):
        # There our renderer is a loop of stock sensors itself.
        ways = {"Rig: as many stock sensors": ours, stock: loop}
    else:
        ways = {"Rig: all rays at once": ours, stock: loop, f"{len(camera.types)} `batch` sensors": batches}
    readings = [way(0) for way in ways.values()]  # and so each is warm
    seconds = alternate(list(ways.values()), REPEATS)
    names = list(ways)
    return [
        Row(
            variant,
            names[0],
            names[place],
            seconds[0],
            seconds[place],
            AIM if place == 1 and not variant.startswith("scalar") else None,
            _difference(readings[0], readings[place]),
        )
        for place in range(1, len(ways))
    ]


def _difference(one: NDArray[np.float64], other: NDArray[np.float64]) -> str:
    apart = one - other
    return f"pixels differ by {np.sqrt((apart**2).mean()):.2g} RMS, {np.abs(apart).max():.2g} at most, of 255"


def _ours(camera: Camera, picture: NDArray[np.float64], variant: str, samples: int) -> Reader:
    renderer = Renderer(camera, variant, SAMPLER)
    renderer.set_target(*[picture] * renderer.channels)

    def expose(seed: int) -> NDArray[np.float64]:
        # Each sensor a seed of its own, else their noise would be alike.
        return np.concatenate(
            [renderer.expose(group, samples, lambda place: 1000 * seed + place)[0] for group in renderer.groups]
        )

    return expose


def _stock_scene(camera: Camera, picture: NDArray[np.float64]) -> object:
    import mitsuba as mi

    texture = texture_of({"bitmap": mi.Bitmap(picture.astype(np.float32)[..., None])})
    # Mitsuba may choose its blocks: with ours, a film of 5 x 5 pixels is one block and occupies one core only.
    integrator = {"type": "path", "max_depth": 1}
    return mi.load_dict({**scene_of(target_of(camera, texture)), "integrator": integrator})


def _loop(camera: Camera, picture: NDArray[np.float64], samples: int) -> Reader:
    import mitsuba as mi

    scene = _stock_scene(camera, picture)
    sensors = [mi.load_dict(stock_sensor(camera, sub, SAMPLER, samples)) for sub in camera.sub_imagers]

    def render(seed: int) -> NDArray[np.float64]:
        numbered = enumerate(sensors, seed * len(sensors))
        # Nothing is read back before all are queued, so that the loop need not wait for each.
        images = [mi.render(scene, sensor=sensor, spp=samples, seed=own) for own, sensor in numbered]  # pyright: ignore
        return np.concatenate([np.array(image, dtype=np.float64).ravel() for image in images])

    return render


def _batches(camera: Camera, picture: NDArray[np.float64], samples: int) -> Reader:
    import mitsuba as mi

    scene = _stock_scene(camera, picture)
    sensors = [
        mi.load_dict(
            {
                "type": "batch",
                "film": film(kind.pixels[1] * kind.count, kind.pixels[0]),
                "sampler": {"type": SAMPLER, "sample_count": samples},
                **{
                    f"sub{place:04d}": stock_sensor(camera, sub, SAMPLER, samples)
                    for place, sub in enumerate(sub for sub in camera.sub_imagers if sub.type == kind)
                },
            }
        )
        for kind in camera.types
    ]

    def render(seed: int) -> NDArray[np.float64]:
        numbered = enumerate(sensors, seed * len(sensors))
        images = [mi.render(scene, sensor=sensor, spp=samples, seed=own) for own, sensor in numbered]  # pyright: ignore
        upright = [
            np.array(image, dtype=np.float64).reshape(kind.pixels[0], kind.count, kind.pixels[1]).swapaxes(0, 1)
            for image, kind in zip(images, camera.types, strict=True)
        ]
        return np.concatenate([image.ravel() for image in upright])

    return render
