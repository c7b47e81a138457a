"""Time to render the whole camera at once, against Mitsuba's sensors of one sub-imager or one lens type each."""

# pyright: basic
from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from rich.table import Table

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.versions import versions
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import read
from ommatid.simulate.renderer.plugins import film, scene_of, stock_sensor, target_of, texture_of
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import unusable_reason

from .alternation import alternate

SAMPLES = (256, 1024)  # of one pass of a scene with 4096 samples, and of a typical rendering without passes
SAMPLER = "multijitter"
REPEATS = 9
VARIANTS = ("llvm_ad_mono", "scalar_rgb")
SCENE = Path(__file__).parents[2] / "scenes" / "tile19.toml"

Reader = Callable[[int], FloatArray]  # from a seed to the values of the sensor pixels, (M,)


def camera_table() -> Table:
    """Return times of ommatid and of stock Mitsuba, on every variant that works here."""
    releases = ", ".join(f"{name} {version}" for name, version in versions("mitsuba", "drjit").items())
    table = Table(title=f"tile19 against stock Mitsuba, on {os.cpu_count()} cores with {releases}", show_lines=True)
    for name in ("samples", "variant", "A", "B", "time of A", "time of B", "B / A", "difference of the results"):
        table.add_column(name)
    reasons = {variant: unusable_reason(variant) for variant in VARIANTS}
    for variant in VARIANTS:
        for samples in () if reasons[variant] else SAMPLES:
            for row in camera_rows(variant, samples):
                table.add_row(*row)
    skipped = [f"{variant} was left out: {reason}." for variant, reason in reasons.items() if reason]
    table.caption = " ".join([f"Medians (minimum to maximum) of {REPEATS} repeats in alternation.", *skipped])
    return table


def camera_rows(variant: str, samples: int) -> Iterator[tuple[str, ...]]:
    """Yield a row for each of Mitsuba's methods, against the fastest of ommatid's that the variant supports."""
    scene = read(SCENE)
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
    first, *others = methods
    for index, other in enumerate(others, 1):
        ratios, difference = seconds[index] / seconds[0], images[0] - images[index]
        yield (
            str(samples),
            variant,
            first,
            other,
            *(f"{np.median(spent) * 1e3:.0f} ms" for spent in (seconds[0], seconds[index])),
            f"{np.median(ratios):.3g} ({ratios.min():.3g} to {ratios.max():.3g})",
            f"{np.sqrt((difference**2).mean()):.2g} RMS, {np.abs(difference).max():.2g} at most, of 255",
        )


def _ours(camera: Camera, picture: FloatArray, variant: str, samples: int) -> Reader:
    renderer = Renderer(camera, variant, SAMPLER)
    renderer.set_target(*[picture] * renderer.channels)

    def expose(seed: int) -> FloatArray:
        # A different seed for each sensor, or their noise would be correlated.
        seeds = [lambda index: 1000 * seed + index]
        every = [renderer.expose(renderer.pixels(group), samples, seeds)[0, 0] for group in renderer.groups]
        return np.concatenate(every)

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
