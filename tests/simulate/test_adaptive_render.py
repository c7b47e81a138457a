"""Adaptive numbers of samples: rendering to a target variance, calibration to a target precision of H."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.analysis.calibration_goal import for_prior, for_stack
from ommatid.reconstruct.restore import restore
from ommatid.runtime.progress import no_progress
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import (
    FLOAT32,
    LEAST,
    SAMPLES,
    SHARE,
    TIME,
    render_until,
)
from ommatid.simulate.calibrate import GOAL, StoppingRule, cached_model, calibrate
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import cached_stack, render
from ommatid.simulate.sampling.passes import (
    EXACT_PASSES,
    Plan,
    Rendering,
    SampleLaw,
    rounding_variance,
    samples_within,
)

from ..conftest import Command
from ..examples import GALLERY, SLOW_SCALAR, THREE, VARIANTS, needs, scene
from .test_checkpoint import after

FRACTIONAL = (("2/5", [2, 2], [5, 5]), ("3/8", [2, 2], [4, 4]))  # pixels see pixels of f in part


AUTO = {"samples": "auto", "variant": "scalar_rgb"}


def auto(shape: tuple[int, int] = (19, 19), lenses: Any = THREE, **render: Any) -> Scene:
    return scene(shape, lenses, render=AUTO | render, noise={"variance": 1e-2})


def lit(described: Scene, **more: Any) -> Rendering:
    return render_until(Setup.from_scene(described), **more)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("sampler", ["multijitter", "independent", "ldsampler"])
def test_the_target_variance_is_reached_in_every_pixel(variant: str, sampler: str) -> None:
    needs(variant)
    described = scene(
        (12, 12),
        (("1/3", [2, 2], [3, 3]),),
        render={"samples": "auto", "variant": variant, "sampler": sampler},
        noise={"variance": 1.0, "bits": 8},
    )
    stack = render(Setup.from_scene(described))
    assert described.noise is not None
    assert stack.record["reached"]
    assert not stack.record["not_reached"]
    assert (stack.rendering_variance <= SHARE * (1.0 + described.noise.quantisation_variance)).all()


def behind_pinholes(seed: int) -> Scene:
    described = auto((19, 19), (("2/5", [2, 2], [5, 5]),), seed=seed, sampler="independent")
    noise = described.noise and described.noise.model_copy(update={"variance": 2.0})
    return described.model_copy(update={"noise": noise})


def behind_apertures(seed: int) -> Scene:
    """Three rounds and more, before each of which most pixels are done."""
    apertures = [f'camera.lens.{name}.aperture="0.4 mm"' for name in ("I", "II", "III")]
    changes = ["target.shape=[35,35]", "render.samples=auto", 'camera.lens_pitch="1 mm"', f"render.seed={seed}"]
    return read(GALLERY / "photo.toml", [*changes, *apertures])


@pytest.mark.slow
@pytest.mark.parametrize("described", [behind_pinholes, behind_apertures])
def test_the_stated_variance_is_that_of_the_error(described: Callable[[int], Scene]) -> None:
    """Over seeds: the sum of squared errors over the sum of stated variances is 1 within its own scatter (t test)."""
    ratios: list[float] = []
    for seed in range(20):
        setup = Setup.from_scene(described(seed))
        found = render_until(setup)
        error = found.mean - ideal_matrix(setup.camera) @ setup.image.ravel()
        ratios.append(float(np.sum(error**2) / np.sum(found.variance)))
    mean, deviation = np.mean(ratios), np.std(ratios, ddof=1) / len(ratios) ** 0.5
    limit = float(stats.t.isf(0.005, len(ratios) - 1))
    assert abs(mean - 1) < limit * deviation, f"{mean:.3f} +- {deviation:.3f}"


@pytest.mark.parametrize("variant", SLOW_SCALAR)
def test_values_do_not_depend_on_other_sub_imagers(variant: str) -> None:
    needs(variant)
    both = auto(lenses=THREE, variant=variant, sampler="stratified")
    alone = auto(lenses=THREE[:1], variant=variant, sampler="stratified")
    first, other = lit(both), lit(alone)
    count = other.mean.size
    assert first.mean[:count].tobytes() == other.mean.tobytes()
    assert first.variance[:count].tobytes() == other.variance.tobytes()


def test_the_time_limit_ends_rendering_after_the_first_round() -> None:
    ticks = iter(range(10**6))
    described = auto(sampler="independent", time="3 s")
    found = lit(described, clock=lambda: float(next(ticks)))
    assert not found.record["reached"]
    assert set(found.record["not_reached"].values()) == {TIME}
    assert (found.variance > 0).all()
    assert found.record["fewest_samples"] >= LEAST
    assert found.record["samples"] < 2 * LEAST, "11,900 without a limit"
    endless = lit(auto(lenses=THREE[:1], time="1e9 s"), clock=lambda: 0.0)
    assert endless.mean.tobytes() == lit(auto(lenses=THREE[:1])).mean.tobytes(), (
        "an unused time limit changes no exact rendering"
    )


def test_a_long_rendering_says_what_it_costs(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    """A clock that jumps by 100 s makes it long: said once, with the rays; fewer samples are offered if worth it."""
    described = scene((14, 14), FRACTIONAL[:1], render={**AUTO, "sampler": "independent"}, noise={"variance": 2.0})
    ticks = iter(range(0, 10**9, 100))
    lit(described, clock=lambda: float(next(ticks)))
    assert not caplog.messages, "few rays, most of whose time is that of compilation"
    monkeypatch.setattr("ommatid.simulate.adaptive_render.TIMED", 0)
    for worth, offered in ((0.0, False), (math.inf, True)):
        monkeypatch.setattr("ommatid.simulate.adaptive_render.WORTH", worth)
        ticks = iter(range(0, 10**9, 100))
        found = lit(described, clock=lambda ticks=ticks: float(next(ticks)))
        assert found.record["rounds"] > 1
        (message,) = caplog.messages
        assert re.search(r"'auto' takes about .* more \(.*e\+.* rays\)", message)
        assert ("; on average it is with render.samples = " in message) == offered
        assert message.endswith("; render.time limits it")
        caplog.clear()
    lit(described, clock=lambda: 0.0)
    assert not caplog.messages


def test_an_unreachable_target_is_recorded_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    silent = scene(
        (14, 14), FRACTIONAL[:1], render={"samples": "auto", "variant": "scalar_rgb"}, noise={"variance": 1e-12}
    )
    assert set(lit(silent).record["not_reached"].values()) <= {FLOAT32, SAMPLES}
    assert lit(silent).record["not_reached"], "float32 does not resolve 1e-6 of 255"
    monkeypatch.setattr("ommatid.simulate.adaptive_render.MOST", 2048)
    few = auto((14, 14), FRACTIONAL[:1], sampler="independent")
    found = lit(few)
    assert set(found.record["not_reached"].values()) == {SAMPLES}
    assert found.record["samples"] <= 2 * 2048 + LEAST


@pytest.mark.parametrize("sets", [["noise.variance="], ["noise.variance=0"]], ids=["no noise", "noise of 0"])
def test_a_scene_without_noise_is_refused_before_any_work(here: Path, ommatid: Command, sets: list[str]) -> None:
    told = [part for one in [*sets, "render.samples=auto"] for part in ("--set", one)]
    ended = ommatid("run", "tiny.toml", "-o", "out", *told)
    assert ended.code == 2
    assert "render.samples 'auto'" in ended.err
    assert "noise.variance" in ended.err
    assert not (here / "out" / "tiny" / "stack.exr").exists()
    ended = ommatid("calibrate", "tiny.toml", "-o", "h.npz", "--set", "calibration.samples=auto", "--set", sets[0])
    assert ended.code == 2
    assert "calibration.samples 'auto'" in ended.err


def test_an_interrupted_rendering_continues(tmp_path: Path) -> None:
    described = auto(lenses=FRACTIONAL)
    camera, image = derive(described), load(described)

    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", Setup(described, camera, image), after(0.5))
    assert [path.name for path in tmp_path.iterdir()] == [".stack.exr.partial.npz"]
    found, _ = cached_stack(tmp_path / "stack.exr", Setup(described, camera, image), no_progress)
    whole, _ = cached_stack(tmp_path / "whole.exr", Setup(described, camera, image), no_progress)
    np.testing.assert_array_equal(found.values, whole.values)
    np.testing.assert_array_equal(found.variance, whole.variance)
    assert found.record["spent"] == whole.record["spent"]


def test_predicted_samples_divide_the_variance_by_the_factor() -> None:
    last = Plan(16, 64)
    for exponent in (1.0, 1.5, 2.0):
        law = SampleLaw(exponent)
        for factor, most in ((10.0, 10**6), (1e4, 512)):
            total = law.samples(factor, last, most)
            each = min(total / 16, most)
            ratio = (each / 64) ** exponent * total / (16 * each)
            bound = max(last.total * 2, min(total, last.total * 64))
            assert ratio == pytest.approx(factor, rel=0.01) or total == bound
        assert law.ratio(last, Plan(32, 256)) == pytest.approx(1 / (2 * 4**exponent), rel=1e-12)


def test_the_rounding_variance_inverts() -> None:
    values = np.array([3.0, 255.0])
    for samples in (64, 1024, 4096):
        variance = rounding_variance(values, samples)
        assert samples - 1 <= samples_within(values, variance) <= samples, "rounded down"


@pytest.mark.parametrize(
    ("variant", "method"),
    [pytest.param("scalar_rgb", "points", marks=pytest.mark.slow), ("llvm_ad_mono", "transport")],
)
def test_calibration_continues_until_h_adds_little(tmp_path: Path, variant: str, method: str) -> None:
    needs(variant)
    described = scene(
        (14, 14),
        (("1/3", [3, 3], [4, 4]), ("1/4", [4, 4], [2, 2])),
        render={"samples": 256, "variant": variant, "sampler": "ldsampler"},
        calibration={"samples": "auto", "method": method},
        noise={"variance": 4.0},
    )
    camera, image = derive(described), load(described)
    stack = render(Setup(described, camera, image))
    rule = for_stack(stack)
    model, made = cached_model(tmp_path / "model.npz", Setup(described, camera), no_progress, rule)
    assert made
    assert model.record["auto"]["reached"]
    assert rule.added_error(model) == pytest.approx(model.record["auto"]["adds"])
    budget = restore(stack, model).budget()
    assert budget["calibration"] <= GOAL * (sum(budget.values()) - budget["calibration"])
    assert model.scene.calibration.samples == "auto"
    assert not cached_model(tmp_path / "model.npz", Setup(described, camera), no_progress, rule)[1], "up to date"
    fixed = described.model_copy(update={"calibration": described.calibration.model_copy(update={"samples": 256})})
    assert cached_model(tmp_path / "model.npz", Setup(fixed, camera), no_progress, rule)[1], "another model"


def endless() -> tuple[Scene, Camera]:
    """Return a small camera with an open number of samples."""
    described = scene(
        (9, 9),
        (("1/3", [1, 1], [3, 3]),),
        render={"variant": "scalar_rgb"},
        calibration={"samples": "auto"},
        noise={"variance": 1.0},
    )
    return described, derive(described)


@pytest.mark.slow
def test_few_rounds_reach_the_goal_and_an_unreachable_one_is_recorded() -> None:
    """With a stopping rule by which the addition of H falls like 1 / samples^1.5."""
    described, camera = endless()

    def calibrated(first: float) -> dict[str, Any]:
        rule = StoppingRule(lambda model: first * (model.record["samples"] / 256) ** -1.5, "law", "a law")
        return calibrate(Setup(described, camera), stopping_rule=rule).record

    record = calibrated(1.0)
    assert record["auto"]["reached"]
    assert len(record["auto"]["tried"]) == 2, "one jump by the exponent"
    never = calibrated(1e9)
    assert not never["auto"]["reached"]
    assert len(never["auto"]["tried"]) <= 5


def test_rounds_end_where_more_samples_change_nothing() -> None:
    """Views that too few centroids determine leave an uncertainty which no number of rays reduces."""
    described, camera = endless()
    rule = StoppingRule(lambda model: 0.05 + (model.record["samples"] / 2.0) ** -2, "floor", "a floor")
    record = calibrate(Setup(described, camera), stopping_rule=rule).record
    assert len(record["auto"]["tried"]) == 3
    assert record["auto"]["reached"], "the goal is a tenth"


def test_without_a_stack_the_prior_decides() -> None:
    """The addition to Eq. 5 falls with the precision of H, though its part of the error alone may rise at first."""
    described = auto((12, 12), (("1/3", [3, 3], [3, 3]),), sampler="independent")
    camera = derive(described)
    rule, found = for_prior(Setup(described, camera)), list[float]()
    for samples in (64, 256, 1024):
        told = described.calibration.model_copy(update={"samples": samples})
        found.append(rule.added_error(calibrate(Setup(described.model_copy(update={"calibration": told}), camera))))
    assert found[0] > found[1] > found[2] > 0


def test_a_whole_run(here: Path, ommatid: Command) -> None:
    told = ["--set", "render.samples=auto", "--set", "calibration.samples=auto"]
    ended = ommatid("run", "tiny.toml", "-o", "out", *told, "-v")
    assert ended.code == 0, ended.err
    assert "samples per pixel" in " ".join(ended.out.replace("│", " ").split())
    run = json.loads((here / "out/tiny/run.json").read_text("utf-8"))
    assert run["stages"]["render"]["reached"]
    assert run["stages"]["render"]["fewest_samples"] == EXACT_PASSES * 9, "one sample per pixel of f and pass at 1/3"
    assert run["stages"]["calibrate"]["auto"]["reached"]
    budget = run["error"]["budget"]
    assert budget["calibration"] <= GOAL * (run["error"]["predicted_mse"] - budget["calibration"])
    again = ommatid("run", "tiny.toml", "-o", "out", *told)
    assert again.err.count("up to date") == 4
    kept = read(here / "out/tiny/scene.toml")
    assert kept.render.samples == "auto"
    assert ommatid("calibrate", "tiny.toml", "-o", "h.npz", "--set", "calibration.samples=auto").code == 0
