"""Stages beside those that compute, in the times of a run."""

from __future__ import annotations

import pytest

from ommatid.reconstruct.output.run_json import PAGE, RunReport

from ..runs import report_of

BUDGET = {"null_space": 0.0, "noise": 1.0, "quantisation": 0.0, "rendering": 0.5, "calibration": 0.25, "detail": 0.0}


def timed(**spent: object) -> RunReport:
    """A report of 3.5 s in three stages, with these fields of its times."""
    stages = {
        "render": {"seconds": 2.0, "samples": 64, "sampler": "multijitter"},
        "calibrate": {"seconds": 1.0, "method": "points"},
        "reconstruct": {"seconds": 0.5},
    }
    return report_of(stages=stages, error={"predicted_mse": 1.75, "budget": BUDGET}, spent=spent)


def test_every_stage_counts_in_the_total_and_those_that_sample_in_the_time_with_more_samples() -> None:
    """Twice the samples take twice the 3 s of the stages that take samples, and 0.5 s as before."""
    report = timed().with_times(files=0.25, start_up=0.3).with_stage(PAGE, 0.75)
    assert report.seconds == pytest.approx(4.5)
    assert list(report.stages) == ["render", "calibrate", "reconstruct", "files", "page"]
    assert report.more_samples[0].seconds == pytest.approx(2 * 3 + 0.5)
    assert report.more_samples[0].predicted_mse == pytest.approx(1 + 0.75 * 2**-1.5)
    assert (report.noise_alone, report.spent.start_up) == (1.0, 0.3)


def test_a_time_limit_keeps_the_time_of_all_its_trials() -> None:
    report = timed(within=20.0, seconds=17.0, chosen={"render.samples": 64}).with_stage(PAGE, 0.75)
    assert (report.spent.within, report.spent.seconds, report.spent.chosen) == (20.0, 17.0, {"render.samples": 64})


@pytest.mark.parametrize("spent", [{}, {"within": 20.0, "seconds": 17.0}], ids=["plain", "time limit"])
def test_the_report_of_the_stages_is_the_same_whatever_time_files_and_page_took(spent: dict[str, float]) -> None:
    report = timed(**spent)
    for files, page in ((0.25, 0.75), (0.5, 1.0)):
        assert report.with_times(files, 0.3).with_stage(PAGE, page).of_stages().plain() == report.plain()
    assert report.with_stage("study", 0.5).of_stages().plain() != report.plain()
