"""Time and precision of the estimator's forms on the same problems."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import numpy as np

from ommatid.reconstruct.estimator.certificate import ExactResiduals, refine
from ommatid.reconstruct.estimator.estimate import FORMS
from ommatid.reconstruct.forms.form import Form, NotSolvableError
from ommatid.reconstruct.prior import independent
from ommatid.reconstruct.problem import Problem
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix

NOISE = 1e-6
CASES = (
    ("tile19", (), "three types"),
    ("tile19", ("I", "II"), "two types"),
    ("tile35", (), "three types"),
    ("tile35", ("I", "II"), "two types"),
    ("tile41", (), "three types"),
    ("tile41", ("I", "II"), "two types"),
)
REPEATS = 3
LONG = 5.0  # seconds, from which on there is a single repeat
REFERENCE = "square-root-information"  # its variances agree with those of the dual form to 12 digits here


@dataclass(frozen=True)
class FormRow:
    """Seconds to factorise, to solve, and to solve and certify; correct digits unrefined, refined, and of variances."""

    unknowns: int
    measurements: int
    lenses: str
    form: str
    seconds: tuple[float, float, float] | None
    digits: tuple[float, float, float] | None
    failed: str = ""


def form_rows(gallery: Path) -> list[FormRow]:
    """Return every form on every case, in alternation within a case."""
    return [row for name, lenses, label in CASES for row in _case(gallery / f"{name}.toml", lenses, label)]


def _case(path: Path, lenses: tuple[str, ...], label: str) -> list[FormRow]:
    camera = derive(read(path, (), lenses))
    problem = Problem(
        ideal_matrix(camera), independent(127.5, 5461.25, camera.unknowns), np.full(camera.measurements, NOISE)
    )
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 255, camera.unknowns)
    recorded = problem.matrix @ image + rng.normal(0, NOISE**0.5, camera.measurements)
    exactly = ExactResiduals(problem)
    built: dict[str, Form] = {}
    failed: dict[str, str] = {}
    times: dict[str, list[float]] = {name: [] for name in FORMS}
    for _ in range(REPEATS):
        for name, factorise in FORMS.items():
            if name in failed or (times[name] and min(times[name]) > LONG):
                continue
            start = perf_counter()
            try:
                built[name] = factorise(problem)
            except NotSolvableError as error:
                failed[name] = str(error)
            times[name].append(perf_counter() - start)
    shift = np.zeros((camera.unknowns, 1))
    exact = refine(built[REFERENCE], exactly, shift, exactly.recorded(recorded))
    variance = built[REFERENCE].variance()
    rows: list[FormRow] = []
    for name in FORMS:
        if name in failed:
            rows.append(FormRow(camera.unknowns, camera.measurements, label, name, None, None, failed[name]))
            continue
        start = perf_counter()
        alone, _ = built[name].solve(shift, exactly.recorded(recorded).high)
        solved = perf_counter() - start
        start = perf_counter()
        refined = refine(built[name], exactly, shift, exactly.recorded(recorded))
        certified = perf_counter() - start
        size = float(np.linalg.norm(exact.coefficients))
        digits = (
            _digits(float(np.linalg.norm(alone - exact.coefficients)) / size),
            _digits(float(np.linalg.norm(refined.coefficients - exact.coefficients)) / size),
            np.nan if name == REFERENCE else _digits(float(np.max(np.abs(built[name].variance() / variance - 1)))),
        )
        seconds = (float(np.median(times[name])), solved, certified)
        rows.append(FormRow(camera.unknowns, camera.measurements, label, name, seconds, digits))
    return rows


def _digits(error: float) -> float:
    return float(-np.log10(max(error, np.finfo(np.float64).eps)))
