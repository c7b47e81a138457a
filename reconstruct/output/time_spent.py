"""What a run took, and what more samples would buy: from its error budget, nothing is computed anew."""

from __future__ import annotations

from typing import Any

FALL = {"independent": 1.0}  # exponents of a part of the error against samples, by sampler: theory's
STRATIFIED = 1.5  # of all other samplers; pinholes
MORE = (2, 4, 16)  # times the samples, of which it is said what they would buy
STAGES = {"render": "rendering", "calibrate": "calibration"}  # and their parts of the error budget


def spent(description: dict[str, Any], calibrated: bool) -> dict[str, Any]:
    """Of a run as run.json describes it; `calibrated`: whether H took samples.

    seconds : of all stages, when they were done;  noise_alone : the expected error without the parts of both stages
    more : the expected seconds and error of so many times the samples of both, with the exponents of theory
    Both errors are those of the estimator as it is; told of the smaller noise it does better, most where much of its
    error is what the lens types hardly see.
    """
    stages, error = description["stages"], description["error"]
    taken = {name: float(stage.get("seconds", 0.0)) for name, stage in stages.items()}
    parts = {stage: error["budget"][part] for stage, part in STAGES.items()}
    sampler = stages["render"].get("sampler")
    rest = error["predicted_mse"] - sum(parts.values())
    found: dict[str, Any] = {"seconds": sum(taken.values()), "stages": taken, "noise_alone": rest}
    if sampler is None:  # recorded frames
        return found
    fall = FALL.get(sampler, STRATIFIED)
    grows = taken["render"] + (taken["calibrate"] if calibrated else 0.0)
    found["more"] = [
        {
            "times": times,
            "seconds": found["seconds"] + (times - 1) * grows,
            "predicted_mse": rest + sum(part * times**-fall for part in parts.values()),
        }
        for times in MORE
    ]
    return found
