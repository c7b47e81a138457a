"""What every way to an estimate - one dense problem, tiles, the whole frame - is given, and what it has to answer."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ommatid.runtime.progress import Progress, no_progress
from ommatid.runtime.workers import Workers
from ommatid.scenes.model import Model
from ommatid.scenes.tables import estimation

from ..estimator.estimate import Solver
from ..expected_error import ExpectedError, Interval
from ..prior import Prior, prior_of, spectrum_of

Vector = NDArray[np.float64]
Image = NDArray[np.float64]


@dataclass(frozen=True)
class Execution:
    """Who does what can be done side by side, absent: threads of this process; and who hears how the work goes on."""

    workers: Workers | None = None
    progress: Progress = no_progress


@dataclass(frozen=True)
class EstimationTask:
    """What is to be estimated from what.

    recorded : (M,) g;  used : (M,) which of them count
    believed : (pixels used,) the variance that the estimator expects of each, 0 allowed
    """

    model: Model
    recorded: Vector
    used: NDArray[np.bool_]
    expected_noise: Vector
    prior: estimation.PriorTable
    settings: estimation.EstimatorTable
    tiles: estimation.TilesTable

    @cached_property
    def complete(self) -> bool:
        """Whether all pixels are used."""
        return bool(self.used.all())

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of f."""
        return self.model.camera.rows, self.model.camera.columns

    def prior_on(self, shape: tuple[int, int]) -> Prior:
        """What is known beforehand of an image of this shape."""
        return prior_of(self.prior, shape, self.model.camera.target_pitch)

    def precision_on(self, shape: tuple[int, int]) -> float | Image:
        """1 / P0 of independent pixels, or 1 / its spectrum under the cosine transform: (rows, columns)."""
        return 1 / spectrum_of(self.prior, shape, self.model.camera.target_pitch)

    def prior_spread(self, weights: Vector) -> float:
        """w^T P0 w, the variance of a weighted sum of pixels before anything is recorded; weights : (N,)."""
        spectrum = spectrum_of(self.prior, self.shape, self.model.camera.target_pitch)
        if isinstance(spectrum, float):
            return spectrum * float(weights @ weights)
        waves = fft.dctn(weights.reshape(self.shape), 2, norm="ortho")
        return float(np.sum(spectrum * np.square(waves)))

    def over_all(self, values: Vector, rest: float) -> Vector:
        """Values of the pixels used as values of all: (pixels used,) to (M,), `rest` for the others."""
        if self.complete:
            return values
        spread = np.full(self.used.size, rest)
        spread[self.used] = values
        return spread


@dataclass(frozen=True)
class MethodResult:
    """An estimate and its error.

    image : (N,) f^;  multipliers : (pixels used,) Rv^-1 (g - H f^)
    expected : Eq. 5 with the noise as it is;  interval : for the image that was given as the truth
    variance_of_sum : of a weighted sum of pixels, (N,) weights, the expected squared error
    """

    image: Vector
    multipliers: Vector
    solver: Solver
    expected: ExpectedError
    interval: Interval | None
    variance_of_sum: Callable[[Vector], float]


class Method(ABC):
    """One way to an estimate."""

    def __init__(self, task: EstimationTask, hands: Execution) -> None:
        """Of a task, with somebody to do the work."""
        self.task = task
        self.hands = hands

    @cached_property
    def image(self) -> Vector:
        """f^ alone: (N,)."""
        return self.estimated()

    @abstractmethod
    def estimated(self) -> Vector:
        """Find f^ alone: (N,)."""

    @abstractmethod
    def result(self, noise: dict[str, Vector], truth: Vector | None) -> MethodResult:
        """The estimate and its error where the noise, (pixels used,) variances by name, is as given."""


def total(noise: dict[str, Vector]) -> Vector:
    """The sum of variances of several causes; where each is one number for all pixels, so is the sum."""
    values = list(noise.values())
    if all(is_one_number(one) for one in values):
        return np.broadcast_to(sum(float(one[0]) for one in values if one.size), values[0].shape)
    summed = np.array(values[0])
    for one in values[1:]:
        summed += one
    return summed


def is_one_number(values: Vector) -> bool:
    """Whether an array repeats one number and stores it once."""
    return values.strides == (0,) or values.size == 0


def residual_multipliers(task: EstimationTask, image: Vector) -> Vector:
    """Rv^-1 (g - H f^): (pixels used,); zeros where a measurement is said to have no noise."""
    left = task.recorded - task.model.forward(image)
    if not task.complete:
        left = left[task.used]
    return np.divide(left, task.expected_noise, out=np.zeros_like(left), where=task.expected_noise > 0)
