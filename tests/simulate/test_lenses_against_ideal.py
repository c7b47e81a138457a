"""Traced H against H in closed form, entry by entry: defocus, diffraction, distortion, misalignment.

With independent samples an entry is a share of n rays, whose number is binomial: the statistic is the normal number of
the same tail, since at five standard errors the binomial law of few rays is far from normal. Entries that few rays meet
are summed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse, stats

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.optics.field import optics_of
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.responses import measured, one_pass
from ommatid.simulate.ideal import ideal_matrix, true_matrix
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.renderer.variant import choose
from ommatid.simulate.renderer.worlds.placement import MILLIMETRES_AT_ORIGIN
from ommatid.simulate.sampling.passes import Plan

from ..examples import OPTICS, familywise, needs, slow, with_optics
from .test_fill_factor import BLUR, LENS, ROOM, SHAPE
from .test_fill_factor import OPTICS as OPENED
from .test_lens_matrix import BENT, FLAT, ONE
from .world_files import distance_to_target

SAMPLES = 2**14
FEWEST = 25  # rays expected in an entry that is compared by itself
RAYS = {"wavelength": "none"}
WAVES = {"0.1 waves": 266.67, "0.3 waves": 108.11, "1 wave": 35.088, "3 waves": 11.976}  # focus, mm, at 550 nm
CLOSED = OPTICS | {
    "a thin lens in focus": ({"aperture": "0.4 mm"}, RAYS),
    "far out of focus": ({"aperture": "0.4 mm", "focus": "700 mm"}, RAYS),
    **{name: ({"aperture": "0.4 mm", "focus": f"{focus} mm"}, {}) for name, focus in WAVES.items()},
    "250 waves": (
        {"aperture": "2 mm", "focus": "333.33 mm"},
        {"wavelength": "4 nm", "lens_pitch": "3 mm", "pixel_pitch": "20 um"},
    ),
    "distorted and misaligned": ({"distortion": [-0.04, 0.02]}, OPTICS["misaligned"][1]),
}
SMALL = (ONE, (15, 15))
SURFACES: dict[str, Any] = {
    "surfaces in focus": ({"surfaces": FLAT}, {"wavelength": "550 nm"}, *SMALL),
    "surfaces out of focus": ({"surfaces": FLAT, "focus": "300 mm"}, {"wavelength": "550 nm"}, *SMALL),
    "surfaces with coma": ({"surfaces": BENT}, {"wavelength": "550 nm"}, *SMALL),
    "rays through surfaces": ({"surfaces": FLAT, "focus": "300 mm"}, RAYS, *SMALL),
    "rays with coma": ({"surfaces": BENT}, RAYS, *SMALL),
}
SLIT = {"fill_factor": ["1/3", "1"]}
PIXELS: dict[str, Any] = {  # that are open in part, or blur
    f"{name}, {kind}": (lens, ROOM | table | pixels, LENS, SHAPE)
    for name, (lens, table) in OPENED.items()
    for kind, pixels in {
        "open": {"fill_factor": "2/3"},
        "slit": SLIT,
        "blur": BLUR,
        "blur and slit": SLIT | BLUR,
    }.items()
    if "blur" not in kind or name in ("pinholes", "diffracting", "out of focus", "surfaces")
}
INDEPENDENT: dict[str, Any] = {"sampler": "independent", "complete": True}


def scores(found: sparse.csr_array, expected: sparse.csr_array, rays: float) -> FloatArray:
    """Return the deviation of each entry in standard errors, and of each row's sum over its rare entries."""
    dense, known = found.toarray(), expected.toarray()
    rare = known * rays < FEWEST
    ours, theirs = (np.where(rare, matrix, 0.0).sum(axis=1) for matrix in (dense, known))
    enough = theirs * rays >= FEWEST
    shares, means = np.concatenate([dense[~rare], ours[enough]]), np.concatenate([known[~rare], theirs[enough]])
    # The binomial law made continuous: the distribution function of k successes is a beta function of k + 1/2.
    counts = shares * rays
    law = stats.beta(counts + 0.5, np.maximum(rays - counts, 0.0) + 0.5)
    return np.where(shares > means, stats.norm.isf(law.cdf(means)), -stats.norm.isf(law.sf(means)))


def traced_in_a_world(camera: Camera, samples: int) -> sparse.csr_array:
    """Return H of the first lens type by rays that find the flat target's distance by themselves."""
    renderer = Renderer(camera, choose("auto"), "independent", together=False)
    group, work = next(iter(renderer.groups)), Plan(16, samples // 16)
    for generator in renderer._generators.values():  # pyright: ignore[reportPrivateUsage]
        generator.follow(distance_to_target(renderer), MILLIMETRES_AT_ORIGIN)
    total = sparse.csr_array((camera.types[0].measurements, camera.unknowns))
    for number in range(work.passes):
        total = total + one_pass(renderer, renderer.pixels(group), work, number, 0).matrix
    return sparse.csr_array(total / work.passes)


def assert_scores(found: FloatArray, fewest: int = 200) -> None:
    """Assert that many scores are normal: their largest, at a familywise significance of 1 %, and their mean square."""
    assert found.size > fewest
    assert np.abs(found).max() < stats.norm.isf(familywise(found.size) / 2)
    assert float(np.square(found).mean()) == pytest.approx(1, abs=5 * (2 / found.size) ** 0.5)


@pytest.mark.parametrize(
    ("kind", "detail"),
    [
        *((kind, 1) for kind in (*CLOSED, *SURFACES)),
        *(slow(kind, 1) if "surfaces" in kind else (kind, 1) for kind in PIXELS),
        *(slow(kind, 3) for kind in PIXELS if "blur" in kind),
    ],
)
def test_traced_h_is_the_closed_form(kind: str, detail: int) -> None:
    needs("llvm_ad_mono")
    optics: Any = (CLOSED | SURFACES | PIXELS)[kind]
    tables: Any = {"calibration": {"samples": SAMPLES}, "render": INDEPENDENT, "target": {"detail": detail}}
    setup = Setup(*with_optics(*optics, **tables)).calibrated
    camera, traced = setup.camera, measured(setup, by_points=False)
    rays = float(traced.work.total)
    if kind in SURFACES and camera.wavelength is None:  # rays leave through the whole exit disk: some are blocked
        rays *= float(optics_of(camera, camera.types[0], None).lit_share(np.zeros(1))[0])
    exact = sparse.csr_array(true_matrix(camera) / float(camera.types[0].light))
    assert_scores(scores(traced.matrix, exact, rays), 5000 if kind in CLOSED else 300)


@pytest.mark.slow
def test_traced_h_of_several_wavelengths_is_the_closed_form() -> None:
    """Every ray has one of the wavelengths, with its share of the light; H of one wavelength is another."""
    needs("llvm_ad_mono")
    lens = {"aperture": "0.4 mm", "focus": "108.11 mm"}
    tables: dict[str, Any] = {"calibration": {"samples": SAMPLES}, "light": {"spectrum": "LED-B3"}}
    described, camera = with_optics(lens, {}, **tables, render=INDEPENDENT)
    assert len(camera.wavelengths) > 2
    traced = measured(Setup(described, camera), by_points=False)
    assert_scores(scores(traced.matrix, ideal_matrix(camera), SAMPLES))
    _, blue = with_optics(lens, {"wavelength": "450 nm"})
    other = scores(traced.matrix, ideal_matrix(blue), SAMPLES)
    assert np.abs(other).max() > 2 * stats.norm.isf(familywise(other.size) / 2)


@pytest.mark.parametrize("kind", WAVES)
def test_the_focus_has_these_waves(kind: str) -> None:
    _, camera = with_optics(*CLOSED[kind])
    lens = camera.types[0]
    vergence = 1 / camera.distance_of(lens) - 1 / camera.focus(lens)
    waves = optics_of(camera, lens, camera.wavelength).waves_of(vergence)
    assert abs(waves) == pytest.approx(float(kind.split()[0]), rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "samples"),
    [
        ("3 waves", SAMPLES // 8),
        ("surfaces out of focus", 4 * SAMPLES),
        *(pytest.param(kind, SAMPLES, marks=pytest.mark.slow) for kind in ("in focus", "0.3 waves", "3 waves")),
        pytest.param("surfaces with coma", 4 * SAMPLES, marks=pytest.mark.slow),
    ],
)
def test_rays_in_a_world_have_the_pattern_of_their_surface_s_distance(kind: str, samples: int) -> None:
    """Rays from points of the pupil that find the flat target's distance by themselves."""
    needs("llvm_ad_mono")
    optics: Any = (CLOSED | SURFACES).get(kind, ({"aperture": "0.4 mm"}, {}))
    _, camera = with_optics(*optics, render={"complete": True})
    expected = ideal_matrix(camera)[camera.type_slices()[0]]
    assert_scores(scores(traced_in_a_world(camera, samples), expected, samples))


@pytest.mark.parametrize("kind", CLOSED)
def test_the_statistic_detects_another_camera(kind: str) -> None:
    """No other optics pass for an ideal pinhole, except a lens in focus, which is one."""
    if kind in ("pinhole", "a thin lens in focus"):
        return
    _, camera = with_optics(*CLOSED[kind])
    _, pinholes = with_optics(*OPTICS["pinhole"])
    found = scores(ideal_matrix(pinholes), true_matrix(camera), SAMPLES)
    assert np.abs(found).max() > 2 * stats.norm.isf(familywise(found.size) / 2)
