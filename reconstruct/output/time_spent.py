"""The time that a run took, and the error that more samples would reach, from its error budget alone."""

from __future__ import annotations

from collections.abc import Mapping

from .run_json import ErrorReport, MoreTime, StageReport, TimeReport

INDEPENDENT = 1.0  # variance of independent samples falls as 1 / samples
STRATIFIED = 1.5  # that of all other samplers as samples^-1.5, for pinholes
MORE = (2, 4, 16)  # factors on the number of samples
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
