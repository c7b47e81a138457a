"""Electrons from lux: limits, ratios, integrals and numbers by hand; spectra; noise in predictions."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import constants

from ommatid.analysis.summary import light_rows
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.optics import radiometry, spectrum
from ommatid.scenes.optics.field import optics_of
from ommatid.scenes.optics.point_spread import point_spread
from ommatid.scenes.optics.radiometry import electrons, predicted_noise, summary
from ommatid.scenes.pose import NO_MISALIGNMENT, Misalignment, pose_of
from ommatid.scenes.scene import Scene, parse, read, with_changes, write
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.scenes.tables.sensor import SensorTable

from ..examples import THREE, Lenses, scene, slow, with_keys
from ..printed_figures import check_figures

SENSOR: dict[str, Any] = {"illuminance": "500 lux", "exposure": "10 ms", "read_noise": 2.0, "black_level": 20.0}


def real(lenses: Lenses = THREE, aperture: float = 0.1, **tables: Any) -> Scene:
    """A scene of thin lenses and a real sensor."""
    described = scene(lenses=lenses, **tables)
    with_apertures = tuple(lens.model_copy(update={"aperture": aperture}) for lens in described.camera.lens)
    described = with_keys(described, camera={"lens": with_apertures})
    return described.model_copy(update={"sensor": SensorTable.model_validate(SENSOR)})


def test_electrons_are_proportional_to_light_and_time() -> None:
    described = real()
    camera, before = derive(described), electrons(real(), derive(real()))
    for key, value, factor in (
        ("illuminance", 1500.0, 3.0),
        ("exposure", 0.005, 0.5),
        ("quantum_efficiency", 0.25, 0.25),
        ("gain", 7.0, 1.0),
    ):
        changed = with_keys(described, sensor={key: value})
        np.testing.assert_allclose(electrons(changed, camera), factor * before, rtol=1e-12)
    red = with_keys(described, camera={"wavelength": 660e-6})
    np.testing.assert_allclose(electrons(red, camera), 660 / 550 * 0.9949501 / 0.061 * before, rtol=1e-6)


def angles(camera: Camera, sub: SubImager) -> FloatArray:
    """Angles between the chief rays of a sub-imager's pixels and the axis: (pixels,)."""
    rows, columns = sub.type.pixels
    x = sub.patch[0] - sub.lens[0] + (np.arange(columns) - (columns - 1) / 2) * camera.pixel_pitch
    y = sub.patch[1] - sub.lens[1] + (np.arange(rows) - (rows - 1) / 2) * camera.pixel_pitch
    return np.arctan(np.hypot(x[None, :], y[:, None]) / sub.depth).ravel()


def test_electrons_follow_the_acceptance_at_the_angle_of_the_chief_ray() -> None:
    described = real()
    camera, limit = derive(described), 0.02
    curve = ((limit, 0.4),)
    accepting = with_keys(described, sensor={"acceptance": curve})
    ratio = electrons(accepting, camera) / electrons(described, camera)
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        np.testing.assert_allclose(ratio[pixels], 1 - 0.6 * angles(camera, sub) / limit, rtol=1e-12)
    told = summary(accepting, camera, electrons(accepting, camera))["lens_types"]
    assert [row["accepted"] for row in told] == [
        pytest.approx(ratio[pixels].min(), rel=1e-12) for pixels in camera.type_slices()
    ]
    with pytest.raises(InputError, match="ends at"):
        electrons(with_keys(described, sensor={"acceptance": ((1e-3, 0.4),)}), camera)


def test_illumination_falls_with_the_fourth_power_of_the_cosine() -> None:
    camera = derive(real())
    for sub in camera.sub_imagers[:3]:
        found = radiometry.relative_illumination(camera, sub, pose_of(sub, NO_MISALIGNMENT))
        np.testing.assert_allclose(found, np.cos(angles(camera, sub)) ** 4, rtol=1e-12)


def test_illumination_of_misaligned_patches() -> None:
    """By the square of the distance, not by rotation, and by the cosine of a tilt on the axis."""
    camera = derive(real((("1/5", [1, 1], [1, 1]),)))
    sub = camera.sub_imagers[0]
    sub = replace(sub, patch=sub.lens)

    def light(misalignment: Misalignment) -> float:
        return float(radiometry.relative_illumination(camera, sub, pose_of(sub, misalignment))[0])

    assert light(NO_MISALIGNMENT) == pytest.approx(1, rel=1e-12)
    assert light(Misalignment(focal_length=0.02)) == pytest.approx(1.02**-2, rel=1e-12)
    assert light(Misalignment(rotation=0.4)) == pytest.approx(1, rel=1e-12)
    assert light(Misalignment(tilt=(0.0, 0.1))) == pytest.approx(np.cos(0.1), rel=1e-12)
    assert light(Misalignment(tilt=(0.1, 0.0))) == pytest.approx(np.cos(0.1), rel=1e-12)
    loose = replace(derive(real()), tolerance=ToleranceTable.model_validate({"focal_length": 0.01}))
    tight = electrons(real(), derive(real()))
    ratio = [float((electrons(real(), loose) / tight)[pixels].mean()) for pixels in loose.slices()]
    standard_error = 0.02 / (2 * len(ratio)) ** 0.5  # of a standard deviation
    assert np.std(ratio) == pytest.approx(0.02, abs=5 * standard_error), "twice that of the focal length"


def test_electrons_need_apertures_and_a_sensor() -> None:
    described = real()
    camera = derive(described)
    pinhole = replace(camera.types[1], optics=replace(camera.types[1].optics, aperture=None))
    with pytest.raises(ValueError, match="'B' is a pinhole"):
        electrons(described, replace(camera, types=(camera.types[0], pinhole, camera.types[2])))
    with pytest.raises(ValueError, match="got one without"):
        electrons(described.model_copy(update={"sensor": None}), camera)


def test_the_summary_has_the_light_of_each_type() -> None:
    described = real()
    camera = derive(described)
    response = electrons(described, camera)
    result = summary(described, camera, response)
    for lens_type, pixels in zip(result["lens_types"], camera.type_slices(), strict=True):
        assert lens_type["white"] == pytest.approx(255 * float(response[pixels].mean()))
        assert lens_type["mean"] == pytest.approx(lens_type["white"] / 2)
        assert not lens_type["saturates"]
        shot = (
            (lens_type["mean"] + 4 + 1 / 12) ** 0.5 / lens_type["mean"] * 127.5
        )  # at half of 255; frames add less than 1/64
        assert shot < lens_type["noise"] < 1.03 * shot
    assert light_rows(result)[0] == ("light", "679.6 lm/W")
    assert [line[0] for line in light_rows(result)[1:]] == ["lens type A", "lens type B", "lens type C"]
    changes = {"exposure": 1.0, "black_level": 0.0, "dark_current": 1.0}
    long = with_keys(described, sensor=changes)
    result = summary(long, camera, electrons(long, camera))
    assert all(lens_type["saturates"] and lens_type["saturation"] < 255 for lens_type in result["lens_types"])
    assert result["cut_off"]
    assert {"without light", "warning"} <= {line[0] for line in light_rows(result)}
    dark = summary(described, camera, np.zeros_like(response))
    assert "too little light" in light_rows(dark)[1][1]


def test_saturated_pixels_are_ignored_in_a_prediction() -> None:
    """The type of the smallest magnification, nearest to its lenses, saturates first; if all do, an error says so."""
    described = real()
    camera = derive(described)
    assert described.sensor is not None
    limits = [
        lens_type["saturation"] for lens_type in summary(described, camera, electrons(described, camera))["lens_types"]
    ]
    between = described.sensor.exposure * float(np.sqrt(limits[1] * limits[2])) / 127.5
    for exposure, seeing in ((described.sensor.exposure, 3), (between, 2)):
        long = with_keys(described, sensor={"exposure": exposure})
        noise = predicted_noise(long, camera, electrons(long, camera))
        assert [bool(np.isfinite(noise[pixels]).all()) for pixels in camera.type_slices()] == [True, seeing == 3, True]
    long = with_keys(described, sensor={"exposure": 1e3})
    with pytest.raises(InputError, match=r"test\.toml: sensor: at the prior's mean, 127\.5, every pixel is full"):
        predicted_noise(long, camera, electrons(long, camera))


# --- spectra: by hand, by another copy of CIE's tables, and by few wavelengths


# By hand: 500 lux on a white target, a lens 0.1 mm wide 1.2 mm before a pixel of 6 um x 6 um, 10 ms.
# E / pi x pi sin^2 x area x time, sin^2 = 0.05^2 / (0.05^2 + 1.2^2) = 1.73310e-3:
# 500 x 1.73310e-3 x 36e-12 x 0.01 = 3.11958e-13 lm s. Times 0.6 electrons per photon, below.
LUMEN_SECONDS = 3.11958e-13
# V (CIE, 1924) at 450, 550 and 650 nm is 0.0380, 0.99495 and 0.1070, so that a lumen second is
# 1 / (683.002 x 0.0380) = 0.0385295 J, 1 / 679.553 = 1.471556e-3 J and 1 / 73.0812 = 0.0136834 J,
# and a photon has 1.986446e-25 J m / wavelength = 4.41432e-19 J, 3.61172e-19 J and 3.05607e-19 J.
BY_HAND = {"450 nm": 16337.2, "550 nm": 762.63, "650 nm": 8380.7}


def lit(light: Any = None, efficiency: Any = 0.6, **more: Any) -> tuple[Scene, Camera]:
    """A scene of one thin lens on the axis of its pixels, lit by a spectrum, and its camera."""
    sensor = {"illuminance": "500 lux", "exposure": "10 ms", "quantum_efficiency": efficiency, "black_level": 20.0}
    data = scene(lenses=(("1/5", [1, 1], [3, 3]),)).plain() | {"sensor": sensor}
    data["camera"] |= more
    data["camera"]["lens"][0]["aperture"] = "0.1 mm"
    if light is not None:
        data["light"] = {"spectrum": light}
    described = parse(data, Path("test.toml"))
    return described, derive(described)


def white(described: tuple[Scene, Camera]) -> float:
    """Electrons in the middle pixel at 255."""
    return float(electrons(*described)[4]) * 255


@pytest.mark.parametrize("light", BY_HAND)
def test_electrons_of_one_wavelength_are_those_by_hand(light: str) -> None:
    """The pixel is wide enough that cos^4 takes 1e-5 of its light."""
    assert white(lit(light)) == pytest.approx(BY_HAND[light], rel=3e-5)
    assert white(lit(wavelength=light)) == pytest.approx(BY_HAND[light], rel=3e-5)


def test_the_table_of_the_documentation() -> None:
    lights = ("450 nm", "550 nm", "650 nm", "D65", "LED-B3")
    row = {light: (spectrum.efficacy(lit(light)[0]), white(lit(light))) for light in lights}
    check_figures("noise.md", '| `"450 nm"` | {} | {} |', *row["450 nm"])
    check_figures("noise.md", '| `"550 nm"`, the default | {} | {} |', *row["550 nm"])
    check_figures("noise.md", '| `"650 nm"` | {} | {} |', *row["650 nm"])
    check_figures("noise.md", '| `"D65"` | {} | {} |', *row["D65"])
    check_figures("noise.md", '| `"LED-B3"` | {} | {} |', *row["LED-B3"])


@pytest.mark.slow
def test_the_tables_are_those_of_another_library() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import colour
    standard = colour.colorimetry.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    for name, other in (("photopic", standard), *((name, colour.SDS_ILLUMINANTS[name]) for name in ("D65", "LED-B3"))):
        table = np.array(spectrum.table(name))
        np.testing.assert_allclose(table[:, 1], [float(other[wavelength]) for wavelength in table[:, 0]], rtol=1e-12)
    lamp, grid = colour.SDS_ILLUMINANTS["LED-B3"], np.arange(380.0, 781.0)
    power = np.interp(grid, lamp.wavelengths, lamp.values)
    lumens = 683.002 * np.trapezoid(power * [float(standard[wavelength]) for wavelength in grid])
    photons = np.trapezoid(power * grid * 1e-9) / (constants.h * constants.c)
    assert white(lit("LED-B3")) == pytest.approx(0.6 * LUMEN_SECONDS * photons / lumens, rel=1e-4)


def test_a_curve_of_quantum_efficiency_weights_the_photons() -> None:
    """Flat power from 500 to 600 nm, efficiency rising from 0 to 1: the mean of (x + 500 nm) x over that of 500 + x."""
    ramp = [[500, 0.0], [600, 1.0]]
    mean = (500 * 100 / 2 + 100**2 / 3) / (500 + 100 / 2) / 100  # of the efficiency, weighted by the photons
    assert white(lit("500-600 nm", ramp)) == pytest.approx(mean * white(lit("500-600 nm", 1.0)), rel=1e-5)
    half = white(lit("500-600 nm", [[400, 0.5], [700, 0.5]]))
    assert half == pytest.approx(0.5 * white(lit("500-600 nm", 1.0)), rel=1e-12)
    # sum of (500 + x)^2 x over sum of (500 + x) x: the mean wavelength of the electrons
    mean = (500**2 / 2 + 1000 * 100 / 3 + 100**2 / 4) / (500 / 2 + 100 / 3)
    camera = lit("500-600 nm", ramp)[1]
    assert camera.wavelength == pytest.approx(mean * 1e-6, rel=1e-5)


def transfer(frequency: np.ndarray) -> np.ndarray:
    """Contrast of a circular pupil by the area that two displaced circles share, summed over chords."""
    height = (np.arange(1000) + 0.5) / 1000
    chord = np.maximum(np.sqrt(1 - height**2) - frequency[..., None], 0)
    return 4 / np.pi * chord.mean(axis=-1)


@pytest.mark.parametrize(("light", "count"), [("D65", 5), ("LED-B3", 5), ("450-650 nm", 4), ("545-555 nm", 1)])
def test_a_few_wavelengths_diffract_as_the_whole_spectrum(light: str, count: int) -> None:
    """Contrast at every frequency within 1e-3, by hundreds of wavelengths; with one node less it is beyond."""
    described, camera = lit(light)
    wavelengths = camera.wavelengths
    assert len(wavelengths) == count
    assert sum(share for _, share in wavelengths) == pytest.approx(1, rel=1e-12)
    assert sum(at * share for at, share in wavelengths) == pytest.approx(camera.wavelength, rel=1e-12)
    assert camera.bands == (wavelengths if count > 1 else ())
    at, weight = spectrum.spectrum_of(described).wavelength, spectrum.detected(described)
    frequency = np.linspace(0, 1 / at[0], 40)[:, None]
    exact = transfer(frequency * at[::2]) @ weight[::2] / weight[::2].sum()
    few = transfer(frequency * [1e6 * at for at, _ in wavelengths]) @ [share for _, share in wavelengths]
    assert np.abs(few - exact).max() < 1.1e-3
    if count > 1:
        at, share = spectrum.gauss(at[weight > 0], weight[weight > 0] / weight.sum(), count - 1)
        assert np.abs(transfer(frequency * at) @ share - exact).max() > 1e-3


@pytest.mark.parametrize("wavelengths", [12, slow(24)])
def test_axial_colour_takes_more_wavelengths(wavelengths: int) -> None:
    """Contrast of a singlet of N-SF11 by waves through its surfaces at many wavelengths, to 1e-3 and aberrations."""
    face = {"radius": "3 mm", "thickness": "0.5 mm", "glass": "N-SF11", "semi_diameter": "0.25 mm", "stop": True}
    data = scene(lenses=(("1/5", [1, 1], [3, 3]),)).plain() | {"light": {"spectrum": "D65"}}
    data["camera"] |= {"lens_pitch": "3 mm", "pixel_pitch": "10 um"}
    data["camera"]["lens"][0]["surfaces"] = [face, {"radius": "-3 mm", "semi_diameter": "0.25 mm"}]
    described = parse(data, Path("test.toml"))
    camera = derive(described)
    (lens,) = camera.types
    frequency = camera.depth(lens) / camera.distance / camera.pixel_pitch  # that of sensor pixels, on the target

    def contrast(places: FloatArray, shares: FloatArray) -> FloatArray:
        waves = [optics_of(camera, lens, float(at)).lit_wave(0.0) for at in places]
        return shares @ [
            point_spread(wave).transfer(np.array([[0.5, 0], [0.75, 0]]) * frequency).real for wave in waves
        ]

    at, weight = spectrum.spectrum_of(described).wavelength, spectrum.detected(described) / 1e20
    parts = [(weight[part].sum(), at[part] @ weight[part]) for part in np.array_split(np.arange(at.size), wavelengths)]
    exact = contrast(*(np.array([(moment / sum_ / 1e6, sum_ / weight.sum()) for sum_, moment in parts]).T))
    few, (five, share) = np.array(camera.wavelengths), spectrum.gauss(at, weight / weight.sum(), 5)
    assert np.abs(contrast(five / 1e6, share) - exact).max() > 8e-3
    assert np.abs(contrast(few[:, 0], few[:, 1]) - exact).max() < 2e-3


def test_one_wavelength_is_the_same_in_either_table() -> None:
    by_light, by_camera = lit("550 nm")[1], lit(wavelength="550 nm")[1]
    assert by_light == by_camera
    assert by_light.wavelengths == ((by_camera.wavelength, 1.0),)
    ((wavelength, share),) = lit()[1].wavelengths
    assert (wavelength, share) == (pytest.approx(by_camera.wavelength, rel=1e-12), 1.0)
    assert lit(wavelength="none")[1].wavelengths == ()
    assert white(lit(wavelength="none")) == white(lit())
    assert white(lit()) == white(lit("550 nm"))


def test_files_hold_curves(tmp_path: Path) -> None:
    """Beside the scene file; a written scene holds their points."""
    (tmp_path / "lamp.csv").write_text("nm, power\n500, 1\n600, 1  # flat\n", encoding="utf-8")
    (tmp_path / "chip.txt").write_text("400 0.5\n700 0.5\n", encoding="utf-8")
    data = lit()[0].plain()
    data |= {"light": {"spectrum": "lamp.csv"}}
    data["sensor"]["quantum_efficiency"] = "chip.txt"
    described = with_changes(data, tmp_path / "mine.toml", (), ())
    assert white((described, derive(described))) == pytest.approx(white(lit("500-600 nm", 0.5)), rel=1e-12)
    write(tmp_path / "elsewhere.toml", described)
    text = (tmp_path / "elsewhere.toml").read_text(encoding="utf-8")
    assert "[500.0, 1.0]" in text
    (tmp_path / "lamp.csv").unlink()
    assert read(tmp_path / "elsewhere.toml").light == described.light


def test_light_that_is_not_seen_or_not_detected_is_refused() -> None:
    with pytest.raises(InputError, match="lux, which measure light from 360 to 830 nm"):
        white(lit("900 nm"))
    with pytest.raises(InputError, match=r"camera\.wavelength: .*lux"):
        white(lit(wavelength="900 nm"))
    with pytest.raises(InputError, match="above 0 within the light's 450 to 650 nm"):
        lit("450-650 nm", [[700, 1.0], [800, 1.0]])
    with pytest.raises(InputError, match=r"camera\.wavelength or light\.spectrum, got both"):
        lit("D65", wavelength="550 nm")
