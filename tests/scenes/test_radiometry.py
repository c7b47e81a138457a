"""Electrons from lux: limits, ratios and integrals (`test_spectrum` has them by hand); noise in predictions."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import integrate

from ommatid.analysis.summary import light_rows
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.optics import radiometry
from ommatid.scenes.optics.radiometry import electrons, predicted_noise, solid_angle, summary
from ommatid.scenes.pose import NO_MISALIGNMENT, Misalignment, pose_of
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.scenes.tables.sensor import SensorTable

from ..examples import THREE, Lenses, scene

SENSOR: dict[str, Any] = {"illuminance": "500 lux", "exposure": "10 ms", "read_noise": 2.0, "black_level": 20.0}


def real(lenses: Lenses = THREE, aperture: float = 0.1, **tables: Any) -> Scene:
    """A scene of thin lenses and a real sensor."""
    described = scene(lenses=lenses, **tables)
    with_apertures = tuple(lens.model_copy(update={"aperture": aperture}) for lens in described.camera.lens)
    camera = described.camera.model_copy(update={"lens": with_apertures})
    return described.model_copy(update={"camera": camera, "sensor": SensorTable.model_validate(SENSOR)})


def test_electrons_are_proportional_to_light_and_time() -> None:
    described = real()
    camera, before = derive(described), electrons(real(), derive(real()))
    for key, value, factor in (
        ("illuminance", 1500.0, 3.0),
        ("exposure", 0.005, 0.5),
        ("quantum_efficiency", 0.25, 0.25),
        ("gain", 7.0, 1.0),
    ):
        assert described.sensor is not None
        changed = described.model_copy(update={"sensor": described.sensor.model_copy(update={key: value})})
        np.testing.assert_allclose(electrons(changed, camera), factor * before, rtol=1e-12)
    red = described.model_copy(update={"camera": described.camera.model_copy(update={"wavelength": 660e-6})})
    np.testing.assert_allclose(electrons(red, camera), 660 / 550 * 0.9949501 / 0.061 * before, rtol=1e-6)


@pytest.mark.parametrize("aperture", [1e-3, 1.0, 5.0, 1e6])
def test_the_solid_angle_is_the_integral_over_the_cone(aperture: float) -> None:
    """The integral of cos sin over the cone of the disk; it is pi for a hemisphere."""
    edge = np.arctan2(aperture / 2, 2.0)
    whole, _ = integrate.quad(lambda angle: 2 * pi * np.cos(angle) * np.sin(angle), 0, edge)
    assert solid_angle(aperture, 2.0) == pytest.approx(whole, rel=1e-9)
    assert solid_angle(aperture, 2.0) <= pi


def test_electrons_follow_the_acceptance_at_the_angle_of_the_chief_ray() -> None:
    """The angle's tangent is the distance of a pixel from the lens's axis over the depth; the curve is linear."""
    described = real()
    assert described.sensor is not None
    camera, limit = derive(described), 0.02
    curve = ((limit, 0.4),)
    accepting = described.model_copy(update={"sensor": described.sensor.model_copy(update={"acceptance": curve})})
    ratio = electrons(accepting, camera) / electrons(described, camera)
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        rows_, columns = sub.type.pixels
        x = sub.patch[0] - sub.lens[0] + (np.arange(columns) - (columns - 1) / 2) * camera.pixel_pitch
        y = sub.patch[1] - sub.lens[1] + (np.arange(rows_) - (rows_ - 1) / 2) * camera.pixel_pitch
        angle = np.arctan(np.hypot(x[None, :], y[:, None]) / sub.depth)
        np.testing.assert_allclose(ratio[pixels], 1 - 0.6 * angle.ravel() / limit, rtol=1e-12)
    told = summary(accepting, camera, electrons(accepting, camera))["lens_types"]
    assert [row["accepted"] for row in told] == [
        pytest.approx(ratio[pixels].min(), rel=1e-12) for pixels in camera.type_slices()
    ]
    short = described.sensor.model_copy(update={"acceptance": ((1e-3, 0.4),)})
    with pytest.raises(InputError, match="ends at"):
        electrons(described.model_copy(update={"sensor": short}), camera)


@pytest.mark.parametrize(
    "rows", [[["2 deg", 1], ["1 deg", 0.5]], [["90 deg", 0.5]], [["5 deg", 0]], [[5, 1]], [["5 deg"]], [], [7], 5]
)
def test_curves_that_are_no_acceptance_are_refused(rows: object) -> None:
    data = real().plain()
    data["sensor"]["acceptance"] = rows
    with pytest.raises(InputError, match="acceptance"):
        parse(data, Path("test.toml"))


def test_an_acceptance_needs_walls() -> None:
    data = real(calibration={"method": "transport"}).plain()
    data["camera"]["walls"] = False
    parse(data, Path("test.toml"))
    data["sensor"]["acceptance"] = [["5 deg", 0.9]]
    with pytest.raises(InputError, match="walls"):
        parse(data, Path("test.toml"))


def test_illumination_falls_with_the_fourth_power_of_the_cosine() -> None:
    """The cosine is that of the angle between a pixel's chief ray and the axis."""
    camera = derive(real())
    for sub in camera.sub_imagers[:3]:
        rows_, columns = sub.type.pixels
        x = sub.patch[0] - sub.lens[0] + (np.arange(columns) - (columns - 1) / 2) * camera.pixel_pitch
        y = sub.patch[1] - sub.lens[1] + (np.arange(rows_) - (rows_ - 1) / 2) * camera.pixel_pitch
        cosine = np.cos(np.arctan(np.hypot(x[None, :], y[:, None]) / sub.depth))
        np.testing.assert_allclose(
            radiometry.relative_illumination(camera, sub, pose_of(sub, NO_MISALIGNMENT)),
            (cosine**4).ravel(),
            rtol=1e-12,
        )


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
    assert described.sensor is not None
    changes = {"exposure": 1.0, "black_level": 0.0, "dark_current": 1.0}
    long = described.model_copy(update={"sensor": described.sensor.model_copy(update=changes)})
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
        long = described.model_copy(update={"sensor": described.sensor.model_copy(update={"exposure": exposure})})
        noise = predicted_noise(long, camera, electrons(long, camera))
        assert [bool(np.isfinite(noise[pixels]).all()) for pixels in camera.type_slices()] == [True, seeing == 3, True]
    long = described.model_copy(update={"sensor": described.sensor.model_copy(update={"exposure": 1e3})})
    with pytest.raises(InputError, match=r"test\.toml: sensor: at the prior's mean, 127\.5, every pixel is full"):
        predicted_noise(long, camera, electrons(long, camera))
