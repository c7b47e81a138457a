"""Grids of samples that leave no error: where they exist, and that float32 moves no sample across an edge."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import expose_exactly, render_until
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import choose
from ommatid.simulate.sampling import passes
from ommatid.simulate.sampling.passes import Plan, exact_plan, rounding_variance

from ..examples import VARIANTS, needs, scene, with_optics

FRACTIONAL = (("2/5", [2, 2], [5, 5]), ("3/8", [2, 2], [4, 4]))
FAR_APART = (("1/3", [2, 2], [16, 16]),)


def auto(shape: tuple[int, int] = (19, 19), lenses: Any = FRACTIONAL, **render: Any) -> Scene:
    return scene(shape, lenses, render={"samples": "auto", **render}, noise={"variance": 1e-2})


def wide() -> Setup:
    """Four sub-imagers in the corners of a target of 4000 x 4000 pixels, where float32 rounds most."""
    tables: Any = {"render": {"samples": "auto"}, "noise": {"variance": 1e-2}}
    described, camera = with_optics({"step": 3950}, {"lens_pitch": "30 mm"}, FAR_APART, (4000, 4000), **tables)
    return Setup(described, camera, np.random.default_rng(0).uniform(0, 255, (4000, 4000)))


def block_means(setup: Setup) -> FloatArray:
    """Return the light on every pixel of a camera whose pixels see squares of 3 x 3 pixels of f."""
    parts: list[FloatArray] = []
    for sub in setup.camera.sub_imagers:
        (top, left), (rows, columns) = (int(start) for start in sub.window), sub.type.pixels
        seen = setup.image.astype(np.float32)[top : top + 3 * rows, left : left + 3 * columns].astype(np.float64)
        parts.append(seen.reshape(rows, 3, columns, 3).mean(axis=(1, 3)).ravel())
    return np.concatenate(parts)


@pytest.mark.parametrize("variant", VARIANTS)
def test_two_passes_show_every_pixel_without_error(variant: str) -> None:
    """The exact H is the second method; nothing but float32's rounding of sums is left, also where m is a fraction."""
    needs(variant)
    setup = Setup.from_scene(auto((40, 40), variant=variant))
    rendering = render_until(setup)
    away = rendering.mean - ideal_matrix(setup.camera) @ setup.image.astype(np.float32).ravel()
    if variant.startswith("llvm"):
        assert rendering.details["samples"] == 2 * 8**2, "8 x 8 cells where m = 8/3"
        assert (away**2 <= 16 * rendering.variance).all()
    assert np.median(away**2 / rendering.variance) < 1


@pytest.mark.slow
def test_samples_keep_away_from_edges_by_what_float32_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    variant = choose("auto")
    if variant.startswith("scalar"):
        pytest.skip("the scalar backend places its samples itself")
    setup = wide()
    renderer, camera = Renderer(setup.simulated, variant), setup.camera
    renderer.set_target(setup.image)
    expected, seeds = block_means(setup), [lambda index: 10 + index, lambda index: 20 + index]

    def wrong() -> int:
        ((_, values),) = expose_exactly(renderer, camera, range(4), Plan(2, 9), seeds)
        return int(((values - expected) ** 2 > 16 * rounding_variance(expected, 1)).sum())

    assert wrong() == 0
    assert render_until(setup).details["rounds"] == 1
    monkeypatch.setattr(passes, "ROUNDINGS", 0)
    assert wrong() > 0, "at the edge of this target, rays are rounded into the next pixel"


def test_only_ideal_pinholes_on_the_grid_of_f_have_such_grids() -> None:
    def plans(setup: Setup, sampler: Any = "multijitter") -> set[Plan | None]:
        return {exact_plan(setup.camera, index, sampler) for index in range(len(setup.camera.sub_imagers))}

    exact = Setup.from_scene(auto())
    assert plans(exact) == {Plan(2, 25), Plan(2, 64)}
    assert plans(exact, "independent") == {None}
    for lens, table in (
        ({"distortion": [0.01, 0.0]}, {}),
        ({"aperture": "0.1 mm"}, {}),
        ({"step": "1/2"}, {}),
        ({"magnification": "5/17"}, {}),
        ({}, {"tolerance": {"position": "10 um"}}),
    ):
        _, camera = with_optics(lens, table, (("1/3", [2, 2], [4, 4]),), (24, 24))
        assert None in plans(Setup(exact.scene, camera)), (lens, table)
    turned = scene((24, 24), (("1/3", [1, 1], [4, 4]),)).plain()
    turned["camera"]["lens"][0]["sub_imager"] = [{"at": [0, 0], "rotation": "1 deg"}]
    assert plans(Setup.from_scene(parse(turned, Path("test.toml")))) == {None}
