"""Lens files, indices, the paraxial theory of a lens, and light lost by reflection, against closed forms."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.field import prescription_of
from ommatid.scenes.optics.prescription import Prescription, prescribe
from ommatid.scenes.optics.radiometry import electrons, transmission, transmissions
from ommatid.scenes.scene import Scene, read, write
from ommatid.scenes.tables import glass
from ommatid.scenes.tables.camera import Surface

from ..conftest import Command
from ..examples import GALLERY
from ..lenses import BICONVEX, DOUBLE_GAUSS, camera_with, lens, turned_round


def f_number(one: Prescription) -> float:
    """Return the focal length over the diameter of the entrance pupil."""
    return one.focal_length / (2 * one.entrance_pupil.radius)


@pytest.mark.parametrize(
    ("name", "yellow", "abbe"),
    [
        ("N-BK7", 1.51680, 64.17),
        ("N-F2", 1.62005, 36.43),
        ("N-SF11", 1.78472, 25.68),
        ("fused silica", 1.45846, 67.82),
        ("PMMA", 1.491, 57.4),
        ("polycarbonate", 1.585, 29.9),
    ],
)
def test_glasses_have_the_catalogues_indices_and_abbe_numbers(name: str, yellow: float, abbe: float) -> None:
    """n_d and v_d as the makers print them; plastics vary in the third decimal, and their v_d by a tenth."""
    plastic = name in ("PMMA", "polycarbonate")
    d, f, c = (glass.index(name, wavelength) for wavelength in (587.5618e-6, 486.1327e-6, 656.2725e-6))
    assert d == pytest.approx(yellow, abs=1e-3 if plastic else 6e-6)
    assert (d - 1) / (f - c) == pytest.approx(abbe, rel=0.1 if plastic else 5e-4)


def test_air_is_one_and_glass_is_asked_for_by_name_and_wavelength() -> None:
    assert glass.index("air") == 1
    with pytest.raises(InputError, match="did you mean 'N-BK7'"):
        glass.index("bk7")
    with pytest.raises(InputError, match="1052 nm, got a wavelength of 1550 nm"):
        glass.index("PMMA", 1550e-6)


curvatures = st.floats(0.05, 0.4) | st.floats(-0.4, -0.05)


@given(curvatures, curvatures, st.floats(0.0, 2.0), st.floats(1.3, 2.0))
def test_the_lensmaker_equation_with_thickness(front: float, back: float, thickness: float, index: float) -> None:
    """And the principal planes: E. Hecht, Optics, section 6.1."""
    power = (index - 1) * (front - back + (index - 1) * thickness * front * back / index)
    if abs(power) < 1e-3:
        return
    found = lens([1 / front, 1 / back], [thickness], [index, 1.0])
    assert found.focal_length == pytest.approx(1 / power, rel=1e-9)
    assert found.front_principal == pytest.approx(-(index - 1) * thickness * back / index / power, abs=1e-9)
    assert found.rear_principal == pytest.approx(thickness - (index - 1) * thickness * front / index / power, abs=1e-9)


def thin(focal_length: float, gap: float, stop: float, *, before: bool) -> Prescription:
    """A lens without thickness, and a stop at a distance."""
    radius = 2 * (1.5 - 1) * focal_length
    glass_radius, openings = [radius, -radius], [3.0, 3.0]
    if before:
        return lens([inf, *glass_radius], [gap, 0.0], [1.0, 1.5, 1.0], [stop, *openings], stop=0)
    return lens([*glass_radius, inf], [0.0, gap], [1.5, 1.0, 1.0], [*openings, stop], stop=2)


def test_the_pupils_are_the_thin_lens_s_images_of_the_stop() -> None:
    """A stop 2 mm before a thin lens of 10 mm: its image is virtual, at 1 / (1/10 - 1/2) = -2.5 mm, 1.25 as large."""
    found = thin(10.0, 2.0, 0.5, before=True)
    assert found.entrance_pupil == pytest.approx((0.0, 0.5))
    assert found.exit_pupil == pytest.approx((2.0 - 2.5, 0.5 * 1.25))
    assert f_number(found) == pytest.approx(10.0)


def test_turning_a_lens_round_exchanges_its_pupils_and_planes() -> None:
    found, turned = thin(10.0, 2.0, 0.5, before=True), thin(10.0, 2.0, 0.5, before=False)
    for one in (turned, turned_round(found)):
        length = found.vertices[-1]
        assert one.exit_pupil == pytest.approx((length - found.entrance_pupil.position, found.entrance_pupil.radius))
        assert one.entrance_pupil == pytest.approx((length - found.exit_pupil.position, found.exit_pupil.radius))
        assert one.rear_principal == pytest.approx(length - found.front_principal)
        assert one.focal_length == pytest.approx(found.focal_length)


def test_the_working_f_number_is_the_exit_pupil_s_distance_over_its_diameter() -> None:
    found = thin(10.0, 2.0, 0.5, before=True)
    pupil = found.exit_pupil
    distance = 12.0 + found.rear_principal - pupil.position
    assert found.working_f_number(12.0) == pytest.approx(distance / (2 * pupil.radius))
    telecentric = thin(10.0, 10.0, 0.5, before=True)  # the cone has the same slope for any position of the sensor
    assert telecentric.working_f_number(12.0) == pytest.approx(10.0) == telecentric.working_f_number(30.0)


def test_a_stop_in_the_focal_plane_has_a_pupil_at_infinity() -> None:
    assert thin(10.0, 10.0, 0.5, before=True).exit_pupil == (inf, inf)
    assert thin(10.0, 10.0, 0.5, before=False).entrance_pupil == (inf, inf)


def test_without_a_mark_the_stop_is_what_limits_the_axial_bundle() -> None:
    """2 mm behind a thin lens of 10 mm the bundle has narrowed to 0.8 of itself: there 0.9 mm let 1.125 mm pass."""
    rows: list[dict[str, Any]] = [
        {"radius": "10 mm", "index": 1.5, "semi_diameter": "1 mm"},
        {"radius": "-10 mm", "thickness": "2 mm", "semi_diameter": "1.2 mm"},
        {"semi_diameter": "0.9 mm"},
    ]
    assert prescribe([Surface.model_validate(row) for row in rows]).stop == 0
    rows[2]["semi_diameter"] = "0.7 mm"
    assert prescribe([Surface.model_validate(row) for row in rows]).stop == 2


def test_a_lens_is_scaled_to_the_focal_length_that_the_camera_asks_for() -> None:
    for more in ({}, {"scale": "fit"}, {"focus": "200 mm"}):
        camera = camera_with(BICONVEX, **more)
        kind = camera.types[0]
        found = prescription_of(camera, kind)
        assert found.focal_length == pytest.approx(camera.focal_length(kind), rel=1e-12)
        vergence = 1 / found.focal_length - 1 / camera.focus(kind)
        assert vergence * camera.depth(kind) == pytest.approx(1, rel=1e-9)
    own = prescription_of(camera_with(BICONVEX), camera_with(BICONVEX).types[0]).focal_length
    twice = camera_with(BICONVEX, scale=2.0)
    once = prescribe([Surface.model_validate(row) for row in BICONVEX]).focal_length
    assert prescription_of(twice, twice.types[0]).focal_length == pytest.approx(2 * once)
    assert own != pytest.approx(once)


FLAT = {"semi_diameter": "1 mm"}
REFUSED: dict[str, tuple[list[dict[str, Any]], str]] = {
    "afocal": ([{**FLAT, "index": 1.5, "thickness": "1 mm"}, FLAT], "camera.lens.I.surfaces: .*afocal"),
    "negative": (
        [{**FLAT, "radius": "-1 mm", "index": 1.5, "thickness": "0.1 mm"}, FLAT],
        "converging lens, got a focal length of -2 mm",
    ),
    "in glass": ([{**FLAT, "radius": "1 mm", "index": 1.5}], "air behind the last surface"),
    "inside": (
        [{**FLAT, "radius": "0.9 mm", "index": 1.5, "thickness": "2.9 mm"}, FLAT],
        "the sensor would lie .* inside the lens",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_shows_no_image_is_refused(name: str) -> None:
    rows, words = REFUSED[name]
    camera = camera_with(rows)
    with pytest.raises(InputError, match=words):
        prescription_of(camera, camera.types[0])


def test_a_lens_type_without_surfaces_has_no_prescription() -> None:
    camera = derive(read(GALLERY / "tile19.toml"))
    with pytest.raises(InputError, match=r"camera.lens.I.surfaces: expected a list"):
        prescription_of(camera, camera.types[0])


def test_pbrt_s_text_is_read_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "gauss.dat"
    path.write_text(DOUBLE_GAUSS, encoding="utf-8")
    surfaces = read_lens(path)
    assert [surface.stop for surface in surfaces] == [place == 5 for place in range(11)]
    assert (surfaces[0].radius, surfaces[0].thickness, surfaces[0].index) == (29.475, 3.76, 1.67)
    assert (surfaces[5].radius, surfaces[5].index, surfaces[5].semi_diameter) == (None, None, 8.55)
    assert surfaces[-1].thickness is None
    found = prescribe(surfaces)
    assert found.focal_length == pytest.approx(50, rel=0.01)
    assert f_number(found) == pytest.approx(2, rel=0.03)
    # The file's own distance to the film, 36.77 mm, is where this lens shows far things sharp.
    assert found.rear_principal + found.focal_length - found.vertices[-1] == pytest.approx(36.77, rel=0.02)


def test_a_plane_of_glass_is_no_stop(tmp_path: Path) -> None:
    path = tmp_path / "flat.dat"
    path.write_text("0 0.5 1.5 2\n-1 0 1 2\n0 0.1 1 1\n0 0 1.5 3\n0 0 1 3\n", encoding="utf-8")
    assert [surface.stop for surface in read_lens(path)] == [False, False, True, False, False]


def test_both_forms_of_file_hold_the_same_lens(tmp_path: Path) -> None:
    text = (
        'title = "flat"\nsurfaces = [{radius = "1 mm", thickness = "200 um", index = 1.5, semi_diameter = "0.2 mm"},'
        ' {semi_diameter = "0.3 mm"}, {semi_diameter = "0.1 mm", stop = true}]'
    )
    (tmp_path / "lens.toml").write_text(text, encoding="utf-8")
    (tmp_path / "lens.dat").write_text("1 0.2 1.5 0.4\n0 0 1 0.6\n0 0 0 0.2\n", encoding="utf-8")
    assert read_lens(tmp_path / "lens.toml") == read_lens(tmp_path / "lens.dat")


def test_a_scene_holds_what_its_lens_file_holds(tmp_path: Path) -> None:
    """So that a resolved scene needs no other file."""
    for name, stop in (("planoconvex", 8.0), ("doublet", 6.0)):
        scene = read(GALLERY / f"{name}.toml")
        assert all(isinstance(kind.surfaces, tuple) for kind in scene.camera.lens)
        write(tmp_path / "again.toml", scene)
        assert read(tmp_path / "again.toml").camera == scene.camera
        camera = derive(scene)
        found = [prescription_of(camera, kind) for kind in camera.types]
        assert [f_number(one) for one in found] == pytest.approx([stop] * 3, rel=0.01)


def test_lens_files_that_are_not_there_and_glasses_that_are_unknown_are_named(tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    text = (GALLERY / "doublet.toml").read_text(encoding="utf-8")
    scene.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"doublet\.toml: no such lens file"):
        read(scene)
    with pytest.raises(InputError, match=r"scene\.toml: camera\.lens\.I\.surfaces\[0\]\.glass: .*N-BK7"):
        read(scene, ['camera.lens.I.surfaces=[{glass="NBK7", semi_diameter="1 mm"}]'], ["I"])


def test_the_sag_is_the_conic_s() -> None:
    """Paraboloid: h^2 / 2 R at every height; sphere: the circle's; no height is beyond the edge."""
    found = replace(lens([2.0, 2.0], [1.0], [1.5, 1.0], 1.6), conic=np.array([-1.0, 0.0]))
    assert found.sag(1.2) == pytest.approx([0.36, 2 - 1.6])
    assert found.sag(9.0) == pytest.approx(found.sag(1.6))


SENSOR = 'sensor={illuminance="500 lux", exposure="10 ms"}'


CROWN, FLINT = 1.51872, 1.79190  # N-BK7 and N-SF11 at the green line of mercury, by SCHOTT's data sheets
CEMENT = ((FLINT - CROWN) / (FLINT + CROWN)) ** 2


def gallery(name: str) -> Camera:
    return derive(read(GALLERY / f"{name}.toml", ["camera.wavelength=546.074 nm"]))


def first_lens(name: str) -> Prescription:
    camera = gallery(name)
    return prescription_of(camera, camera.types[0])


def test_the_gallery_s_lenses_lose_what_fresnel_s_equations_say() -> None:
    silica = (0.4599 / 2.4599) ** 2  # 3.495 %
    assert transmissions(gallery("planoconvex"))["I"] == pytest.approx((1 - silica) ** 2, rel=1e-9)
    crown, flint = (0.51872 / 2.51872) ** 2, (0.79190 / 2.79190) ** 2  # 4.241 and 8.045 %
    lost = 1 - transmissions(gallery("doublet"))["II"]
    assert lost == pytest.approx(1 - (1 - crown) * (1 - CEMENT) * (1 - flint), abs=2e-5)
    assert lost == pytest.approx(0.125, abs=5e-4)


def test_a_coating_takes_the_place_of_surfaces_to_air() -> None:
    lens = first_lens("doublet")
    assert transmission(lens, 0.005) == pytest.approx(0.995**2 * (1 - CEMENT), abs=2e-6)
    assert transmission(lens, 0.0) == pytest.approx(1 - CEMENT, abs=2e-6)
    in_air = replace(first_lens("planoconvex"), index=np.ones(3))
    assert transmission(in_air, 0.5) == 1, "a stop in air reflects nothing"


def collected(scene: Scene) -> FloatArray:
    return electrons(scene, derive(scene))


def test_electrons_are_those_that_pass() -> None:
    changes = [SENSOR, "noise="]
    bare, coated = (
        collected(read(GALLERY / "doublet.toml", [*changes, *more]))
        for more in ([], [f"camera.lens.{name}.coating=0.0" for name in ("I", "II", "III")])
    )
    np.testing.assert_allclose(bare / coated, 0.8747 / (1 - CEMENT), rtol=1e-3)


def test_openings_wider_than_the_pitch_are_refused(ommatid: Command) -> None:
    """A thin lens when the scene is read; glass, which is scaled, before anything is rendered or computed."""
    with pytest.raises(
        InputError, match=r"camera: expected lens\.II\.aperture of at most lens_pitch, 0\.5 mm, got 3 mm"
    ):
        read(GALLERY / "tile19.toml", ['camera.lens.II.aperture="3 mm"'])
    read(GALLERY / "tile19.toml", ['camera.lens.II.aperture="0.5 mm"'])
    with pytest.raises(InputError, match="coating belongs to surfaces"):
        read(GALLERY / "tile19.toml", ["camera.lens.II.coating=0.1"])
    narrow = ["--set", "camera.lens_pitch=0.4 mm"]
    for command in (["show", "planoconvex"], ["predict", "planoconvex"], ["render", "planoconvex", "-o", "g.exr"]):
        ended = ommatid(*command, *narrow)
        assert ended.code == 2
        assert "camera.lens.I.surfaces: expected openings of at most camera.lens_pitch, 0.4 mm, got" in ended.err
        assert not Path("g.exr").exists()


def first_prescription(name: str, changes: list[str]) -> Prescription | None:
    camera = derive(read(GALLERY / f"{name}.toml", changes, ["I"]))
    return prescription_of(camera, camera.types[0]) if camera.types[0].optics.surfaces is not None else None


def test_a_single_lens_may_be_wider_than_the_pitch() -> None:
    alone = ["camera.lens.I.array=[1, 1]", "camera.lens_pitch=0.4 mm"]
    camera = derive(read(GALLERY / "planoconvex.toml", alone, ["I"]))
    assert 2 * prescription_of(camera, camera.types[0]).semi_diameter.max() > camera.lens_pitch
    wide = [*alone, 'camera.lens.I.aperture="3 mm"']
    assert derive(read(GALLERY / "tile19.toml", wide, ["I"])).types[0].optics.aperture == 3.0
    for scene, change in (("planoconvex", alone), ("tile19", wide)):
        two = [key.replace("[1, 1]", "[1, 2]") for key in change]
        with pytest.raises(InputError, match=r"of at most (camera\.)?lens_pitch, 0\.4 mm"):
            first_prescription(scene, two)
