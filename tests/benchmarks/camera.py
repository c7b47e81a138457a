"""Time to render the whole camera at once, against Mitsuba's sensors of one sub-imager or one lens type each."""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import read
from ommatid.simulate.renderer.plugins import film, scene_of, stock_sensor, target_of, texture_of
from ommatid.simulate.renderer.renderer import Renderer

from .alternation import Row, alternate, difference_words

SAMPLES = (256, 1024)  # of one pass of a scene with 4096 samples, and of a typical rendering without passes
SAMPLER = "multijitter"
REPEATS = 9
TARGET = 3.0

Reader = Callable[[int], FloatArray]  # from a seed to the values of the sensor pixels, (M,)


def camera_rows(scene_file: Path, variant: str, samples: int) -> list[Row]:
    """Return a row for each of Mitsuba's methods, against the fastest of ommatid's that the variant supports."""
    scene = read(scene_file)
    camera = derive(scene)
    picture = load(scene)
    ours = _ours(camera, picture, variant, samples)
    loop, batches = _loop(camera, picture, samples), _batches(camera, picture, samples)
    stock = f"{len(camera.sub_imagers)} `perspective` sensors, one by one"
    if variant.startswith("scalar"):
        # There our renderer is a loop of stock sensors itself.
        methods = {"Renderer: as many stock sensors": ours, stock: loop}
    else:
        methods = {"Renderer: all rays at once": ours, stock: loop, f"{len(camera.types)} `batch` sensors": batches}
    images = [method(0) for method in methods.values()]  # also warms them up
    seconds = alternate(list(methods.values()), REPEATS)
    names = list(methods)
    return [
        Row(
            variant=variant,
            ours=names[0],
            other=names[index],
            seconds=seconds[0],
            other_seconds=seconds[index],
            target=TARGET if index == 1 and not variant.startswith("scalar") else None,
            check=difference_words(images[0], images[index]),
        )
        for index in range(1, len(methods))
    ]


def _ours(camera: Camera, picture: FloatArray, variant: str, samples: int) -> Reader:
    renderer = Renderer(camera, variant, SAMPLER)
    renderer.set_target(*[picture] * renderer.channels)

    def expose(seed: int) -> FloatArray:
        # A different seed for each sensor, or their noise would be correlated.
        return np.concatenate(
            [renderer.expose(group, samples, lambda index: 1000 * seed + index)[0] for group in renderer.groups]
        )

    return expose


def _stock_scene(camera: Camera, picture: FloatArray) -> object:
    import mitsuba as mi

    texture = texture_of({"bitmap": mi.Bitmap(picture.astype(np.float32)[..., None])})
    # Mitsuba chooses its blocks: with ours, a film of 5 x 5 pixels would be one block and occupy one core only.
    integrator = {"type": "path", "max_depth": 1}
    return mi.load_dict({**scene_of(target_of(camera, texture)), "integrator": integrator})


def _loop(camera: Camera, picture: FloatArray, samples: int) -> Reader:
    import mitsuba as mi

    scene = _stock_scene(camera, picture)
    sensors = [mi.load_dict(stock_sensor(camera, sub, SAMPLER, samples)) for sub in camera.sub_imagers]

    def render(seed: int) -> FloatArray:
        numbered = enumerate(sensors, seed * len(sensors))
        # Nothing is read back before all are queued, so that the loop does not wait for each.
        images = [mi.render(scene, sensor=sensor, spp=samples, seed=own) for own, sensor in numbered]  # pyright: ignore
        return np.concatenate([np.array(image, dtype=np.float64).ravel() for image in images])

    return render


def _batches(camera: Camera, picture: FloatArray, samples: int) -> Reader:
    import mitsuba as mi

    scene = _stock_scene(camera, picture)
    sensors = [
        mi.load_dict(
            {
                "type": "batch",
                "film": film(lens_type.pixels[1] * lens_type.count, lens_type.pixels[0]),
                "sampler": {"type": SAMPLER, "sample_count": samples},
                **{
                    f"sub{index:04d}": stock_sensor(camera, sub, SAMPLER, samples)
                    for index, sub in enumerate(sub for sub in camera.sub_imagers if sub.type == lens_type)
                },
            }
        )
        for lens_type in camera.types
    ]

    def render(seed: int) -> FloatArray:
        numbered = enumerate(sensors, seed * len(sensors))
        images = [mi.render(scene, sensor=sensor, spp=samples, seed=own) for own, sensor in numbered]  # pyright: ignore
        upright = [
            np.array(image, dtype=np.float64)
            .reshape(lens_type.pixels[0], lens_type.count, lens_type.pixels[1])
            .swapaxes(0, 1)
            for image, lens_type in zip(images, camera.types, strict=True)
        ]
        return np.concatenate([image.ravel() for image in upright])

    return render
