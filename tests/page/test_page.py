"""The pages of a run and of a batch as text: well-formed, self-contained, and with the content of the files.

Their behaviour in a browser is tested in test_page_in_browser.py.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
import shutil
from collections.abc import Mapping
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

from ommatid.analysis.averaging_kernel import ErrorWindow
from ommatid.bench.table import BenchTable, bench_tables, write
from ommatid.page import batch_index, charts, data, sections
from ommatid.page.cached import cached_page
from ommatid.page.sections import page
from ommatid.reconstruct.measured_error import best_single_sub_image
from ommatid.reconstruct.output import facts, run_json
from ommatid.reconstruct.output.run_json import (
    RunReport,
    StageReport,
    TimeReport,
    VerdictReport,
)
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats import exr
from ommatid.scenes.scene import parse

from ..bench.tables import bench_table, cell
from ..runs import report_of
from .runs import F, letter_run, synthetic

VOID = {"meta", "link", "img", "input", "br"}


class Reader(HTMLParser):
    """Tags in order, text by the tag around it, open tags, and closing tags that do not match."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.mismatched: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.mismatched.append(tag)

    def handle_data(self, data: str) -> None:
        if self.open:
            self.text[self.open[-1]] = self.text.get(self.open[-1], "") + data


def parsed(text: str) -> Reader:
    reader = Reader()
    reader.feed(text)
    reader.close()
    return reader


def embedded(text: str) -> Any:
    """The JSON of the maps in a page."""
    match = re.search(r'<script type="application/json" id="figures">(.*?)</script>', text, flags=re.DOTALL)
    assert match
    return json.loads(match[1])


def group_of(text: str, name: str) -> dict[str, Any]:
    """A group of maps of a page."""
    [group] = [group for group in embedded(text)["groups"] if group["name"] == name]
    return group


def maps_of(text: str, name: str = "maps") -> dict[str, NDArray[Any]]:
    """The stored arrays of a group of maps by name."""
    return {shown["name"]: decoded(shown["values"]) for shown in group_of(text, name)["maps"] if "values" in shown}


def decoded(content: Mapping[str, Any]) -> NDArray[Any]:
    """The array that a page holds as text."""
    values = gzip.decompress(base64.b64decode(content["data"]))
    return np.frombuffer(values, dtype=np.dtype(content["dtype"]).newbyteorder("<")).reshape(content["shape"])


@pytest.fixture(scope="module")
def html(finished: Path) -> str:
    """The page of the tiny scene's run."""
    return (finished / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> data.Run:
    """The run of a letter F; tests must not change its folder."""
    return letter_run(tmp_path_factory.mktemp("letter"))


def html_of(run: data.Run, **changes: Any) -> str:
    """The page of a run with changes to its report, without bench."""
    return page(replace(run, report=run.report.with_changes(**changes)), None, "0")


# --- self-contained and well-formed


def test_a_page_is_well_formed_and_says_what_it_is(html: str) -> None:
    reader = parsed(html)
    assert (reader.open, reader.mismatched) == ([], [])
    tags = [tag for tag, _ in reader.tags]
    assert dict(reader.tags)["html"] == {"lang": "en"}
    assert [tags.count(tag) for tag in ("h1", "main", "header", "footer")] == [1] * 4
    assert reader.text["h1"] == "Tiny"
    assert tags.count("caption") == tags.count("table")
    assert all({"scope"} <= attributes.keys() for tag, attributes in reader.tags if tag == "th")
    assert all("alt" in attributes for tag, attributes in reader.tags if tag == "img")
    identities = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(set(identities)) == len(identities)
    targets = [str(attributes["href"]) for tag, attributes in reader.tags if tag == "a"]
    assert {target[1:] for target in targets if target.startswith("#")} <= set(identities)


def test_every_figure_has_a_description_in_words(html: str) -> None:
    drawn = [attributes for tag, attributes in parsed(html).tags if tag in ("canvas", "svg") and "role" in attributes]
    names = {"truth", "single", "estimate", "error", "deviation", "compare"}
    assert names <= {attributes.get("data-map") for attributes in drawn}
    charts = {"chart-transfer", "chart-errors"}
    assert charts <= {attributes.get("id") for attributes in drawn}
    for attributes in drawn:
        assert attributes["role"] == "img"
        if "camera" not in str(attributes):
            assert len(str(attributes.get("aria-label", 20 * " "))) > 20 or "data-map" not in attributes


def test_a_page_requests_no_other_resource(html: str) -> None:
    for tag, attributes in parsed(html).tags:
        for name in ("src", "href", "data", "action", "poster", "srcset"):
            if attributes.get(name):
                links = ("file:",) if tag == "a" else ()
                assert str(attributes[name]).startswith(("#", "data:", *links)), f"{tag} {name}"
    own = html.replace("http://www.w3.org/", "")  # names of SVG, which nothing is loaded from
    assert not re.findall(r"https?://|@import|url\((?!#)", own)
    assert len(html.encode()) < 1_000_000


def test_markup_in_a_title_is_escaped(finished: Path, tmp_path: Path) -> None:
    title = '</script><script>alert("x")</script> & <b>'
    run = data.read_run(finished)
    run = replace(run, stack=replace(run.stack, scene=run.stack.scene.model_copy(update={"title": title})))
    text = page(run, None, "0")
    assert "<script>alert" not in text
    assert parsed(text).text["h1"] == title
    folder = tmp_path / "batch" / "a"
    shutil.copytree(finished, folder)
    described = {**run.report.plain(), "title": title}
    (folder / "run.json").write_text(json.dumps(described), encoding="utf-8")
    shutil.copytree(folder, tmp_path / "batch" / "b")
    assert batch_index.cached_index(tmp_path / "batch", {folder: "", folder.parent / "<i>": "because of <script>alert"})
    listed = (tmp_path / "batch" / "index.html").read_text(encoding="utf-8")
    assert "<script>alert" not in listed
    assert "&lt;i&gt;" in listed


# --- content is that of the files


def test_the_maps_are_those_of_estimate_exr(html: str, finished: Path) -> None:
    channels, maps = exr.read(finished / "estimate.exr")[0].channels, maps_of(html)
    np.testing.assert_array_equal(maps["estimate"], channels["estimate"])
    np.testing.assert_array_equal(maps["truth"], channels["truth"])
    np.testing.assert_array_equal(maps["deviation"], np.sqrt(channels["variance"]))
    run = data.read_run(finished)
    best = best_single_sub_image(run.stack, channels["truth"].astype(np.float64))
    assert best is not None
    np.testing.assert_allclose(maps["single"], best.image, rtol=2**-23)
    assert f"Best single sub-image ({best.name}, bicubic)" in html
    assert run.report.error.gain is not None
    assert f"{run.report.error.gain:+.1f} dB" in html


def test_pictures_share_a_colour_scale(html: str) -> None:
    shown = {item["name"]: item for item in group_of(html, "maps")["maps"]}
    scales = {name: (item["scale"]["low"], item["scale"]["high"]) for name, item in shown.items()}
    truth = maps_of(html)["truth"]
    assert scales["truth"] == scales["single"] == scales["estimate"] == (truth.min(), truth.max())
    assert scales["error"][0] == -scales["error"][1]
    assert scales["deviation"][0] == 0
    assert shown["error"]["difference"] == ["estimate", "truth"]


def test_a_letter_is_upright_in_the_maps(run: data.Run) -> None:
    text = page(run, None, "0")
    for name in ("truth", "estimate"):
        np.testing.assert_array_equal(maps_of(text)[name] > 128, F)


def test_dead_pixels_are_counted(tmp_path: Path) -> None:
    assert "Sensor pixels left out: 5 dead" in page(letter_run(tmp_path, dead=5), None, "0")


def test_without_the_truth_a_page_has_no_comparison(tmp_path: Path) -> None:
    text = page(letter_run(tmp_path, truth=False), None, "0")
    assert set(maps_of(text)) == {"single", "estimate", "deviation"}
    assert "The truth is not known" in text
    assert "Best single sub-image" not in text
    for absent in ("chart-errors", 'data-map="truth"', 'data-map="error"', " dB"):
        assert absent not in text
    assert "chart-transfer" in text


@pytest.mark.parametrize("shape", [(200, 600), pytest.param((512, 512), marks=pytest.mark.slow)])
def test_a_large_frame_is_reduced_to_means_and_fits(shape: tuple[int, int], run: data.Run) -> None:
    frame = synthetic(run, shape)
    text = page(frame, None, "0")
    assert len(text.encode()) < 3_000_000
    estimate = maps_of(text)["estimate"]
    block = group_of(text, "maps")["block"]
    assert estimate.size <= data.MOST_PIXELS
    assert f"means over blocks of {block} &times; {block}, in which errors partly cancel" in text
    expected = frame.estimate[:block, :block].mean(dtype=np.float64)
    assert estimate[0, 0] == pytest.approx(expected, rel=2**-23), "the mean, rounded to float32"


@given(
    arrays.arrays(np.float32, st.tuples(st.integers(1, 12), st.integers(1, 12)), elements=st.floats(0, 255, width=32)),
    st.integers(1, 5),
)
def test_means_over_blocks_keep_the_sum(image: NDArray[np.float32], block: int) -> None:
    means = data.reduced(image, block)
    assert means.shape == tuple(-(-size // block) for size in image.shape)
    np.testing.assert_array_equal(data.reduced(np.ones_like(image), block), 1)
    heights, widths = ([min(block, size - start) for start in range(0, size, block)] for size in image.shape)
    total = float((means * np.outer(heights, widths)).sum(dtype=np.float64))
    # Every mean is rounded to float32; the smallest of its numbers is 1.4e-45.
    assert total == pytest.approx(float(image.sum(dtype=np.float64)), rel=2**-23, abs=1e-40)


def test_a_page_shows_the_run_time_and_the_effect_of_more_samples(run: data.Run) -> None:
    assert "times the samples" not in html_of(run)
    stages: dict[str, Any] = {
        "render": StageReport(seconds=1.25, sampler="independent"),
        "calibrate": StageReport(seconds=2.5, method="points"),
        "reconstruct": StageReport(seconds=0.25),
    }
    error = run.report.error.model_copy(update={"predicted_mse": 0.25, "budget": {"noise": 0.125, "rendering": 0.125}})
    text = html_of(run, stages=stages, error=error)
    for name, value in (
        ("calibrate", "2.50 s (points)"),
        ("MSE with 2 times the samples", "at most 0.1875 (in 7.75 s)"),
        ("MSE with noise alone", "0.125"),
    ):
        assert f'<th scope="row">{name}</th><td>{value}</td>' in text
    assert "of the time limit" not in text
    chosen: Any = {"render.samples": 700, "calibration.samples": "auto"}
    text = html_of(run, spent=TimeReport(seconds=9.0, within=30.0, chosen=chosen))
    assert "9.0 s of 30 s, all trials together (render.samples 700, calibration.samples auto)" in text


# --- error groups, error against time


def with_errors(seed: int, deviation: NDArray[np.float64], predicted: NDArray[np.float64], run: data.Run) -> data.Run:
    """A run with independent Gaussian errors of a standard deviation, and a predicted one."""
    error = np.random.default_rng(seed).normal(0, deviation)
    zero, variance = np.zeros(error.shape, dtype=np.float32), np.square(predicted).astype(np.float32)
    return replace(run, truth=zero, estimate=error.astype(np.float32), variance=variance)


@pytest.mark.slow
def test_errors_that_are_as_predicted_are_inside_the_interval_as_often_as_it_says(run: data.Run) -> None:
    deviation = np.sqrt(np.geomspace(0.5, 8, 900)).reshape(30, 30)
    runs = [with_errors(seed, deviation, deviation, run) for seed in range(100)]
    groups = [group for drawn in runs for group in charts.error_groups(drawn)]
    assert sum(group.pixels for group in groups) == 100 * 900
    inside = sum(group.is_inside for group in groups)
    assert stats.binomtest(inside, len(groups), charts.CONFIDENCE).pvalue > 0.001
    larger = with_errors(0, 2 * deviation, deviation, run)
    assert not any(group.is_inside for group in charts.error_groups(larger))


@pytest.mark.slow
def test_intervals_allow_for_correlated_errors(run: data.Run) -> None:
    """Groups of correlated errors vary more than independent ones: their intervals are wider, and contain them."""
    rows, columns = np.divmod(np.arange(400), 20)
    distance = np.hypot(np.subtract.outer(rows, rows), np.subtract.outer(columns, columns))
    covariance = np.sqrt(np.outer(1 + rows, 1 + rows)) * np.exp(-distance / 4)
    whole, ones = slice(0, 20), np.eye(400)
    window = ErrorWindow(whole, whole, (20, 20), covariance, ones, ones, 1.0)
    root, deviation = np.linalg.cholesky(covariance), np.sqrt(covariance.diagonal())
    inside, independent, total = 0, 0, 0
    for seed in range(150):
        error = root @ np.random.default_rng(seed).normal(size=400)
        drawn = with_errors(0, np.zeros((20, 20)), deviation.reshape(20, 20), run)
        drawn = replace(drawn, estimate=error.reshape(20, 20).astype(np.float32))
        found, without = charts.error_groups(drawn, window), charts.error_groups(drawn)
        inside += sum(group.is_inside for group in found)
        independent += sum(group.is_inside for group in without)
        total += len(found)
    # Chi-squared with the same variance is the distribution of such a sum only in its first two moments.
    assert inside / total > 0.97
    assert independent / total < 0.9


def test_what_a_trusting_estimator_alone_has_is_left_out_of_others(run: data.Run) -> None:
    """Kernels, correlations and other types are computed with H as it is and independent noise."""
    plain: dict[str, Any] = run.stack.scene.plain() | {"estimator": {"misalignment": "fit"}}
    plain["camera"]["tolerance"] = {"position": "400 nm"}
    stack = replace(run.stack, scene=parse(plain, run.stack.scene.source))
    text = html_of(replace(run, stack=stack), verdict=VerdictReport(trusted=True, reasons=()))
    plots = ("Modulation transfer function", "with the 99 % interval", "nother lens type, of")
    reader = parsed(text)
    assert (reader.open, reader.mismatched) == ([], [])
    assert text.count("not computed for <code>estimator.misalignment = &#39;fit&#39;</code>") == 1
    assert [words for words in plots if words in text] == []
    assert "groups without intervals" in text
    trusting = html_of(run)
    assert all(words in trusting for words in plots[:2])
    assert "not computed for <code>estimator" not in trusting


def test_pixels_of_equal_deviation_are_one_group(run: data.Run) -> None:
    deviation = np.full((40, 40), 2**0.5)
    [group] = charts.error_groups(with_errors(1, deviation, deviation, run))
    assert (group.pixels, group.predicted) == (1600, pytest.approx(2**0.5, rel=2**-23))
    # The sum of 1600 independent squares is chi-squared with as many degrees of freedom.
    quantiles = stats.chi2.ppf([0.005, 0.995], 1600)
    assert group.interval == pytest.approx(group.predicted * np.sqrt(quantiles / 1600), rel=1e-9)
    assert group.is_inside
    [wrong] = charts.error_groups(with_errors(1, 1.2 * deviation, deviation, run))
    assert not wrong.is_inside


def bench(camera: Camera) -> BenchTable:
    """A bench table with three renderings, an estimate, and a calibration without a known error."""
    cells = [cell(samples=n, seconds=0.1 * n, mse=1 / n) for n in (1, 2, 4)]
    cells.append(cell("reconstruct", way="frame", samples=None, seconds=0.01, mse=0.5))
    cells.append(cell("calibrate", way="points, multijitter", mse=None))
    return bench_table(camera, cells, why="four samples reach the noise floor")


def test_a_bench_of_the_same_camera_is_drawn(run: data.Run) -> None:
    assert "there are no results for this camera" in html_of(run)
    table = bench(run.stack.camera)
    text = page(run, table, "0")
    assert 'id="chart-effort"' in text
    assert "Recommendation of the bench: four samples reach the noise floor." in text
    assert f"The mean squared error of this run is {run.report.error.mse:.4g}." in text


def test_a_bench_serves_the_same_camera_in_the_folder_or_its_parent(run: data.Run, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    camera, table = run.stack.camera.describe(), bench(run.stack.camera)
    assert not list(bench_tables(folder, camera))
    write(tmp_path, table)
    assert list(bench_tables(folder, camera)) == [table]
    assert not list(bench_tables(folder, {**camera, "target.distance": 7.0}))
    write(folder, table)
    assert list(bench_tables(folder, camera)) == [table, table]
    for damaged in ("[1]", "{", '{"camera": 3}', json.dumps({"camera": camera, "cells": [{"mse": 3}]})):
        (folder / "bench.json").write_text(damaged, encoding="utf-8")
        assert list(bench_tables(folder, camera)) == [table]


# --- words


def described(**error: Any) -> RunReport:
    """A report with this error and the fields that the summary depends on."""
    budget = {"null_space": 0.0, "noise": 1.0, "quantisation": 0.0, "rendering": 3.0, "calibration": 0.0}
    return report_of(error={"predicted_mse": 4.0, "budget": budget, **error})


INTERVAL = {"mse": 4.0, "low": 2.25, "high": 6.25}


@pytest.mark.parametrize(
    ("error", "agreement", "sentence"),
    [
        ({"mse": 4.0, "expected_given_truth": INTERVAL}, "agrees", "The error is as expected for this image."),
        ({"mse": 9.0, "expected_given_truth": INTERVAL}, "worse", "The error is larger than expected for this image."),
        (
            {"mse": 1.0, "expected_given_truth": INTERVAL},
            "better",
            "The error is smaller than expected for this image.",
        ),
        ({"mse": 9.0}, "unknown", ""),
        ({}, "unknown", "The truth is not known."),
    ],
)
def test_the_sentence_compares_measured_and_expected_error(
    error: dict[str, Any], agreement: str, sentence: str
) -> None:
    assert facts.agreement(described(**error).error) == agreement
    assert sections.sentence(described(**error)) == sentence


def test_without_trust_the_sentence_says_that_the_numbers_are_of_little_use() -> None:
    report = described(mse=4.0, expected_given_truth=INTERVAL)
    wrong = report.with_changes(verdict=VerdictReport(trusted=False, reasons=("H is another camera's",)))
    assert sections.reasons(wrong) == ["H is another camera's."]
    assert "resolve this first" in sections.sentence(wrong)


def test_next_steps_are_those_of_a_trusted_run(run: data.Run) -> None:
    text = html_of(run, verdict=VerdictReport(trusted=True, reasons=()))
    assert "null space of H, 97 % of the predicted MSE; neither samples nor less noise reduce it" in text, (
        "nor does another lens type"
    )
    budget = {"null_space": 0.0, "noise": run.report.error.predicted_mse}
    noisy = run.report.error.model_copy(update={"budget": budget})
    text = html_of(run, verdict=VerdictReport(trusted=True, reasons=()), error=noisy)
    assert "<strong>Half the noise variance</strong>" in text
    assert "instead of" in text
    assert "null space of H" not in text.split('id="next"')[1].split("</section>")[0]
    untrusted = html_of(run, verdict=VerdictReport(trusted=False, reasons=("H is another camera's",)))
    assert "First remove the cause named in the verdict" in untrusted
    assert "instead of" not in untrusted.split('id="next"')[1].split("</section>")[0]


# --- pages that are up to date


def written(folder: Path) -> bool:
    """Return True if the page of a finished run had to be written."""
    return cached_page(folder, run_json.read(folder))


def test_a_page_is_rewritten_only_if_its_content_changes(finished: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(finished, tmp_path / "run")
    assert not written(folder)
    document = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    (folder / "run.json").write_text(json.dumps({**document, "title": "Another"}), encoding="utf-8")
    assert written(folder)
    assert not written(folder)
    write(folder, bench(data.read_run(folder).stack.camera))
    assert written(folder)
    assert 'id="chart-effort"' in (folder / "report.html").read_text(encoding="utf-8")


# --- batches


def test_an_index_lists_results_and_failures(finished: Path, tmp_path: Path) -> None:
    for name in ("a", "b", "older"):
        shutil.copytree(finished, tmp_path / name)
    folders = {tmp_path / "b": "", tmp_path / "gone": "gone.toml: no such scene file", tmp_path / "a": ""}
    assert batch_index.cached_index(tmp_path, folders)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    reader = parsed(text)
    assert (reader.open, reader.mismatched) == ([], [])
    links = [attributes["href"] for tag, attributes in reader.tags if tag == "a" and "tabindex" not in attributes]
    assert links[1:] == ["b/report.html", "a/report.html", "older/report.html"]
    assert "failed: gone.toml: no such scene file" in text
    assert "3 of 4 scenes are finished" in text
    error = data.read_run(finished).report.error
    for value in (error.mse, error.predicted_mse):
        assert f'<td data-value="{value}">{value:.4g}</td>' in text
    area = run_area(finished)
    assert f">{data.read_run(finished).report.measurements}</td>" in text
    assert f">{area:.3g}</td>" in text
    assert "sensor area <small>mm²</small>" in text
    assert not batch_index.cached_index(tmp_path, folders)
    assert not batch_index.cached_index(tmp_path / "nothing", folders)


def run_area(folder: Path) -> float:
    """Area of the recorded sensor pixels of a run in mm^2."""
    camera = data.read_run(folder).stack.camera
    return camera.measurements * camera.pixel_pitch**2


def test_an_index_of_a_sweep_shows_its_values_errors_and_figure(finished: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        shutil.copytree(finished, tmp_path / name)
    listed: list[dict[str, Any]] = [
        {"folder": "a", "values": {"noise.variance": "1e-4", "lens": "1/2"}, "mse": 2.0, "predicted_mse": 2.5},
        {"folder": "b", "values": {"noise.variance": "1e-2", "lens": "1/2"}, "mse": 3.0, "predicted_mse": 3.5},
        {"folder": "c", "values": {"noise.variance": "-1", "lens": "1/2"}, "failed": "below 0"},
    ]
    (tmp_path / "sweep.json").write_text(json.dumps([{"scene": "a.toml", **row} for row in listed]), encoding="utf-8")
    folders = {tmp_path / "a": "", tmp_path / "b": "", tmp_path / "c": "below 0"}
    assert batch_index.cached_index(tmp_path, folders)
    text = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert "noise.variance" in parsed(text).text["th"]
    assert text.count("<td>1e-2</td><td>1/2</td>") == 1
    assert "<td>-1</td><td>1/2</td>" in text
    assert "c/report.html" not in text
    assert "sweep.png" not in text
    (tmp_path / "sweep.png").touch()
    assert batch_index.cached_index(tmp_path, folders)
    assert '<img src="sweep.png"' in (tmp_path / "index.html").read_text(encoding="utf-8")
    for damaged in ("{}", "[{}]", "nothing"):
        (tmp_path / "sweep.json").write_text(damaged, encoding="utf-8")
        assert batch_index.cached_index(tmp_path, folders)
        assert "noise.variance" not in parsed((tmp_path / "index.html").read_text(encoding="utf-8")).text["th"]
        (tmp_path / "index.html").unlink()
