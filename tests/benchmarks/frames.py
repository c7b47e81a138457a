"""The frame solver against other solvers, from the same H and g and to the same error of every pixel.

Iterative solvers take as few steps as reduce the largest error below 0.01 posterior standard deviations, the frame
solver's default accuracy. That number is determined beforehand and not timed.
"""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import numpy as np
from rich.table import Table
from scipy import sparse

from ommatid.reconstruct.frame.conjugate_gradients import ACCURACY
from ommatid.runtime.arrays import FloatArray

from .alternation import alternate
from .fresh import call, memory_of
from .rivals import OURS, RIVALS, Matrix, by_cg, by_lsmr
from .whole import KINDS, LENSES, NOISE, SMALL, Whole, compile_all, stored

SIZE = 539
TUNING_SIZE = 119  # of the frame on which the steps of LSMR and of conjugate gradients are compared
REPEATS = 3
REFERENCE = 1e-6  # accuracy of the solution with which errors are computed
MOST_STEPS = 5000
FEW_STEPS = 5  # for the peak of memory, which does not increase with more


class _EnoughError(Exception):
    """Stops an iterative solver from its callback."""


def frames_tables() -> Iterator[Table]:
    """Yield the frame solver against other solvers, for each kind of camera."""
    compile_all()
    for kind in KINDS:
        yield frames_table(kind)


def frames_table(kind: str) -> Table:
    """Return the frame solver against the other solvers that serve a kind of camera."""
    start = perf_counter()
    rivals = [rival for rival in RIVALS if rival.wide or kind != LENSES]
    whole = Whole.drawn(kind, SIZE)
    matrix, errors = stored(whole), _Errors(whole)
    counts = _counts(kind, whole, matrix, errors)
    solutions: dict[str, FloatArray] = {}

    def solve(number: int) -> None:
        rival = rivals[number]
        solutions[rival.name] = rival.solve(whole, matrix, counts.get(rival.steps, 0), None)

    seconds = alternate([lambda _, number=number: solve(number) for number in range(len(rivals))], REPEATS)
    memory = [_memory(kind, rival.name) for rival in rivals]
    counts[OURS.steps] = whole.estimate().steps
    table = Table(
        title=f"{kind}: {SIZE} x {SIZE}, noise variance {NOISE:g}, to {ACCURACY:g} posterior standard deviations"
    )
    table.add_column("solver", no_wrap=True)
    for name in ("steps", "time", "time / ours", "memory", "memory / ours", "largest error"):
        table.add_column(name, justify="right", no_wrap=True)
    for rival, spent, needs in zip(rivals, seconds, memory, strict=True):
        ratios = spent / seconds[0]
        table.add_row(
            rival.name,
            str(counts[rival.steps]) if rival.steps or rival is OURS else "-",
            f"{np.median(spent):.3g} s",
            f"{np.median(ratios):.3g} ({ratios.min():.3g} to {ratios.max():.3g})",
            f"{needs * 1e3:.3g} MB",
            f"{needs / memory[0]:.3g}",
            f"{errors.of(solutions[rival.name]):.3g}",
        )
    table.caption = (
        f"Medians (minimum to maximum) of {REPEATS} repeats in alternation. Iterative solvers take the fewest steps"
        " that suffice, to 5 %. Storing H beforehand is neither timed nor counted; memory is the peak of a separate"
        " interpreter above that with H and g. Errors are in posterior standard deviations of a pixel far from the"
        f" edges, against our solver's solution to 1e-6. Total time: {perf_counter() - start:.0f} s."
    )
    return table


class _Errors:
    """The largest error of a frame's pixels, in posterior standard deviations."""

    def __init__(self, whole: Whole) -> None:
        self.deviation, self.reference = whole.deviation, whole.estimate(REFERENCE).image

    def of(self, image: FloatArray) -> float:
        return float(np.max(np.abs(image - self.reference))) / self.deviation


def _counts(kind: str, whole: Whole, matrix: Matrix, errors: _Errors) -> dict[str, int]:
    """Return the numbers of steps that suffice.

    Conjugate gradients are stopped by their callback. LSMR has none, so its number is found by bisection in a small
    frame, scaled like that of conjugate gradients, and raised until it suffices.
    """
    small = Whole.drawn(kind, TUNING_SIZE)
    small_errors, table = _Errors(small), stored(small)
    small_steps = _steps_of_cg(small, table, small_errors)
    short, long = small_steps // 2, 2 * small_steps
    while long - short > 1:
        middle = (short + long) // 2
        short, long = (short, middle) if small_errors.of(by_lsmr(small, table, middle)) <= ACCURACY else (middle, long)
    cg_steps = _steps_of_cg(whole, matrix, errors)
    steps = long * cg_steps // small_steps
    while errors.of(by_lsmr(whole, matrix, steps)) > ACCURACY:
        steps += -(-steps // 20)
    return {"cg": cg_steps, "lsmr": steps}


def _steps_of_cg(whole: Whole, matrix: Matrix, errors: _Errors) -> int:
    count = 0

    def watch(image: FloatArray) -> None:
        nonlocal count
        count += 1
        if errors.of(image) <= ACCURACY:
            raise _EnoughError

    try:
        by_cg(whole, matrix, MOST_STEPS, watch)
    except _EnoughError:
        return count
    raise RuntimeError(f"conjugate gradients do not reach {ACCURACY:g} in {MOST_STEPS} steps")


def _memory(kind: str, name: str) -> float:
    held, peak = call(needed, kind, name, SIZE)
    return peak - held


def needed(kind: str, name: str, size: int) -> tuple[float, float]:
    """Return the gigabytes of this process with g and, if stored, H, and their peak during one estimate."""
    compile_all()
    whole, small = Whole.drawn(kind, size), Whole.drawn(kind, SMALL)
    rival = next(rival for rival in RIVALS if rival.name == name)
    rival.solve(small, stored(small), FEW_STEPS, None)  # to import its modules
    matrix = stored(whole) if rival.stored else sparse.csr_array((0, 0))
    return memory_of(lambda: rival.solve(whole, matrix, FEW_STEPS, None))
