"""Rays through real lenses against Snell's law, closed forms of aberration, symmetries, and a second arithmetic."""

from __future__ import annotations

from dataclasses import replace
from math import inf, pi, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.lens_type import LensOptics
from ommatid.scenes.optics import sharpness
from ommatid.scenes.optics.field import exit_disk_of, optics_of, prescription_of, reach
from ommatid.scenes.optics.prescription import Prescription, prescribe
from ommatid.scenes.optics.ray_trace import (
    NUMPY,
    Disk,
    Functions,
    exit_disk,
    path,
    spread,
    through,
    trace,
)
from ommatid.scenes.optics.wavefront import wavefront_of
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix

from ..examples import GALLERY, needs
from ..lenses import BICONVEX, DOUBLE_GAUSS, THIN, ball, camera_with, lens, turned_round

Array = NDArray[np.float64]


def straight(lens: Prescription, height: Any) -> tuple[Array, Array, Any]:
    """Where axial rays from the sensor's side cross the lens's first vertex, their slopes, and whether they pass."""
    height = np.asarray(height, dtype=np.float64)
    rows = path(lens, Disk(lens.rear_principal - float(lens.vertices[-1]), 1.0)).rows[:-1]
    (x, y), (u, v, w), passed, _ = through(
        [*rows, (0.0, 0.0, 1.0, 1.0, 1e30)], (height, 0 * height), (0.0, 0.0, 1.0), NUMPY, True
    )
    assert not np.any(y)
    assert not np.any(v)
    return x, u / w, passed


def double_gauss(tmp_path: Any) -> Prescription:
    from ommatid.scenes.formats.lens_file import read_lens

    (tmp_path / "gauss.dat").write_text(DOUBLE_GAUSS, encoding="utf-8")
    return prescribe(read_lens(tmp_path / "gauss.dat"))


radii = st.floats(2.5, 9.0) | st.floats(-9.0, -2.5)
small = st.floats(-0.3, 0.3)  # with these sines stay below 0.55: short of total reflection in an index of 1.7


@given(radii, st.floats(1.2, 1.7), small, small, st.floats(-0.25, 0.25), st.floats(-0.25, 0.25))
def test_snell_s_law_holds_at_a_sphere(radius: float, index: float, x: float, y: float, u: float, v: float) -> None:
    """n (d x N) is the same on both sides, N from the sphere's centre to the point, which lies on the sphere."""
    one = lens([radius], [], [index])
    step, *rest = path(one, Disk(0.0, 1.0)).rows[0]
    start = np.array([u, v, 1.0]) / sqrt(u * u + v * v + 1)
    (a, b), out, passed, _ = through([[0 * step, *rest]], (np.float64(x), np.float64(y)), tuple(start), NUMPY, True)
    assert passed
    centre = np.array([0.0, 0.0, -radius])  # the prescription's axis runs to the sensor, the ray's to the target
    point = np.array([a, b, centre[2] + np.sign(radius) * sqrt(radius**2 - a * a - b * b)])
    normal = point - centre
    np.testing.assert_allclose(np.cross(point - [x, y, 0], start), 0, atol=1e-12)  # it lies on the ray
    assert np.linalg.norm(out) == pytest.approx(1, rel=1e-12)
    # `index` is behind the surface, on the sensor's side, from which the ray comes
    np.testing.assert_allclose(index * np.cross(start, normal), np.cross(out, normal), atol=1e-12)


def test_total_reflection_and_rims_block_and_leave_numbers() -> None:
    """From glass of index 1.5 nothing leaves beyond asin(1 / 1.5) = 41.8 degrees."""
    angle = np.radians([41.0, 42.0, 80.0])
    for surface in ([0.0, 0.0, 1.0, 1.5, inf], [0.0, 1.0, 1.0, 1.5, inf]):
        (x, y), direction, passed, _ = through(
            [surface], (0 * angle, 0 * angle), (np.sin(angle), 0 * angle, np.cos(angle)), NUMPY, True
        )
        assert list(passed) == [True, False, False]
        assert np.all(np.isfinite([x, y, *direction]))
        assert np.all(direction[2][1:] == 1)
    x = np.array([0.0, 0.99, 1.01, 50.0])
    assert list(straight(ball(1.0), x)[2]) == [True, True, False, False]


def test_the_disk_holds_every_ray_that_passes(tmp_path: Any) -> None:
    """Wide angles, vignetting, a pupil behind or beyond the sensor: and hardly more than them."""
    gauss = double_gauss(tmp_path)
    shaded = lens([inf, 10.0, -10.0], [5.0, 1.0], [1.0, 1.5, 1.0], [3.0, 0.5, 0.5])  # its stop stops nothing
    remote = lens([inf, 10.0, -10.0], [9.0, 1.0], [1.0, 1.5, 1.0], [0.5, 3.0, 3.0])  # telecentric, but for the glass
    # the sag of its last surface is largest inside its edge
    bent = replace(lens([1.0, 3.0], [0.3], [1.5, 1.0], [0.2, 0.4], stop=0), aspheric=((), (-1.0, -8.0)))
    assert bent.last_extent()[1] > max(0.0, bent.sag(inf)[1]) + 1e-3
    for one, depth, field in (
        (gauss, 52.0, 12.0),
        (remote, 11.0, 2.0),
        (shaded, 11.0, 2.0),
        (ball(), 1.55, 0.1),
        (turned_round(gauss), 60.0, 0.0),
        (bent, 2.0, 0.4),
    ):
        disk = exit_disk(one, depth, field)
        wide = Disk(disk.height, disk.radius * 1.6)
        far = 0.0
        for height in np.linspace(0, field, 4):
            across, down = spread(20000)
            weight = trace(path(one, wide), 0.0, height, across, down, depth)[2]
            far = max(far, float((np.hypot(across, down) * (weight > 0)).max()) * wide.radius)
        assert 0.93 * disk.radius < far < disk.radius


def test_a_lens_that_lets_no_light_through_is_refused() -> None:
    shut = lens([inf, 1.0, -1.0], [50.0, 0.2], [1.0, 1.5, 1.0], [1e-9, 1e-9, 1.0])
    with pytest.raises(InputError, match="no light comes through"):
        exit_disk(shut, 1.2, 0.3)


@pytest.mark.parametrize("sine", [0.2, 0.7, 0.95])
def test_on_the_axis_a_wide_cone_gives_pi_times_its_sine_squared(sine: float) -> None:
    """The result does not depend on the optics in front: here a stop behind a lens that blocks no rays."""
    depth, gap = 5.0, 2.0
    stop = (depth - gap) * sine / sqrt(1 - sine**2)
    one = lens([1e4, -1e4, inf], [0.0, gap], [1.5, 1.0, 1.0], [1e3, 1e3, stop], stop=2)
    disk = exit_disk(one, depth, 0.0)
    rays = wavefront_of(one, disk, depth, 0.0, 1e3, None)
    assert rays is not None
    assert rays.brightness == pytest.approx(pi * sine**2, rel=0.01)


def test_a_camera_s_lenses_collect_what_their_f_numbers_say() -> None:
    """pi / 4 N^2 on the axis, N at the sensor, to the square of the slope; cos^4 beside it, of a thin lens."""
    camera = derive(read(GALLERY / "doublet.toml", (), ["I", "III"]))
    reported = {one["lens"]: one["working_f_number"] for one in sharpness.describe(camera)}
    for lens_type in camera.types:
        angle = optics_of(camera, lens_type, None).weight(np.zeros(1))[0]
        assert angle == pytest.approx(pi / (4 * reported[lens_type.name] ** 2), rel=0.015)
    camera = camera_with(THIN, ['target.distance="20 mm"'])
    field = optics_of(camera, camera.types[0], None)
    height = np.linspace(0, field.field, 9)
    assert field.field / field.depth > 0.4
    light = field.weight(height)
    np.testing.assert_allclose(light / light[0], (1 + (height / field.depth) ** 2) ** -2, rtol=0.01)


def test_numpy_and_dr_jit_agree_to_float32() -> None:
    """For spheres, and for a lens with an aspheric surface among them."""
    needs("llvm_ad_mono")
    from ommatid.simulate.renderer.variant import activate

    activate("llvm_ad_mono")
    import drjit as dr
    import mitsuba as mi

    functions = Functions(dr.sqrt, dr.select, dr.maximum)
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-0.07, 0.07, (2, 2000))
    across, down = spread(2000)
    rays = [mi.Float(np.float32(values)) for values in (x, y, across, down)]
    asphere = [BICONVEX[0] | {"conic": -0.7, "aspheric": [0.5, -3.0, 20.0]}, BICONVEX[1]]
    for camera in (camera_with(BICONVEX), derive(read(GALLERY / "doublet.toml")), camera_with(asphere)):
        kind = camera.types[0]
        one, depth = prescription_of(camera, kind), camera.depth(kind)
        numbers = path(one, exit_disk(one, depth, 0.1))
        traced = trace(numbers.converted(mi.Float), rays[0], rays[1], rays[2], rays[3], mi.Float(depth), functions)
        found = np.array([np.array(values) for values in (*traced[0], *traced[1], traced[2])])
        place, direction, weight, _ = trace(numbers, x, y, across, down, depth)
        expected = np.array([*place, *direction, weight])
        edge = (weight > 0) == (found[-1] > 0)  # which float32 may put on the other side of a rim
        assert np.mean(edge) > 0.998
        assert 0.9 < np.mean(weight > 0) < 1
        np.testing.assert_allclose(found[:, edge], expected[:, edge], atol=1e-6)


def test_a_thin_real_lens_diffracts_as_a_thin_lens() -> None:
    """H in closed form by traced waves against that of the thin lens, by other formulas."""
    camera = camera_with(THIN)
    real = camera.types[0]
    thin = replace(real, optics=LensOptics(aperture=0.15 * camera.focal_length(real) / 2))
    found, expected = (ideal_matrix(replace(camera, types=(kind,))).toarray() for kind in (real, thin))
    np.testing.assert_allclose(found, expected, atol=2e-3 * expected.max())


def test_a_camera_s_disk_serves_sensors_that_stand_askew() -> None:
    data = ["camera.tolerance.focal_length=0.02", 'camera.tolerance.tilt="2 deg"']
    camera = derive(read(GALLERY / "planoconvex.toml", data))
    kind = camera.types[0]
    _, least, largest = reach(camera, kind)
    assert least < camera.depth(kind) < largest
    one = prescription_of(camera, kind)
    assert exit_disk_of(camera, kind, one).radius == pytest.approx(one.exit_pupil.radius, rel=0.1)


def test_depth_of_field_ends_where_the_thin_lens_blurs_over_a_pixel() -> None:
    """By the thin-lens equation: image at v, blur A |v - d| / v."""
    focal_length, aperture, depth, blur = 2.0, 0.5, 2.1, 0.02
    ends = sharpness.depth_of_field(depth, 1 / focal_length - 1 / depth, aperture, blur)
    for distance in ends:
        assert distance is not None
        image = 1 / (1 / focal_length - 1 / distance)
        assert aperture * abs(image - depth) / image == pytest.approx(blur)
    # With a stop before the lens the cone from the target is cut there, and is D z / (z - e) wide at the lens.
    pupil = 5.0
    for distance in sharpness.depth_of_field(depth, 1 / focal_length - 1 / depth, aperture, blur, pupil):
        assert distance is not None
        image = 1 / (1 / focal_length - 1 / distance)
        wide = aperture * distance / (distance - pupil)
        assert wide * abs(image - depth) / image == pytest.approx(blur)
    # Focused at the hyperfocal distance it reaches from half of that to infinity.
    hyperfocal = depth * aperture / blur
    for rounded in (1 - 1e-15, 1 + 1e-15):
        near, far = sharpness.depth_of_field(depth, rounded / hyperfocal, aperture, blur)
        assert near == pytest.approx(hyperfocal / 2)
        assert far is None


def test_a_thin_real_lens_is_reported_as_a_thin_lens() -> None:
    """Biconvex, thickness next to nothing, out of focus: only its spherical aberration stays, at f/13 small."""
    (real,) = sharpness.describe(camera_with(THIN, focus="100 mm"))
    camera = camera_with(THIN, focus="100 mm")
    diameter = 0.15 * camera.focal_length(camera.types[0]) / 2
    data = [f'camera.lens.I.aperture="{diameter} mm"', 'camera.lens.I.focus="100 mm"']
    (ideal,) = sharpness.describe(derive(read(GALLERY / "tile19.toml", data, ["I"])))
    assert real.keys() == ideal.keys()
    for name, value in ideal.items():
        if name in ("curvature", "distortion"):  # which a thin lens does not have
            continue
        loose = 0.15 if name.startswith(("spot", "sharpest", "wavefront")) else 2e-3
        assert real[name] == (value if value is None or name == "lens" else pytest.approx(value, rel=loose)), name
    assert real["f_number"] == pytest.approx(13.3, abs=0.05)
    assert abs(real["distortion"]) < 1e-3


def test_a_lens_s_rays_are_sharpest_short_of_the_paraxial_focus() -> None:
    """Spherical aberration of a single lens; the distance of least spot is one that no other beats."""
    camera = derive(read(GALLERY / "planoconvex.toml", (), ["I"]))
    best = sharpness.describe(camera)[0]
    assert best["sharpest_axis"] < best["focus"] == pytest.approx(camera.distance)
    kind = camera.types[0]
    one = prescription_of(camera, kind)
    (x, _), (u, _, w), weight, _ = trace(
        path(one, exit_disk_of(camera, kind, one)), 0.0, 0.0, *spread(4096), camera.depth(kind)
    )
    distances = best["sharpest_axis"] * np.array([0.9, 0.99, 1.0, 1.01, 1.1])
    angles = [np.sqrt(np.sum(weight * (x + z * u / w) ** 2)) / z for z in distances]
    assert int(np.argmin(angles)) == 2
