"""The page of a run and the page of a batch as text: what they hold is what the files hold, and nothing else is needed.

What a browser makes of them is tests/test_page_in_browser.py.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
import sys
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from scipy import stats

from ommatid.page import batch_index, data, error_groups, point_response, sensor, time_curves, words
from ommatid.page.cached import cached_page
from ommatid.page.document import page
from ommatid.reconstruct.output.run_json import (
    DepthBin,
    DiagnosticsReport,
    ErrorReport,
    RunReport,
    StudyCase,
    TimeReport,
)
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.scenes.hardware import stack_import
from ommatid.scenes.hardware.frames import AcquisitionSettings
from ommatid.scenes.recording import Recording
from ommatid.scenes.scene import parse
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.sensor import SensorTable
from ommatid.simulate.ideal import ideal_matrix, matrix_as_designed

from ..conftest import Command
from ..examples import familywise, scene
from .runs import F, lettered, seen, synthetic

VOID = {"meta", "link", "img", "input", "br"}
SENSOR = {"illuminance": "100 lx", "exposure": "10 ms"}


class Reader(HTMLParser):
    """Tags in order, text by the id or tag around it, and what is not closed as it was opened."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data: str) -> None:
        if self.open:
            self.text[self.open[-1]] = self.text.get(self.open[-1], "") + data


def parsed(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    reader.close()
    return reader


def embedded(text: str) -> Any:
    """The figures' JSON in a page."""
    found = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, flags=re.DOTALL)
    assert found
    return json.loads(found[1])


def columns(text: str, name: str) -> dict[str, Any]:
    """The columns of a named source as a browser decodes them."""
    [source] = [one for one in sources(text) if one["attributes"].get("name") == name]
    return {key: decoded(values) for key, values in source["attributes"]["data"]["entries"]}


def sources(text: str) -> list[dict[str, Any]]:
    return [one for one in objects(embedded(text)) if one["name"] == "ColumnDataSource"]


def objects(content: Any) -> list[dict[str, Any]]:
    if isinstance(content, list):
        return [found for one in content for found in objects(one)]
    if not isinstance(content, dict):
        return []
    own = [content] if content.get("type") == "object" and "attributes" in content else []
    return own + [found for one in content.values() for found in objects(one)]


def decoded(value: Any) -> Any:
    if isinstance(value, list):
        return [decoded(one) for one in value]
    if isinstance(value, dict) and value.get("type") == "ndarray":
        assert value["order"] == "little"
        pixels = gzip.decompress(base64.b64decode(value["array"]["data"]))
        return np.frombuffer(pixels, dtype=value["dtype"]).reshape(value["shape"])
    return value


@pytest.fixture(scope="module")
def told(finished: Path) -> str:
    """The page of the tiny scene's run."""
    return (finished / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> data.Run:
    """The run of a letter F, of which nobody changes anything."""
    return lettered(tmp_path_factory.mktemp("letter"))


# --- a page that stands alone


def test_a_page_is_well_formed_and_says_what_it_is(told: str) -> None:
    reader = parsed(told)
    assert (reader.open, reader.wrong) == ([], [])
    tags = [tag for tag, _ in reader.tags]
    assert dict(reader.tags)["html"] == {"lang": "en"}
    assert [tags.count(tag) for tag in ("h1", "main", "header", "footer", "nav")] == [1] * 5
    assert reader.text["h1"] == "Tiny"
    assert tags.count("caption") == tags.count("table")
    assert all({"scope"} <= attributes.keys() for tag, attributes in reader.tags if tag == "th")
    assert all("alt" in attributes for tag, attributes in reader.tags if tag == "img")
    identities = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(set(identities)) == len(identities)
    targets = [str(attributes["href"]) for tag, attributes in reader.tags if tag == "a"]
    assert {target[1:] for target in targets if target.startswith("#")} <= set(identities)


def test_every_figure_is_told_in_words(told: str) -> None:
    plots = [attributes for _, attributes in parsed(told).tags if str(attributes.get("id", "")).startswith("plot-")]
    assert {f"plot-{name}" for name in ("truth", "estimate", "error", "deviation", "packed", "place", "errors")} <= {
        attributes["id"] for attributes in plots
    }
    assert set(embedded(told)["roots"].values()) == {attributes["id"] for attributes in plots}
    for attributes in plots:
        assert attributes["role"] == "img"
        assert len(str(attributes["aria-label"])) > 20


def test_a_page_asks_for_nothing_else(told: str) -> None:
    for tag, attributes in parsed(told).tags:
        for name in ("src", "href", "data", "action", "poster", "srcset"):
            if attributes.get(name):
                assert str(attributes[name]).startswith(("#", "data:")), f"{tag} {name}"
    own = re.sub(r"<script>.*?</script>", "", told, flags=re.DOTALL)  # Bokeh's own program names its sites
    assert not re.findall(r"https?://|@import|url\(", own)
    assert len(told.encode()) < 3_000_000


def test_a_title_is_text_whatever_stands_in_it(finished: Path, tmp_path: Path) -> None:
    title = '</script><script>alert("x")</script> & <b>'
    run = data.read_run(finished)
    run = replace(run, stack=replace(run.stack, scene=run.stack.scene.model_copy(update={"title": title})))
    text = page(run, None, None, "0")
    assert "<script>alert" not in text
    assert parsed(text).text["h1"] == title
    folder = tmp_path / "batch" / "a"
    shutil.copytree(finished, folder)
    described = {**run.description.plain(), "title": title}
    (folder / "run.json").write_text(json.dumps(described), encoding="utf-8")
    shutil.copytree(folder, tmp_path / "batch" / "b")
    assert batch_index.cached_index(tmp_path / "batch", {folder: "", folder.parent / "<i>": "because of <script>alert"})
    listed = (tmp_path / "batch" / "index.html").read_text(encoding="utf-8")
    assert "<script>alert" not in listed
    assert "<i>" not in listed
    assert embedded(listed)


# --- what it holds is what the files hold


def test_the_maps_are_those_of_the_estimate(told: str, finished: Path) -> None:
    channels, maps = exr.read(finished / "estimate.exr")[0].channels, columns(told, "maps")
    np.testing.assert_array_equal(maps["estimate"][0], channels["estimate"])
    np.testing.assert_array_equal(maps["truth"][0], channels["truth"])
    np.testing.assert_array_equal(maps["deviation"][0], np.sqrt(channels["variance"]))
    assert maps["error"][0].shape == channels["estimate"].shape


def test_truth_and_estimate_have_one_scale_and_all_maps_one_range(told: str) -> None:
    found = objects(embedded(told))
    by_name = {one["attributes"].get("name"): one for one in found if one["name"] == "Figure"}
    maps = [by_name[name] for name in ("truth", "estimate", "error", "deviation")]
    for axis, whole in (("x_range", (0, 12)), ("y_range", (12, 0))):
        ranges = [one["attributes"][axis] for one in maps]
        assert {one["id"] for one in ranges} == {ranges[0]["id"]}
        limits = ranges[0]["attributes"]  # what is as Bokeh would have it anyway is not there
        assert (limits.get("start", 0), limits.get("end", 1)) == whole
    ends: list[tuple[float, float]] = []
    for one in maps:
        mapper = next(part for part in objects(one) if part["name"] == "LinearColorMapper")
        ends.append((mapper["attributes"]["low"], mapper["attributes"]["high"]))
    truth = columns(told, "maps")["truth"][0]
    assert ends[0] == ends[1] == (truth.min(), truth.max())
    assert ends[2][0] == -ends[2][1]
    assert ends[3][0] == 0


def test_a_letter_is_upright_in_the_maps_and_upside_down_on_the_sensor(drawn: data.Run, tmp_path: Path) -> None:
    run = drawn
    text = page(run, None, None, "0")
    np.testing.assert_array_equal(columns(text, "maps")["truth"][0] > 128, F)
    assert np.corrcoef(columns(text, "maps")["estimate"][0].ravel(), F.ravel())[0, 1] > 0.99
    # What hardware records is what `import` cuts: the mosaic of the page gives the stack back.
    mosaic, origin, step = mosaic_of(columns(text, "sensor"), sensor.mosaic(run.stack))
    np.save(tmp_path / "mosaic.npy", mosaic)
    bench, setup = AcquisitionSettings(origin=origin), Setup(run.stack.scene, run.stack.camera)
    back, _ = stack_import.import_stack(setup, [tmp_path / "mosaic.npy"], bench)
    np.testing.assert_allclose(back.values, run.stack.values, atol=0.51 * step + 1e-4)
    turned, _ = stack_import.import_stack(setup, [tmp_path / "mosaic.npy"], replace(bench, upright=True))
    assert np.abs(turned.values - run.stack.values).max() > 50, "the comparison can tell"


def mosaic_of(found: dict[str, Any], shown: sensor.Mosaic) -> tuple[NDArray[np.float64], tuple[int, int], float]:
    """The picture that a page shows of the sensor, where its first patch lies in it, and the step of its values."""
    low, high = shown.ends
    step = (high - low) / sensor.LEVELS
    # Patches that lie between whole pixels are cut at the nearest ones from where the first one is.
    first = found["place_row"][0], found["place_column"][0]
    places = [
        (int(np.floor(row - first[0] + 0.5 + 1e-6)), int(np.floor(column - first[1] + 0.5 + 1e-6)))
        for row, column in zip(found["place_row"], found["place_column"], strict=True)
    ]
    top, left = min(row for row, _ in places), min(column for _, column in places)
    size = max(row for row, _ in places) - top + 40, max(column for _, column in places) - left + 40
    mosaic = np.zeros(size)
    for codes, (row, column) in zip(found["image"], places, strict=True):
        rows, across = codes.shape
        mosaic[row - top : row - top + rows, column - left : column - left + across] = low + step * codes
    return mosaic, (-top, -left), step


def test_dead_pixels_are_marked_and_counted(tmp_path: Path) -> None:
    run = lettered(tmp_path, dead=5)
    text = page(run, None, None, "0")
    codes = np.concatenate([image.ravel() for image in columns(text, "sensor")["image"]])
    assert np.sum(codes == sensor.MISSING) == 5
    assert "5 sensor pixels are dead" in text
    assert "5 dead and 0 saturated sensor pixels are left out" in text


def test_without_the_truth_a_page_promises_no_comparison(tmp_path: Path) -> None:
    run = lettered(tmp_path, truth=False)
    text = page(run, None, None, "0")
    assert set(columns(text, "maps")) == {"estimate", "deviation"}
    assert "The truth is not known" in text
    assert 'id="plot-errors"' not in text
    assert 'id="plot-truth"' not in text


def test_a_sensor_shows_what_it_recorded(drawn: data.Run) -> None:
    run = drawn
    digital = np.arange(run.stack.values.size, dtype=np.float64)
    some = np.ones_like(digital)
    recording = Recording(SensorTable.model_validate(SENSOR), digital, some, some, some)
    shown = sensor.mosaic(replace(run.stack, recording=recording))
    assert shown.unit == "digital number (DN)"
    assert shown.patches[0].image[0, 0] == shown.patches[0].image.size - 1, "its last pixel lies at the top left"


def test_too_many_sub_imagers_are_shown_from_the_middle() -> None:
    described = scene((60, 60), (("1/2", [50, 50], [2, 2]),))
    stack, _ = seen(described, np.zeros((60, 60)))
    shown = sensor.mosaic(stack)
    assert (shown.count, len(shown.patches)) == (2500, 44 * 44)
    assert min(patch.k for patch in shown.patches) == 3
    assert max(patch.k for patch in shown.patches) == 46


@pytest.mark.parametrize("shape", [(1024, 1024), (300, 900)])
def test_a_large_frame_is_shown_by_means_and_fits(shape: tuple[int, int], drawn: data.Run) -> None:
    run = synthetic(drawn, shape)
    text = page(run, None, None, "0")
    assert len(text.encode()) < 3_000_000
    maps = columns(text, "maps")
    block = data.maps(run).block
    assert maps["estimate"][0].size <= data.MOST_PIXELS
    assert f"means over blocks of {block} &times; {block} pixels" in text
    expected = run.estimate[:block, :block].mean(dtype=np.float64)
    assert maps["estimate"][0][0, 0] == pytest.approx(expected, rel=1e-6)


@given(
    arrays.arrays(np.float32, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(0, 255, width=32)),
    st.integers(1, 5),
)
def test_means_over_blocks_keep_the_mean(image: NDArray[np.float32], block: int) -> None:
    made = data.reduced(image, block)
    weights = data.reduced(np.ones_like(image), block)
    assert made.shape == tuple(-(-size // block) for size in image.shape)
    np.testing.assert_array_equal(weights, 1)
    rows = [min(block, image.shape[0] - start) for start in range(0, image.shape[0], block)]
    across = [min(block, image.shape[1] - start) for start in range(0, image.shape[1], block)]
    total = float((made * np.outer(rows, across)).sum(dtype=np.float64))
    assert total == pytest.approx(float(image.sum(dtype=np.float64)), rel=1e-5, abs=1e-3)


def test_means_over_blocks_leave_out_what_is_missing() -> None:
    image = np.array([[1, np.nan, np.nan], [3, np.nan, np.nan]])
    np.testing.assert_array_equal(data.reduced(image, 2), [[2, np.nan]])


def test_a_study_and_the_error_against_distance_have_tables(drawn: data.Run) -> None:
    case = StudyCase(model="ideal", mse=3.0, predicted=1.0, expected=1.0, low=0.5, high=2.0, seconds=1.0)
    far = DepthBin(nearest=900.0, farthest=950.0, pixels=7, rms_error=4.0, expected_deviation=0.5, rms_disparity=0.1,
                   rms_disparity_by_type={})  # fmt: skip
    report = drawn.description.with_changes(study=(case,), depth=(far,))
    text = page(replace(drawn, description=report), None, None, "0")
    assert "OUTSIDE 0.5 to 2" in text
    assert "error 4 rms in 7 pixels" in text
    reader = parsed(text)
    assert (reader.open, reader.wrong) == ([], [])


def test_a_page_tells_what_was_spent_and_what_more_would_bring(drawn: data.Run) -> None:
    assert "What more samples would bring" not in page(drawn, None, None, "0")
    spent: dict[str, Any] = {
        "seconds": 9.0,
        "stages": {"render": 1.25, "calibrate": 2.5, "reconstruct": 0.25},
        "noise_alone": 0.125,
        "more": [{"times": 2, "seconds": 7.75, "predicted_mse": 0.1875}],
    }

    def with_spent(spent: dict[str, Any]) -> RunReport:
        return drawn.description.with_changes(spent=TimeReport.model_validate(spent))

    rows = [("as here", "4", None), ("2 times as many", "7.75", "0.1875"), ("without end", "", "0.125")]
    text = page(replace(drawn, description=with_spent(spent)), None, None, "0")
    told = f"{drawn.description.error.predicted_mse:.4g}"
    for name, seconds, error in rows:
        time = f"{seconds}\N{NO-BREAK SPACE}s" if seconds else ""
        assert f'<th scope="row">{name}</th><td>{time}</td><td>{error or told}</td>' in text
    assert "The run was given" not in text
    within = {"within": 30.0, "chosen": {"render.samples": 700, "calibration.samples": "auto"}}
    text = page(replace(drawn, description=with_spent(spent | within)), None, None, "0")
    assert "given 30\N{NO-BREAK SPACE}s and took 9\N{NO-BREAK SPACE}s" in text
    assert "it chose render.samples = 700, calibration.samples = auto." in text


def test_commands_in_the_verdict_are_marked_and_the_rest_is_text(
    drawn: data.Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ommatid.page.words.verdict", lambda _: "a < b; `ommatid design` & more")
    assert "a &lt; b; <code>ommatid design</code> &amp; more</p>" in page(drawn, None, None, "0")


# --- errors, responses, effort


def independent(seed: int, variance: NDArray[np.float64], run: data.Run) -> data.Run:
    """A run whose errors are Gaussian, independent, and as large as predicted."""
    error = np.random.default_rng(seed).normal(0, np.sqrt(variance))
    zero = np.zeros_like(variance, dtype=np.float32)
    return replace(run, truth=zero, estimate=error.astype(np.float32), variance=variance.astype(np.float32))


def test_errors_that_are_as_predicted_lie_in_the_band_as_often_as_it_says(drawn: data.Run) -> None:
    run, variance = drawn, np.geomspace(0.5, 8, 900).reshape(30, 30)
    found = [group for seed in range(100) for group in error_groups.groups(independent(seed, variance, run))]
    assert sum(group.pixels for group in found) == 100 * 900
    inside = sum(group.low <= group.measured <= group.high for group in found)
    assert stats.binomtest(inside, len(found), error_groups.SURE).pvalue > 0.001
    larger = independent(0, 4 * variance, run)
    larger = replace(larger, variance=variance.astype(np.float32))
    assert not any(group.low <= group.measured <= group.high for group in error_groups.groups(larger))


def test_pixels_of_one_deviation_are_one_group(drawn: data.Run) -> None:
    run = independent(1, np.full((40, 40), 2.0), drawn)
    [group] = error_groups.groups(run)
    assert (group.pixels, group.predicted) == (1600, pytest.approx(2**0.5))


def test_responses_are_columns_of_h(finished: Path) -> None:
    run = data.read_run(finished)
    camera, model = run.stack.camera, run.model
    [found] = point_response.responses(model, lambda sub: matrix_as_designed(camera, sub))
    sub = camera.sub_imagers[4]
    assert (found.lens, found.k, found.l) == ("I", sub.k, sub.l)
    rows, column = camera.slices()[4], found.source[0] * camera.columns + found.source[1]
    cut = np.s_[
        found.corner[0] : found.corner[0] + found.measured.shape[0],
        found.corner[1] : found.corner[1] + found.measured.shape[1],
    ]
    measured = model.matrix.toarray()[rows, column].reshape(3, 3)
    ideal = ideal_matrix(camera).toarray()[rows, column].reshape(3, 3)
    assert measured.any()
    np.testing.assert_array_equal(found.measured, measured[cut])
    assert found.ideal is not None
    assert found.difference is not None
    np.testing.assert_allclose(found.ideal, ideal[cut], rtol=1e-14)
    known = np.isfinite(found.difference) & (found.difference != 0)
    assert np.abs(found.difference[known]).max() < stats.t.isf(familywise(known.sum()) / 2, 15)


@pytest.mark.parametrize("glass", [{}, {"aperture": "0.4 mm", "focus": "600 mm"}])
def test_h_of_one_sub_imager_is_its_part_of_the_whole(glass: dict[str, Any]) -> None:
    tables = scene((14, 14), (("1/3", [2, 2], [3, 3]), ("1/2", [2, 3], [4, 4]))).plain()
    tables["camera"]["lens"][1] |= glass
    camera = derive(parse(tables, Path("test.toml")))
    whole = ideal_matrix(camera)
    for sub, rows in zip(camera.sub_imagers, camera.slices(), strict=True):
        one = matrix_as_designed(camera, sub)
        np.testing.assert_allclose(one.toarray(), whole[rows].toarray(), rtol=1e-12, atol=1e-15)


def test_the_ideal_h_has_responses_without_a_comparison(drawn: data.Run) -> None:
    run = drawn
    text = page(run, lambda sub: matrix_as_designed(run.stack.camera, sub), None, "0")
    assert "H is the ideal one here" in text
    assert "Measured response" not in text
    assert 'id="plot-response-A-measured"' in text
    assert 'id="plot-response-A-ideal"' not in text
    stored = point_response.responses(run.model, None)
    boxes = point_response.responses(replace(run.model, stored=None), None)
    for one, other in zip(stored, boxes, strict=True):
        np.testing.assert_allclose(one.measured, other.measured, rtol=1e-14)


def test_a_response_without_a_closed_form_stands_alone(finished: Path) -> None:
    def none(sub: Any) -> Any:
        raise InputError(f"{sub.name}: has no closed form")

    run = data.read_run(finished)
    assert "has no closed form here" in page(run, none, None, "0")


def bench(camera: dict[str, Any]) -> dict[str, Any]:
    def cell(stage: str, seconds: float, mse: float | None, samples: int) -> dict[str, Any]:
        of = {"low": seconds, "median": seconds, "high": seconds}
        brought = None if mse is None else {"low": mse, "median": mse, "high": mse}
        return {"stage": stage, "way": "multijitter", "variant": None, "samples": samples, "setting": "",
                "repeats": 1, "error": of, "seconds": of, "memory": None, "mse": brought}  # fmt: skip

    cells = [cell("render", 0.1 * n, 1 / n, n) for n in (1, 2, 4)]
    cells += [cell("reconstruct", 0.01, 0.5, 0), cell("calibrate", 1.0, None, 16)]
    return {"camera": camera, "cells": cells, "curves": [], "recommended": {"why": "Four samples reach the floor."}}


def test_a_bench_of_the_same_camera_is_drawn_and_of_another_is_not(drawn: data.Run, tmp_path: Path) -> None:
    run = replace(drawn, folder=tmp_path / "run")
    (tmp_path / "run").mkdir()
    camera = run.stack.camera.describe()
    assert "There is no bench" in page(run, None, time_curves.bench_of(tmp_path / "run", camera), "0")
    other = {**bench(camera), "camera": {**camera, "target.distance": 7.0}}
    (tmp_path / "bench.json").write_text(json.dumps(other), encoding="utf-8")
    assert time_curves.bench_of(tmp_path / "run", camera) is None
    (tmp_path / "bench.json").write_text(json.dumps(bench(camera)), encoding="utf-8")
    text = page(run, None, time_curves.bench_of(tmp_path / "run", camera), "0")
    assert 'id="plot-effort"' in text
    assert "Four samples reach the floor." in text
    curves = time_curves.time_curves(run, bench(camera))
    assert curves is not None
    assert {point.stage for point in curves.run} == {"render", "calibrate", "reconstruct"}
    assert len(curves.points) == 4, "what brings no known error is not drawn"
    for damaged in ("[1]", "{", '{"camera": 3}', json.dumps({"camera": camera, "cells": [{"mse": 3}]})):
        (tmp_path / "bench.json").write_text(damaged, encoding="utf-8")
        assert time_curves.time_curves(run, time_curves.bench_of(tmp_path / "run", camera)) is None


# --- words


def described(**error: Any) -> RunReport:
    """A report with this error and no more than the words speak of."""
    budget = {"null_space": 0.0, "noise": 1.0, "quantisation": 0.0, "rendering": 3.0, "calibration": 0.0}
    diagnostics: dict[str, Any] = {"pixels_used": 9, "pixels_dead": 0, "pixels_saturated": 0, "resolution": 1.0}
    return RunReport.model_construct(
        error=ErrorReport.model_validate({"predicted_mse": 4.0, "budget": budget, **error}),
        diagnostics=DiagnosticsReport.model_construct(**diagnostics),
    )


GIVEN = {"mse": 4.0, "low": 2.25, "high": 6.25}


@pytest.mark.parametrize(
    ("error", "agreement", "said"),
    [
        ({"mse": 4.0, "expected_given_truth": GIVEN}, "agrees", "off by 2 of 255 (rms), as theory expects"),
        ({"mse": 9.0, "expected_given_truth": GIVEN}, "worse", "off by 3 of 255 (rms), more than theory allows"),
        ({"mse": 1.0, "expected_given_truth": GIVEN}, "better", "off by 1 of 255 (rms), less than theory expects"),
        ({"mse": 9.0}, "unknown", "where theory expects 2 on average"),
        ({}, "unknown", "The truth is not known; theory expects pixels to be off by 2 of 255"),
    ],
)
def test_the_verdict_compares_what_was_measured_with_what_was_expected(
    error: dict[str, Any], agreement: str, said: str
) -> None:
    told = words.verdict(described(**error))
    assert words.agreement(described(**error).error) == agreement
    assert said in told
    assert "as sharp as the target's grid" in told
    assert "75 % of the expected squared error: more render.samples would help" in told
    assert told.endswith(".")


def test_the_verdict_of_no_measurement_is_that_there_is_no_image() -> None:
    report = described()
    nothing = report.diagnostics.model_copy(update={"pixels_used": 0, "resolution": None})
    assert "not an image" in words.verdict(report.with_changes(diagnostics=nothing))
    blurred = report.diagnostics.model_copy(update={"resolution": 2.5})
    assert "resolved to 2.5 pixels" in words.verdict(report.with_changes(diagnostics=blurred))


def test_what_must_not_be_trusted_is_said_first(finished: Path, told: str) -> None:
    run = json.loads((finished / "run.json").read_text(encoding="utf-8"))
    assert run["model"]["spurious_information"] > 0.05, "one lens type leaves pixels open"
    assert "Do not trust the predicted error" in told
    assert told.index("Do not trust the predicted error") < told.index("<main")


# --- what is kept


def test_a_page_is_kept_until_what_it_shows_changes(finished: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(finished, tmp_path / "run")
    assert not cached_page(folder, None)
    told = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps({**told, "title": "Another"}), encoding="utf-8")
    assert cached_page(folder, None)
    assert not cached_page(folder, None)
    camera = data.read_run(folder).stack.camera.describe()
    (folder / "bench.json").write_text(json.dumps(bench(camera)), encoding="utf-8")
    assert cached_page(folder, None)
    assert 'id="plot-effort"' in (folder / "report.html").read_text(encoding="utf-8")


def test_what_is_no_run_is_refused(finished: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(finished, tmp_path / "run")
    for content in ("{", "[]", "{}"):
        (folder / "run.json").write_text(content, encoding="utf-8")
        with pytest.raises(InputError, match=r"run\.json: expected the results of a run"):
            cached_page(folder, None)


# --- batches


def test_an_index_lists_what_was_done_and_why_not(finished: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "older"):
        shutil.copytree(finished, tmp_path / name)
    folders = {tmp_path / "b": "", tmp_path / "gone": "gone.toml: no such scene file", tmp_path / "a": ""}
    assert batch_index.cached_index(tmp_path, folders)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    reader = parsed(text)
    assert (reader.open, reader.wrong) == ([], [])
    links = [attributes["href"] for tag, attributes in reader.tags if tag == "a" and "tabindex" not in attributes]
    assert links[1:] == ["b/report.html", "a/report.html", "older/report.html"]
    assert "failed: gone.toml: no such scene file" in text
    assert "3 of 4 scenes are done" in text
    error = json.loads((finished / "run.json").read_text(encoding="utf-8"))["error"]
    assert f"<td>{error['mse']:.4g}</td><td>{error['predicted_mse']:.4g}</td>" in text
    assert columns(text, "scenes")["mse"] == [error["mse"]] * 3
    assert not batch_index.cached_index(tmp_path, folders)
    assert not batch_index.cached_index(tmp_path / "nothing", folders)


def test_an_index_shows_a_sweep_where_there_is_one(finished: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(finished, tmp_path / name)
    listed = [
        {"folder": "a", "values": {"noise.variance": "1e-4", "lens": "1/2"}, "mse": 2.0, "predicted_mse": 2.5},
        {"folder": "b", "values": {"noise.variance": "1e-2", "lens": "1/2"}, "mse": 3.0, "predicted_mse": 3.5},
    ]
    listed = [{"scene": "a.toml", **row} for row in listed]
    (tmp_path / "sweep.json").write_text(json.dumps(listed), encoding="utf-8")
    assert batch_index.cached_index(tmp_path, {tmp_path / "a": "", tmp_path / "b": ""})
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "noise.variance" in parsed(text).text["th"]
    assert 'id="plot-sweep"' in text
    failed = {"scene": "a.toml", "values": {"noise.variance": "-1", "lens": "1/2"}, "failed": "below 0"}
    listed.append({"folder": "c", **failed})
    (tmp_path / "sweep.json").write_text(json.dumps(listed), encoding="utf-8")
    assert batch_index.cached_index(tmp_path, {tmp_path / "a": "", tmp_path / "b": "", tmp_path / "c": "below 0"})
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert 'id="plot-sweep"' in text
    assert "c/report.html" not in text
    for damaged in ("{}", "[{}]", "nothing"):
        (tmp_path / "sweep.json").write_text(damaged, encoding="utf-8")
        assert batch_index.sweep_of(tmp_path / "sweep.json") is None


def test_a_batch_has_its_index_even_where_scenes_fail(kept: Path, here: Path, ommatid: Command) -> None:
    assert kept.is_dir()
    assert ommatid("run", "tiny.toml", "missing.toml", "-o", "out").code == 2
    text = (here / "out" / "index.html").read_text(encoding="utf-8")
    assert 'href="tiny/report.html"' in text
    assert "failed: missing.toml: no such scene file" in text


def test_nothing_heavy_is_loaded_for_a_page_that_is_kept(
    kept: Path, ommatid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert kept.is_dir()
    assert ommatid("run", "tiny.toml", "-o", "out").code == 0
    monkeypatch.setitem(sys.modules, "ommatid.page.document", None)  # which imports Bokeh
    assert ommatid("run", "tiny.toml", "-o", "out").code == 0
