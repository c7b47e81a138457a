"""Dividing a time over the stages: against brute force, by clocks and curves that are told, never by this machine's."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ommatid.batch.remote import RunObserver
from ommatid.bench import table
from ommatid.pipeline import bench_curves
from ommatid.pipeline.time_allocation import NEGLIGIBLE, ErrorCurve, allocate_time, error_curve
from ommatid.pipeline.time_budget import KEYS, run_within, shared_time
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.output.time_spent import time_spent
from ommatid.runtime.progress import no_progress
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.units import duration

from ..bench.tables import bench_table, cell, exactly
from ..conftest import Command
from ..examples import scene


def positive(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log(low), np.log(high)).map(np.exp).map(float)


curves = st.builds(
    ErrorCurve,
    part=positive(1e-4, 1e2),
    samples=st.just(256),
    exponent=st.floats(0.5, 2.0),
    fixed=positive(1e-2, 5.0),
    each=positive(1e-6, 1e-2),
)


@settings(max_examples=60)
@given(curves, curves, positive(1e-3, 1e2), positive(1.0, 100.0))
def test_no_division_of_the_time_is_better(
    render: ErrorCurve, calibrate: ErrorCurve, floor: float, seconds: float
) -> None:
    """Every pair of numbers of samples on a grid four times as fine as the one that is searched."""
    most = 2**20
    found = allocate_time(render, calibrate, floor, seconds, (most, most))
    numbers = 256 * 2 ** np.arange(0, 12, 1 / 64)
    numbers = numbers[numbers <= most]
    taken = render.seconds(1) - render.each + numbers[:, None] * render.each
    taken = taken + calibrate.fixed + numbers[None, :] * calibrate.each
    error = floor + render.part * (256 / numbers[:, None]) ** render.exponent
    error = error + calibrate.part * (256 / numbers[None, :]) ** calibrate.exponent
    fits = taken <= seconds
    if found is None:
        assert not fits.any()
        return
    assert found.seconds <= seconds
    step = 2 ** (2.0 / 16)  # the most that a neighbour on the searched grid loses of either part
    assert found.predicted_mse <= error[fits].min() * (1 + NEGLIGIBLE) * step
    assert found.predicted_mse == pytest.approx(
        floor + render.error(found.render) + calibrate.error(found.calibrate), rel=1e-9
    )


def test_no_more_is_spent_than_brings_something() -> None:
    cheap = ErrorCurve(part=1.0, samples=256, exponent=1.5, fixed=0.1, each=1e-4)
    found = allocate_time(cheap, cheap, 100.0, 1e5, (2**24, 2**24))
    assert found is not None
    assert found.seconds < 1.0, "2 of 102 are left to win, and half a per cent is nothing"


@given(curves, st.integers(257, 4096))
def test_a_curve_is_found_again_from_two_of_its_points(law: ErrorCurve, more: int) -> None:
    ends = [(n, law.seconds(n), 7 * law.error(n)) for n in (256, more)]
    found = error_curve(ends[0], ends[1], law.error(more))
    for n in (300, 5000, 10**5):
        assert found.seconds(n) == pytest.approx(law.seconds(n), rel=1e-3, abs=1e-3)
        assert found.error(n) == pytest.approx(law.error(n), rel=1e-3)


def described(**tables: Any) -> Scene:
    told = {"samples": 64, "variant": "scalar_rgb", "sampler": "independent"}
    return scene((12, 12), (("1/3", [3, 3], [3, 3]),), render=told, noise={"variance": 1e-2}, **tables)


def within(folder: Path, one: Scene, seconds: float, clock: Callable[[], float]) -> tuple[dict[str, Any], list[str]]:
    said: list[str] = []
    folder.mkdir(exist_ok=True)
    watch = RunObserver(lambda _: nullcontext(no_progress), dict[str, bool]().__setitem__)
    return run_within(Setup.from_scene(one), folder, watch, seconds, said.append, clock), said


def ticking(step: float) -> Callable[[], float]:
    """A clock on which every look takes so long."""
    now = [0.0]

    def look() -> float:
        now[0] += step
        return now[0]

    return look


def test_where_the_least_does_not_fit_it_is_done_and_said(tmp_path: Path) -> None:
    description, said = within(tmp_path / "x", described(), 3.0, ticking(2.0))
    assert description["spent"]["chosen"] == dict.fromkeys(KEYS, 256)
    assert description["spent"]["seconds"] > 3.0
    assert len(said) == 1
    assert "of 3 s" in said[0]


def test_time_that_is_there_brings_more_samples_and_the_folder_repeats_it(tmp_path: Path) -> None:
    folder = tmp_path / "x"
    description, said = within(folder, described(), 6.0, ticking(1e-3))
    assert not said
    spent_on = description["spent"]
    assert spent_on["within"] == 6.0
    assert min(spent_on["chosen"].values()) >= 1024
    kept = read(folder / "scene.toml")
    assert (kept.render.samples, kept.calibration.samples) == tuple(spent_on["chosen"][key] for key in KEYS)
    assert json.loads((folder / "run.json").read_text("utf-8"))["spent"] == spent_on
    made = [folder / name for name in ("stack.exr", "model.npz", "estimate.exr")]
    before = [path.stat().st_mtime_ns for path in made]
    again, _ = within(folder, described(), 6.0, ticking(1e-3))
    assert again["spent"]["chosen"] == spent_on["chosen"]
    assert [path.stat().st_mtime_ns for path in made] == before, "nothing is done again"


def test_scenes_that_share_a_time_are_repeated_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares differ from run to run, what was asked does not; a scene that fails leaves its share to the others."""
    monkeypatch.setattr("ommatid.pipeline.stages.write_page", lambda *_: None)
    one, folders = described(), [tmp_path / name for name in ("fails", "a", "b")]
    watch = RunObserver(lambda _: nullcontext(no_progress), dict[str, bool]().__setitem__)

    def done(seconds: float, which: list[Path], later: float) -> list[dict[str, Any]]:
        does = shared_time(seconds, which, 0.0, lambda _: None, ticking(later))
        return [does(Setup.from_scene(one), folder, watch)["spent"] for folder in which if folder.name != "fails"]

    for folder in folders[1:]:
        folder.mkdir()
    first = done(0.9, folders, 1e-3)
    assert first[0]["within"] == pytest.approx(0.9 / 2, rel=0.01)
    before = [(folder / "stack.exr").stat().st_mtime_ns for folder in folders[1:]]
    assert done(0.9, folders, 2e-3) == first
    assert [(folder / "stack.exr").stat().st_mtime_ns for folder in folders[1:]] == before
    assert done(0.9, folders[1:2], 1e-3)[0]["within"] == pytest.approx(0.9, rel=0.01), "alone it has more"


def test_where_grids_fit_as_many_are_taken_as_are_needed(tmp_path: Path) -> None:
    one = described()
    one = one.model_copy(update={"render": one.render.model_copy(update={"sampler": "multijitter"})})
    description, _ = within(tmp_path / "x", one, 60.0, ticking(1e-3))
    assert description["spent"]["chosen"] == dict.fromkeys(KEYS, "auto")
    budget = description["error"]["budget"]
    assert budget["rendering"] + budget["calibration"] < 0.1 * description["error"]["predicted_mse"]


def benched(folder: Path, one: Scene, laws: dict[table.Stage, ErrorCurve], counts: tuple[int, ...]) -> None:
    """Write what `bench` would have measured if these laws were true."""
    ways = {"render": "independent", "calibrate": "points, independent"}
    cells = [
        cell(
            stage,
            way=ways[stage],
            variant="scalar_rgb",
            samples=n,
            seconds=exactly(law.seconds(n)),
            mse=exactly(law.error(n)),
        )
        for stage, law in laws.items()
        for n in counts
    ]
    # Cells with an adaptive number of samples are not part of a curve.
    adaptive = {"samples": 2**26, "setting": table.AUTO, "seconds": exactly(1e3), "mse": exactly(1e-3)}
    cells += [one.model_copy(update=adaptive) for one in cells[::2]]
    slopes = [
        table.ConvergenceCurve(
            stage=stage,
            way=ways[stage],
            variant="scalar_rgb",
            slope=-law.exponent / 2,
            slope_deviation=0.01,
            theory=None,
            why="",
            agrees=None,
        )
        for stage, law in laws.items()
    ]
    table.write(folder, bench_table(derive(one), cells, slopes))


def test_curves_of_bench_serve_the_same_camera_alone(tmp_path: Path) -> None:
    one = described()
    laws: dict[table.Stage, ErrorCurve] = {
        "render": ErrorCurve(0.5, 256, 1.0, 0.2, 1e-4),
        "calibrate": ErrorCurve(2.0, 256, 1.5, 0.4, 1e-3),
    }
    benched(tmp_path, one, laws, (256, 2**24))
    found = bench_curves.bench_error_curves(tmp_path / "x", Setup.from_scene(one))
    assert found is not None
    for law, read_again in zip(laws.values(), found, strict=True):
        assert read_again.exponent == law.exponent
        assert read_again.seconds(5000) == pytest.approx(law.seconds(5000))
        assert read_again.error(5000) == pytest.approx(law.error(5000), rel=1e-3)
    other = scene((14, 14), (("1/3", [3, 3], [3, 3]),))
    assert bench_curves.bench_error_curves(tmp_path / "x", Setup.from_scene(other)) is None


def test_curves_that_begin_at_few_samples_ask_for_no_fewer_than_have_been_taken(tmp_path: Path) -> None:
    """`bench` begins at 4 samples, which no scene can ask for; where noise hides the rest these are the cheapest."""
    one = described()
    flat = ErrorCurve(1e-9, 4, 1.0, 1e-3, 1e-6)
    benched(tmp_path, one, {"render": flat, "calibrate": flat}, (4, 2**14))
    description, _ = within(tmp_path / "x", one, 600.0, ticking(1e-3))
    assert min(description["spent"]["chosen"].values()) >= 256


def test_a_world_has_edges_where_no_grid_is(tmp_path: Path) -> None:
    """So 'auto', which knows no time, is not left to end there; the flat target above is."""
    shape = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale value="2.3"/>'
    glow = '<emitter type="area"><float name="radiance" value="0.5"/></emitter>'
    content = f'{shape}<translate x="0.3" y="0.4" z="990"/></transform>{glow}</shape>'
    (tmp_path / "world.xml").write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    one = described(world={"file": str(tmp_path / "world.xml")}, calibration={"method": "ideal"})
    one = one.model_copy(update={"render": one.render.model_copy(update={"sampler": "multijitter"})})
    description, _ = within(tmp_path / "x", one, 3.0, ticking(1e-3))
    assert "auto" not in description["spent"]["chosen"].values()


def test_every_run_says_what_more_would_buy(here: Path, ommatid: Command) -> None:
    ended = ommatid("run", "tiny.toml", "-o", "out")
    assert ended.code == 0, ended.err
    assert "error at most, in more time" in ended.out
    run = json.loads((here / "out/tiny/run.json").read_text("utf-8"))
    error, found = run["error"], run["spent"]
    assert found["seconds"] == pytest.approx(sum(stage["seconds"] for stage in run["stages"].values()))
    bought = [one["predicted_mse"] for one in found["more"]]
    assert error["predicted_mse"] > bought[0] > bought[1] > bought[2] > found["noise_alone"]
    assert found["noise_alone"] == pytest.approx(
        error["predicted_mse"] - error["budget"]["rendering"] - error["budget"]["calibration"]
    )
    report = RunReport.model_validate(run)
    assert time_spent(report.stages, report.error, calibrated=True) == report.spent


@pytest.mark.parametrize(("text", "seconds"), [("30s", 30.0), ("2 min", 120.0), ("0.5 h", 1800.0)])
def test_durations(text: str, seconds: float) -> None:
    assert duration(text) == pytest.approx(seconds)


@pytest.mark.parametrize("told", [["--within", "30"], ["--within", "soon"], ["--within", "3 s", "--workers", "2"]])
def test_what_is_no_time_is_refused(here: Path, ommatid: Command, told: list[str]) -> None:
    ended = ommatid("run", "tiny.toml", "-o", "out", *told)
    assert ended.code == 2
    assert "--within" in ended.err
    assert not (here / "out").exists()
