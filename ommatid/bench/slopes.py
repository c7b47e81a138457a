"""How fast errors fall with samples, what is worth its seconds, and which setting reaches the noise floor first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from math import exp, log
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.analysis.pareto import pareto_front
from ommatid.scenes.shrinkage import shrink_variances

from .table import ALONE, AUTO, Cell

AGREES = 3.0  # standard errors within which a slope is that of theory
FEWEST = 3  # points of a slope
WORSE = 0.1  # of the mean squared error: what a recommended setting may add to the noise floor


@dataclass(frozen=True)
class Slope:
    """d log error / d log samples, and its standard error."""

    value: float
    deviation: float

    def agrees(self, theory: float, allowed: float = 0.0) -> bool:
        """Whether it lies within 3 standard errors of what theory says, which is known to what is `allowed`."""
        return abs(self.value - theory) <= AGREES * self.deviation + allowed


def slope(cells: Sequence[Cell]) -> Slope | None:
    """Of cells that differ in samples alone: weighted least squares on logarithms; None where they are too few.

    Each point weighs by the variance of its median logarithm over seeds, these variances drawn towards one another,
    since few repeats tell little of each. The standard error is what those variances make of the slope, whether or not
    the points happen to lie on a line.
    """
    known = [cell for cell in cells if cell.scatter and cell.samples and cell.repeats > 1 and cell.error.median > 0]
    if len({cell.samples for cell in known}) < FEWEST:
        return None
    x = np.log([float(cell.samples or 1) for cell in known])
    y = np.log([cell.error.median for cell in known])
    repeats = np.array([cell.repeats for cell in known])
    scatter = np.square([cell.scatter or 0.0 for cell in known])
    variance = shrink_variances(scatter, int(repeats.min())) * of_medians(repeats)
    weight = 1 / variance
    middle = float(weight @ x / weight.sum())
    spread = float(weight @ np.square(x - middle))
    return Slope(float(weight @ ((x - middle) * y)) / spread, spread**-0.5)


def of_medians(repeats: NDArray[Any]) -> NDArray[Any]:
    """Variance of the median of so many normal values, in units of the variance of one.

    pi / (2 n + pi - 2) is right for one value and for many, within 2 % for odd numbers between, and too large for even
    ones, by 22 % at most.
    """
    return np.pi / (2 * repeats + np.pi - 2)


def pareto(cells: Sequence[Cell]) -> list[Cell]:
    """Cells that none is both faster and better than, from the fastest on."""
    return pareto_front(cells, lambda cell: cell.seconds.median, lambda cell: cell.error.median)


def excess(cell: Cell, floor: float) -> float:
    """What a setting adds to the mean squared error of exact light, exact H and an exact estimate, in units of that.

    An estimate that is off by e posterior standard deviations adds e^2.
    """
    if cell.stage == "reconstruct":
        return cell.error.median**2
    if cell.mse is None or floor <= 0:
        return float("inf")
    return max(cell.mse.median / floor - 1, 0.0)


def recommend(cells: Sequence[Cell], floor: float) -> dict[str, Any]:
    """The cheapest setting of all stages whose excesses add up to no more than a tenth; else the one of least excess.

    floor : mean squared error of exact light and exact H, with the scene's noise
    Rendering and calibration share the scene's sampler and variant.
    """
    found: dict[str, Any] = {"noise_floor": floor, "mse": None, "reached": False}
    choices = list(_choices([cell for cell in cells if cell.setting != ALONE], floor))
    if floor <= 0 or not choices:
        why = "there was no time for a cell of every stage; raise --seconds"
        if floor <= 0:
            why = "the scene has no noise, so there is no floor: more samples always bring more"
        return {**found, "why": why}
    reaching = [some for some in choices if _excess_of(some, floor) <= WORSE]
    best = min(reaching, key=_seconds_of) if reaching else min(choices, key=lambda some: _excess_of(some, floor))
    more = _excess_of(best, floor)
    found |= {cell.stage: _told(cell) for cell in best} | {"mse": floor * (1 + more), "reached": bool(reaching)}
    if reaching:
        above = f"{round(100 * more, 4):.2g} % above it"
        why = f"the cheapest within {100 * WORSE:g} % of what exact light and exact H give: {above}"
        return {**found, "why": "; ".join([why, *_as_needed(best)])}
    words = [word for word in (_needed(cells, cell, floor) for cell in best) if word]
    why = f"no setting measured comes within {100 * WORSE:g} % of what exact light and exact H give; these come nearest"
    return {**found, "why": "; ".join([f"{why}, {100 * more:.0f} % above it", *words, *_as_needed(best)])}


def _choices(cells: Sequence[Cell], floor: float) -> Iterator[tuple[Cell, ...]]:
    """A cell of each stage, those of rendering and calibration of one sampler and variant, as a scene has them."""
    estimates = _worth([cell for cell in cells if cell.stage == "reconstruct"], floor)
    for key in dict.fromkeys(_shared(cell) for cell in cells if cell.stage == "render"):
        alike = [cell for cell in cells if _shared(cell) == key]
        stages = [_worth([cell for cell in alike if cell.stage == stage], floor) for stage in ("render", "calibrate")]
        yield from product(*stages, estimates)


def _shared(cell: Cell) -> tuple[str, str | None]:
    return cell.way.split(", ")[-1], cell.variant


def _excess_of(some: Sequence[Cell], floor: float) -> float:
    return sum(excess(cell, floor) for cell in some)


def _seconds_of(some: Sequence[Cell]) -> float:
    return sum(cell.seconds.median for cell in some)


def _worth(cells: Sequence[Cell], floor: float) -> list[Cell]:
    """Cells that none is both faster than and brings less excess."""
    finite = [cell for cell in cells if excess(cell, floor) < float("inf")]
    return pareto_front(finite, lambda cell: cell.seconds.median, lambda cell: excess(cell, floor))


def _told(cell: Cell) -> dict[str, Any]:
    seconds = {"seconds": cell.seconds.median}
    if cell.stage == "reconstruct":
        return {"method": cell.way, "setting": cell.setting, **seconds}
    *method, sampler = cell.way.split(", ")
    told = {"method": method[0]} if method else {}
    samples = cell.samples if cell.counted else AUTO
    return {**told, "sampler": sampler, "variant": cell.variant, "samples": samples, **seconds}


def _as_needed(some: Sequence[Cell]) -> list[str]:
    """What "auto" took, where it is recommended."""
    names = {"render": "render.samples", "calibrate": "calibration.samples"}
    open_ones = [cell for cell in some if not cell.counted]
    return [f'{names[cell.stage]} = "{AUTO}" took up to {cell.samples} samples a pixel' for cell in open_ones]


def _needed(cells: Sequence[Cell], cell: Cell, floor: float) -> str:
    """About how many samples a stage would take, as its last two cells go on: excess falls with the squared error."""
    if cell.samples is None or not cell.counted:
        return ""
    share, now = WORSE / 2, excess(cell, floor)  # the other half is for the other of both
    alike = [one for one in cells if (one.stage, one.way, one.variant) == (cell.stage, cell.way, cell.variant)]
    last = sorted((one for one in alike if one.samples and one.counted), key=lambda one: one.samples or 0)[-2:]
    if now <= share or len(last) < 2 or last[0].error.median <= last[1].error.median:
        return ""
    fall = log(last[0].error.median / last[1].error.median) / log((last[1].samples or 1) / (last[0].samples or 1))
    samples = cell.samples * exp(log(now / share) / (2 * fall))
    return f"{cell.stage}, {cell.way}, would take about {float(f'{samples:.1g}'):.0f} samples"
