"""The coverage of error bars: three cells of the table as they are, and the benchmark that makes the table."""

from __future__ import annotations

import shutil
from math import comb
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from scipy import stats

from ommatid.reconstruct.method_choice import choose_method
from ommatid.scenes.camera import derive
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import Sampler
from ommatid.scenes.tables.gallery import gallery_names
from ommatid.simulate.validation import check_scene

from ..examples import GALLERY, needs
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


def test_the_cells_span_what_the_table_is_to_cover_in_six_hours() -> None:
    assert len(BY_NAME) == len(CELLS) <= 60
    assert sum(cell.seconds * cell.seeds for cell in CELLS) < 6 * 3600
    assert {cell.scene for cell in CELLS} == set(gallery_names())
    scenes = [cell.described(0) for cell in CELLS]
    assert {scene.render.sampler for scene in scenes} == set(get_args(Sampler))
    assert {scene.calibration.method for scene in scenes} == {"ideal", "points", "transport"}
    assert "geometry" in {scene.calibration.fit for scene in scenes}
    assert {len(scene.camera.lens) for scene in scenes} >= {1, 2, 3}
    sizes = {derive(scene).rows for scene in scenes}
    assert (min(sizes), max(sizes)) == (19, 479)


@pytest.mark.slow
def test_every_cell_has_a_method_and_can_be_rendered() -> None:
    needs("llvm_ad_mono")
    for cell in CELLS:
        scene = cell.described(0)
        setup = Setup.from_scene(scene)
        check_scene(setup)
        choose_method(scene, setup.camera, setup.has_structured_matrix)


def test_cells_of_fewer_samples_than_the_scene_asks_for_are_known() -> None:
    few = {cell.name for cell in CELLS if cell.has_few_samples}
    assert {"tile19-transport-64", "photo-119-flat-256", "tile19-bright-transport-1024"} <= few
    assert not few & {"tile19-transport-4096", "photo-119-transport-896", "tile19-ideal", "tile19-points-4096"}


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


def test_the_definition_of_a_cell_is_the_same_in_every_checkout(tmp_path: Path) -> None:
    shutil.copytree(GALLERY, tmp_path, dirs_exist_ok=True, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for name in gallery_names():
        here, there = (Cell("a cell", scene, (), 1).definition for scene in (name, str(tmp_path / f"{name}.toml")))
        assert here == there


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


def test_the_cells_that_fail_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(20):
        append(tmp_path, CELL, run_of(number, 3.0 if number < 3 else 1.0, trusted=number > 0))
        append(tmp_path, BY_NAME["tile19-transport-64"], run_of(number, 1.0))
    command.command(["-o", str(tmp_path), "--table"])
    printed = capsys.readouterr().out
    assert f"in 1 of 2 cells: {CELL.name} (17 of 20 inside, 1 of 20 red)." in printed
    assert "| tile19-transport-64 † | 20 |" in printed


def test_a_run_that_cannot_be_made_is_recorded_as_failed() -> None:
    result = measured_run(Cell("failing", "tile19", ("target.origin=[5000, 0]",), 1), 0)
    assert isinstance(result, Failure)
    assert result.error.startswith("InputError: ")
    assert "leaves the picture" in result.error


def test_an_unknown_cell_is_refused() -> None:
    with pytest.raises(SystemExit, match="'tile20' is not a cell"):
        command.command(["--cells", "tile20"])
