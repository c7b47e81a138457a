"""Runs within a given time, with given clocks and cost curves, so that nothing depends on this machine's speed."""

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
from ommatid.pipeline.time_allocation import (
    NEGLIGIBLE,
    STEPS,
    ErrorCurve,
    allocate_time,
    error_curve,
)
from ommatid.pipeline.time_budget import FEW, KEYS, MORE, run_within, shared_time
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.runtime.progress import no_progress
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.units import DURATION

from ..conftest import Command
from ..examples import scene

# --- allocation


def positive(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(np.log(low), np.log(high)).map(np.exp).map(float)


CURVES = st.builds(
    ErrorCurve,
    part=positive(1e-4, 1e2),
    samples=st.just(256),
    exponent=st.floats(0.5, 2.0),
    fixed=positive(1e-2, 5.0),
    each=positive(1e-6, 1e-2),
)


@settings(max_examples=60)
@given(CURVES, CURVES, positive(1e-3, 1e2), positive(1.0, 100.0))
def test_no_allocation_is_better(render: ErrorCurve, calibrate: ErrorCurve, floor: float, seconds: float) -> None:
    """Every pair of numbers of samples on a grid four times as fine as the one that is searched."""
    most = 2**20
    allocation = allocate_time(render, calibrate, floor, seconds, (most, most))
    samples = 256 * 2 ** np.arange(0, 12 + 1e-9, 1 / (4 * STEPS))
    n, k = samples[:, None], samples[None, :]
    time = render.fixed + n * render.each + calibrate.fixed + k * calibrate.each
    error = floor + render.part * (256 / n) ** render.exponent + calibrate.part * (256 / k) ** calibrate.exponent
    fits = time <= seconds
    if allocation is None:
        assert not fits.any()
        return
    assert allocation.seconds <= seconds
    step = 2 ** (2.0 / STEPS)  # the largest factor between neighbours of the searched grid, at the steepest exponent
    assert allocation.predicted_mse <= error[fits].min() * (1 + NEGLIGIBLE) * step
    assert allocation.predicted_mse == pytest.approx(
        floor + render.error(allocation.render) + calibrate.error(allocation.calibrate), rel=1e-9
    )


def test_no_time_is_used_for_a_negligible_gain() -> None:
    cheap = ErrorCurve(part=1.0, samples=256, exponent=1.5, fixed=0.1, each=1e-4)
    allocation = allocate_time(cheap, cheap, 100.0, 1e5, (2**24, 2**24))
    assert allocation is not None
    assert allocation.seconds < 1.0, "at most 2 of 102 can be gained, and half a percent is negligible"


@given(CURVES, st.integers(257, 4096))
def test_a_curve_is_recovered_from_two_of_its_points(law: ErrorCurve, more: int) -> None:
    points = [(n, law.seconds(n), 7 * law.error(n)) for n in (256, more)]
    curve = error_curve(points[0], points[1], law.error(more))
    for n in (300, 5000, 10**5):
        # Rounding of the seconds, 1e-15 of 5 s, is multiplied by n / (more - 256), up to 1e5, relative to 1e-2 s.
        assert curve.seconds(n) == pytest.approx(law.seconds(n), rel=1e-7)
        assert curve.error(n) == pytest.approx(law.error(n), rel=1e-7)


# --- runs


def setup_of(sampler: str = "independent", **tables: Any) -> Setup:
    render = {"samples": 64, "variant": "scalar_rgb", "sampler": sampler}
    return Setup.from_scene(
        scene((12, 12), (("1/3", [3, 3], [3, 3]),), render=render, noise={"variance": 1e-2}, **tables)
    )


OBSERVER = RunObserver(lambda _: nullcontext(no_progress), lambda _stage, _done: None)


def within(folder: Path, setup: Setup, seconds: float, clock: Callable[[], float]) -> tuple[dict[str, Any], list[str]]:
    """Description of a run within a time, and its messages."""
    messages: list[str] = []
    folder.mkdir(exist_ok=True)
    return run_within(setup, folder, OBSERVER, seconds, messages.append, clock), messages


def ticking(step: float) -> Callable[[], float]:
    """A clock that advances by `step` whenever it is read."""
    now = [0.0]

    def read_clock() -> float:
        now[0] += step
        return now[0]

    return read_clock


def stamps(folder: Path) -> list[int]:
    return [(folder / name).stat().st_mtime_ns for name in ("stack.exr", "model.npz", "estimate.exr")]


def test_the_fewest_samples_are_taken_and_reported_if_they_take_too_long(tmp_path: Path) -> None:
    description, messages = within(tmp_path / "x", setup_of(), 3.0, ticking(2.0))
    assert description["spent"]["chosen"] == dict.fromkeys(KEYS, FEW)
    assert description["spent"]["seconds"] > 3.0
    [message] = messages
    assert "of 3 s with 256 and 256 samples per pixel, the fewest possible" in message


@pytest.mark.slow
def test_more_time_brings_more_samples_and_a_repeated_run_keeps_them(tmp_path: Path) -> None:
    folder = tmp_path / "x"
    description, messages = within(folder, setup_of(), 6.0, ticking(1e-3))
    assert not messages
    spent = description["spent"]
    assert spent["within"] == 6.0
    assert min(spent["chosen"].values()) >= MORE
    written = read(folder / "scene.toml")
    assert (written.render.samples, written.calibration.samples) == tuple(spent["chosen"][key] for key in KEYS)
    assert json.loads((folder / "run.json").read_text("utf-8"))["spent"] == spent
    before = stamps(folder)
    repeated, _ = within(folder, setup_of(), 6.0, ticking(1e-3))
    assert repeated["spent"]["chosen"] == spent["chosen"]
    assert stamps(folder) == before, "nothing is made again"


@pytest.mark.slow
def test_scenes_with_a_common_time_are_repeated_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares differ from run to run, but not the request; a scene that fails leaves its share to the others."""
    monkeypatch.setattr("ommatid.pipeline.stages.write_page", lambda *_: None)
    folders = [tmp_path / name for name in ("fails", "a", "b")]

    def run(folders: list[Path], step: float) -> list[dict[str, Any]]:
        stages = shared_time(0.9, folders, 0.0, lambda _: None, ticking(step))
        return [stages(setup_of(), folder, OBSERVER)["spent"] for folder in folders if folder.name != "fails"]

    for folder in folders[1:]:
        folder.mkdir()
    first = run(folders, 1e-3)
    assert first[0]["within"] == pytest.approx((0.9 - 1e-3) / 2), "the clock has been read once"
    before = [stamps(folder) for folder in folders[1:]]
    assert run(folders, 2e-3) == first
    assert [stamps(folder) for folder in folders[1:]] == before
    assert run(folders[1:2], 1e-3)[0]["within"] == 0.9, "alone it has all of the time"


@pytest.mark.slow
def test_samples_are_adaptive_where_grids_fit_the_pixels(tmp_path: Path) -> None:
    description, _ = within(tmp_path / "x", setup_of("multijitter"), 60.0, ticking(1e-3))
    assert description["spent"]["chosen"] == dict.fromkeys(KEYS, "auto")
    budget = description["error"]["budget"]
    assert budget["rendering"] + budget["calibration"] < 0.1 * description["error"]["predicted_mse"]


@pytest.mark.slow
def test_samples_of_a_world_are_not_adaptive(tmp_path: Path) -> None:
    """A world has edges inside pixels, where 'auto', which has no time limit, would take too long."""
    shape = '<shape type="rectangle"><transform name="to_world"><rotate y="1" angle="180"/><scale value="2.3"/>'
    glow = '<emitter type="area"><float name="radiance" value="0.5"/></emitter>'
    content = f'{shape}<translate x="0.3" y="0.4" z="990"/></transform>{glow}</shape>'
    (tmp_path / "world.xml").write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    setup = setup_of("multijitter", world={"file": str(tmp_path / "world.xml")}, calibration={"method": "ideal"})
    description, _ = within(tmp_path / "x", setup, 3.0, ticking(1e-3))
    assert "auto" not in description["spent"]["chosen"].values()


# --- commands


def test_every_run_reports_the_gain_from_more_time(here: Path, ommatid: Command) -> None:
    ended = ommatid("run", "tiny.toml", "-o", "out")
    assert ended.code == 0, ended.err
    assert "in more time" not in ended.out, "the verdict comes first: more samples are no remedy that is certain"
    run = RunReport.model_validate_json((here / "out/tiny/run.json").read_bytes())
    error = run.error
    errors = [more.predicted_mse for more in run.more_samples]
    assert error.predicted_mse > errors[0] > errors[1] > errors[2] > run.noise_alone
    assert run.noise_alone == pytest.approx(
        error.predicted_mse - error.budget["rendering"] - error.budget["calibration"]
    )


def test_times_are_read_and_wrong_ones_refused(here: Path, ommatid: Command) -> None:
    assert [DURATION.read(text) for text in ("30s", "2 min", "0.5 h")] == pytest.approx([30.0, 120.0, 1800.0])
    for options in (["--within", "30"], ["--within", "soon"], ["--within", "3 s", "--workers", "2"]):
        ended = ommatid("run", "tiny.toml", "-o", "out", *options)
        assert (ended.code, "--within" in ended.err) == (2, True)
    assert not (here / "out").exists()
