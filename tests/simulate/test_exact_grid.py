"""Grids of samples that leave no error: where they exist, and that float32 moves no sample across an edge."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.setup import Setup
from ommatid.simulate.adaptive_render import render_until
from ommatid.simulate.ideal import ideal_matrix, true_matrix
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import choose
from ommatid.simulate.sampling import passes
from ommatid.simulate.sampling.passes import AVERAGED, Plan, cells_of, exact_plan, rounding_variance

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
        assert rendering.record["samples"] == 2 * 8**2, "8 x 8 cells where m = 8/3"
        assert (away**2 <= 16 * rendering.variance).all()
    assert np.median(away**2 / rendering.variance) < 1


@pytest.mark.slow
def test_samples_keep_away_from_edges_by_what_float32_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    variant = choose("auto")
    if variant.startswith("scalar"):
        pytest.skip("the scalar backend places its samples itself")
    setup = wide()
    renderer = Renderer(setup.simulated, variant)
    renderer.set_target(setup.image)
    expected, seeds = block_means(setup), [lambda index: 10 + index, lambda index: 20 + index]

    def wrong() -> int:
        values = renderer.expose(renderer.sub_imagers(range(4)), 9, seeds, "grid")[0]
        return int(((values - expected) ** 2 > 16 * rounding_variance(expected, 1)).sum())

    assert wrong() == 0
    assert render_until(setup).record["rounds"] == 1
    monkeypatch.setattr(passes, "ROUNDINGS", 0)
    assert wrong() > 0, "at the edge of this target, rays are rounded into the next pixel"


def test_pinholes_are_exact_by_grids_or_by_averages() -> None:
    """Grids serve ideal ones on the grid of f, averages those whose pixels throw equal boxes beside it."""

    def plans(setup: Setup, sampler: Any = "multijitter") -> set[Plan | None]:
        return {exact_plan(setup.camera, index, sampler) for index in range(len(setup.camera.sub_imagers))}

    exact = Setup.from_scene(auto())
    assert plans(exact) == {Plan(2, 25), Plan(2, 64)}
    assert [cells_of(lens_type) for lens_type in exact.camera.types] == [5, 8]
    assert plans(exact, "independent") == {None}
    averages = AVERAGED
    for lens, table, expected in (
        ({"distortion": [0.01, 0.0]}, {}, {None}),
        ({"aperture": "0.1 mm"}, {}, {None}),
        ({"step": "1/2"}, {}, {Plan(2, 9), averages}),
        ({"magnification": "5/17"}, {}, {None}),
        ({}, {"tolerance": {"position": "10 um"}}, {averages}),
        ({}, {"tolerance": {"position": "10 um", "tilt": "1 deg"}}, {None}),
    ):
        _, camera = with_optics(lens, table, (("1/3", [2, 2], [4, 4]),), (24, 24))
        assert plans(Setup(exact.scene, camera)) == expected, (lens, table)
    turned = scene((24, 24), (("1/3", [1, 1], [4, 4]),)).plain()
    turned["camera"]["lens"][0]["sub_imager"] = [{"at": [0, 0], "rotation": "1 deg"}]
    assert plans(Setup.from_scene(parse(turned, Path("test.toml")))) == {None}


def moved(lens: dict[str, Any], camera: dict[str, Any], variance: float, side: int = 35) -> Setup:
    """A camera whose pixels see parts of pixels of f, in front of a picture of edges."""
    tables: Any = {"render": {"samples": "auto"}, "noise": {"variance": variance}}
    described, layout = with_optics(lens, camera, (("1/5", [5, 5], [6, 6]),), (side, side), **tables)
    picture = np.where(np.random.default_rng(2).random((side, side)) > 0.8, 255.0, 0.0)
    return Setup(described, layout, picture)


@pytest.mark.parametrize(
    ("lens", "camera"),
    [
        ({}, {"tolerance": {"position": "41 nm"}}),
        ({}, {"tolerance": {"position": "5 um"}}),
        ({"step": "1/2"}, {}),
        ({"magnification": "3/8"}, {"tolerance": {"position": "1 um"}}),
    ],
)
def test_averages_of_pinholes_are_the_closed_form(lens: dict[str, Any], camera: dict[str, Any]) -> None:
    """To what float32 rounds, edges of the target included, without a random number."""
    needs("llvm_ad_mono")
    setup = moved(lens, camera, 1e-2)
    rendering = render_until(setup)
    error = rendering.mean - true_matrix(setup.camera) @ setup.image.ravel()
    assert np.abs(error).max() < 1e-3
    assert float(np.mean(error**2 / rendering.variance)) < 1
    assert rendering.record["rounds"] == 1


@pytest.mark.parametrize("seeds", [range(1), pytest.param(range(1, 3), marks=pytest.mark.slow)], ids=["one", "more"])
def test_no_edge_goes_unseen_where_samples_are_taken(seeds: range) -> None:
    """Strips of some percent of a pixel beyond an edge are seen before a pixel counts as done.

    Of 256 samples many show nothing of such a strip, and agree: readings were 10 deviations of the noise off.
    """
    needs("llvm_ad_mono")
    for seed in seeds:
        setup = moved({}, {"tolerance": {"position": "41 nm", "rotation": "0.001 deg", "seed": seed}}, 1e-2)
        setup = Setup(setup.scene, setup.camera, np.full(setup.camera.shape, 200.0))
        error = render_until(setup).mean - true_matrix(setup.camera) @ setup.image.ravel()
        assert np.abs(error).max() < 5 * (0.1 * 1e-2) ** 0.5
