"""The time that a run took, and the error that more samples would reach, from its error budget alone."""

from __future__ import annotations

from collections.abc import Mapping

from .run_json import ErrorReport, MoreTime, RunReport, StageReport, TimeReport

INDEPENDENT = 1.0  # variance of independent samples falls as 1 / samples
STRATIFIED = 1.5  # that of all other samplers as samples^-1.5, for pinholes
MORE = (2, 4, 16)  # factors on the number of samples
FILES, PAGE = "files", "page"  # stages beside those that compute: reading, checking and writing files; the report
STAGES = {"render": "rendering", "calibrate": "calibration"}  # to their parts of the error budget


def time_spent(stages: Mapping[str, StageReport], error: ErrorReport, *, calibrated: bool) -> TimeReport:
    """Return the seconds of a run and what more samples would cost and bring.

    calibrated : whether H took samples
    Errors with more samples are those of the estimator as it is. An estimator that expects the smaller noise does
    better, most of all where much of its error is in components that the lens types hardly measure.
    """
    seconds = {name: stage.seconds for name, stage in stages.items()}
    parts = [error.budget[part] for part in STAGES.values()]
    rest, total = error.predicted_mse - sum(parts), sum(seconds.values())
    sampler = stages["render"].sampler
    if sampler is None:  # recorded frames
        return TimeReport(seconds=total, stages=seconds, noise_alone=rest)
    fall = INDEPENDENT if sampler == "independent" else STRATIFIED
    growing = seconds["render"] + (seconds["calibrate"] if calibrated else 0.0)
    more = tuple(
        MoreTime(
            times=times,
            seconds=total + (times - 1) * growing,
            predicted_mse=rest + sum(part * times**-fall for part in parts),
        )
        for times in MORE
    )
    return TimeReport(seconds=total, stages=seconds, noise_alone=rest, more=more)


def with_stage(report: RunReport, name: str, seconds: float) -> RunReport:
    """Return a report with the time of one more stage, which changes none of its other numbers."""
    return _with_stages(report, {**report.stages, name: StageReport(seconds=seconds)})


def before_page(report: RunReport) -> RunReport:
    """Return a report as it was before the time of its page was added."""
    stages = {name: stage for name, stage in report.stages.items() if name != PAGE}
    return report if PAGE not in report.stages else _with_stages(report, stages)


def _with_stages(report: RunReport, stages: dict[str, StageReport]) -> RunReport:
    spent = time_spent(stages, report.error, calibrated=report.stages["calibrate"].method != "ideal")
    asked = report.spent.model_dump(include={"within", "asked", "chosen", "start_up"}, exclude_unset=True)
    if report.spent.within is not None:
        asked["seconds"] = report.spent.seconds  # of all trials together
    return report.with_changes(stages=stages, spent=TimeReport.model_validate({**spent.plain(), **asked}))


def without_page(report: RunReport) -> dict[str, object]:
    """Return the content of run.json that does not depend on the time that the page took."""
    content = report.plain()
    content["stages"].pop(PAGE, None)
    content["spent"]["stages"].pop(PAGE, None)
    if report.spent.within is None:
        del content["spent"]["seconds"]
    for more in content["spent"].get("more", ()):
        del more["seconds"]
    return content
