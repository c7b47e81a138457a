"""Stages beside those that compute, in the times of a run."""

from __future__ import annotations

import pytest

from ommatid.reconstruct.output.run_json import (
    PAGE,
    RunReport,
    StageReport,
    TimeReport,
    of_stages,
    time_spent,
    with_stage,
    with_times,
)

from ..runs import report_of

BUDGET = {"null_space": 0.0, "noise": 1.0, "quantisation": 0.0, "rendering": 0.5, "calibration": 0.25, "detail": 0.0}


def timed(**spent: object) -> RunReport:
    """A report of 3.5 s in three stages, with these fields of its times."""
    stages = {
        "render": StageReport(seconds=2.0, samples=64, sampler="multijitter"),
        "calibrate": StageReport(seconds=1.0, method="points"),
        "reconstruct": StageReport(seconds=0.5),
    }
    report = report_of(
        stages={name: stage.plain() for name, stage in stages.items()}, error={"predicted_mse": 1.75, "budget": BUDGET}
    )
    times = time_spent(stages, report.error, calibrated=True)
    return report.with_changes(spent=TimeReport.model_validate({**times.plain(), **spent}))


def test_every_stage_counts_in_the_total_and_in_the_time_with_more_samples() -> None:
    """Twice the samples take twice the 3 s of the stages that take samples, and 0.5 s as before."""
    report = with_times(timed(), files=0.25, page=0.75, start_up=0.3)
    assert report.spent.seconds == pytest.approx(4.5)
    assert report.spent.stages == {"render": 2.0, "calibrate": 1.0, "reconstruct": 0.5, "files": 0.25, "page": 0.75}
    assert report.spent.more[0].seconds == pytest.approx(2 * 3 + 0.5)
    assert report.spent.start_up == 0.3


def test_a_time_limit_keeps_the_time_of_all_its_trials() -> None:
    report = with_stage(timed(within=20.0, seconds=17.0, chosen={"render.samples": 64}), PAGE, 0.75)
    assert (report.spent.within, report.spent.seconds, report.spent.chosen) == (20.0, 17.0, {"render.samples": 64})


@pytest.mark.parametrize("spent", [{}, {"within": 20.0, "seconds": 17.0}], ids=["plain", "time limit"])
def test_the_report_of_the_stages_is_the_same_whatever_time_files_and_page_took(spent: dict[str, float]) -> None:
    report = timed(**spent)
    for files, page in ((0.25, 0.75), (0.5, 1.0)):
        assert of_stages(with_times(report, files, page, start_up=0.3)).plain() == report.plain()
    assert of_stages(with_stage(report, "study", 0.5)).plain() != report.plain()
