"""Light lost by reflection against Fresnel's equations by hand; openings that would overlap are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.optics.field import prescription_of
from ommatid.scenes.optics.prescription import Prescription
from ommatid.scenes.optics.radiometry import electrons, transmission, transmissions
from ommatid.scenes.scene import Scene, read

from ..conftest import Command
from ..examples import GALLERY

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
