"""What leaving out saves: the same scene with what is too small to matter, and without it."""

# pyright: basic
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.negligible import SkippedEffect, negligible_shot_noise, without_negligible_effects
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.sampling.passes import plan
from ommatid.simulate.sensor.emva1288 import record

from .alternation import Row, alternate

VARIANT, SAMPLER, SAMPLES, REPEATS = "llvm_ad_mono", "multijitter", 256, 9
SIDE = 119
LENSES = (("I", "1/3", 3), ("II", "1/5", 5), ("III", "1/4", 4))
SENSOR = {"illuminance": "1 lux", "exposure": "3 ms", "read_noise": 30, "black_level": 300}
RULES: dict[str, tuple[dict[str, str], dict[str, str]]] = {
    "apertures in focus": ({"aperture": "0.4 mm"}, {}),
    "apertures nearly in focus": ({"aperture": "0.4 mm", "focus": "970 mm"}, {}),
    "diffraction that hardly shows": ({"aperture": "2.6 mm"}, {"wavelength": "550 nm"}),
}


def leaving_out_rows() -> list[Row]:
    """Every rule: the light of a rendering with and without, and the electrons of an exposure."""
    return [*(_light(kind) for kind in RULES), _shot()]


def _scene(lens: dict[str, str], more: dict[str, str], **tables: Any) -> tuple[Scene, Camera]:
    kinds = [{"name": name, "magnification": ratio, "array": [m, m], "pixels": "fit"} for name, ratio, m in LENSES]
    target = {"image": "photo:camera", "origin": [0, 0], "shape": [SIDE, SIDE]}
    tables = {"noise": {"variance": 100.0}, **tables} if "sensor" not in tables else tables
    scene = parse(
        {
            "target": {**target, "pixel_pitch": "1 mm", "distance": "1 m"},
            "camera": {"pixel_pitch": "6 um", "lens_pitch": "3 mm", **more, "lens": [kind | lens for kind in kinds]},
            **tables,
        },
        Path("benchmark"),
    )
    return scene, derive(scene)


def _light(kind: str) -> Row:
    from ommatid.scenes.formats.picture import load

    scene, camera = _scene(*RULES[kind])
    short, left = without_negligible_effects(scene, camera)
    picture, each = load(scene), plan(SAMPLES * 16).samples
    ways: list[Callable[[int], Any]] = [_exposure(one, picture, each) for one in (short, camera)]
    images = [way(0) for way in ways]
    seconds = alternate(ways, REPEATS)
    apart = float(np.abs(images[0] - images[1]).max())
    check = f"{apart:.2g} apart at most, chance included; stated {_bound(left):.2g} without it"
    return Row(VARIANT, f"without {kind}", "complete", seconds[0], seconds[1], None, check)


def _exposure(camera: Camera, picture: NDArray[np.float64], samples: int) -> Callable[[int], NDArray[np.float64]]:
    renderer = Renderer(camera, VARIANT, SAMPLER)
    renderer.set_target(picture)

    def expose(seed: int) -> NDArray[np.float64]:
        found = [renderer.expose(group, samples, lambda place: 100 * seed + place)[0] for group in renderer.groups]
        return np.concatenate(found)

    return expose


def _shot() -> Row:
    scene, camera = _scene({"aperture": "0.4 mm"}, {}, sensor=SENSOR)
    left, sensor = negligible_shot_noise(scene, camera), scene.sensor
    assert sensor is not None
    freed, light = electrons(scene, camera), np.full(camera.measurements, 100.0)

    def way(shot: bool) -> Callable[[int], Any]:
        return lambda seed: record(light, freed, sensor, camera, seed, shot)

    seconds = alternate([way(False), way(True)], REPEATS)
    stated = "was not left out" if left is None else f"stated {left.bound:.2g}"
    return Row("-", "without shot noise below the read noise", "complete", seconds[0], seconds[1], None, stated)


def _bound(left: tuple[SkippedEffect, ...]) -> float:
    return sum(one.bound or 0.0 for one in left)
