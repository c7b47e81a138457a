"""The coverage of error bars: three cells of the table as they are, and the benchmark that makes the table."""

from __future__ import annotations

from math import comb
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ..examples import needs
from .coverage import command
from .coverage.cell import Cell
from .coverage.cells import CELLS
from .coverage.journal import append, results
from .coverage.run import Failure, Run, measured_run
from .coverage.statistics import COLUMNS, allowed_misses, statistics

BY_NAME = {cell.name: cell for cell in CELLS}
QUICK = ("tile19-coarse-ideal", "tile19-coarse-transport-1024", "tile19-coarse-I-prior-ideal")
CELL = BY_NAME[QUICK[0]]
SIGNIFICANCE = 1e-3


def run_of(number: int, mse: float, trusted: bool = True) -> Run:
    """A run of expected error 1, whose interval is 0.5 to 2, and of chi-squared 110 where 100 +- 5 are expected."""
    return Run(
        number=number,
        mse=mse,
        promised=2.0,
        budget={"noise": 2.0},
        expected=1.0,
        low=0.5,
        high=2.0,
        chi_squared=110.0,
        chi_expected=100.0,
        chi_deviation=5.0,
        trusted=trusted,
        reasons=() if trusted else ("a reason",),
        method="dense",
        samples=None,
        seconds=1.0,
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_intervals_hold_their_share_of_errors(name: str) -> None:
    """Twenty seeds; the mean error agrees with its expectation within Student's t of their own scatter."""
    needs("llvm_ad_mono")
    runs = [measured_run(BY_NAME[name], number) for number in range(20)]
    assert [run for run in runs if isinstance(run, Failure)] == []
    found = statistics(runs)
    assert found.judged == 20
    assert found.holds, f"{found.inside} of {found.judged} inside"
    limit = float(stats.t.isf(SIGNIFICANCE / 2, found.runs - 1))
    assert abs(found.against_expectation.value - 1) < limit * found.against_expectation.error
    assert found.red == 0


@pytest.mark.slow
def test_predictions_that_few_samples_make_too_small_are_not_trusted() -> None:
    """Rough images and 256 samples: Eq. 5 takes their contrast from estimates that have lost some of it."""
    needs("llvm_ad_mono")
    runs = [measured_run(BY_NAME["tile19-prior-transport-256"], number) for number in range(6)]
    succeeded = [run for run in runs if isinstance(run, Run)]
    assert len(succeeded) == len(runs)
    assert np.mean([run.mse / run.promised for run in succeeded]) > 1.2
    assert not any(run.trusted for run in succeeded)


def test_runs_differ_in_their_seeds_and_cells_do_too() -> None:
    seeds = [cell.described(number).render.seed for cell in CELLS for number in range(2)]
    assert len(set(seeds)) == len(seeds)
    misaligned = BY_NAME["misaligned-19-robust-ideal"]
    drawn = [misaligned.described(number).camera.tolerance for number in range(5)]
    assert len({tolerance.seed for tolerance in drawn if tolerance is not None}) == 5


def test_an_image_of_the_prior_has_its_mean_and_variance() -> None:
    cell = BY_NAME["photo-79-prior-896"]
    scene = cell.described(0)
    image = cell.drawn_image(scene, (79, 79), 0)
    limit = float(stats.norm.isf(SIGNIFICANCE / 2))
    assert abs(image.mean() - scene.prior.mean) < limit * (scene.prior.variance / image.size) ** 0.5
    assert abs(image.var() / scene.prior.variance - 1) < limit * (2 / image.size) ** 0.5
    assert not np.array_equal(image, cell.drawn_image(scene, (79, 79), 1))


def test_misses_are_allowed_that_one_in_a_hundred_explains() -> None:
    """The probability of more, summed term by term, is below 0.2 %, and that of one less is not."""
    for runs, allowed in ((20, 2), (40, 3)):
        more = [
            sum(comb(runs, misses) * 0.01**misses * 0.99 ** (runs - misses) for misses in range(least, runs + 1))
            for least in (allowed + 1, allowed)
        ]
        assert more[0] < 2e-3 < more[1]
        assert allowed_misses(runs) == allowed


def test_statistics_count_alarms_and_misses() -> None:
    runs = [
        run_of(0, 1.0),
        run_of(1, 3.0, trusted=False),  # outside and red
        run_of(2, 3.0),  # outside and trusted
        run_of(3, 1.0, trusted=False),  # inside and red
    ]
    found = statistics([*runs, Failure(number=4, error="MachineError: the disk is full")])
    assert (found.runs, found.failed, found.inside, found.judged) == (4, 1, 2, 4)
    assert (found.red, found.false_alarms, found.silent_misses) == (2, 1, 1)
    assert found.against_expectation.value == pytest.approx(2.0)
    assert found.against_promise.value == pytest.approx(1.0)
    assert found.against_promise.error == pytest.approx((1 / 3) ** 0.5 / 2)  # of 0.5, 1.5, 1.5, 0.5
    assert (found.chi_squared.value, found.z.value) == (pytest.approx(1.1), pytest.approx(2.0))
    assert not found.holds
    assert len(found.row("a cell")) == len(COLUMNS)


def test_a_journal_keeps_the_last_result_of_every_run_and_an_unfinished_line_costs_its_own(tmp_path: Path) -> None:
    append(tmp_path, CELL, Failure(number=1, error="MachineError: no memory"))
    append(tmp_path, CELL, run_of(0, 1.0))
    append(tmp_path, CELL, run_of(1, 1.5))
    assert results(tmp_path, CELL) == {0: run_of(0, 1.0), 1: run_of(1, 1.5)}
    path = tmp_path / f"{CELL.name}.jsonl"
    path.write_bytes(path.read_bytes()[:-40])
    append(tmp_path, CELL, run_of(2, 0.7))
    left = results(tmp_path, CELL)
    assert (left[0], left[2]) == (run_of(0, 1.0), run_of(2, 0.7))
    assert left.get(1) != run_of(1, 1.5)


def test_results_of_another_definition_of_a_cell_do_not_count(tmp_path: Path) -> None:
    append(tmp_path, CELL, run_of(0, 1.0))
    other = Cell(CELL.name, CELL.scene, (*CELL.changes, "noise.variance=1e-3"), CELL.seconds)
    assert results(tmp_path, other) == {}


def test_a_second_start_runs_what_is_missing_or_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started: list[int] = []

    def recorded(_cell: Cell, number: int) -> Run | Failure:
        started.append(number)
        return run_of(number, 1.0)

    monkeypatch.setattr(command, "measured_run", recorded)
    append(tmp_path, CELL, run_of(1, 1.0))
    append(tmp_path, CELL, Failure(number=2, error="MachineError: no memory"))
    command.command(["-o", str(tmp_path), "--cells", CELL.name, "--seeds", "4"])
    assert started == [0, 2, 3]
    printed = capsys.readouterr().out
    command.command(["-o", str(tmp_path), "--table"])
    assert capsys.readouterr().out == printed
    assert f"| {CELL.name} | 4 | 0.500 ± 0.000 | 1.000 ± 0.000 | 4 of 4 |" in printed
    assert started == [0, 2, 3]
