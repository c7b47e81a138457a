"""`ommatid bench`: slopes, recommendations, its time limit and the files that it writes."""

from __future__ import annotations

import csv
import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import special

from ommatid.bench import subject as subjects
from ommatid.bench.bench import JOURNAL, LATE, Measurement, cell_of, rows
from ommatid.bench.cost import CLEAR_REFS, measured
from ommatid.bench.figure import write_figures
from ommatid.bench.slopes import curves, excess, pareto_front, recommend, slope
from ommatid.bench.subject import SAMPLERS, Repeat, Subject, sample_plan
from ommatid.bench.table import AUTO, CSV, JSON, BenchTable, Cell, Setting, Stage, read, write
from ommatid.pipeline.stages import open_scene
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import no_progress
from ommatid.runtime.study import FAILED, Row, append, study
from ommatid.scenes.camera import derive

from ..conftest import Command
from ..examples import GALLERY, VARIANTS, needs, scene
from ..kept_figures import KeptFigures
from .tables import bench_table, cell

FIGURES = ("render.png", "calibrate.png", "reconstruct.png")


def test_the_slope_of_a_power_law_is_found_with_its_standard_error() -> None:
    """Medians of 5 with a scatter of 5 % each: s^2 pi / (2 n + pi - 2) over the spread of ln(samples).

    Variances are shrunk by their logarithms, whose mean for 4 degrees of freedom is digamma(2) - ln 2 too low.
    """
    samples = 4.0 ** np.arange(2, 8)
    cells = [cell(samples=int(count), error=7.0 * count**-0.75, scatter=0.05) for count in samples]
    fit = slope(cells)
    assert fit is not None
    assert fit[0] == pytest.approx(-0.75)
    unbiased = 2 * np.exp(-special.digamma(2))
    spread = np.log(samples).var() * samples.size
    assert fit[1] == pytest.approx(0.05 * (unbiased * np.pi / (8 + np.pi) / spread) ** 0.5)


def test_too_few_points_have_no_slope() -> None:
    cells = [cell(samples=count, error=1 / count) for count in (4, 16)]
    assert slope(cells) is None
    assert slope([*cells, cell(samples=64, scatter=None)]) is None


def test_the_cheapest_settings_that_reach_the_floor_are_recommended() -> None:
    """Excesses add up over the stages; rendering and calibration share the sampler of a scene."""

    def measured(stage: Stage, way: str, seconds: float, mse: float, samples: int) -> Cell:
        return cell(stage, way=way, seconds=seconds, mse=mse, samples=samples)

    estimate = cell("reconstruct", way="frame", error=0.1, seconds=0.1, samples=None)
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
    assert (best.render.samples, best.calibrate.way) == (64, "transport, multijitter")
    assert best.mse == pytest.approx(2.0 * (1 + 0.035 + 0.04 + 0.01))
    harder = [one.model_copy(update={"mse": 2.3}) if one.stage == "calibrate" else one for one in cells]
    assert not recommend(harder, 2.0).reached
    assert "no noise floor" in recommend(cells, 0.0).why
    assert excess(estimate, 2.0) == pytest.approx(0.01)


def test_adaptive_samples_are_recommended_as_a_scene_asks_for_them() -> None:
    """They share their sampler with cells of given numbers; no slope uses them."""
    ways: list[tuple[Stage, str]] = [("render", "multijitter"), ("calibrate", "transport, multijitter")]
    counted = [
        cell(stage, way=way, seconds=0.1 * count, mse=2 + 100 / count, samples=count,
             error=count**-0.5)
        for stage, way in ways
        for count in (16, 64, 256)
    ]  # fmt: skip
    adaptive = [
        cell(stage, way=way, seconds=1.0, mse=2.0, samples=576, setting=AUTO, error=1e-15) for stage, way in ways
    ]
    estimate = cell("reconstruct", way="frame", error=0.0, seconds=0.1, samples=None)
    best = recommend([*counted, *adaptive, estimate], 2.0)
    assert best.reached
    assert [(one.counted, one.sampler) for one in best.cells[:2]] == [(False, "multijitter")] * 2
    assert 'render.samples = "auto" took up to 576' in best.why
    assert not recommend([*counted, estimate], 2.0).reached
    tile = open_scene(GALLERY / "tile19.toml").camera
    assert curves([*counted, *adaptive], tile) == curves(counted, tile)


def settings_of(*samples: int) -> list[Row]:
    return [Setting(stage="render", way="independent", samples=count, setting="").model_dump() for count in samples]


def work(ran: list[tuple[int | None, int]], seconds: float = 0.0, within: float = 60.0) -> Measurement:
    """Notes repeats in `ran` that take no time, but say that they took `seconds`; 13 samples cannot be measured."""

    def repeated(setting: Setting, repeat: int) -> Repeat:
        ran.append((setting.samples, repeat))
        if setting.samples == 13:
            raise InputError("thirteen cannot be done")
        return Repeat(1 / (setting.samples or 1) + 1e-3 * repeat, seconds, 2**20, 2.0)

    return Measurement(repeated, within, no_progress, Path(JOURNAL))


def test_known_cells_are_not_repeated_and_each_new_one_is_kept(tmp_path: Path) -> None:
    """Also beside a line that an interruption left unfinished."""
    ran, journal = list[tuple[int | None, int]](), tmp_path / JOURNAL
    first = study(journal, settings_of(4, 13), work(ran).measure)
    assert ran == [*((4, repeat) for repeat in range(5)), (13, 0)]
    assert (Cell(**first[0]).samples, first[1][FAILED]) == (4, "thirteen cannot be done")
    with journal.open("ab") as file:
        file.write(b'\xff\n[1]\n{"cell": 3}\n{"cell": {"sta')
    append(journal, {"cell": settings_of(16)[0], "row": 5})  # which no study has written
    again = study(journal, settings_of(4, 16), work(ran).measure)
    assert ran[6:] == [(16, repeat) for repeat in range(5)]
    assert again == study(journal, settings_of(4, 16), work(ran).measure)
    assert [row["samples"] for row in again] == [4, 16]
    assert len(ran) == 11
    journal.write_text(json.dumps({"cell": settings_of(4)[0], "row": {}}), encoding="utf-8")
    with pytest.raises(InputError, match="expected rows of a bench, got others; delete it"):
        study(journal, settings_of(4), work(ran).measure, work(ran).report)


def test_what_does_not_fit_is_left_out(tmp_path: Path) -> None:
    """Time is proportional to samples: of a cell of 5 s in 60 s one with 4 times as many fits, one with 16 does not."""
    ran = list[tuple[int | None, int]]()
    for samples, fits in (((4, 16), True), ((4, 64), False)):
        timed = work(ran, seconds=1.0)
        rows = study(tmp_path / f"{fits}.jsonl", settings_of(*samples), timed.measure, timed.report)
        assert [row.get(FAILED) for row in rows] == [None, None if fits else LATE]
        journal = tmp_path / f"{fits}.jsonl"
        journal.write_text(re.sub(r'"spent": [^}]*', '"spent": 5.0', journal.read_text("utf-8")), "utf-8")
        resumed = work(ran, within=4.0)
        rows = study(journal, settings_of(*samples, 8), resumed.measure, resumed.report)
        assert rows[-1][FAILED] == LATE, "the time of the cells that are known counts"
        assert resumed.seconds > 5


def test_a_cell_is_median_and_quantiles_of_its_repeats() -> None:
    repeats = [Repeat(error, 1.0, memory, None) for error, memory in ((1.0, 5), (3.0, 7), (2.0, 6))]
    made = cell_of(Setting(stage="render", way="independent", samples=4, setting=""), repeats)
    assert made.error == 2.0
    assert (made.error_low, made.error_high) == (pytest.approx(1.2), pytest.approx(2.8))
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


@given(st.builds(cell, error=numbers, error_low=numbers, mse=st.none() | numbers, samples=st.none() | st.integers(1)))
def test_a_table_that_is_read_is_the_one_that_was_written(
    tmp_path_factory: pytest.TempPathFactory, measured: Cell
) -> None:
    folder = tmp_path_factory.mktemp("table")
    table = bench_table(derive(scene()), [measured])
    write(folder, table)
    assert read(folder / JSON) == table
    (row,) = csv.DictReader((folder / CSV).read_text(encoding="utf-8").splitlines())
    assert list(row) == [name for name in Cell.model_fields if name != "spent"]
    assert float(row["error_low"]) == measured.error_low
    assert row["mse_high"] == ("" if measured.mse is None else str(measured.mse))


def test_an_adaptive_cell_without_error_leaves_the_scale_to_the_others(tmp_path: Path) -> None:
    cells = [cell(samples=count, error=count**-0.5) for count in (4, 16, 64)]
    cells.append(cell(samples=18, setting=AUTO, error=1e-12))
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
    return Subject.of(open_scene(here / "tiny.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS)
def test_errors_of_real_renderings_fall_as_theory_says(subject: Subject, variant: str) -> None:
    """Within 4 standard errors with 16 degrees of freedom: one seed in a thousand would fail."""
    needs(variant)
    listed, _ = subjects.settings(subject)
    used = [
        each
        for each in listed
        if (each.stage, each.way, each.variant) == ("render", "independent", variant) and (each.samples or 0) <= 256
    ]
    cells = [cell_of(each, [subject.measure(each, repeat) for repeat in range(5)]) for each in used]
    (curve,) = curves(cells, subject.camera)
    assert curve.theory == -0.5
    assert curve.slope is not None
    assert curve.slope_deviation is not None
    assert 4 * curve.slope_deviation < 0.25, "precise enough to exclude the slope of stratified samples, -0.75"
    assert abs(curve.slope + 0.5) < 4 * curve.slope_deviation


def test_every_sampler_method_and_solver_is_measured(subject: Subject) -> None:
    listed, left_out = subjects.settings(subject)
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
    adaptive = [each for each in subjects.settings(subject)[0] if each.setting == AUTO]
    assert adaptive
    for each in adaptive:
        repeat = subject.measure(each, 0)
        assert repeat.mse is not None
        assert repeat.samples is not None
        assert repeat.samples >= 18, "two passes of a grid of 3 x 3 have no error"
        assert repeat.mse < 1.1 * subject.noise_floor, each.name


def test_without_noise_no_cell_has_adaptive_samples(here: Path) -> None:
    listed, left_out = subjects.settings(Subject.of(open_scene(here / "tiny.toml", ["noise="])))
    assert all(job.setting != AUTO for job in listed)
    assert ["noise.variance above 0" in skipped.why for skipped in left_out if "auto" in skipped.what] == [True]


def test_seeds_differ_between_cells_and_repeats_and_from_the_scenes_own(subject: Subject) -> None:
    seeds = {subject.seed(name, repeat) for name in ("a", "b") for repeat in range(5)}
    assert len(seeds) == 10
    assert subject.setup.scene.render.seed not in seeds


def check(table: BenchTable, document: dict[str, object]) -> None:
    """The file holds what the command printed, under the documented keys."""
    assert set(document) >= {"title", "fingerprint", "camera", "machine", "versions", "seconds", "cells", "curves"}
    assert set(document) >= {"recommended", "left_out"}
    assert table.describe() == document
    for each in table.cells:
        assert each.error_low <= each.error <= each.error_high
        assert each.repeats >= 3


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two samplers with few samples: seconds on any machine."""
    monkeypatch.setattr("ommatid.bench.subject.SAMPLES", (4, 16, 64))
    monkeypatch.setattr("ommatid.bench.subject.SAMPLERS", ("independent", "ldsampler"))


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
    assert {path.name for path in (here / "out").iterdir()} == {JSON, CSV, JOURNAL, *FIGURES}
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
