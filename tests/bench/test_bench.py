"""`ommatid bench`: slopes, recommendations, its time limit and the files that it writes."""

from __future__ import annotations

import csv
import json
import warnings
from pathlib import Path
from time import perf_counter

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from ommatid.bench.bench import measure, rows
from ommatid.bench.cells import (
    CLEAR_REFS,
    SAMPLERS,
    Job,
    Repeat,
    Subject,
    cell_from_repeats,
    jobs,
    measured,
    name_of,
)
from ommatid.bench.figure import write_figures
from ommatid.bench.reference import reference, sample_plan
from ommatid.bench.slopes import Slope, curves, excess, pareto_front, recommend, slope
from ommatid.bench.table import AUTO, CSV, JSON, BenchTable, Cell, Quantiles, Stage, read, row_of, write
from ommatid.pipeline.stages import open_scene
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive

from ..conftest import Command
from ..examples import GALLERY, VARIANTS, needs, scene
from ..kept_figures import KeptFigures
from .tables import bench_table, cell, exactly

FIGURES = ("render.png", "calibrate.png", "reconstruct.png")


def test_the_slope_of_a_power_law_is_found_with_its_standard_error() -> None:
    """Medians of 5 with a scatter of 5 % each: s^2 pi / (2 n + pi - 2) over the spread of ln(samples).

    Variances are shrunk by their logarithms, whose mean for 4 degrees of freedom is digamma(2) - ln 2 too low.
    """
    samples = 4.0 ** np.arange(2, 8)
    cells = [cell(samples=int(count), error=exactly(7.0 * count**-0.75), scatter=0.05) for count in samples]
    fit = slope(cells)
    assert fit is not None
    assert fit.value == pytest.approx(-0.75)
    unbiased = 2 * np.exp(-special.digamma(2))
    spread = np.log(samples).var() * samples.size
    assert fit.deviation == pytest.approx(0.05 * (unbiased * np.pi / (8 + np.pi) / spread) ** 0.5)


def test_too_few_points_have_no_slope() -> None:
    cells = [cell(samples=count, error=exactly(1 / count)) for count in (4, 16)]
    assert slope(cells) is None
    assert slope([*cells, cell(samples=64, scatter=None)]) is None
    assert Slope(-0.738, 0.002).agrees(-0.75, 0.01)
    assert not Slope(-0.738, 0.002).agrees(-0.75)


def test_the_cheapest_settings_that_reach_the_floor_are_recommended() -> None:
    """Excesses add up over the stages; rendering and calibration share the sampler of a scene."""

    def measured(stage: Stage, way: str, seconds: float, mse: float, samples: int) -> Cell:
        return cell(stage, way=way, seconds=exactly(seconds), mse=exactly(mse), samples=samples)

    estimate = cell("reconstruct", way="frame", error=exactly(0.1), seconds=exactly(0.1), samples=None)
    cells = [
        measured("render", "multijitter", 1.0, 2.07, 64),
        measured("render", "multijitter", 9.0, 2.01, 4096),
        measured("render", "ldsampler", 0.5, 2.01, 64),
        measured("calibrate", "transport, multijitter", 1.0, 2.08, 64),
        measured("calibrate", "points, multijitter", 1.5, 2.30, 64),
        estimate,
    ]
    best = recommend(cells, 2.0)
    assert best.reached
    assert best.render is not None
    assert best.calibrate is not None
    assert (best.render.samples, best.calibrate.method) == (64, "transport")
    assert best.mse == pytest.approx(2.0 * (1 + 0.035 + 0.04 + 0.01))
    harder = [one.model_copy(update={"mse": exactly(2.3)}) if one.stage == "calibrate" else one for one in cells]
    assert not recommend(harder, 2.0).reached
    assert "no noise floor" in recommend(cells, 0.0).why
    assert excess(estimate, 2.0) == pytest.approx(0.01)


def test_adaptive_samples_are_recommended_as_a_scene_asks_for_them() -> None:
    """They share their sampler with cells of given numbers; no slope uses them."""
    ways: list[tuple[Stage, str]] = [("render", "multijitter"), ("calibrate", "transport, multijitter")]
    counted = [
        cell(stage, way=way, seconds=exactly(0.1 * count), mse=exactly(2 + 100 / count), samples=count,
             error=exactly(count**-0.5))
        for stage, way in ways
        for count in (16, 64, 256)
    ]  # fmt: skip
    adaptive = [
        cell(stage, way=way, seconds=exactly(1.0), mse=exactly(2.0), samples=576, setting=AUTO, error=exactly(1e-15))
        for stage, way in ways
    ]
    estimate = cell("reconstruct", way="frame", error=exactly(0.0), seconds=exactly(0.1), samples=None)
    best = recommend([*counted, *adaptive, estimate], 2.0)
    assert best.reached
    for setting in (best.render, best.calibrate):
        assert setting is not None
        assert (setting.samples, setting.sampler) == (AUTO, "multijitter")
    assert 'render.samples = "auto" took up to 576' in best.why
    assert not recommend([*counted, estimate], 2.0).reached
    tile = open_scene(GALLERY / "tile19.toml").camera
    assert curves([*counted, *adaptive], tile) == curves(counted, tile)


def job(samples: int, ran: list[tuple[int, int]], seconds: float = 0.0) -> Job:
    """A job that notes its repeats in `ran` and takes no time; one of 13 samples cannot be measured."""

    def work(repeat: int) -> Repeat:
        ran.append((samples, repeat))
        if samples == 13:
            raise InputError("thirteen cannot be done")
        return Repeat(1 / samples + 1e-3 * repeat, seconds, 2**20, 2.0)

    return Job("render", "independent", None, samples, "", work)


def test_known_cells_are_not_repeated_and_each_new_one_is_saved() -> None:
    ran, saved = list[tuple[int, int]](), list[list[Cell]]()
    first, refused = measure([job(4, ran), job(13, ran)], {}, perf_counter() + 60, lambda cells: saved.append([*cells]))
    assert ran == [*((4, repeat) for repeat in range(5)), (13, 0)]
    assert [(skipped.why, skipped.late) for skipped in refused] == [("thirteen cannot be done", False)]
    known = {name_of(cell): cell for cell in first}
    again, _ = measure([job(4, ran), job(16, ran)], known, perf_counter() + 60, lambda cells: saved.append([*cells]))
    assert ran[6:] == [(16, repeat) for repeat in range(5)]
    assert [cell.samples for cell in again] == [4, 16]
    assert saved == [first, again]


def test_what_does_not_fit_is_left_out() -> None:
    """Time is proportional to samples: of a cell of 5 s in 60 s one with 4 times as many fits, one with 16 does not."""
    ran: list[tuple[int, int]] = []
    listed = [job(4, ran, 1.0), job(16, ran, 1.0), job(64, ran, 1.0)]
    cells, _ = measure(listed, {}, perf_counter() + 60, lambda _: None)
    assert [cell.samples for cell in cells] == [4, 16, 64], "each as long as the one before"
    known = {name_of(cell): cell for cell in cells[:1]}
    cells, left_out = measure([listed[0], job(64, ran)], known, perf_counter() + 60, lambda _: None)
    assert [cell.samples for cell in cells] == [4]
    assert [(skipped.late, "64 samples" in skipped.what) for skipped in left_out] == [(True, True)]
    assert job(4, ran).measure(deadline=0.0) is None, "one repeat is no cell"


def test_a_cell_is_median_and_quantiles_of_its_repeats() -> None:
    repeats = [Repeat(error, 1.0, memory, None) for error, memory in ((1.0, 5), (3.0, 7), (2.0, 6))]
    made = cell_from_repeats(job(4, []), repeats)
    assert made.error.median == 2.0
    assert (made.error.low, made.error.high) == (pytest.approx(1.2), pytest.approx(2.8))
    assert (made.memory, made.mse, made.repeats) == (7, None, 3)
    assert made.scatter == pytest.approx(np.std(np.log([1.0, 2.0, 3.0]), ddof=1))


def test_memory_is_the_peak_of_the_work_alone() -> None:
    if not CLEAR_REFS.exists():
        assert measured(lambda: 1)[2] is None
        return
    large, small = (measured(lambda size=size: np.ones(size).sum())[2] for size in (2**25, 2**10))
    assert large is not None
    assert small is not None
    # 8 bytes per number, released afterwards; the interpreter's own memory varies by less than 2**25.
    assert large - small == pytest.approx(2**28, abs=2**25)


numbers = st.floats(1e-12, 1e12)
quantiles = st.builds(Quantiles, median=numbers, low=numbers, high=numbers)


@given(
    st.builds(cell, error=quantiles, seconds=quantiles, mse=st.none() | quantiles, samples=st.none() | st.integers(1))
)
def test_a_table_that_is_read_is_the_one_that_was_written(
    tmp_path_factory: pytest.TempPathFactory, measured: Cell
) -> None:
    folder = tmp_path_factory.mktemp("table")
    table = bench_table(derive(scene()), [measured])
    write(folder, table)
    assert read(folder / JSON) == table
    (row,) = csv.DictReader((folder / CSV).read_text(encoding="utf-8").splitlines())
    assert list(row) == list(row_of(measured))
    assert float(row["error"]) == measured.error.median
    assert row["mse_high"] == ("" if measured.mse is None else str(measured.mse.high))


def test_an_adaptive_cell_without_error_leaves_the_scale_to_the_others(tmp_path: Path) -> None:
    cells = [cell(samples=count, error=exactly(count**-0.5)) for count in (4, 16, 64)]
    cells.append(cell(samples=18, setting=AUTO, error=exactly(1e-12)))
    figures = KeptFigures()
    cells.append(cell("calibrate", way="transport, independent", mse=None))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_figures(tmp_path, bench_table(derive(scene()), cells), figures)
    panel = figures.kept["render"].axes[0]
    assert panel.get_ylim()[0] > 0.01
    assert "auto, below: 1e-12" in [text.get_text() for text in panel.texts]


@pytest.fixture
def subject(here: Path) -> Subject:
    """The tiny scene, to be measured."""
    setup = open_scene(here / "tiny.toml")
    return Subject(setup, reference(setup))


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_errors_of_real_renderings_fall_as_theory_says(subject: Subject, variant: str) -> None:
    """Within 4 standard errors with 16 degrees of freedom: one seed in a thousand would fail."""
    needs(variant)
    listed, _ = jobs(subject)
    used = [
        job
        for job in listed
        if (job.stage, job.way, job.variant) == ("render", "independent", variant) and (job.samples or 0) <= 256
    ]
    cells = [cell_from_repeats(job, [job.work(repeat) for repeat in range(5)]) for job in used]
    (curve,) = curves(cells, subject.camera)
    assert curve.theory == -0.5
    assert curve.slope is not None
    assert curve.slope_deviation is not None
    assert 4 * curve.slope_deviation < 0.25, "precise enough to exclude the slope of stratified samples, -0.75"
    assert abs(curve.slope + 0.5) < 4 * curve.slope_deviation


def test_every_sampler_method_and_solver_is_measured(subject: Subject) -> None:
    listed, left_out = jobs(subject)
    names = [job.name for job in listed]
    assert len(set(names)) == len(names)
    assert {job.way for job in listed if job.stage == "render"} == set(SAMPLERS)
    assert {"points, multijitter"} <= {job.way for job in listed if job.stage == "calibrate"}
    assert {"dense", "tiles"} <= {job.way for job in listed if job.stage == "reconstruct"}
    assert all(skipped.why for skipped in left_out)
    counts = {job.samples for job in listed if (job.stage, job.way) == ("render", "multijitter")}
    assert counts == {4, 16, 64, 256, 1024, 4096, 16384, None}
    adaptive = {(job.stage, job.way) for job in listed if job.setting == AUTO}
    calibrations = {("calibrate", f"{method}, multijitter") for method in ("points", "transport")}
    assert {("render", "multijitter")} <= adaptive <= {("render", "multijitter"), *calibrations}
    assert sample_plan(4, "orthogonal").passes == 1


@pytest.mark.slow
def test_adaptive_samples_leave_the_noise_alone(subject: Subject) -> None:
    """Rendering may add a tenth of the noise, H a tenth of all the rest, for any backend."""
    adaptive = [job for job in jobs(subject)[0] if job.setting == AUTO]
    assert adaptive
    for job in adaptive:
        repeat = job.work(0)
        assert repeat.mse is not None
        assert repeat.samples is not None
        assert repeat.samples >= 18, "two passes of a grid of 3 x 3 have no error"
        assert repeat.mse < 1.1 * subject.noise_floor, job.name


def test_without_noise_no_cell_has_adaptive_samples(here: Path) -> None:
    setup = open_scene(here / "tiny.toml", ["noise="])
    listed, left_out = jobs(Subject(setup, reference(setup)))
    assert all(job.setting != AUTO for job in listed)
    assert ["noise.variance above 0" in skipped.why for skipped in left_out if "auto" in skipped.what] == [True]


def test_seeds_differ_between_cells_and_repeats_and_from_the_scenes_own(subject: Subject) -> None:
    seeds = {subject.seed(name, repeat) for name in ("a", "b") for repeat in range(5)}
    assert len(seeds) == 10
    assert subject.scene.render.seed not in seeds


def check(table: BenchTable, document: dict[str, object]) -> None:
    """The file holds what the command printed, under the documented keys."""
    assert set(document) >= {"title", "fingerprint", "camera", "machine", "versions", "seconds", "cells", "curves"}
    assert set(document) >= {"recommended", "left_out"}
    assert table.describe() == document
    for each in table.cells:
        assert each.error.low <= each.error.median <= each.error.high
        assert each.repeats >= 3


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two samplers with few samples: seconds on any machine."""
    monkeypatch.setattr("ommatid.bench.cells.SAMPLES", (4, 16, 64))
    monkeypatch.setattr("ommatid.bench.cells.SAMPLERS", ("independent", "ldsampler"))


@pytest.mark.slow
@pytest.mark.usefixtures("few")
def test_the_command_writes_its_table_and_repeats_nothing(ommatid: Command, here: Path) -> None:
    ended = ommatid("bench", "tiny.toml", "-o", "out", "--within", "1 h", "--json")
    assert ended.code == 0, ended.err
    table = read(here / "out" / JSON)
    check(table, json.loads(ended.out))
    assert {measured.stage for measured in table.cells} == {"render", "calibrate", "reconstruct"}
    assert not any(skipped.late for skipped in table.left_out)
    assert "dense" in (here / "out" / CSV).read_text(encoding="utf-8")
    assert {path.name for path in (here / "out").iterdir()} == {JSON, CSV, *FIGURES}
    before = (here / "out" / JSON).stat().st_mtime_ns
    again = ommatid("bench", "tiny.toml", "-o", "out", "--set", "render.samples=64")
    assert (again.code, "up to date" in again.err) == (0, True), "the scene's own samples are not measured"
    assert (here / "out" / JSON).stat().st_mtime_ns == before
    assert dict(rows(table))["cells"]
    other = ommatid("bench", "tiny.toml", "-o", "out", "--set", "noise.variance=1")
    assert (other.code, "another scene" in other.err) == (2, True)


def test_scenes_that_cannot_be_measured_are_refused(ommatid: Command, here: Path) -> None:
    for file, reason in (("missing.toml", "no such scene file"), (str(GALLERY / "corridor.toml"), "flat targets")):
        ended = ommatid("bench", file, "-o", "out")
        assert (ended.code, reason in ended.err) == (2, True), ended.err
    assert not (here / "out").exists()


@given(st.binary(max_size=60) | st.just(b"{}") | st.just(b'{"cells": 1e999}'))
@settings(max_examples=40)
def test_a_damaged_table_is_reported_in_one_sentence(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("damaged") / JSON
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"run `ommatid bench` again$"):
        read(path)


@given(st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-9, 1e6)), max_size=12))
def test_no_point_beats_the_front_and_none_of_it_is_beaten(points: list[tuple[float, float]]) -> None:
    front = pareto_front(points, lambda point: point[0], lambda point: point[1])
    for cost, error in points:
        assert any(best_cost <= cost and best_error <= error for best_cost, best_error in front)
    for cost, error in front:
        assert not any(other[0] < cost and other[1] <= error for other in points)
    assert front == sorted(front)
    errors = [error for _, error in front]
    assert errors == sorted(set(errors), reverse=True), "each costs more for a smaller error"
