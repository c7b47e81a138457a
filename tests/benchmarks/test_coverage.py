"""The coverage of error bars: three cells of the table as they are, and the benchmark that makes the table."""

from __future__ import annotations

from dataclasses import replace
from math import comb
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from ommatid.interface import target_image
from ommatid.reconstruct.output.run_json import ResidualReport, RunReport

from ..examples import needs
from ..runs import report_of
from . import coverage
from .coverage import allowed_misses, holds, is_inside, is_red, mean, measured_run, ratios, results, row
from .coverage_cells import CELLS, Cell

BY_NAME = {cell.name: cell for cell in CELLS}
QUICK = ("tile19-coarse-ideal", "tile19-coarse-transport-1024", "tile19-coarse-I-prior-ideal")
CELL = BY_NAME[QUICK[0]]
SIGNIFICANCE = 1e-3


def run_of(mse: float, trusted: bool = True) -> RunReport:
    """A run of expected error 1, whose interval is 0.5 to 2, and of chi-squared 110 where 100 +- 5 are expected."""
    interval, chi = {"mse": 1.0, "low": 0.5, "high": 2.0}, {"chi_squared": 110.0, "expected": 100.0, "deviation": 5.0}
    report = report_of(
        fingerprint=CELL.definition,
        verdict={"trusted": trusted, "reasons": () if trusted else ("a reason",)},
        error={"mse": mse, "predicted_mse": 2.0, "budget": {"noise": 2.0}, "expected_given_truth": interval},
    )
    residual = ResidualReport.model_validate(chi)
    return report.with_changes(diagnostics=report.diagnostics.model_copy(update={"chi_squared": residual}))


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_intervals_hold_their_share_of_errors(name: str) -> None:
    """Twenty seeds; the mean error agrees with its expectation within Student's t of their own scatter."""
    needs("llvm_ad_mono")
    reports = [measured_run(BY_NAME[name], number) for number in range(20)]
    assert None not in map(is_inside, reports)
    assert holds(reports)
    ratio, error = mean(ratios(reports)[1])
    assert abs(ratio - 1) < float(stats.t.isf(SIGNIFICANCE / 2, len(reports) - 1)) * error
    assert not any(map(is_red, reports))


@pytest.mark.slow
def test_predictions_that_few_samples_make_too_small_are_not_trusted() -> None:
    """Rough images and 256 samples: Eq. 5 takes their contrast from estimates that have lost some of it."""
    needs("llvm_ad_mono")
    reports = [measured_run(BY_NAME["tile19-prior-transport-256"], number) for number in range(6)]
    assert np.mean(ratios(reports)[0]) > 1.2
    assert all(map(is_red, reports))


def test_runs_differ_in_their_seeds_and_cells_do_too() -> None:
    seeds = [cell.described(number).render.seed for cell in CELLS for number in range(2)]
    assert len(set(seeds)) == len(seeds)
    misaligned = BY_NAME["misaligned-19-transport-8192"]
    drawn = [misaligned.described(number).camera.tolerance for number in range(5)]
    assert len({tolerance.seed for tolerance in drawn if tolerance is not None}) == 5


def test_an_image_of_the_prior_has_its_mean_and_variance(tmp_path: Path) -> None:
    cell = BY_NAME["photo-79-prior-896"]
    scene = cell.prepared(0, tmp_path)
    image = target_image(scene)
    limit = float(stats.norm.isf(SIGNIFICANCE / 2))
    assert abs(image.mean() - scene.prior.mean) < limit * (scene.prior.variance / image.size) ** 0.5
    assert abs(image.var() / scene.prior.variance - 1) < limit * (2 / image.size) ** 0.5
    assert not np.array_equal(image, target_image(cell.prepared(1, tmp_path)))


def test_misses_are_allowed_that_one_in_a_hundred_explains() -> None:
    """The probability of more, summed term by term, is below 0.2 %, and that of one less is not."""
    for runs, allowed in ((20, 2), (40, 3)):
        more = [
            sum(comb(runs, misses) * 0.01**misses * 0.99 ** (runs - misses) for misses in range(least, runs + 1))
            for least in (allowed + 1, allowed)
        ]
        assert more[0] < 2e-3 < more[1]
        assert allowed_misses(runs) == allowed


def test_rows_count_alarms_and_misses() -> None:
    """Inside, outside and red, outside and trusted, inside and red."""
    reports = [run_of(1.0), run_of(3.0, trusted=False), run_of(3.0), run_of(1.0, trusted=False)]
    assert not holds(reports)
    deviation = (1 / 3) ** 0.5 / 2  # of the mean of 0.5, 1.5, 1.5, 0.5
    cells = row("a cell", reports)
    assert cells == (
        "a cell",
        "4",
        f"1.000 ± {deviation:.3f}",
        f"2.000 ± {2 * deviation:.3f}",
        "**2 of 4**",
        "1.100 ± 0.000",
        "+2.00",
        "2",
        "1",
        "1",
    )
    assert len(cells) == len(coverage.COLUMNS)


def test_a_second_start_runs_what_is_missing_failed_damaged_or_of_another_definition(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    started: list[int] = []

    def recorded(_cell: Cell, number: int) -> RunReport:
        started.append(number)
        if number == 2 and len(started) == 3:
            raise MemoryError
        return run_of(1.0)

    monkeypatch.setattr(coverage, "measured_run", recorded)
    words = ["-o", str(tmp_path), "--cells", CELL.name, "--seeds", "4"]
    coverage.command(words)
    assert set(results(tmp_path, CELL)) == {0, 1, 3}
    journal = tmp_path / coverage.JOURNAL
    lines = journal.read_text(encoding="utf-8").splitlines()
    journal.write_text("\n".join([lines[0], lines[1][:-9], lines[2]]), encoding="utf-8")
    coverage.command(words)
    assert started == [0, 1, 2, 3, 1, 2]
    printed = capsys.readouterr().out.rsplit("| cell", 1)[1]
    coverage.command(["-o", str(tmp_path), "--table"])
    assert capsys.readouterr().out.endswith(printed)
    assert f"| {CELL.name} | 4 | 0.500 ± 0.000 | 1.000 ± 0.000 | 4 of 4 |" in printed
    assert results(tmp_path, replace(CELL, changes=(*CELL.changes, "noise.variance=1e-3"))) == {}
