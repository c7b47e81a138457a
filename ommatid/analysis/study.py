"""One stack reconstructed several times, each time with another idea of H: what each costs, and what it promises."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.restore import restore
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, fingerprint, write_csv, write_text
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack

NUMBERS, TABLE = "study.json", "study.csv"
MISALIGNMENT = {"robust": "robust", "fitted": "fit"}  # of the estimator; of every other model "trust"
WORDS = {
    "ideal": "the ideal H on trust",
    "robust": "the ideal H, misalignment as more noise",
    "points": "H of rendered point sources",
    "transport": "H by transport",
    "fitted": "H found from the stack itself",
    "true": "the true H",
}


@dataclass(frozen=True)
class StudyCase:
    """What one idea of H gave: mean squared errors.

    predicted : Eq. 5;  expected : of this picture, which `low` and `high` hold 99 times in 100
    What is measured or for this picture is None without the truth, the latter also where it is not known.
    """

    model: str
    mse: float | None
    predicted: float
    expected: float | None
    low: float | None
    high: float | None
    seconds: float


def check_study(scene: Scene, camera: Camera) -> None:
    """Raise InputError where a study names what this camera cannot be reconstructed with, before any work."""
    for name in () if scene.study is None else scene.study.models:
        how = MISALIGNMENT.get(name, "trust")
        told = scene.estimator.model_copy(update={"misalignment": how})
        choose_method(scene.model_copy(update={"estimator": told}), camera, camera.has_box_footprints)
        if name == "true" and camera.tolerance is not None and not camera.has_sharp_footprints:
            raise InputError(
                f"{scene.source}: study.models: the 'true' H of misaligned lenses with surfaces or blur has no closed"
                " form; leave it out"
            )


def study_case(
    stack: Stack, name: str, model: Model, truth: NDArray[np.float64] | None, progress: Progress = no_progress
) -> StudyCase:
    """Reconstruct a stack with one idea of H. Raises what reconstruction raises."""
    told = stack.scene.estimator.model_copy(update={"misalignment": MISALIGNMENT.get(name, "trust")})
    stack = replace(stack, scene=stack.scene.model_copy(update={"estimator": told}))
    found = restore(stack, model, truth, None, progress)
    given = found.interval
    return StudyCase(
        model=name,
        mse=None if found.error is None else found.error.mse,
        predicted=found.expected.mse,
        expected=None if given is None else given.mse,
        low=None if given is None else given.low,
        high=None if given is None else given.high,
        seconds=found.seconds,
    )


def cached_study(
    folder: Path,
    stack: Stack,
    models: Mapping[str, Callable[[], Model]],
    truth: NDArray[np.float64] | None,
    progress: Progress = no_progress,
) -> tuple[list[dict[str, Any]], bool]:
    """The cases of a study in JSON's types, and whether they had to be made; study.json and study.csv hold them.

    models : by name, made only where they are needed
    """
    wanted = fingerprint([list(models), stack.record, stack.scene.plain(), truth is not None])

    def make() -> list[StudyCase]:
        cases: list[StudyCase] = []
        for name, model in models.items():
            cases.append(study_case(stack, name, model(), truth))
            progress(len(cases) / len(models))
        return cases

    def write(folder: Path, cases: list[StudyCase]) -> None:
        write_csv(folder / TABLE, [field.name for field in fields(StudyCase)], (astuple(case) for case in cases))
        document = {"fingerprint": wanted, "cases": [asdict(case) for case in cases]}
        write_text(folder / NUMBERS, json.dumps(document, indent=2) + "\n")

    return cached(folder, wanted, _read_study, make, write)


def _read_study(folder: Path) -> tuple[list[dict[str, Any]], str | None]:
    """The cases in study.json, and its fingerprint if study.csv is there too."""
    document: dict[str, Any] = json.loads((folder / NUMBERS).read_text(encoding="utf-8"))
    return list(document["cases"]), document["fingerprint"] if (folder / TABLE).is_file() else None


def rows(cases: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """The lines of the printed table."""
    lines: list[tuple[str, str]] = []
    for case in cases:
        told = f"predicted {case['predicted']:.4g}"
        if case["mse"] is not None:
            told = f"mean squared error {case['mse']:.4g}, {told}"
        if case["mse"] is not None and case["low"] is not None:
            within = "inside" if case["low"] <= case["mse"] <= case["high"] else "OUTSIDE"
            told += f"; for this picture {case['expected']:.4g}, {within} {case['low']:.4g} to {case['high']:.4g}"
        lines.append((WORDS[case["model"]], told))
    return lines
