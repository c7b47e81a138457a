"""Time saved by skipping negligible effects: the same scene with and without them."""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.negligible import negligible_shot_noise, without_negligible_effects
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.sampling.passes import plan
from ommatid.simulate.sensors import record

from .alternation import Row, alternate

VARIANT, SAMPLER, SAMPLES, REPEATS = "llvm_ad_mono", "multijitter", 256, 9
SIDE = 119
LENSES = (("I", "1/3", 3), ("II", "1/5", 5), ("III", "1/4", 4))
SENSOR = {"illuminance": "1 lux", "exposure": "3 ms", "read_noise": 30, "black_level": 300}
RULES: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "apertures in focus": ({"aperture": "0.4 mm"}, {}),
    "apertures nearly in focus": ({"aperture": "0.4 mm", "focus": "970 mm"}, {}),
    "negligible diffraction": ({"aperture": "2.6 mm"}, {"wavelength": "550 nm"}),
}


def leaving_out_rows() -> list[Row]:
    """Return a row per rule for the light of a rendering, and one for the electrons of an exposure."""
    return [*(_light_row(rule) for rule in RULES), _shot_noise_row()]


def _scene(lens: dict[str, str], more: dict[str, str], **tables: Any) -> tuple[Scene, Camera]:
    types = [{"name": name, "magnification": ratio, "array": [m, m], "pixels": "fit"} for name, ratio, m in LENSES]
    target = {"image": "photo:camera", "origin": [0, 0], "shape": [SIDE, SIDE]}
    tables = {"noise": {"variance": 100.0}, **tables} if "sensor" not in tables else tables
    scene = parse(
        {
            "target": {**target, "pixel_pitch": "1 mm", "distance": "1 m"},
            "camera": {
                "pixel_pitch": "6 um",
                "lens_pitch": "3 mm",
                **more,
                "lens": [lens_type | lens for lens_type in types],
            },
            **tables,
        },
        Path("benchmark"),
    )
    return scene, derive(scene)


def _light_row(rule: str) -> Row:
    from ommatid.scenes.formats.picture import load

    scene, camera = _scene(*RULES[rule])
    short, left = without_negligible_effects(scene, camera)
    picture, each = load(scene), plan(SAMPLES * 16).samples
    methods: list[Callable[[int], Any]] = [_exposure(simulated, picture, each) for simulated in (short, camera)]
    images = [method(0) for method in methods]
    seconds = alternate(methods, REPEATS)
    largest = float(np.abs(images[0] - images[1]).max())
    bound = sum(effect.bound or 0.0 for effect in left)
    check = f"at most {largest:.2g} including noise; bound without noise {bound:.2g}"
    return Row(VARIANT, f"without {rule}", "complete", seconds[0], seconds[1], None, check)


def _exposure(camera: Camera, picture: FloatArray, samples: int) -> Callable[[int], FloatArray]:
    renderer = Renderer(camera, VARIANT, SAMPLER)
    renderer.set_target(picture)

    def expose(seed: int) -> FloatArray:
        groups = renderer.groups
        return np.concatenate(
            [renderer.expose(group, samples, lambda index: 100 * seed + index)[0] for group in groups]
        )

    return expose


def _shot_noise_row() -> Row:
    scene, camera = _scene({"aperture": "0.4 mm"}, {}, sensor=SENSOR)
    left, sensor = negligible_shot_noise(scene, camera), scene.sensor
    assert sensor is not None
    freed, light = electrons(scene, camera), np.full(camera.measurements, 100.0)

    def recorder(shot: bool) -> Callable[[int], Any]:
        return lambda seed: record(light, freed, sensor, camera, seed, shot)

    seconds = alternate([recorder(False), recorder(True)], REPEATS)
    check = "was not skipped" if left is None else f"bound {left.bound:.2g}"
    return Row("-", "without shot noise below the read noise", "complete", seconds[0], seconds[1], None, check)
