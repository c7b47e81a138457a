"""Skipped effects: the rules, their bounds against complete renderings, and that skipping saves the work."""

from __future__ import annotations

import subprocess
import sys
from bisect import bisect_left
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from ommatid.reconstruct.noise import depends_on_light
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.lens_matrix import row_by_waves
from ommatid.scenes.optics.negligible import (
    MOST_SHOT,
    SkippedEffect,
    light_kept_in_focus,
    negligible_shot_noise,
    skipped_effects,
    without_negligible_effects,
)
from ommatid.scenes.optics.point_spread import point_spread
from ommatid.scenes.optics.radiometry import electrons
from ommatid.scenes.optics.wavefront import thin_wavefront
from ommatid.scenes.scene import parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.simulate.sampling.passes import Plan
from ommatid.simulate.sensors import record

from ..examples import THREE, TWO, needs, not_none, scene, slow, with_optics
from ..modules import ROOT, existing

RAYS = {"wavelength": "none"}
NOISY: dict[str, Any] = {"noise": {"variance": 1e4}}
RULES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "in focus": ({"aperture": "0.4 mm"}, RAYS),
    "nearly in focus": ({"aperture": "0.4 mm", "focus": "970 mm"}, RAYS),
    "hardly diffracting": ({"aperture": "2.35 mm"}, {"wavelength": "550 nm", "lens_pitch": "3 mm"}),
}


def reduced_scene(rule: str, **tables: Any) -> tuple[Any, Any, tuple[SkippedEffect, ...]]:
    """A scene, its camera without negligible effects, and the skipped effects."""
    described, camera = with_optics(*RULES[rule], **{**NOISY, **tables})
    return described, *without_negligible_effects(described, camera)


@pytest.mark.parametrize("rule", RULES)
def test_the_bound_holds_for_the_worst_target(rule: str) -> None:
    """In closed form, for the target of values 0 and 255 with the largest difference in each measurement."""
    described, reduced, skipped = reduced_scene(rule)
    assert skipped
    change = (ideal_matrix(derive(described)) - ideal_matrix(reduced)).toarray()
    worst = 255 * np.maximum(np.where(change > 0, change, 0).sum(axis=1), -np.where(change < 0, change, 0).sum(axis=1))
    assert worst.max() <= sum(effect.bound for effect in skipped) + 1e-9
    if rule == "nearly in focus":
        assert worst.max() > 0.2 * sum(effect.bound for effect in skipped), "the bound is not far too wide"


@pytest.mark.parametrize("rule", ["nearly in focus", slow("hardly diffracting")])
def test_the_expected_error_without_the_effect_is_low_by_two_percent_at_most(rule: str) -> None:
    """At the least noise at which the effect is skipped, by dense algebra; at the corners rays miss the target.

    Thresholds that compare the change far from the edges with a tenth of the noise fail, by 3 to 14 %.
    """

    def reduced(noise: float) -> Camera | None:
        without = without_negligible_effects(*with_optics(*RULES[rule], THREE, noise={"variance": noise}))[0]
        skips = without.wavelength is None and all(each.optics.aperture is None for each in without.types)
        return without if skips else None

    noises: list[float] = np.geomspace(1e-3, 1e5, 100).tolist()
    noise = noises[bisect_left(noises, True, key=lambda variance: reduced(variance) is not None)]
    camera, (mean, variance) = reduced(noise), (127.5, 5461.25)
    assert camera is not None
    designed = ideal_matrix(camera).toarray()
    actual = ideal_matrix(with_optics(*RULES[rule], THREE)[1]).toarray()
    gain = variance * designed.T @ np.linalg.inv(variance * designed @ designed.T + noise * np.eye(len(designed)))
    errors: list[float] = []
    for matrix in (designed, actual):
        resolution = np.eye(camera.unknowns) - gain @ matrix
        shift = gain @ (matrix - designed).sum(axis=1) * mean
        errors.append(variance * float(np.square(resolution).sum()) + float(shift @ shift))
    noisy = noise * float(np.square(gain).sum())
    assert 1 < (errors[1] + noisy) / (errors[0] + noisy) < 1.02


@pytest.mark.parametrize("rule", RULES)
def test_the_reduced_rendering_draws_fewer_random_numbers(rule: str) -> None:
    """The speed-up, counted in a way that does not depend on the machine."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer.renderer import Renderer

    _, reduced, _ = reduced_scene(rule)
    _, camera = with_optics(*RULES[rule])
    assert list(Renderer(reduced, "llvm_ad_mono").groups) == ["camera"], "all pinholes are one Mitsuba sensor"
    counts: list[int] = []
    for each in (reduced, camera):
        renderer = Renderer(each, "llvm_ad_mono")
        drawn = 0
        for group, generator in renderer._generators.items():  # pyright: ignore[reportPrivateUsage]
            generator.sampler = spy = Mock(wraps=generator.sampler)
            generator.sampled(renderer.pixels(group), Plan(1, 16), 0)
            drawn += spy.next_2d.call_count
        counts.append(drawn // len(renderer.groups))
    assert counts[0] == 1, "only the position in the pixel"
    assert counts[1] == 2


def test_effects_that_matter_are_kept() -> None:
    """Little noise, no noise, a wide disk of defocus, a wide Airy disk, and misalignment."""
    cases: tuple[tuple[dict[str, Any], dict[str, Any], dict[str, Any]], ...] = (
        ({"aperture": "0.4 mm", "focus": "970 mm"}, RAYS, {"noise": {"variance": 1e-6}}),
        ({"aperture": "0.4 mm", "focus": "970 mm"}, RAYS, {}),
        ({"aperture": "0.4 mm", "focus": "800 mm"}, RAYS, NOISY),
        ({"aperture": "0.4 mm"}, {"wavelength": "550 nm"}, NOISY),
        ({"aperture": "0.4 mm"}, RAYS | {"tolerance": {"focal_length": 0.01}}, NOISY),
    )
    for lens, more, tables in cases:
        described, camera = with_optics(lens, more, **tables)
        assert without_negligible_effects(described, camera) == (camera, ())


def test_the_aperture_of_a_single_type_is_skipped() -> None:
    data = scene(lenses=TWO, **NOISY).plain()
    data["camera"]["lens"][0] |= {"aperture": "0.4 mm", "focus": "990 mm"}
    data["camera"]["lens"][1] |= {"aperture": "0.4 mm", "focus": "500 mm"}
    data["camera"] |= RAYS
    described = parse(data, Path("test.toml"))
    reduced, skipped = without_negligible_effects(described, derive(described))
    assert [lens_type.optics.is_pinhole for lens_type in reduced.types] == [True, False]
    assert [effect.what for effect in skipped] == ["samples of the aperture of lens type A"]


TRACED = "renderer.diffracting_lens renderer.real_lens renderer.world"


@pytest.mark.slow
def test_a_pinhole_camera_imports_no_modules_of_lenses() -> None:
    """No plugin, kernel or table of an absent effect is loaded."""
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
    optics = "diffraction footprints distortion radiometry prescription ray_trace wavefront point_spread field"
    absent = existing(
        *(f"ommatid.scenes.optics.{name}" for name in (*optics.split(), "lens_matrix", "lens_kernels")),
        *(f"ommatid.simulate.{name}" for name in TRACED.split()),
    )
    assert not absent & set(ended.stdout.split())


def dim(**more: Any) -> tuple[Any, Any]:
    """A scene of two types that collect about ten electrons, with a read noise of thirty, and its camera."""
    data = with_optics({"aperture": "0.4 mm"}, {})[0].plain()
    sensor = {"illuminance": "1 lux", "exposure": "3 ms", "read_noise": 30, "black_level": 300, "gain": 1.0}
    described = parse({**data, "sensor": sensor, **more}, Path("test.toml"))
    return described, derive(described)


@pytest.mark.slow
def test_negligible_shot_noise_changes_exposures_by_less_than_its_bound() -> None:
    """Means and variances over 60 exposures with and without shot noise, to five standard errors."""
    described, camera = dim()
    skipped = not_none(negligible_shot_noise(described, camera))
    assert skipped.describe() in [effect.describe() for effect in skipped_effects(described, camera)]
    assert negligible_shot_noise(*dim(render={"complete": True})) is None
    response, light = electrons(described, camera), np.full(camera.measurements, 255.0)
    exposures = {
        shot: np.array(
            [record(light, response, not_none(described.sensor), camera, seed, shot).values for seed in range(60)]
        )
        for shot in (True, False)
    }
    means = {shot: values.mean(axis=0) for shot, values in exposures.items()}
    noise = 5 * float(np.mean([values.std(axis=0) for values in exposures.values()])) * (2 / 60) ** 0.5
    assert np.abs(means[True] - means[False]).max() < skipped.bound + noise
    variances = {shot: float(values.var(axis=0, ddof=1).mean()) for shot, values in exposures.items()}
    standard_error = 2 / (59 * light.size) ** 0.5  # relative, of the ratio of two mean sample variances
    assert 1 / (1 + MOST_SHOT) - 5 * standard_error < variances[False] / variances[True] < 1 + 5 * standard_error


def test_without_shot_noise_no_photon_is_drawn_and_one_estimate_suffices(monkeypatch: pytest.MonkeyPatch) -> None:
    described, camera = dim()
    draws = [0]

    class Strict(np.random.Generator):
        def poisson(self, *arguments: Any, **more: Any) -> Any:
            draws[0] += 1
            return super().poisson(*arguments, **more)

    monkeypatch.setattr(np.random, "Generator", Strict)
    assert described.sensor is not None
    response, light = electrons(described, camera), np.full(camera.measurements, 100.0)
    short = record(light, response, described.sensor, camera, 0, shot=False)
    assert draws == [0]
    record(light, response, described.sensor, camera, 0)
    assert draws[0] > 0
    model = ideal_model(described, camera)
    assert not depends_on_light(Stack(described, camera, short.values, np.zeros(light.size), {}, short), model)
    bright, same = dim(sensor={**described.sensor.model_dump(mode="json"), "illuminance": "5000 lux"})
    assert depends_on_light(Stack(bright, same, short.values, np.zeros(light.size), {}, short), model)


@pytest.mark.parametrize("side", [0.1, 1.0, 3.0, 10.0])
def test_the_light_that_a_pixel_keeps_is_an_entry_of_h(side: float) -> None:
    """By Parseval, against the entry of a footprint and a texel of one size, integrated over the Airy pattern."""
    spread = point_spread(thin_wavefront(1e-3, 1e3, 0.0, 1.0, 1.0, 1e-3 / side))
    kept = row_by_waves(spread.values, spread.cell, (np.array([0.0, 1.0]),) * 2, (0.0, 0.0), (1, 1))[0, 0]
    assert light_kept_in_focus(side) == pytest.approx(kept, abs=1e-6)


def test_pinholes_and_rays_say_what_diffraction_would_change() -> None:
    """A white target of one footprint before a black world loses the light that leaves its pixel."""
    described, camera = with_optics({}, {}, (("1/3", [1, 1], [5, 5]),))
    first = skipped_effects(described, camera)[0]
    assert first.what == "aperture and diffraction"
    lens = {"aperture": f"{camera.lens_pitch} mm"}
    for table in ({}, RAYS):
        _, wide = with_optics(lens, table, (("1/3", [1, 1], [5, 5]),))
        assert wide.wavelengths == (((550e-6, 1.0),) if not table else ())
    _, waves = with_optics(lens, {}, (("1/3", [1, 1], [5, 5]),))
    change = (ideal_matrix(waves) - ideal_matrix(camera)).toarray()
    largest = 255 * np.maximum(np.maximum(change, 0).sum(axis=1), np.maximum(-change, 0).sum(axis=1)).max()
    assert 0.5 * first.bound < largest <= first.bound
    described, rays = with_optics(lens, RAYS, (("1/3", [1, 1], [5, 5]),))
    left_out = {effect.what: effect for effect in skipped_effects(described, rays)}
    assert largest / 1.0001 <= left_out["diffraction"].bound < 1.01 * first.bound
