"""Statistics of the runs of a cell, and the table of all cells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import nan

import numpy as np
from scipy import stats

from ommatid.reconstruct.expected_error import COVERAGE

from .run import Failure, Run

OUTSIDE = COVERAGE[0] + 1 - COVERAGE[1]  # share of errors outside correct intervals
CHANCE = 2e-3  # that a cell of correct error bars has more misses than are allowed
COLUMNS = (
    "cell",
    "runs",
    "error / promised",
    "error / expected",
    "inside",
    "chi-squared / expected",
    "z",
    "red",
    "false alarms",
    "silent misses",
)


@dataclass(frozen=True)
class Mean:
    """A mean over runs and its standard error; NaN without runs, the error also for one."""

    value: float
    error: float

    @classmethod
    def of(cls, values: Iterable[float]) -> Mean:
        """Return the mean of independent values."""
        sample = np.array(list(values), dtype=np.float64)
        if not sample.size:
            return cls(nan, nan)
        error = float(sample.std(ddof=1) / sample.size**0.5) if sample.size > 1 else nan
        return cls(float(sample.mean()), error)

    def __str__(self) -> str:
        error = "" if np.isnan(self.error) else f" ± {self.error:.3f}"
        return "-" if np.isnan(self.value) else f"{self.value:.3f}{error}"


@dataclass(frozen=True)
class CellStatistics:
    """Coverage in one cell.

    against_promise, against_expectation : measured error over that of Eq. 5, and over that expected for the image
    inside, judged : runs whose 99 % interval contains the error, of those that have an interval
    chi_squared : over its expectation;  z : its deviation from it in standard deviations
    red : runs not to be trusted;  false_alarms : red, error inside;  silent_misses : trusted, error outside
    """

    runs: int
    failed: int
    against_promise: Mean
    against_expectation: Mean
    inside: int
    judged: int
    chi_squared: Mean
    z: Mean
    red: int
    false_alarms: int
    silent_misses: int
    seconds: float

    @property
    def holds(self) -> bool:
        """False if more runs are outside than correct intervals would leave by chance."""
        return self.judged - self.inside <= allowed_misses(self.judged)

    def row(self, name: str) -> tuple[str, ...]:
        """Return the table's row."""
        inside = f"{self.inside} of {self.judged}" if self.judged else "-"
        return (
            name,
            f"{self.runs}" if not self.failed else f"{self.runs}, {self.failed} failed",
            str(self.against_promise),
            str(self.against_expectation),
            inside if self.holds else f"**{inside}**",
            str(self.chi_squared),
            "-" if np.isnan(self.z.value) else f"{self.z.value:+.2f}",
            f"{self.red}",
            f"{self.false_alarms}",
            f"{self.silent_misses}",
        )


def allowed_misses(runs: int) -> int:
    """Return the largest number of errors outside correct intervals that chance explains: 2 of 20, 3 of 40."""
    return int(stats.binom.isf(CHANCE, runs, OUTSIDE)) if runs else 0


def statistics(results: Iterable[Run | Failure]) -> CellStatistics:
    """Return the statistics of the runs of a cell."""
    results = list(results)
    runs = [result for result in results if isinstance(result, Run)]
    chi = [
        (run.chi_squared, run.chi_expected, run.chi_deviation)
        for run in runs
        if run.chi_squared is not None and run.chi_expected and run.chi_deviation
    ]
    return CellStatistics(
        runs=len(runs),
        failed=len(results) - len(runs),
        against_promise=Mean.of(run.mse / run.promised for run in runs if run.promised > 0),
        against_expectation=Mean.of(run.mse / run.expected for run in runs if run.expected),
        inside=sum(run.inside is True for run in runs),
        judged=sum(run.inside is not None for run in runs),
        chi_squared=Mean.of(value / expected for value, expected, _ in chi),
        z=Mean.of((value - expected) / deviation for value, expected, deviation in chi if deviation is not None),
        red=sum(not run.trusted for run in runs),
        false_alarms=sum(not run.trusted and run.inside is True for run in runs),
        silent_misses=sum(run.trusted and run.inside is False for run in runs),
        seconds=float(np.mean([run.seconds for run in runs])) if runs else nan,
    )


def markdown(rows: Sequence[tuple[str, ...]]) -> str:
    """Return the table of all cells in Markdown."""
    lines = [COLUMNS, ("---", *["---:"] * (len(COLUMNS) - 1)), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
