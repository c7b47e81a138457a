"""What is left out: every rule, its bound held against the complete rendering, and that nothing is made for it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.noise import depends_on_light
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.negligible import (
    SkippedEffect,
    negligible_shot_noise,
    noise_variance,
    without_negligible_effects,
)
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.scene import parse
from ommatid.scenes.setup import Setup
from ommatid.scenes.skipped import skipped_effects
from ommatid.scenes.stack import stack_from_recording
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.simulate.render import light
from ommatid.simulate.sensor.emva1288 import record

from ..examples import needs, scene
from ..modules import ROOT, existing
from ..simulate.test_ray_transport import TWO, built

NOISY: dict[str, Any] = {"noise": {"variance": 100.0}}
RULES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "in focus": ({"aperture": "0.4 mm"}, {}),
    "nearly in focus": ({"aperture": "0.4 mm", "focus": "970 mm"}, {}),
    "hardly diffracting": ({"aperture": "2.6 mm"}, {"wavelength": "550 nm"}),
}


def short(kind: str, **tables: Any) -> tuple[Any, Any, tuple[SkippedEffect, ...]]:
    described, camera = built(*RULES[kind], TWO, **{**NOISY, **tables})
    return described, *without_negligible_effects(described, camera)


@pytest.mark.parametrize("kind", RULES)
def test_the_bound_holds_for_the_worst_target(kind: str) -> None:
    """In closed form: the target of zeros and 255 that shows most of the difference shows no more than is stated."""
    described, reduced, found = short(kind)
    assert found
    change = (ideal_matrix(derive(described)) - ideal_matrix(reduced)).toarray()
    worst = 255 * np.maximum(np.where(change > 0, change, 0).sum(axis=1), -np.where(change < 0, change, 0).sum(axis=1))
    assert worst.max() <= sum(left.bound for left in found) + 1e-9
    if kind == "nearly in focus":
        assert worst.max() > 0.2 * sum(left.bound for left in found), "nor is it empty words"


@pytest.mark.parametrize("kind", RULES)
def test_the_short_run_agrees_with_the_complete_one(kind: str) -> None:
    needs("llvm_ad_mono")
    samples = {"samples": 1024}
    described, _, found = short(kind, render=samples)
    complete, camera = built(*RULES[kind], TWO, **NOISY, render={**samples, "complete": True})
    assert without_negligible_effects(complete, camera) == (camera, ())
    one, other = light(Setup(described, camera)), light(Setup(complete, camera))
    chance = 6 * np.sqrt(one.variance + other.variance)
    assert (np.abs(one.mean - other.mean) <= sum(left.bound for left in found) + chance).all()


@pytest.mark.parametrize("kind", RULES)
def test_it_draws_fewer_random_numbers_and_compiles_no_lens(kind: str) -> None:
    """The short run is the faster one because it does less; that can be counted on any machine."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer.renderer import Renderer

    _, reduced, _ = short(kind)
    _, camera = built(*RULES[kind], TWO)
    assert list(Renderer(reduced, "llvm_ad_mono").groups) == ["camera"], "pinholes are one sensor"
    counts: list[int] = []
    for one in (reduced, camera):
        rig = Renderer(one, "llvm_ad_mono")
        drawn = [0]
        for eye in rig._eyes.values():  # pyright: ignore[reportPrivateUsage]
            eye.sampler = Counting(eye.sampler, drawn)
            eye.rays(16, 0, eye.blocks(16)[0])
        counts.append(drawn[0] // len(rig.groups))
    assert counts[0] == 1, "the place in the pixel and nothing else"
    assert counts[1] == (3 if kind == "hardly diffracting" else 2)


class Counting:
    """A sampler that counts how often it is asked for two numbers."""

    def __init__(self, sampler: Any, drawn: list[int]) -> None:
        self._sampler, self._drawn = sampler, drawn

    def __getattr__(self, name: str) -> Any:
        return getattr(self._sampler, name)

    def next_2d(self) -> Any:
        self._drawn[0] += 1
        return self._sampler.next_2d()


def test_what_matters_stays() -> None:
    """Little noise, a wide disk of defocus or of diffraction: each is enough to keep the effect."""
    cases: tuple[tuple[dict[str, Any], dict[str, Any], dict[str, Any]], ...] = (
        ({"aperture": "0.4 mm", "focus": "970 mm"}, {}, {"noise": {"variance": 1e-6}}),
        ({"aperture": "0.4 mm", "focus": "970 mm"}, {}, {}),
        ({"aperture": "0.4 mm", "focus": "800 mm"}, {}, NOISY),
        ({"aperture": "0.4 mm"}, {"wavelength": "550 nm"}, NOISY),
        ({"aperture": "0.4 mm"}, {"tolerance": {"focal_length": 0.01}}, NOISY),
    )
    for lens, more, tables in cases:
        described, camera = built(lens, more, TWO, **tables)
        assert without_negligible_effects(described, camera) == (camera, ())


def test_an_aperture_of_one_type_alone_is_left_out() -> None:
    data = scene(lenses=TWO, **NOISY).plain()
    data["camera"]["lens"][0] |= {"aperture": "0.4 mm", "focus": "990 mm"}
    data["camera"]["lens"][1] |= {"aperture": "0.4 mm", "focus": "500 mm"}
    described = parse(data, Path("test.toml"))
    reduced, found = without_negligible_effects(described, derive(described))
    assert [kind.optics.is_pinhole for kind in reduced.types] == [True, False]
    assert [left.what for left in found] == ["samples of the aperture of lens type A"]


def test_the_plan_says_what_why_and_how_much() -> None:
    described, camera = built(*RULES["nearly in focus"], TWO, **NOISY)
    told = [left.describe() for left in skipped_effects(described, camera)]
    apertures = [one for one in told if "aperture" in one["what"]]
    assert len(apertures) == 2
    assert all(0 < one["bound"] < 1 for one in apertures)
    assert "pixels of f wide" in apertures[0]["why"]
    assert "bound" not in next(one for one in told if one["what"] == "interreflection")


def test_noise_of_a_real_sensor_counts_too() -> None:
    data = built({"aperture": "0.4 mm", "focus": "970 mm"}, {}, TWO)[0].plain()
    sensor = {"illuminance": "500 lux", "exposure": "10 ms", "read_noise": 4}
    described = parse({**data, "sensor": sensor}, Path("test.toml"))
    assert noise_variance(described, derive(described)) > 0.01
    assert noise_variance(*built({}, {}, TWO)) == 0


def test_a_pinhole_camera_loads_nothing_of_lenses() -> None:
    """No plugin, kernel or table of an effect that is absent: the modules are not even imported."""
    needs("llvm_ad_mono")
    script = (
        "import sys; from pathlib import Path\n"
        "from tests.examples import scene; from ommatid.scenes.setup import Setup\n"
        "from ommatid.simulate.render import light; from ommatid.simulate.calibrate import calibrate\n"
        "described = scene(render={'samples': 16}, calibration={'samples': 16}); setup = Setup.from_scene(described)\n"
        "light(setup); calibrate(setup)\n"
        "print(*sys.modules)"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    optics = ("blur", "footprints", "footprint_kernels", "distortion", "radiometry")
    simulated = (
        "lenses.prescription",
        "lenses.ray_trace",
        "renderer.real_lens",
        "renderer.world",
        "sensor.emva1288",
        "calibration.ray_transport",
        "calibration.transport_kernels",
    )
    absent = existing(
        *(f"ommatid.scenes.optics.{name}" for name in optics), *(f"ommatid.simulate.{name}" for name in simulated)
    )
    assert not absent & set(ended.stdout.split())


def dim(**more: Any) -> tuple[Any, Any]:
    """Two types that collect some ten electrons, which are read with a noise of thirty."""
    data = built({"aperture": "0.4 mm"}, {}, TWO)[0].plain()
    told = {"illuminance": "1 lux", "exposure": "3 ms", "read_noise": 30, "black_level": 300, "gain": 1.0}
    described = parse({**data, "sensor": told, **more}, Path("test.toml"))
    return described, derive(described)


def test_shot_noise_that_hides_below_the_read_noise_is_left_out() -> None:
    """The short recording is the complete one to the bound, on average over many exposures, and draws no photons."""
    described, camera = dim()
    left = negligible_shot_noise(described, camera)
    assert left is not None
    assert left.describe() in [one.describe() for one in skipped_effects(described, camera)]
    assert negligible_shot_noise(*dim(render={"complete": True})) is None
    assert described.sensor is not None
    response, light = electrons(described, camera), np.full(camera.measurements, 255.0)
    values: dict[bool, list[Any]] = {True: [], False: []}
    for shot, found in values.items():
        for seed in range(60):
            found.append(record(light, response, described.sensor, camera, seed, shot).values)
    means = {shot: np.mean(found, axis=0) for shot, found in values.items()}
    noise = 5 * float(np.mean([np.std(found, axis=0) for found in values.values()])) / 60**0.5
    assert np.abs(means[True] - means[False]).max() < left.bound + noise
    variances = {shot: float(np.var(found, axis=0, ddof=1).mean()) for shot, found in values.items()}
    assert 0.95 < variances[False] / variances[True] < 1.05, "it hides"


def test_without_shot_noise_no_photon_is_drawn_and_nothing_is_estimated_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    described, camera = dim()
    asked = [0]

    class Strict(np.random.Generator):
        def poisson(self, *arguments: Any, **more: Any) -> Any:
            asked[0] += 1
            return super().poisson(*arguments, **more)

    monkeypatch.setattr(np.random, "Generator", Strict)
    assert described.sensor is not None
    response, light = electrons(described, camera), np.full(camera.measurements, 100.0)
    short = record(light, response, described.sensor, camera, 0, shot=False)
    assert asked == [0]
    record(light, response, described.sensor, camera, 0)
    assert asked[0] > 0
    model = ideal_model(described, camera)
    assert not depends_on_light(stack_from_recording(described, camera, short, np.zeros(light.size), {}), model)
    bright, same = dim(sensor={**described.sensor.model_dump(mode="json"), "illuminance": "5000 lux"})
    assert depends_on_light(stack_from_recording(bright, same, short, np.zeros(light.size), {}), model)
