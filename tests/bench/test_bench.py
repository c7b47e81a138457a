"""`ommatid bench`: the law of slopes, what is worth its time, what is kept, left out and written."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ommatid.bench.bench import curves, rows
from ommatid.bench.jobs import SAMPLERS, Subject, jobs
from ommatid.bench.reference import reference, work_of
from ommatid.bench.resources import FORGET, Cost, measure_cost
from ommatid.bench.scheduler import Job, Journal, Repeat, cell_from_repeats, measure, name_of
from ommatid.bench.slopes import Slope, excess, pareto, recommend, slope
from ommatid.bench.table import AUTO, CSV, JSON, BenchTable, Cell, Quantiles, Stage, cell_of, read, row_of
from ommatid.pipeline.stages import opened
from ommatid.reconstruct.estimator.estimate import FORMS
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import no_progress

from ..conftest import Command
from ..examples import GALLERY, VARIANTS, needs

SHOWN = ("render.png", "calibrate.png", "reconstruct.png")


def made(stage: Stage = "render", **values: object) -> Cell:
    """A cell of one sampler."""
    one = Quantiles.of([1.0])
    plain = Cell(stage, "independent", None, 16, "", 5, one, one, None, one, 0.05)
    return replace(plain, **values)  # pyright: ignore[reportArgumentType]


def exactly(value: float) -> Quantiles:
    return Quantiles(value, value, value)


@pytest.mark.parametrize("power", [-0.5, -0.75, -1.0])
def test_slopes_are_right_within_their_standard_error(power: float) -> None:
    """Errors of 5 seeds that scatter by 5 %, 400 times over: z is as a normal number, but for few degrees of freedom.

    Variances of 6 points from 4 degrees each, moderated, are those of some 24: Student's deviation is 1.04.
    """
    rng = np.random.default_rng(3)
    samples = np.array([16, 64, 256, 1024, 4096, 16384])
    scores: list[float] = []
    for _ in range(400):
        drawn = 7.0 * samples[:, None] ** power * np.exp(rng.normal(0, 0.05, (6, 5)))
        cells = [
            made(samples=int(count), error=Quantiles.of(list(some)), scatter=float(np.std(np.log(some), ddof=1)))
            for count, some in zip(samples, drawn, strict=True)
        ]
        found = slope(cells)
        assert found is not None
        scores.append((found.value - power) / found.deviation)
    assert np.mean(scores) == pytest.approx(0, abs=4 / 20)
    assert np.std(scores) == pytest.approx(1.04, abs=4 * 1.04 / 800**0.5)
    assert np.mean(np.abs(scores) <= 3) > 0.985


def test_too_few_points_have_no_slope() -> None:
    cells = [made(samples=count, error=exactly(1 / count)) for count in (4, 16)]
    assert slope(cells) is None
    assert slope([*cells, made(samples=64, scatter=None)]) is None
    assert Slope(-0.738, 0.002).agrees(-0.75, 0.01)
    assert not Slope(-0.738, 0.002).agrees(-0.75)


Points = st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-9, 1e3)), min_size=1, max_size=12)


@given(Points)
def test_nothing_beats_the_pareto_front(points: list[tuple[float, float]]) -> None:
    cells = [made(seconds=exactly(seconds), error=exactly(error)) for seconds, error in points]
    front = pareto(cells)
    assert min(cells, key=lambda one: one.error.median).error in {one.error for one in front}
    for one in cells:
        reached = [best for best in front if best.seconds.median <= one.seconds.median]
        assert any(best.error.median <= one.error.median for best in reached)
    times, errors = [one.seconds.median for one in front], [one.error.median for one in front]
    assert times == sorted(times)
    assert errors == sorted(set(errors), reverse=True)


def test_the_cheapest_that_reaches_the_floor_is_recommended() -> None:
    """Excesses add up over the stages; rendering and calibration share a sampler, as a scene has one alone."""

    def one(stage: Stage, way: str, seconds: float, mse: float, samples: int) -> Cell:
        return made(stage, way=way, seconds=exactly(seconds), mse=exactly(mse), samples=samples)

    estimate = made("reconstruct", way="frame", error=exactly(0.1), seconds=exactly(0.1), samples=None)
    cells = [
        one("render", "multijitter", 1.0, 2.07, 64),
        one("render", "multijitter", 9.0, 2.01, 4096),
        one("render", "ldsampler", 0.5, 2.01, 64),
        one("calibrate", "transport, multijitter", 1.0, 2.08, 64),
        one("calibrate", "points, multijitter", 1.5, 2.30, 64),
        estimate,
    ]
    found = recommend(cells, 2.0)
    assert found["reached"]
    assert (found["render"]["samples"], found["calibrate"]["method"]) == (64, "transport")
    assert found["mse"] == pytest.approx(2.0 * (1 + 0.035 + 0.04 + 0.01))
    harder = [replace(one, mse=exactly(2.3)) if one.stage == "calibrate" else one for one in cells]
    assert not recommend(harder, 2.0)["reached"]
    assert "no floor" in recommend(cells, 0.0)["why"]
    assert excess(estimate, 2.0) == pytest.approx(0.01)


def test_what_takes_as_many_as_needed_is_recommended_as_a_scene_asks_for_it() -> None:
    """It shares its sampler with cells of given numbers, and neither slopes nor forecasts of samples count it."""
    ways: list[tuple[Stage, str]] = [("render", "multijitter"), ("calibrate", "transport, multijitter")]
    counted = [
        made(stage, way=way, seconds=exactly(0.1 * count), mse=exactly(2 + 100 / count), samples=count,
             error=exactly(count**-0.5))
        for stage, way in ways
        for count in (16, 64, 256)
    ]  # fmt: skip
    needed = [
        made(stage, way=way, seconds=exactly(1.0), mse=exactly(2.0), samples=576, setting=AUTO, error=exactly(1e-15))
        for stage, way in ways
    ]
    estimate = made("reconstruct", way="frame", error=exactly(0.0), seconds=exactly(0.1), samples=None)
    found = recommend([*counted, *needed, estimate], 2.0)
    assert found["reached"]
    assert (found["render"]["samples"], found["calibrate"]["samples"]) == (AUTO, AUTO)
    assert found["render"]["sampler"] == found["calibrate"]["sampler"] == "multijitter"
    assert 'render.samples = "auto" took up to 576' in found["why"]
    assert not recommend([*counted, estimate], 2.0)["reached"]
    half = recommend([*counted, needed[0], estimate], 2.0)
    assert (half["render"]["samples"], half["calibrate"]["samples"]) == (AUTO, 256)
    assert "calibrate, transport, multijitter, would take about 1000 samples" in half["why"]
    of_tile = opened(GALLERY / "tile19.toml").camera
    assert curves([*counted, *needed], of_tile) == curves(counted, of_tile)


class Counter:
    """Jobs that count how often they ran; each says that it takes its guess, and takes no time."""

    def __init__(self) -> None:
        self.ran: list[tuple[int, int]] = []

    def job(self, samples: int, guess: float = 1e-3) -> Job:
        def work(repeat: int) -> Repeat:
            self.ran.append((samples, repeat))
            if samples == 13:
                raise InputError("thirteen cannot be done")
            return Repeat(1 / samples + 1e-3 * repeat, Cost(guess, 2**20), 2.0)

        return Job("render", "independent", None, samples, "", guess, work)


def test_what_is_finished_is_not_repeated_whatever_stopped_the_program(tmp_path: Path) -> None:
    path, counter = tmp_path / "partial", Counter()
    first = Journal(path, "a")
    assert measure([counter.job(4), counter.job(13)], 60, first, no_progress) == []
    assert (len(counter.ran), set(first.refused.values())) == (6, {"thirteen cannot be done"})
    with path.open("a", encoding="utf-8") as stream:
        stream.write('{"fingerprint": "a", "name": "render ind')  # killed in the middle of a line
    again = Journal(path, "a")
    measure([counter.job(4), counter.job(13), counter.job(16)], 60, again, no_progress)
    assert counter.ran[6:] == [(16, number) for number in range(5)]
    assert again.cells == Journal(path, "a").cells
    assert len(again.cells) == 2
    assert Journal(path, "another").cells == {}
    again.remove()
    assert not path.exists()


def test_the_cheapest_come_first_and_what_does_not_fit_is_named(tmp_path: Path) -> None:
    counter, done = Counter(), list[float]()
    jobs = [counter.job(64, 1e6), counter.job(16, 0.02), counter.job(4, 0.01)]
    left_out = measure(jobs, 60, Journal(tmp_path / "partial", "a"), done.append)
    assert [samples for samples, repeat in counter.ran if repeat == 0] == [4, 16]
    assert len(left_out) == 1
    assert "64 samples" in left_out[0].what
    assert left_out[0].late
    assert done[-1] == 1.0


def test_short_jobs_of_unknown_samples_come_first_and_are_found_again(tmp_path: Path) -> None:
    """A long one waits for its turn. The most samples of any repeat are told; the name is the same before and after."""
    ran: list[str] = []

    def job(way: str, guess: float) -> Job:
        def work(repeat: int) -> Repeat:
            ran.append(way)
            return Repeat(1e-15, Cost(guess, None), 2.0, 576 * (1 + repeat % 2))

        return Job("render", way, None, None, AUTO, guess, work)

    several, path = [Counter().job(4), job("short", 1.0), job("long", 3.0)], tmp_path / "partial"
    measure(several, 60, Journal(path, "a"), no_progress)
    assert list(dict.fromkeys(ran)) == ["short", "long"]
    again = Journal(path, "a")
    assert list(again.cells) == ["render short, auto", several[0].name, "render long, auto"]
    assert all(name_of(one) == name for name, one in again.cells.items())
    assert again.cells["render short, auto"].samples == 1152
    assert not again.cells["render short, auto"].counted
    assert measure(several, 60, again, no_progress) == []
    assert len(ran) == 5 + 5, "five repeats of each, since neither takes the time that it says, and no more"


def test_a_cell_is_median_and_quantiles_of_its_repeats() -> None:
    repeats = [Repeat(error, Cost(1.0, memory), None) for error, memory in ((1.0, 5), (3.0, 7), (2.0, 6))]
    found = cell_from_repeats(Counter().job(4), repeats)
    assert found.error == Quantiles(2.0, pytest.approx(1.2), pytest.approx(2.8))  # pyright: ignore[reportArgumentType]
    assert (found.memory, found.mse, found.repeats) == (7, None, 3)
    assert found.scatter == pytest.approx(np.std(np.log([1.0, 2.0, 3.0]), ddof=1))


def test_memory_is_the_peak_of_the_work_alone() -> None:
    if not FORGET.exists():
        assert measure_cost(lambda: 1)[1].memory is None
        return
    large, small = (measure_cost(lambda size=size: np.ones(size).sum())[1].memory for size in (2**25, 2**10))
    assert large is not None
    assert small is not None
    assert 0.9 * 2**28 < large - small < 1.2 * 2**28, "8 bytes a number, forgotten afterwards"


Numbers = st.floats(1e-12, 1e12)
Some = st.builds(Quantiles, Numbers, Numbers, Numbers)


@given(st.builds(made, error=Some, seconds=Some, mse=st.none() | Some, samples=st.none() | st.integers(1, 2**30)))
def test_write_then_read_is_the_identity(one: Cell) -> None:
    from dataclasses import asdict

    assert cell_of(json.dumps(asdict(one))) == one
    row = row_of(one)
    assert row["error"] == one.error.median
    assert row["mse_high"] == (None if one.mse is None else one.mse.high)


@pytest.fixture
def subject(here: Path) -> Subject:
    """What is measured of the tiny scene."""
    setup = opened(here / "tiny.toml")
    return Subject(setup, reference(setup, here))


@pytest.mark.parametrize("variant", VARIANTS)
def test_errors_of_real_renderings_fall_as_theory_says(subject: Subject, variant: str) -> None:
    """Within 4 standard errors, known from 16 degrees of freedom: other seeds would fail once in a thousand times."""
    needs(variant)
    told, _ = jobs(subject)
    some = [job for job in told if (job.stage, job.way, job.variant) == ("render", "independent", variant)]
    cells = [
        cell_from_repeats(job, [job.work(repeat) for repeat in range(5)]) for job in some if (job.samples or 0) <= 256
    ]
    (curve,) = curves(cells, subject.camera)
    assert curve.theory == -0.5
    assert curve.slope is not None
    assert curve.slope_deviation is not None
    assert curve.slope_deviation < 0.03
    assert abs(curve.slope + 0.5) < 4 * curve.slope_deviation


def test_every_sampler_method_and_way_is_measured(subject: Subject) -> None:
    told, left_out = jobs(subject)
    names = [job.name for job in told]
    assert len(set(names)) == len(names)
    assert {job.way for job in told if job.stage == "render"} == set(SAMPLERS)
    assert {"points, multijitter"} <= {job.way for job in told if job.stage == "calibrate"}
    assert {"information", "dual", "tiles"} <= {job.way for job in told if job.stage == "reconstruct"}
    assert all(one.why for one in left_out)
    counts = {job.samples for job in told if (job.stage, job.way) == ("render", "multijitter")}
    assert counts == {4, 16, 64, 256, 1024, 4096, 16384, None}
    needed = {(job.stage, job.way) for job in told if job.setting == AUTO}
    assert needed <= {
        ("render", "multijitter"),
        *(("calibrate", f"{how}, multijitter") for how in ("points", "transport")),
    }
    assert ("render", "multijitter") in needed
    assert work_of(4, "orthogonal").passes == 1


def test_as_many_samples_as_are_needed_leave_the_noise_alone(subject: Subject) -> None:
    """Rendering may add a tenth of the noise, H a tenth of all the rest, whatever the backend."""
    told, _ = jobs(subject)
    some = [job for job in told if job.setting == AUTO]
    assert some
    for job in some:
        found = job.work(0)
        assert found.mse is not None
        assert found.samples is not None
        assert found.samples >= 256
        assert found.mse < 1.1 * subject.floor, job.name


def test_without_noise_no_cell_takes_as_many_as_needed(here: Path) -> None:
    setup = opened(here / "tiny.toml", ["noise="])
    told, left_out = jobs(Subject(setup, reference(setup, here)))
    assert all(job.setting != AUTO for job in told)
    assert ["noise.variance above 0" in one.why for one in left_out if "auto" in one.what] == [True]


def test_light_and_h_of_a_cell_are_those_of_no_run(subject: Subject) -> None:
    """No stream of bench is one of the scene's: seeds differ from its own, between cells and between repeats."""
    seeds = {subject.seed(name, repeat) for name in ("a", "b") for repeat in range(5)}
    assert len(seeds) == 10
    assert subject.scene.render.seed not in seeds


@pytest.mark.parametrize(("name", "whether"), [("tile19", True), ("planoconvex", False), ("misaligned", True)])
def test_which_cameras_have_a_closed_form(name: str, whether: bool) -> None:
    assert opened(GALLERY / f"{name}.toml").has_closed_form == whether


def check(table: BenchTable, document: dict[str, object]) -> None:
    """The files say what the command printed, in the units and names that others read."""
    assert set(document) >= {"title", "fingerprint", "camera", "machine", "versions", "seconds", "cells", "curves"}
    assert set(document) >= {"recommended", "left_out"}
    assert json.loads(json.dumps(table.describe())) == document
    for one in table.cells:
        assert one.error.low <= one.error.median <= one.error.high
        assert one.repeats >= 3


@pytest.fixture
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two samplers with few samples: seconds on any machine."""
    monkeypatch.setattr("ommatid.bench.jobs.SAMPLES", (4, 16, 64))
    monkeypatch.setattr("ommatid.bench.jobs.SAMPLERS", ("independent", "ldsampler"))
    monkeypatch.setattr("ommatid.bench.precision.FORMS", {"information": FORMS["information"]})


@pytest.mark.usefixtures("few")
def test_the_command_writes_its_table_and_repeats_nothing(ommatid: Command, here: Path) -> None:
    ended = ommatid("bench", "tiny.toml", "-o", "out", "--seconds", "3600", "--json")
    assert ended.code == 0, ended.err
    table = read(here / "out" / JSON)
    check(table, json.loads(ended.out))
    assert {one.stage for one in table.cells} == {"render", "calibrate", "reconstruct"}
    assert not any(one.late for one in table.left_out)
    assert "information" in (here / "out" / CSV).read_text(encoding="utf-8")
    assert {path.name for path in (here / "out").iterdir()} == {JSON, CSV, *SHOWN}
    before = (here / "out" / JSON).stat().st_mtime_ns
    again = ommatid("bench", "tiny.toml", "-o", "out", "--set", "render.samples=64")
    assert (again.code, "up to date" in again.err) == (0, True), "its own samples are none of those measured"
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


def test_what_cannot_be_measured_is_refused(ommatid: Command, here: Path) -> None:
    for words, said in (
        (("bench", "missing.toml"), "no such scene file"),
        (("bench", str(GALLERY / "corridor.toml")), "flat targets"),
    ):
        ended = ommatid(*words, "-o", "out")
        assert (ended.code, said in ended.err) == (2, True), ended.err
    assert not (here / "out").exists()


@given(st.binary(max_size=60) | st.just(b"{}") | st.just(b'{"cells": 1e999}'))
@settings(max_examples=40)
def test_a_damaged_table_is_told_in_one_sentence(tmp_path_factory: pytest.TempPathFactory, content: bytes) -> None:
    path = tmp_path_factory.mktemp("damaged") / JSON
    path.write_bytes(content)
    with pytest.raises(InputError, match="make it again"):
        read(path)
