"""`ommatid bench`: slopes, recommendations, the scheduler and its journal, and the files it writes."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from ommatid.bench.bench import curves, rows
from ommatid.bench.figure import write_figures
from ommatid.bench.jobs import SAMPLERS, Subject, jobs
from ommatid.bench.reference import reference, sample_plan
from ommatid.bench.resources import CLEAR_REFS, Cost, measure_cost
from ommatid.bench.scheduler import Job, Journal, Repeat, cell_from_repeats, measure, name_of
from ommatid.bench.slopes import Slope, excess, recommend, slope
from ommatid.bench.table import AUTO, CSV, JSON, BenchTable, Cell, Quantiles, Stage, read, row_of, write
from ommatid.pipeline.stages import open_scene
from ommatid.reconstruct.estimator.estimate import FORMS
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import no_progress
from ommatid.scenes.camera import derive

from ..conftest import Command
from ..examples import GALLERY, VARIANTS, needs, scene
from .tables import bench_table, cell, exactly

FIGURES = ("render.png", "calibrate.png", "reconstruct.png")


@pytest.mark.parametrize("power", [-0.5, -0.75, -1.0])
def test_slopes_are_right_within_their_standard_error(power: float) -> None:
    """400 fits to errors of 5 seeds with a scatter of 5 %: the scores follow Student's t with about 24 degrees.

    The shrunk variances of 6 points with 4 degrees of freedom each have about 24; Student's deviation is then 1.04.
    """
    rng = np.random.default_rng(3)
    samples = np.array([16, 64, 256, 1024, 4096, 16384])
    scores: list[float] = []
    for _ in range(400):
        drawn = 7.0 * samples[:, None] ** power * np.exp(rng.normal(0, 0.05, (6, 5)))
        cells = [
            cell(samples=int(count), error=Quantiles.of(list(errors)), scatter=float(np.std(np.log(errors), ddof=1)))
            for count, errors in zip(samples, drawn, strict=True)
        ]
        fit = slope(cells)
        assert fit is not None
        scores.append((fit.value - power) / fit.deviation)
    # Bounds of 4 standard errors of mean and deviation, and the binomial bound of the same significance.
    assert np.mean(scores) == pytest.approx(0, abs=4 / 400**0.5)
    assert np.std(scores) == pytest.approx(1.04, abs=4 * 1.04 / 800**0.5)
    outside = int(np.sum(np.abs(scores) > 3))
    assert outside <= stats.binom.isf(stats.norm.sf(4), 400, 2 * stats.t.sf(3, 24))


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
    """They share their sampler with cells of given numbers; neither slopes nor forecasts of samples use them."""
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
    half = recommend([*counted, adaptive[0], estimate], 2.0)
    assert [setting.samples for setting in (half.render, half.calibrate) if setting] == [AUTO, 256]
    assert "calibrate, transport, multijitter, would need about 1000 samples" in half.why
    tile = open_scene(GALLERY / "tile19.toml").camera
    assert curves([*counted, *adaptive], tile) == curves(counted, tile)


class Counter:
    """Jobs that count their repeats; each reports its guess as its duration, and takes no time."""

    def __init__(self) -> None:
        self.ran: list[tuple[int, int]] = []

    def job(self, samples: int, guess: float = 1e-3) -> Job:
        def work(repeat: int) -> Repeat:
            self.ran.append((samples, repeat))
            if samples == 13:
                raise InputError("thirteen cannot be done")
            return Repeat(1 / samples + 1e-3 * repeat, Cost(guess, 2**20), 2.0)

        return Job("render", "independent", None, samples, "", guess, work)


@pytest.mark.parametrize("link", [os.symlink, os.link])
def test_a_link_in_place_of_the_journal_is_replaced(link: Callable[[Path, Path], None], tmp_path: Path) -> None:
    other, path = tmp_path / "other", tmp_path / "partial"
    other.write_text("of another program", encoding="utf-8")
    link(other, path)
    Journal(path, "a").add("render", "no time", 1.0)
    assert other.read_text(encoding="utf-8") == "of another program"
    assert Journal(path, "a").refused == {"render": "no time"}


def test_finished_jobs_are_not_repeated_after_an_interruption(tmp_path: Path) -> None:
    path, counter = tmp_path / "partial", Counter()
    first = Journal(path, "a")
    assert measure([counter.job(4), counter.job(13)], 60, first, no_progress) == []
    assert (len(counter.ran), set(first.refused.values())) == (6, {"thirteen cannot be done"})
    with path.open("a", encoding="utf-8") as stream:
        stream.write('{"fingerprint": "a", "name": "render ind')  # killed in the middle of a line
    again = Journal(path, "a")
    measure([counter.job(4), counter.job(13), counter.job(16)], 60, again, no_progress)
    assert counter.ran[6:] == [(16, repeat) for repeat in range(5)]
    assert again.cells == Journal(path, "a").cells
    assert len(again.cells) == 2
    assert Journal(path, "another").cells == {}
    again.remove()
    assert not path.exists()


def test_the_cheapest_come_first_and_what_does_not_fit_is_named(tmp_path: Path) -> None:
    counter, shares = Counter(), list[float]()
    listed = [counter.job(64, 1e6), counter.job(16, 0.02), counter.job(4, 0.01)]
    left_out = measure(listed, 60, Journal(tmp_path / "partial", "a"), shares.append)
    assert [samples for samples, repeat in counter.ran if repeat == 0] == [4, 16]
    assert len(left_out) == 1
    assert "64 samples" in left_out[0].what
    assert left_out[0].late
    assert shares[-1] == 1.0


def test_short_adaptive_jobs_come_first_and_are_found_again(tmp_path: Path) -> None:
    """A long one waits for its turn. The cell has the most samples of any repeat, and the name of its job."""
    ran: list[str] = []

    def job(way: str, guess: float) -> Job:
        def work(repeat: int) -> Repeat:
            ran.append(way)
            return Repeat(1e-15, Cost(guess, None), 2.0, 576 * (1 + repeat % 2))

        return Job("render", way, None, None, AUTO, guess, work)

    listed, path = [Counter().job(4), job("short", 1.0), job("long", 3.0)], tmp_path / "partial"
    measure(listed, 60, Journal(path, "a"), no_progress)
    assert list(dict.fromkeys(ran)) == ["short", "long"]
    again = Journal(path, "a")
    assert list(again.cells) == ["render short, auto", listed[0].name, "render long, auto"]
    assert all(name_of(one) == name for name, one in again.cells.items())
    assert again.cells["render short, auto"].samples == 1152
    assert not again.cells["render short, auto"].counted
    assert measure(listed, 60, again, no_progress) == []
    assert len(ran) == 5 + 5, "five repeats of each, since neither takes as long as its guess, and no more"


def test_a_cell_is_median_and_quantiles_of_its_repeats() -> None:
    repeats = [Repeat(error, Cost(1.0, memory), None) for error, memory in ((1.0, 5), (3.0, 7), (2.0, 6))]
    made = cell_from_repeats(Counter().job(4), repeats)
    assert made.error.median == 2.0
    assert (made.error.low, made.error.high) == (pytest.approx(1.2), pytest.approx(2.8))
    assert (made.memory, made.mse, made.repeats) == (7, None, 3)
    assert made.scatter == pytest.approx(np.std(np.log([1.0, 2.0, 3.0]), ddof=1))


def test_memory_is_the_peak_of_the_work_alone() -> None:
    if not CLEAR_REFS.exists():
        assert measure_cost(lambda: 1)[1].memory is None
        return
    large, small = (measure_cost(lambda size=size: np.ones(size).sum())[1].memory for size in (2**25, 2**10))
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


@pytest.mark.parametrize("seconds", [0.01, 0.023146497000197996, 1.0])
def test_a_single_cell_is_drawn_whatever_its_time(tmp_path: Path, seconds: float) -> None:
    """Matplotlib's limits of a logarithmic axis coincide around some single values."""
    single = cell("reconstruct", way="covariance", error=exactly(1e-10), seconds=exactly(seconds))
    write_figures(tmp_path, bench_table(derive(scene()), [single]))
    assert (tmp_path / "reconstruct.png").is_file()


@pytest.fixture
def subject(here: Path) -> Subject:
    """The tiny scene, to be measured."""
    setup = open_scene(here / "tiny.toml")
    return Subject(setup, reference(setup, here))


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
    assert {"information", "dual", "tiles"} <= {job.way for job in listed if job.stage == "reconstruct"}
    assert all(skipped.why for skipped in left_out)
    counts = {job.samples for job in listed if (job.stage, job.way) == ("render", "multijitter")}
    assert counts == {4, 16, 64, 256, 1024, 4096, 16384, None}
    adaptive = {(job.stage, job.way) for job in listed if job.setting == AUTO}
    calibrations = {("calibrate", f"{method}, multijitter") for method in ("points", "transport")}
    assert {("render", "multijitter")} <= adaptive <= {("render", "multijitter"), *calibrations}
    assert sample_plan(4, "orthogonal").passes == 1


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
    listed, left_out = jobs(Subject(setup, reference(setup, here)))
    assert all(job.setting != AUTO for job in listed)
    assert ["noise.variance above 0" in skipped.why for skipped in left_out if "auto" in skipped.what] == [True]


def test_seeds_differ_between_cells_and_repeats_and_from_the_scenes_own(subject: Subject) -> None:
    seeds = {subject.seed(name, repeat) for name in ("a", "b") for repeat in range(5)}
    assert len(seeds) == 10
    assert subject.scene.render.seed not in seeds


@pytest.mark.parametrize(("name", "closed"), [("tile19", True), ("planoconvex", True), ("misaligned", True)])
def test_which_cameras_have_a_closed_form(name: str, closed: bool) -> None:
    assert open_scene(GALLERY / f"{name}.toml").has_closed_form == closed


def check(table: BenchTable, document: dict[str, object]) -> None:
    """The file holds what the command printed, under the documented keys."""
    assert set(document) >= {"title", "fingerprint", "camera", "machine", "versions", "seconds", "cells", "curves"}
    assert set(document) >= {"recommended", "left_out"}
    assert table.describe() == document
    for measured in table.cells:
        assert measured.error.low <= measured.error.median <= measured.error.high
        assert measured.repeats >= 3


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two samplers with few samples and one form: seconds on any machine."""
    monkeypatch.setattr("ommatid.bench.jobs.SAMPLES", (4, 16, 64))
    monkeypatch.setattr("ommatid.bench.jobs.SAMPLERS", ("independent", "ldsampler"))
    monkeypatch.setattr("ommatid.bench.precision.FORMS", {"information": FORMS["information"]})


@pytest.mark.usefixtures("few")
def test_the_command_writes_its_table_and_repeats_nothing(ommatid: Command, here: Path) -> None:
    ended = ommatid("bench", "tiny.toml", "-o", "out", "--seconds", "3600", "--json")
    assert ended.code == 0, ended.err
    table = read(here / "out" / JSON)
    check(table, json.loads(ended.out))
    assert {measured.stage for measured in table.cells} == {"render", "calibrate", "reconstruct"}
    assert not any(skipped.late for skipped in table.left_out)
    assert "information" in (here / "out" / CSV).read_text(encoding="utf-8")
    assert {path.name for path in (here / "out").iterdir()} == {JSON, CSV, *FIGURES}
    before = (here / "out" / JSON).stat().st_mtime_ns
    again = ommatid("bench", "tiny.toml", "-o", "out", "--set", "render.samples=64")
    assert (again.code, "up to date" in again.err) == (0, True), "the scene's own samples are not measured"
    assert (here / "out" / JSON).stat().st_mtime_ns == before
    assert dict(rows(table))["cells"]
    other = ommatid("bench", "tiny.toml", "-o", "out", "--set", "noise.variance=1")
    assert (other.code, "another scene" in other.err) == (2, True)


@pytest.mark.usefixtures("here")
def test_a_tiny_budget_still_ends_in_a_table(ommatid: Command) -> None:
    ended = ommatid("bench", "tiny.toml", "-o", "out", "--seconds", "1", "--json")
    assert ended.code == 0, ended.err
    document = json.loads(ended.out)
    assert len(document["left_out"]) > len(document["cells"])
    assert document["recommended"]["why"]


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
