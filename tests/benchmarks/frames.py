"""The frame solver against other solvers, from the same H and g and to the same error of every pixel.

Iterative solvers take as few steps as reduce the largest error below 0.01 posterior standard deviations, the frame
solver's default accuracy. That number is determined beforehand and not timed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from rich.table import Table
from scipy import sparse

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY
from ommatid.runtime.arrays import FloatArray

from .alternation import alternate
from .fresh import call, memory_of
from .rivals import RIVALS, Rival, by_boxes, by_lsmr, factorised
from .whole import NOISE, SMALL, Whole, compile_all, deviations, stored

SIZE = 539
TUNING_SIZE = 119  # of the frame on which the steps of LSMR and of conjugate gradients are compared
REPEATS = 3
REFERENCE = 1e-6  # accuracy of the solution with which errors are computed
MOST_STEPS = 5000
FEW_STEPS = 5  # for the peak of memory, which does not increase with more
OURS = "our frame solver, unprepared"
PREPARED = "our frame solver, prepared"


class _EnoughError(Exception):
    """Stops an iterative solver from its callback."""


@dataclass(frozen=True)
class FrameRow:
    """A solver: seconds of every repeat, its own and those of ours; its memory above H and g; its largest error.

    memory, ours_memory : gigabytes, None if not measured
    """

    name: str
    steps: int | None
    seconds: FloatArray
    ours: FloatArray
    memory: float | None
    ours_memory: float | None
    error: float
    target: float | None = None
    memory_target: float | None = None


def frame_rows() -> tuple[list[FrameRow], float]:
    """Return a row per solver, prepared ones last, and the difference of the reference solution from Cholesky's."""
    compile_all()
    whole, errors = Whole.drawn(SIZE), _Errors(SIZE)
    matrix = stored(whole.camera)
    errors.reference = whole.estimate(REFERENCE).image
    counts = _counts(whole, matrix, errors)
    frame, factor = whole.frame(), factorised(matrix)
    right = frame.right_hand_side(whole.residual)
    difference = errors.of(factor(right))
    direct = frame.solve(right).steps
    solvers = [
        _Solver(OURS, direct, OURS, lambda: whole.estimate().image),
        *(_Solver.of(rival, counts.get(rival.steps), whole, matrix) for rival in RIVALS),
        _Solver(PREPARED, direct, PREPARED, lambda: frame.solve(right).image),
        _Solver("CHOLMOD, factor stored", None, PREPARED, lambda: factor(right)),
    ]
    timed = alternate([solver.work for solver in solvers], REPEATS)
    seconds = {solver.name: timed[index] for index, solver in enumerate(solvers)}
    memory = {name: _memory(name) for name in (OURS, *(rival.name for rival in RIVALS))}
    rows = [
        FrameRow(
            name=solver.name,
            steps=solver.steps,
            seconds=seconds[solver.name],
            ours=seconds[solver.against],
            memory=memory.get(solver.name),
            ours_memory=memory.get(solver.against),
            error=errors.of(solver.solutions[-1]),
            target=solver.target,
            memory_target=solver.memory_target,
        )
        for solver in solvers
    ]
    return rows, difference


@dataclass(frozen=True)
class _Solver:
    """A solver, the name of the solver with which it is compared, and its last solution."""

    name: str
    steps: int | None
    against: str
    solve: Callable[[], FloatArray]
    target: float | None = None
    memory_target: float | None = None
    solutions: list[FloatArray] = field(default_factory=list[FloatArray])

    @staticmethod
    def of(rival: Rival, steps: int | None, whole: Whole, matrix: sparse.csr_array) -> _Solver:
        def solve() -> FloatArray:
            return rival.solve(whole, matrix, steps or 0, None)

        return _Solver(rival.name, steps, OURS, solve, rival.target, rival.memory_target)

    def work(self, seed: int) -> None:
        del seed
        self.solutions[:] = [self.solve()]


class _Errors:
    """The largest error of a frame's pixels, in posterior standard deviations of each."""

    def __init__(self, size: int) -> None:
        self.deviation = deviations(size).ravel()
        self.reference = np.zeros(size * size)

    def of(self, image: FloatArray) -> float:
        return float(np.max(np.abs(image - self.reference) / self.deviation))


def _counts(whole: Whole, matrix: sparse.csr_array, errors: _Errors) -> dict[str, int]:
    """Return the numbers of steps that suffice.

    Conjugate gradients are stopped by their callback. LSMR has none, so its number is found by bisection in a small
    frame, scaled like that of conjugate gradients, and raised until it suffices.
    """
    small, small_errors = Whole.drawn(TUNING_SIZE), _Errors(TUNING_SIZE)
    small_errors.reference = small.estimate(REFERENCE).image
    table = stored(small.camera)
    small_steps = _steps_of_cg(small, table, small_errors)
    short, long = small_steps // 2, 2 * small_steps
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if small_errors.of(by_lsmr(small, table, middle)) <= ACCURACY else (middle, long)
    cg_steps = _steps_of_cg(whole, matrix, errors)
    steps = long * cg_steps // small_steps
    while errors.of(by_lsmr(whole, matrix, steps)) > ACCURACY:
        steps += -(-steps // 100)
    return {"cg": cg_steps, "lsmr": steps}


def _steps_of_cg(whole: Whole, matrix: sparse.csr_array, errors: _Errors) -> int:
    count = 0

    def watch(image: FloatArray) -> None:
        nonlocal count
        count += 1
        if errors.of(image) <= ACCURACY:
            raise _EnoughError

    try:
        by_boxes(whole, matrix, MOST_STEPS, watch)
    except _EnoughError:
        return count
    raise RuntimeError(f"conjugate gradients do not reach {ACCURACY:g} in {MOST_STEPS} steps")


def _memory(name: str) -> float:
    held, peak = call(needed, name, SIZE)
    return peak - held


def needed(name: str, size: int) -> tuple[float, float]:
    """Return the gigabytes of this process with g and, if stored, H, and their peak during one estimate."""
    compile_all()
    whole = Whole.drawn(size)
    rival = next((rival for rival in RIVALS if rival.name == name), Rival(OURS, lambda *_: whole.estimate().image))
    if name != OURS:
        small = Whole.drawn(SMALL)
        rival.solve(small, stored(small.camera), FEW_STEPS, None)  # to import its modules
    matrix = stored(whole.camera) if rival.stored and name != OURS else sparse.csr_array((0, 0))
    return memory_of(lambda: rival.solve(whole, matrix, FEW_STEPS, None))


def frames_table() -> Table:
    """Return the frame solver against other solvers."""
    start = perf_counter()
    table = Table(
        title=f"A frame of {SIZE} x {SIZE}, noise variance {NOISE:g}, to {ACCURACY:g} posterior standard deviations"
    )
    table.add_column("solver", no_wrap=True)
    for name in ("steps", "time", "time / ours", "target", "memory", "memory / ours", "target", "largest error"):
        table.add_column(name, justify="right", no_wrap=True)
    rows, difference = frame_rows()
    for row in rows:
        if row.memory is None and row.ours is row.seconds:
            table.add_section()
        table.add_row(*_cells(row))
    table.caption = (
        f"Medians (minimum to maximum) of {REPEATS} repeats in alternation. The lower part is relative to its own first"
        " line. The other solvers take the fewest steps that suffice. Storing H beforehand is neither timed nor"
        " counted; memory is the peak of a separate interpreter above that with H and g. Errors are in posterior"
        " standard deviations, against our solver's solution to 1e-6, which differs by"
        f" {difference:.1g} from that of Cholesky. Total time: {perf_counter() - start:.0f} s."
    )
    return table


def _cells(row: FrameRow) -> list[str]:
    ratios = row.seconds / row.ours
    memory = ["-", "-", "-"]
    if row.memory is not None and row.ours_memory is not None:
        memory = [f"{row.memory * 1e3:.3g} MB", f"{row.memory / row.ours_memory:.3g}", _number(row.memory_target)]
    return [
        row.name,
        _number(row.steps),
        f"{np.median(row.seconds):.3g} s",
        f"{np.median(ratios):.3g} ({ratios.min():.3g} to {ratios.max():.3g})",
        _number(row.target),
        *memory,
        f"{row.error:.3g}",
    ]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"
