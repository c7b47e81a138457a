"""What a run's page says would reduce its error, against runs with these changes."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.analysis.averaging_kernel import error_window
from ommatid.analysis.design import with_lens
from ommatid.analysis.next_steps import NextStep, best_other_type, next_steps
from ommatid.analysis.predict import predict_scene
from ommatid.reconstruct.output.result_files import reconstruct
from ommatid.reconstruct.output.run_json import RunReport, StageReport, VerdictReport
from ommatid.reconstruct.output.verdict_words import limit
from ommatid.scenes.recording import expected_recording
from ommatid.scenes.scene import Scene, parse

from ..examples import THREE, Lenses, not_none, scene
from ..page.runs import record

IMAGE = np.add.outer(np.linspace(60, 180, 19), np.linspace(0, 40, 19))
LENSES: Lenses = tuple((magnification, array, "fit") for magnification, array, _ in THREE)


def run_of(lenses: Lenses = LENSES, **noise: Any) -> tuple[Scene, RunReport]:
    described = scene((19, 19), lenses, noise=noise)
    return described, report_of(described)


def report_of(described: Scene) -> RunReport:
    """The report of a run, taken for trusted: these tests concern its predictions."""
    stack, model = record(described, IMAGE)
    report = reconstruct(stack, model, IMAGE.ravel(), (Path("stack"), Path("model")))[1]
    return report.with_changes(verdict=VerdictReport(trusted=True, reasons=()))


def step_of(report: RunReport, words: str) -> NextStep:
    [step] = [step for step in next_steps(report) if words in step.change]
    return step


def test_half_the_noise_brings_at_least_what_is_said_and_hardly_more() -> None:
    report = run_of(variance=4.0)[1]
    again = run_of(variance=2.0)[1].error
    said = step_of(report, "half the noise variance")
    assert said.is_bound
    # The error is concave in the noise variance, and its slope there is the part of the noise (envelope theorem): the
    # tangents at both ends enclose the gain.
    gain = report.error.predicted_mse - again.predicted_mse
    least, most = report.error.budget["noise"] / 2, again.budget["noise"]
    assert report.error.predicted_mse - said.mse == pytest.approx(least, rel=1e-12)
    assert least <= gain <= most
    assert most < 1.5 * least, "else this test could not tell the gain from half of it"


def test_one_more_bit_brings_at_least_what_is_said() -> None:
    report = run_of(variance=1e-6, bits=8)[1]
    again = run_of(variance=1e-6, bits=9)[1].error
    said = step_of(report, "half the quantisation step")
    assert again.predicted_mse <= said.mse
    slack = 3 * again.budget["quantisation"] - 0.75 * report.error.budget["quantisation"]  # tangents, as above
    assert said.mse - again.predicted_mse <= slack + 1e-12


def exposed(gain: float, bits: int) -> RunReport:
    """The report of a run with a [sensor] of 5 electrons per unit of f."""
    sensor = {"illuminance": "500 lux", "exposure": "1 ms", "full_well": 2000, "read_noise": 30}
    plain: dict[str, Any] = scene((19, 19), LENSES).plain() | {"sensor": sensor | {"gain": gain, "bits": bits}}
    plain["camera"]["wavelength"] = "none"
    for lens in plain["camera"]["lens"]:
        lens |= {"aperture": "0.1 mm", "focus": "1 m"}
    described = parse(plain, Path("test.toml"))
    stack, model = record(described, IMAGE)
    response = np.full(stack.values.size, 5.0)
    recording = expected_recording(not_none(described.sensor), stack.camera, response, model.forward(IMAGE))
    stack = replace(stack, values=recording.values, recording=recording)
    report = reconstruct(stack, model, IMAGE.ravel(), (Path("stack"), Path("model")))[1]
    return report.with_changes(verdict=VerdictReport(trusted=True, reasons=()))


def test_half_the_step_of_a_sensor_is_twice_its_gain_with_one_more_bit() -> None:
    report, again = exposed(0.01, 5), exposed(0.02, 6).error
    said = step_of(report, "half the quantisation step")
    assert said.how == "one more of `noise.bits`, or `sensor.gain` doubled with one more of `sensor.bits`"
    assert again.predicted_mse <= said.mse
    slack = 3 * again.budget["quantisation"] - 0.75 * report.error.budget["quantisation"]  # tangents, as above
    assert said.mse - again.predicted_mse <= slack
    assert exposed(0.01, 6).error.budget == pytest.approx(report.error.budget), "bits alone change nothing"
    changed = report.with_changes(error=report.error.model_copy(update={"budget": {"quantisation": 1.0}}))
    assert f"; {said.change} ({said.how}): RMS" in limit(changed)


def test_another_lens_type_brings_what_the_prediction_says() -> None:
    lenses: Lenses = (("1/3", [3, 3], "fit"), ("1/4", [4, 4], "fit"))
    described = scene((19, 19), lenses, noise={"variance": 1.0}, prior={"level": "known"})
    (stack, model), report = record(described, IMAGE), report_of(described)
    window = not_none(error_window(stack, model, IMAGE, report))
    other = not_none(best_other_type(described, window))
    tried = [Fraction(1, 2), Fraction(1, 5)]  # those with the finest pixels that the camera does not have
    after = {ratio: predict_scene(with_lens(described, ratio), rays=False) for ratio in tried}
    assert other.magnification == min(tried, key=lambda ratio: after[ratio].mse)
    chosen, before = after[other.magnification], predict_scene(described, rays=False)
    assert other.ratio == pytest.approx(chosen.mse / before.mse, rel=1e-6)
    assert other.measurements == chosen.measurements - before.measurements
    step = next(step for step in next_steps(report, other) if "lens type" in step.change)
    assert step.mse == pytest.approx(chosen.mse, rel=1e-3)


def test_a_camera_without_a_closed_form_is_not_compared_with_other_types() -> None:
    described, report = run_of(variance=1.0)
    stack, model = record(described, IMAGE)
    window = not_none(error_window(stack, model, IMAGE, report))
    plain = described.plain()
    plain["camera"]["lens"][0] |= {"aperture": "0.4 mm", "focus": "600 mm"}
    assert best_other_type(parse(plain, described.source), window) is None


def test_steps_are_ranked_by_their_gain_and_small_ones_left_out() -> None:
    report = run_of(variance=4.0)[1]
    now = report.error.predicted_mse
    budget = {"noise": 0.5 * now, "quantisation": 0.06 * now, "rendering": 0.4 * now, "calibration": 0.04 * now}
    times = {"render": 1.0, "calibrate": 0.5, "reconstruct": 0.25}
    stages = {name: StageReport(seconds=seconds, sampler="independent") for name, seconds in times.items()}
    changed = report.with_changes(error=report.error.model_copy(update={"budget": budget}), stages=stages)
    by_samples = changed.error.model_copy(update={"budget": {"rendering": 0.9 * now}})
    sampled = changed.with_changes(error=by_samples)
    assert "; four times the samples (`render.samples`): RMS" in limit(sampled)
    steps = next_steps(changed)
    assert [step.change for step in steps] == ["four times the samples", "half the noise variance"]
    assert (steps[0].mse, steps[0].seconds) == (pytest.approx((0.56 + 0.44 / 4) * now), 1.75 + 3 * 1.5)
    assert steps[0].how == "`render.samples` and `calibration.samples`"
    assert steps[1].mse == pytest.approx(0.75 * now)
    noisy = changed.with_changes(model=changed.model.model_copy(update={"spurious_information": 0.097}))
    assert [step.change for step in next_steps(noisy)] == ["half the noise variance"]
    assert limit(sampled.with_changes(model=noisy.model)).endswith("of the predicted MSE")
    wrong = changed.with_changes(verdict=VerdictReport(trusted=False, reasons=("H is another camera's",)))
    assert next_steps(wrong) == []
