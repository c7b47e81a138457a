"""One run of a cell, as `ommatid run` does it without files: its errors, its error bars and its verdict."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

from pydantic import BaseModel, ConfigDict

from ommatid.pipeline.stages import checked_setup
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import TRUTH
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibrate import calibrate
from ommatid.simulate.ground_truth import cached_truth
from ommatid.simulate.render import render

from .cell import Cell


class Run(BaseModel):
    """Measured and stated errors of a run; None where there is nothing to state.

    promised : expected mean squared error over images of the prior (Eq. 5), `budget` its parts by cause
    expected, low, high : mean squared error expected for this image, and its 99 % interval
    chi_squared, chi_expected, chi_deviation : of the residual, as in run.json
    method, samples : of the estimate, and of the calibration;  seconds : of the stages together
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    number: int
    mse: float
    promised: float
    budget: dict[str, float]
    expected: float | None
    low: float | None
    high: float | None
    chi_squared: float | None
    chi_expected: float | None
    chi_deviation: float | None
    trusted: bool
    reasons: tuple[str, ...]
    method: str
    samples: int | None
    seconds: float

    @property
    def inside(self) -> bool | None:
        """True if the interval contains the measured error, None if there is none."""
        return None if self.low is None or self.high is None else self.low <= self.mse <= self.high


class Failure(BaseModel):
    """A run that ended with an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    number: int
    error: str


def measured_run(cell: Cell, number: int) -> Run | Failure:
    """Render, calibrate and reconstruct run `number` of a cell; an error ends that run alone."""
    start = perf_counter()
    try:
        setup = _setup(cell, number)
        stack, model = render(setup), calibrate(setup)
        outcome = restore(stack, model, _truth(setup))
    except Exception as error:
        return Failure(number=number, error=f"{type(error).__name__}: {error}")
    samples = model.record.get("samples")
    return _record(number, outcome, samples, perf_counter() - start)


def _setup(cell: Cell, number: int) -> Setup:
    scene = cell.described(number)
    if not cell.drawn:
        return checked_setup(scene)
    camera = derive(scene)
    return Setup(scene, camera, cell.drawn_image(scene, camera.shape, number))


def _truth(setup: Setup) -> FloatArray:
    if setup.scene.world is None:
        return setup.picture.ravel()
    with TemporaryDirectory(prefix="ommatid-") as folder:
        return cached_truth(Path(folder) / TRUTH, setup).ravel()


def _record(number: int, outcome: Reconstruction, samples: int | None, seconds: float) -> Run:
    if outcome.error is None:
        raise ValueError("expected a run whose truth is known")
    interval, residual = outcome.interval, outcome.residual
    return Run(
        number=number,
        mse=outcome.error.mse,
        promised=outcome.expected.mse,
        budget=outcome.budget(),
        expected=None if interval is None else interval.mse,
        low=None if interval is None else interval.low,
        high=None if interval is None else interval.high,
        chi_squared=None if residual is None else residual.chi_squared,
        chi_expected=None if residual is None else residual.expected,
        chi_deviation=None if residual is None else residual.deviation,
        trusted=outcome.verdict.trusted,
        reasons=outcome.verdict.reasons,
        method=outcome.choice.method,
        samples=samples,
        seconds=seconds,
    )
