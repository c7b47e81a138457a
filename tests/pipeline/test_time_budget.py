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
from ommatid.pipeline import stages
from ommatid.pipeline.time_budget import FEW, KEYS, TimeBudget, allocate
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


PAIRS = st.tuples(positive(1e-4, 1e2), positive(1e-4, 1e2))


@settings(max_examples=100)
@given(PAIRS, PAIRS, positive(1e-3, 1e3), st.sampled_from((1.0, 1.5)))
def test_no_allocation_is_better(parts: Any, times: Any, seconds: float, fall: float) -> None:
    """Every pair of factors of at least 1 that takes the whole time."""
    first, second = allocate(parts, times, seconds, fall)
    assert min(first, second) >= 1
    if sum(times) >= seconds:
        return
    assert first * times[0] + second * times[1] == pytest.approx(seconds)
    x = np.geomspace(1, (seconds - times[1]) / times[0], 1000)
    y = (seconds - x * times[0]) / times[1]
    least = float((parts[0] * x**-fall + parts[1] * np.maximum(y, 1.0) ** -fall).min())
    assert parts[0] * first**-fall + parts[1] * second**-fall <= least * (1 + 1e-9)


def test_a_stage_without_samples_takes_no_time() -> None:
    assert allocate((1.0, 0.0), (2.0, 0.0), 10.0, 1.0) == (5.0, 1.0)


# --- runs


def setup_of(sampler: str = "independent", samples: int = 64, **tables: Any) -> Setup:
    render = {"samples": samples, "variant": "scalar_rgb", "sampler": sampler}
    return Setup.from_scene(
        scene((12, 12), (("1/3", [3, 3], [3, 3]),), render=render, noise={"variance": 1e-2}, **tables)
    )


OBSERVER = RunObserver(lambda _: nullcontext(no_progress), lambda _stage, _done: None)


def within(folder: Path, setup: Setup, seconds: float, clock: Callable[[], float]) -> tuple[dict[str, Any], list[str]]:
    """Description of a run within a time, and its messages."""
    messages: list[str] = []
    folder.mkdir(exist_ok=True)
    return TimeBudget(seconds, [folder], clock(), messages.append, clock)(setup, folder, OBSERVER), messages


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
    """A run of as many samples without a time limit then makes nothing again, but has none of the limit's times."""
    folder = tmp_path / "x"
    description, messages = within(folder, setup_of(), 3.0, ticking(2.0))
    assert description["spent"]["chosen"] == dict.fromkeys(KEYS, FEW)
    assert description["spent"]["seconds"] > 3.0
    [message] = messages
    assert "of 3 s with 256 and 256 samples per pixel, the fewest possible" in message
    before = stamps(folder)
    spent = stages.run(setup_of(samples=FEW, calibration={"samples": FEW}), folder, OBSERVER)["spent"]
    assert (stamps(folder), spent.keys() & {"within", "asked", "seconds", "chosen"}) == (before, set())


@pytest.mark.slow
def test_more_time_brings_more_samples_and_a_repeated_run_keeps_them(tmp_path: Path) -> None:
    folder = tmp_path / "x"
    description, messages = within(folder, setup_of(), 6.0, ticking(1e-3))
    assert not messages
    spent = description["spent"]
    assert spent["within"] == 6.0
    assert max(spent["chosen"].values()) >= 2 * FEW
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
        stages = TimeBudget(0.9, folders, 0.0, lambda _: None, ticking(step))
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
