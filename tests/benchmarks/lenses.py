"""Time of rays through five surfaces against Mitsuba's `thinlens` on the same film; transport against point sources.

All render the same image with the same number of rays. ommatid's thin lens and Mitsuba's must agree; the image of the
five surfaces, a cemented achromat and a singlet, differs by their aberrations.
"""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import atan, degrees
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import Scene, parse, read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.point_sources import responses_from_points
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.renderer.plugins import film, scene_of, target_of, texture_of
from ommatid.simulate.renderer.renderer import Renderer

from .alternation import Row, alternate, difference_words

VARIANT, SAMPLER = "llvm_ad_mono", "independent"
SIDE, SAMPLES, REPEATS = 128, 256, 7
APERTURE = 0.4  # mm
TARGET_OF_RAYS, TARGET_OF_TRANSPORT = 1 / 3, 100.0
FIVE = [
    {"radius": "1.6 mm", "thickness": "0.5 mm", "glass": "N-BK7", "semi_diameter": "0.3 mm"},
    {"radius": "-1.1 mm", "thickness": "0.25 mm", "glass": "N-SF11", "semi_diameter": "0.3 mm"},
    {"radius": "-2.6 mm", "thickness": "0.1 mm", "semi_diameter": "0.3 mm"},
    {"thickness": "0.3 mm", "glass": "N-BK7", "semi_diameter": "0.2 mm", "stop": True},
    {"radius": "-4 mm", "semi_diameter": "0.3 mm"},
]


def scene_with(lens: dict[str, Any]) -> Scene:
    """Return a scene with one sub-imager of SIDE x SIDE pixels."""
    kind = {"name": "I", "magnification": "1/2", "array": [1, 1], "pixels": [SIDE, SIDE], **lens}
    target = {"image": "photo:camera", "origin": [0, 0], "shape": [2 * SIDE] * 2}
    return parse(
        {
            "target": {**target, "pixel_pitch": "1 mm", "distance": "1 m"},
            "camera": {"pixel_pitch": "6 um", "lens_pitch": "2 mm", "lens": [kind]},
            "render": {"complete": True},
        },
        Path("benchmark"),
    )


def lens_rows() -> list[Row]:
    """Return rows for ommatid's lens with surfaces and its thin lens, against Mitsuba's thin lens."""
    from ommatid.scenes.formats.picture import load

    described = scene_with({"surfaces": FIVE})
    picture, camera = load(described), derive(described)
    thin = derive(scene_with({"aperture": f"{APERTURE} mm"}))
    methods: list[Callable[[int], Any]] = [_ours(camera, picture), _ours(thin, picture), _thinlens(thin, picture)]
    images = [method(0) for method in methods]
    seconds = alternate(methods, REPEATS)
    rays = SIDE * SIDE * SAMPLES / 1e6
    name = f"Mitsuba's thinlens, {rays / np.median(seconds[2]):.0f} million rays a second"
    return [
        Row(
            variant=VARIANT,
            ours=f"{lens}, {rays / np.median(own):.0f} million",
            other=name,
            seconds=own,
            other_seconds=seconds[2],
            target=target,
            check=difference_words(image, images[2]),
        )
        for lens, own, image, target in (
            ("five surfaces", seconds[0], images[0], TARGET_OF_RAYS),
            ("thin lens", seconds[1], images[1], None),
        )
    ]


def transport_rows(scene_file: Path) -> list[Row]:
    """Return rows for the calibration of a tile with pinholes, and with lenses out of focus."""
    rows: list[Row] = []
    for lenses, keys in (("pinholes", ()), ("lenses out of focus", ('aperture="0.4 mm"', 'focus="800 mm"'))):
        changes = [f"camera.lens.{name}.{key}" for name in ("I", "II", "III") for key in keys]
        setup = Setup.from_scene(read(scene_file, ["calibration.samples=1024", "render.complete=true", *changes]))
        methods = [partial(_calibrate, method, setup) for method in (responses_from_rays, responses_from_points)]
        matrices = [method(0).matrix for method in methods]
        largest = abs(matrices[0] - matrices[1]).max() / matrices[1].max()
        seconds = alternate(methods, 3)
        check = f"H differs by {largest:.1g} of its largest entry"
        target = TARGET_OF_TRANSPORT if keys else None
        rows.append(Row(VARIANT, f"transport, {lenses}", "point sources", seconds[0], seconds[1], target, check))
    return rows


def _calibrate(method: Callable[[Setup], Any], setup: Setup, seed: int) -> Any:
    del seed  # both methods use the scene's own, to give the same H
    return method(setup)


def _ours(camera: Camera, picture: FloatArray) -> Callable[[int], FloatArray]:
    renderer = Renderer(camera, VARIANT, SAMPLER)
    renderer.set_target(picture)
    return lambda seed: renderer.expose("I", SAMPLES, lambda _: seed)[0].reshape(SIDE, SIDE)


def _thinlens(camera: Camera, picture: FloatArray) -> Callable[[int], FloatArray]:
    import mitsuba as mi

    texture = texture_of({"bitmap": mi.Bitmap(picture.astype(np.float32)[..., None])})
    integrator = {"type": "path", "max_depth": 1}
    stage = mi.load_dict({**scene_of(target_of(camera, texture)), "integrator": integrator})
    sensor = mi.load_dict(
        {
            "type": "thinlens",
            "fov": 2 * degrees(atan(camera.columns * camera.target_pitch / 2 / camera.distance)),
            "aperture_radius": APERTURE / 2,
            "focus_distance": camera.distance,
            "near_clip": 1.0,
            "far_clip": 2 * camera.distance,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0], [0, 0, 1], [0, 1, 0]),
            "film": film(SIDE, SIDE),
            "sampler": {"type": SAMPLER, "sample_count": SAMPLES},
        }
    )

    def render(seed: int) -> FloatArray:
        image: Any = mi.render(stage, sensor=sensor, spp=SAMPLES, seed=seed)  # pyright: ignore
        return np.array(image, dtype=np.float64)[..., 0]

    return render
