"""A whole frame by our solver against every rival, from the same H and g and to the same error of every pixel.

Rivals that take steps take as few as bring the largest error, in posterior standard deviations, below 0.01, our
solver's own default. How few is found beforehand and not timed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY

from .alternation import alternate
from .fresh import call, memory_of
from .rivals import RIVALS, Rival, by_boxes, by_lsmr, factorised
from .whole import SMALL, Whole, compile_all, deviations, stored

Vector = NDArray[np.float64]

SIZE = 539
TUNED = 119  # the frame on which the counts of lsmr and of conjugate gradients are compared
REPEATS = 3
REFERENCE = 1e-6  # accuracy of what the errors are measured against
MOST_STEPS = 5000
BRIEF = 5  # steps for a peak of memory, which more would not raise
OURS = "our frame solver, from nothing"
AGAIN = "our frame solver, prepared"


class _EnoughError(Exception):
    """Stops a rival whose steps are watched."""


@dataclass(frozen=True)
class FrameRow:
    """One way: seconds of every repeat, its own and those of ours; its memory above H and g; its largest error.

    memory, ours_memory : gigabytes; None where they were not measured
    """

    name: str
    steps: int | None
    seconds: NDArray[np.float64]
    ours: NDArray[np.float64]
    memory: float | None
    ours_memory: float | None
    error: float
    aim: float | None = None
    memory_aim: float | None = None


def frame_rows() -> tuple[list[FrameRow], float]:
    """Our solver, every rival, and both that can prepare, prepared; and how far our reference is from Cholesky's."""
    compile_all()
    whole, errors = Whole.drawn(SIZE), _Errors(SIZE)
    matrix = stored(whole.camera)
    errors.reference = whole.estimate(REFERENCE).image
    counts = _counts(whole, matrix, errors)
    frame, factor = whole.frame(), factorised(matrix)
    right = frame.right_hand_side(whole.unexpected)
    apart = errors.of(factor(right))
    direct = frame.solve(right).steps
    ways = [
        _Way(OURS, direct, OURS, lambda: whole.estimate().image),
        *(_Way.of(rival, counts.get(rival.steps), whole, matrix) for rival in RIVALS),
        _Way(AGAIN, direct, AGAIN, lambda: frame.solve(right).image),
        _Way("CHOLMOD, factor kept", None, AGAIN, lambda: factor(right)),
    ]
    seconds = dict(zip((way.name for way in ways), alternate([way.work for way in ways], REPEATS), strict=True))
    memory = {name: _memory(name) for name in (OURS, *(rival.name for rival in RIVALS))}
    rows = [
        FrameRow(
            way.name,
            way.steps,
            seconds[way.name],
            seconds[way.against],
            memory.get(way.name),
            memory.get(way.against),
            errors.of(way.found[-1]),
            way.aim,
            way.memory_aim,
        )
        for way in ways
    ]
    return rows, apart


@dataclass(frozen=True)
class _Way:
    """A way, whose time its own is set against, and what it found last."""

    name: str
    steps: int | None
    against: str
    solve: Callable[[], Vector]
    aim: float | None = None
    memory_aim: float | None = None
    found: list[Vector] = field(default_factory=list[Vector])

    @staticmethod
    def of(rival: Rival, steps: int | None, whole: Whole, matrix: sparse.csr_array) -> _Way:
        def solve() -> Vector:
            return rival.solve(whole, matrix, steps or 0, None)

        return _Way(rival.name, steps, OURS, solve, rival.aim, rival.memory_aim)

    def work(self, seed: int) -> None:
        del seed
        self.found[:] = [self.solve()]


class _Errors:
    """The largest error of a frame's pixels, in posterior standard deviations of each."""

    def __init__(self, size: int) -> None:
        self.deviation = deviations(size).ravel()
        self.reference = np.zeros(size * size)

    def of(self, image: Vector) -> float:
        return float(np.max(np.abs(image - self.reference) / self.deviation))


def _counts(whole: Whole, matrix: sparse.csr_array, errors: _Errors) -> dict[str, int]:
    """Steps that suffice.

    Conjugate gradients are watched. LSMR lets nobody watch, so its count is found by bisection in a small frame, scaled
    like that of conjugate gradients, and raised until it suffices.
    """
    small, near = Whole.drawn(TUNED), _Errors(TUNED)
    near.reference = small.estimate(REFERENCE).image
    table = stored(small.camera)
    known = _watched(small, table, near)
    short, long = known // 2, 2 * known
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if near.of(by_lsmr(small, table, middle)) <= ACCURACY else (middle, long)
    own = _watched(whole, matrix, errors)
    steps = long * own // known
    while errors.of(by_lsmr(whole, matrix, steps)) > ACCURACY:
        steps += -(-steps // 100)
    return {"cg": own, "lsmr": steps}


def _watched(whole: Whole, matrix: sparse.csr_array, errors: _Errors) -> int:
    count = 0

    def watch(image: Vector) -> None:
        nonlocal count
        count += 1
        if errors.of(image) <= ACCURACY:
            raise _EnoughError

    try:
        by_boxes(whole, matrix, MOST_STEPS, watch)
    except _EnoughError:
        return count
    raise RuntimeError(f"conjugate gradients do not get there in {MOST_STEPS} steps")


def _memory(name: str) -> float:
    held, peak = call(needed, name, SIZE)
    return peak - held


def needed(name: str, size: int) -> tuple[float, float]:
    """Gigabytes that this process holds with H, if it is stored, and g, and its peak while one way estimates."""
    compile_all()
    whole = Whole.drawn(size)
    rival = next((rival for rival in RIVALS if rival.name == name), Rival(OURS, lambda *_: whole.estimate().image))
    if name != OURS:
        small = Whole.drawn(SMALL)
        rival.solve(small, stored(small.camera), BRIEF, None)  # what it imports is not what it needs
    matrix = stored(whole.camera) if rival.stored and name != OURS else sparse.csr_array((0, 0))
    return memory_of(lambda: rival.solve(whole, matrix, BRIEF, None))
