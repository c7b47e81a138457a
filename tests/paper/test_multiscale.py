"""The second paper's expected errors, and readings that are sums over pixels of f."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from ommatid.analysis.predict import predict_scene
from ommatid.paper.multiscale import camera_of, is_deficient
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.render import render

from ..conftest import Command
from ..printed_figures import check_figures


def test_published_errors_are_met(here: Path, ommatid: Command) -> None:
    """To 1 %, as claims.csv says of each; and those of docs/paper.md."""
    found = json.loads(ommatid("paper", "--which", "multiscale", "-o", "errors", "--json").out)
    with (here / "errors" / "claims.csv").open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["holds"] for row in rows] == ["yes"] * 13
    errors = {each["claim"]: each["numbers"].get("computed") for each in found["claims"]}
    small, large = (f"pixels of {sizes}" for sizes in ("2, 3, 5", "17, 18, 19"))
    assert errors[f"{small}, averages"] == pytest.approx(30.441, rel=1e-3)
    assert errors["pixels of 2, 3 along one dimension, averages"] == pytest.approx(3.2816, rel=1e-3)
    check_figures("paper.md", "Averages of 2, 3 and 5 pixels have an error of {},", errors[f"{small}, averages"])
    check_figures("paper.md", "of 17, 18 and 19 pixels one of {}.", errors[f"{large}, averages"])
    check_figures("paper.md", "differ little: {} and {}.", errors[f"{small}, sums"], errors[f"{large}, sums"])


@pytest.mark.parametrize(
    ("sizes", "deficient"),
    [((2, 3), True), ((2, 4, 5), True), ((6, 10, 15), True), ((2, 3, 5), False), ((3, 4, 5), False)],
)
def test_a_null_space_takes_two_common_factors(sizes: tuple[int, ...], deficient: bool) -> None:
    """By the transfer functions of boxes on a ring, whose side all sizes divide."""
    side = int(np.lcm.reduce(sizes))
    boxes = [np.abs(np.fft.fft(np.r_[np.full(size, 1 / size), np.zeros(side - size)])) for size in sizes]
    seen = sum(np.outer(box, box) for box in boxes)
    assert is_deficient(sizes) is deficient
    assert (float(np.min(seen)) < 1e-9) is deficient


def test_sums_are_averages_times_the_number_of_pixels() -> None:
    """In H and in the renderer alike, whose rays are the same."""
    averages, sums = (
        read(GALLERY / "tile19.toml", (f"camera.binning={each}", "noise=")) for each in ("average", "sum")
    )
    weights = np.repeat([9.0, 25.0, 16.0], [each.measurements for each in derive(averages).types])
    one, other = (ideal_matrix(derive(each)).toarray() for each in (averages, sums))
    np.testing.assert_allclose(other, weights[:, None] * one, rtol=1e-12)
    light = [render(Setup.from_scene(each)).values for each in (averages, sums)]
    np.testing.assert_allclose(light[1], weights * light[0], rtol=1e-6)


def test_the_error_of_sums_is_that_of_averages_of_less_noise() -> None:
    """Of one size, where all readings are scaled alike: by 1/m^4."""
    one = predict_scene(camera_of((3,), "sum", 11), rays=False).mse
    scene = camera_of((3,), "average", 11)
    noise = scene.noise
    assert noise is not None
    quieter = scene.model_copy(update={"noise": noise.model_copy(update={"variance": 1 / 81})})
    assert one == pytest.approx(predict_scene(quieter, rays=False).mse, rel=1e-9)


def test_sums_take_an_ideal_sensor(ommatid: Command) -> None:
    ended = ommatid("predict", "sensor", "--set", "camera.binning=sum")
    assert (ended.code, "got a [sensor]" in ended.err) == (2, True)
    ended = ommatid("predict", "tile19", "--set", "camera.binning=sum", "--set", "noise.bits=8")
    assert (ended.code, "full scale of noise.bits" in ended.err) == (2, True)


def test_a_run_of_sums_is_inside_its_interval(here: Path, ommatid: Command) -> None:
    changes = "--set", "camera.binning=sum", "--set", "noise.variance=1"
    assert ommatid("run", "tile19", *changes, "-o", "out", "-q").code == 0
    found = json.loads((here / "out" / "tile19" / "run.json").read_text(encoding="utf-8"))
    expected = found["error"]["expected_given_truth"]
    assert expected["low"] < found["error"]["mse"] < expected["high"]
