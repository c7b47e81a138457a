"""Files of Zemax: lenses, and glass catalogues against the indices that are known by other formulas and tables."""

from __future__ import annotations

from pathlib import Path

import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.lens_file import read_lens
from ommatid.scenes.optics.dispersion import Dispersion
from ommatid.scenes.optics.field import prescription_of
from ommatid.scenes.scene import read, with_changes, write
from ommatid.scenes.tables import glass
from ommatid.scenes.tables.camera import Surface

from ..examples import GALLERY, not_none

LENS = """VERS 140124
MODE SEQ
UNIT {unit} X W X CM MR CPMM
WAVM 1 0.55 1
SURF 0
  TYPE STANDARD
  DISZ INFINITY
SURF 1
  COMM dummy
  TYPE STANDARD
  CURV 0.0 0 0 0 0 ""
  DISZ 5
  DIAM 9 0 0 0 1 ""
SURF 2
  STOP
  TYPE STANDARD
  CURV 0.0
  DISZ 0.5
  DIAM 1
SURF 3
  TYPE EVENASPH
  CURV 0.1
  PARM 1 0
  PARM 2 2E-4
  PARM 8 -3e-9
  DISZ 2
  GLAS PMMA 0 0 1.49 57 0
  CONI -0.5
  DIAM 3
SURF 4
  TYPE STANDARD
  CURV -5.0E-2 0 0 0 0 ""
  DISZ 1,5
  DIAM 3
SURF 5
  TYPE STANDARD
  DISZ 0.5
  DIAM 4
SURF 6
  TYPE STANDARD
  DISZ 2
  CURV 0.2
  GLAS ___BLANK 1 0 1.5168 64.17 0
  DIAM 2
SURF 7
  TYPE STANDARD
  DISZ 30
  CLAP 0 1.5 0
  DIAM 2
SURF 8
  TYPE STANDARD
  DIAM 3
TOL TOFF 0 0
MNUM 1 1
"""


def lens(tmp_path: Path, text: str, encoding: str = "utf-8") -> tuple[Surface, ...]:
    (tmp_path / "lens.zmx").write_text(text, encoding=encoding)
    return read_lens(tmp_path / "lens.zmx")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-8-sig", "latin-1"])
def test_a_file_holds_its_lens(encoding: str, tmp_path: Path) -> None:
    """Without the object, the image and two planes in air, the second of whose distances counts with the gap."""
    text = LENS.format(unit="MM").replace("dummy", "plan sphérique")
    stop, front, back, fourth, last = lens(tmp_path, text, encoding)
    assert (stop.radius, stop.thickness, stop.semi_diameter, stop.stop) == (None, 0.5, 1.0, True)
    assert (front.radius, front.thickness, front.semi_diameter, front.glass) == (10.0, 2.0, 3.0, "PMMA")
    assert (front.conic, front.aspheric, front.stop) == (-0.5, (2e-4, 0, 0, 0, 0, 0, -3e-9), False)
    assert (back.radius, back.thickness, back.glass, back.aspheric) == (-20.0, 2.0, None, None)
    assert fourth.radius == 5.0
    assert (last.radius, last.thickness, last.semi_diameter) == (None, None, 1.5)


@pytest.mark.parametrize(("unit", "length"), [("CM", 10.0), ("IN", 25.4), ("METER", 1000.0)])
def test_lengths_are_in_the_file_s_unit(unit: str, length: float, tmp_path: Path) -> None:
    """A lens of the same numbers is so many times larger, its polynomial too: a4 r^4 is a length."""
    small, large = (lens(tmp_path, LENS.format(unit=name)) for name in ("MM", unit))
    for one, other in zip(small, large, strict=True):
        assert other.semi_diameter == pytest.approx(length * one.semi_diameter)
        assert (other.radius or 0.0) == pytest.approx(length * (one.radius or 0.0))
        assert (other.thickness or 0.0) == pytest.approx(length * (one.thickness or 0.0))
    for power, term, other in zip((4, 16), (2e-4, -3e-9), (large[1].aspheric or ())[::6], strict=True):
        assert other * length**power == pytest.approx(length * term)


def test_a_model_glass_has_its_index_and_abbe_number(tmp_path: Path) -> None:
    surface = lens(tmp_path, LENS.format(unit="MM"))[3]
    d, f, c = (glass.index_behind(surface, wavelength) for wavelength in (587.5618e-6, 486.1327e-6, 656.2725e-6))
    assert d == pytest.approx(1.5168, rel=1e-9)
    assert (d - 1) / (f - c) == pytest.approx(64.17, rel=1e-9)
    # N-BK7 has these two numbers
    assert glass.index_behind(surface, 550e-6) == pytest.approx(glass.index("N-BK7", 550e-6), abs=1e-5)
    with pytest.raises(InputError, match="from 400 to 700 nm, got a wavelength of 1064"):
        glass.index_behind(surface, 1064e-6)
    (tmp_path / "lens.zmx").write_text(LENS.format(unit="MM").replace("1.5168 64.17", "1.5168 0"), encoding="utf-8")
    assert read_lens(tmp_path / "lens.zmx")[3].index == 1.5168


def test_a_square_term_is_a_paraboloid(tmp_path: Path) -> None:
    text = LENS.format(unit="MM").replace("PARM 1 0", "PARM 1 0.02")
    with pytest.raises(InputError, match=r"surface 3: expected PARM 1, .*got 0.02"):
        lens(tmp_path, text)
    flat = lens(tmp_path, text.replace("CURV 0.1", "CURV 0"))[1]
    assert (flat.radius, flat.conic) == (25.0, -1.0)


REFUSED = {
    "mirror": ("GLAS PMMA", "GLAS MIRROR", "line 20, surface 3: .* got a mirror"),
    "type": ("TYPE EVENASPH", "TYPE BICONICX", "surface 3: .* got the type BICONICX"),
    "unit": ("UNIT MM", "UNIT FURLONG", "line 3: expected a unit among MM.* got 'FURLONG'"),
    "obscured": ("CLAP 0", "CLAP 0.5", "surface 7: .* inner radius"),
    "nan": ("CURV 0.1", "CURV nan", "surface 3: expected CURV, a number .* got 'nan'"),
    "strong": ("PARM 8 -3e-9", "PARM 8 1e3", "surface 3: .* aspheric term .* a16 = 1000"),
    "back": ("DISZ 2\n  GLAS", "DISZ -2\n  GLAS", "surface 3: thickness: expected a length above zero, got '-2.0 mm'"),
    "index": ("1.5168 64.17", "9.9 0", "surface 6: index: expected a number of at most 5, got 9.9"),
    "sign": ("1.5168 64.17", "-1.5168 64.17", "surface 6: expected a glass of nd from 1 to 5, got -1.5168"),
    "stops": ("SURF 4", "SURF 4\n  STOP", "expected one aperture stop at most, got 2"),
    "many": ("SURF 4", "SURF 4\n" * 2000, "expected at most 200 surfaces"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_not_supported_is_named(name: str, tmp_path: Path) -> None:
    old, new, words = REFUSED[name]
    text = LENS.format(unit="MM")
    assert old in text
    with pytest.raises(InputError, match=rf"lens\.zmx.*{words}"):
        lens(tmp_path, text.replace(old, new))


# Coefficients of materials, and their indices as printed, by wavelength in um.
MATERIALS = {
    # SCHOTT 1992, BK7: nd and nF of the catalogue
    "1 BK7": (2.2718929, -1.0108077e-2, 1.0592509e-2, 2.0816965e-4, -7.6472538e-6, 4.9240991e-7),
    "2 N-BK7": (1.03961212, 0.00600069867, 0.231792344, 0.0200179144, 1.01046945, 103.560653),
    # C. D. Salzberg, J. J. Villa, J. Opt. Soc. Am. 47, 244 (1957): silicon at 26 degrees, and its measured indices
    "3 SILICON": (3.41696, 0.138497, 0.013924, -2.09e-5, 1.48e-7),
    # D. Eimerl et al., J. Appl. Phys. 62, 1968 (1987): beta barium borate, ordinary
    "7 BBO": (2.7405, 0.0184, 0.0179, 0.0155),
}
KNOWN = {
    "1 BK7": {0.5875618: 1.51680, 0.4861327: 1.52238, 0.6562725: 1.51432},
    "2 N-BK7": {0.5875618: 1.51680, 0.4861327: 1.52238, 0.6562725: 1.51432},
    "3 SILICON": {5.0: 3.4221, 10.0: 3.4178},
    "7 BBO": {1.0642: 1.6551, 0.5321: 1.6749, 0.266: 1.7571},
}


def agf(**glasses: tuple[int, tuple[float, ...]]) -> str:
    """Return a catalogue of glasses from 0.3 to 11 um."""
    text = "CC a catalogue\n"
    for name, (formula, coefficients) in glasses.items():
        text += f"NM {name} {formula} 517642 1.5 60 0 1\nGC comment\nED 7.1 8.3 2.51 -0.0008 0\n"
        text += f"CD {' '.join(map(str, coefficients))}\nTD 0 0 0 0 0 0 20\nOD 1 1 1 1 1\nLD 0.3 11\nIT 0.3 0.05 10\n"
    return text


def dispersion(
    formula: int, coefficients: tuple[float, ...], shortest: str = "300 nm", longest: str = "2 um"
) -> Dispersion:
    table = {"formula": formula, "coefficients": coefficients, "shortest": shortest, "longest": longest}
    return Dispersion.model_validate(table)


@pytest.mark.parametrize("name", MATERIALS)
def test_formulas_yield_the_known_indices(name: str) -> None:
    formula = int(name.split()[0])
    material = dispersion(formula, MATERIALS[name], "200 nm", "11 um")
    for wavelength, index in KNOWN[name].items():
        assert material.index(wavelength * 1e-3) == pytest.approx(index, abs=1e-4 if formula in (3, 7) else 1e-5)


# One function in several formulas, which share nothing but their definition.
SAME = {
    "powers": [
        (1, (2.2, 0, 0.01)),
        (10, (2.2, 0, 0.01)),
        (12, (2.2, 0, 0.01)),
        (13, (2.2, 0, 0, 0.01)),
        (7, (2.2, 0.01)),
    ],
    "more powers": [(1, (2.2, 0.03, 0, 2e-4, 3e-6, 1e-7)), (13, (2.2, 0.03, 0, 0, 2e-4, 3e-6, 1e-7))],
    "high powers": [(10, (2.2, 0, 0, 0, 0, 0, 3e-9, 2e-10)), (13, (2.2, 0, 0, 0, 0, 0, 0, 3e-9, 2e-10))],
    "fourth power": [(12, (2.2, 0, 0, 0, 0, 0, 0.002)), (13, (2.2, 0, 0.002))],
    "one pole": [
        (2, (1.2, 0.01)),
        (4, (0, 1.2, 0.1)),
        (6, (1.2, 0.01)),
        (8, (2.2 - 1.2, 1.2, 0.01)),
        (9, (1, 1.2, 0.01)),
        (11, (1.2, 0.01)),
        (7, (2.2, 0.012, 0.01)),
    ],
    "three poles": [(2, (1.2, 0.01, 0.3, 0.02, 0.5, 90)), (6, (0.3, 0.02, 0.5, 90, 0, 0, 1.2, 0.01))],
    "last poles": [(6, (0, 0, 0.3, 0.02, 0.5, 90, 1.2, 0.01)), (11, (0.3, 0.02, 0, 0, 0.5, 90, 0, 0, 1.2, 0.01))],
    "two poles": [(9, (2.2, 0.3, 0.02, 0.4, 0.03)), (11, (0.3, 0.02, 0.4, 0.03, 1.2, 0))],
    "a pole without w": [(4, (0.2, 1.1, 0.15, 0.02, 0.1)), (9, (-0.8, 1.1, 0.0225, 2.0, 0.01))],
    "a square": [(8, (2.2, 0.3, 0.02, 0.01)), (7, (2.5, 0.3 * 0.02, 0.02, 0.01))],
    "linear": [(5, (1.5,)), (3, (1.5,)), (1, (2.25,))],
}


@pytest.mark.parametrize("name", SAME)
def test_formulas_that_are_one_function_agree(name: str) -> None:
    for wavelength in (0.4e-3, 0.55e-3, 0.8e-3, 1.6e-3):
        indices = [dispersion(*each).index(wavelength) for each in SAME[name]]
        assert indices[1:] == pytest.approx([indices[0]] * (len(indices) - 1), rel=1e-12)


def test_the_rest_of_the_formulas_by_hand() -> None:
    """At 2 um: n = 1.5 + 0.02 / 2 + 0.3 / 2^3.5; w^6 = 64; Herzberger's w^2, w^4 and w^6, and L = 1 / 3.972."""
    for formula, coefficients, index in (
        (5, (1.5, 0.02, 0.3), 1.5 + 0.01 + 0.3 / 11.313708498984761),
        (12, (2.2, 0, 0, 0, 0, 0, 0, 0.001), 2.264**0.5),
        (3, (1.5, 0.02, 0.03, 0.004, 0.0005, 0.00006), 1.5 + 0.005035246727 + 0.001901529 + 0.016 + 0.008 + 0.00384),
    ):
        assert dispersion(formula, coefficients).index(2e-3) == pytest.approx(index, abs=1e-8)


def test_a_scene_takes_glasses_from_a_catalogue(tmp_path: Path) -> None:
    """By any case of their names, before those built in; the scene that is written needs no catalogue."""
    text = agf(**{"E-LAK9": (2, (1.2, 0.01)), "N-BK7": (5, (1.7,)), "BAD": (99, (1.0,))})
    (tmp_path / "glass.agf").write_text(text, encoding="utf-16")
    (tmp_path / "lens.zmx").write_text(LENS.format(unit="MM").replace("PMMA", "e-lak9"), encoding="utf-8")
    data = read(GALLERY / "tile19.toml", (), ["I"]).plain()
    data["camera"]["lens"][0]["surfaces"] = "lens.zmx"
    data["camera"] |= {"glass_catalogue": "glass.agf", "lens_pitch": "2 mm"}
    scene = with_changes(data, tmp_path / "scene.toml", (), ())
    write(tmp_path / "other.toml", scene)
    (tmp_path / "glass.agf").unlink()
    for one in (scene, read(tmp_path / "other.toml")):
        camera = derive(one)
        prescription = prescription_of(camera, camera.types[0])
        assert prescription.index[1] == pytest.approx((1 + 1.2 * 0.3025 / (0.3025 - 0.01)) ** 0.5, rel=1e-12)
    assert read(tmp_path / "other.toml").camera == scene.camera
    (tmp_path / "glass.agf").write_text(text, encoding="utf-8")
    for name, words in (
        ("N-BK8", r"surfaces\[1\].glass: expected a glass .*N-BK7.*nearest glass is 'N-BK7'"),
        ("bad", "glass.agf, line 18, glass BAD: formula: expected a number of at most 13"),
    ):
        (tmp_path / "lens.zmx").write_text(LENS.format(unit="MM").replace("PMMA", name), encoding="utf-8")
        with pytest.raises(InputError, match=words.replace("less", "(?:less|.*)")):
            with_changes(data, tmp_path / "scene.toml", (), ())
    (tmp_path / "lens.zmx").write_text(LENS.format(unit="MM").replace("PMMA", "N-BK7"), encoding="utf-8")
    surfaces = not_none(with_changes(data, tmp_path / "scene.toml", (), ()).camera.lens[0].surfaces)
    assert isinstance(surfaces[1], Surface)
    assert glass.index_behind(surfaces[1]) == 1.7


def test_zemax_s_names_of_the_built_in_glasses(tmp_path: Path) -> None:
    (tmp_path / "lens.zmx").write_text(LENS.format(unit="MM").replace("PMMA", "F_SILICA"), encoding="utf-8")
    data = read(GALLERY / "tile19.toml", (), ["I"]).plain()
    data["camera"]["lens"][0]["surfaces"] = "lens.zmx"
    surfaces = not_none(with_changes(data, tmp_path / "scene.toml", (), ()).camera.lens[0].surfaces)
    assert isinstance(surfaces[1], Surface)
    assert surfaces[1].glass == "fused silica"


def test_a_wavelength_outside_the_catalogue_s_range_is_refused() -> None:
    material = dispersion(2, (1.2, 0.01), "400 nm", "1 um")
    for wavelength in (399e-6, 1001e-6):
        with pytest.raises(InputError, match="the index of X is known from 400 to 1000 nm"):
            material.index(wavelength, "X")
    for pole in (0.3025, 0.30250001):
        with pytest.raises(InputError, match="yield an index"):
            dispersion(2, (1.2, pole)).index(550e-6)
