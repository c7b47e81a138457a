"""Print tables and JSON documents on stdout, and messages and progress bars on stderr.

All other modules print by these functions, which escape and shorten what came from outside.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager, nullcontext, suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from ommatid.runtime.printable import LONGEST_MESSAGE, printable, printable_sentence
from ommatid.runtime.progress import Progress, no_progress

if TYPE_CHECKING:
    from ommatid.analysis.summary import Section
    from ommatid.batch.remote import RunObserver
    from ommatid.reconstruct.output.run_json import RunReport

Detail = Literal["table", "summary", "verdict"]

LONGEST_LINE = 1000  # characters of a line on stdout, or of a cell of a table
MOST_WARNINGS = 20  # which are printed of one list
WIDE = 72  # columns in which a table of several values keeps its names in one line
LEAST_WIDTH = 40  # columns of a table; in narrower ones, numbers would be cut off

FILE_OF_STAGE = {"render": "stack.exr", "report": "report.html"}


def say(text: str) -> None:
    """Print a sentence on stderr, unless its reader has gone."""
    with suppress(OSError, ValueError):
        print(printable_sentence(text, LONGEST_MESSAGE), file=sys.stderr)


def warn(sentence: str) -> None:
    """Print a warning on stderr."""
    say(f"warning: {sentence}")


def warn_all(sentences: Iterable[str]) -> None:
    """Print warnings on stderr, a line each: the first of very many."""
    sentences = list(sentences)
    for sentence in sentences[:MOST_WARNINGS]:
        warn(sentence)
    if len(sentences) > MOST_WARNINGS:
        warn(f"there are {len(sentences) - MOST_WARNINGS} more of these")


def say_done(command: str, made: bool, file: Path | None = None) -> None:
    """Say on stderr that a command or stage is done, or that its result was up to date."""
    say(f"{command}: {'done' if made else 'up to date, nothing to do'}{'' if file is None else f', {file}'}")


def print_json(document: object) -> None:
    """Print a JSON document on stdout. Raises ValueError for numbers that JSON does not have."""
    print(json.dumps(document, indent=2, allow_nan=False))


def print_result(document: object, sections: Iterable[Section], as_json: bool, footer: str = "") -> None:
    """Print the JSON document, or else the tables and a line below them."""
    if as_json:
        print_json(document)
        return
    print_tables(sections)
    if footer:
        print_lines([footer])


def print_tables(sections: Iterable[Section]) -> None:
    """Print titled tables on stdout. Brackets and colons in a title have no special meaning."""
    from rich.console import Console
    from rich.table import Table

    for title, lines in sections:
        console = Console(markup=False, emoji=False)
        console.width = max(console.width, LEAST_WIDTH)
        named = printable_sentence(title, LONGEST_MESSAGE)
        table = Table(title=named, title_justify="left", show_header=False)
        columns = max(map(len, lines), default=2)
        for column in range(columns):
            whole = column == 0 and columns > 2 and console.width >= WIDE  # names of quantities are short
            table.add_column(overflow="fold", no_wrap=whole)
        for name, *values in lines:
            table.add_row(
                printable(name),
                *(printable(value, LONGEST_LINE) for value in values),
                style="bold red" if name == "verdict" and values[0].startswith("not") else None,
            )
        console.print(table)


class Bars:
    """Bars with the time left on stderr, one below the other, where that is a terminal.

    progress : takes the finished fraction of the scenes of a batch
    """

    def __init__(self, quiet: bool = False, alone: bool = False) -> None:
        """Create bars; quiet : True to show and say nothing;  alone : True for a process that runs a single scene."""
        from rich import progress as rich_progress
        from rich.console import Console

        columns = (
            rich_progress.TextColumn("{task.description:11}"),
            rich_progress.BarColumn(),
            rich_progress.TaskProgressColumn(),
            rich_progress.TimeRemainingColumn(),
        )
        self.progress: Progress = no_progress
        self._quiet, self._alone = quiet, alone
        console = Console(stderr=True)
        disabled = quiet or not console.is_terminal
        self._shown = rich_progress.Progress(
            *columns,
            console=console,
            transient=True,
            disable=disabled,
            redirect_stdout=False,  # results never go to stderr
            speed_estimate_period=inf,  # the time left is estimated from all steps, each of which may take minutes
        )

    @contextmanager
    def bar(self, stage: str) -> Generator[Progress]:
        """Show a bar of a stage below those that are there."""
        if not self._shown.tasks:
            self._shown.start()
        task = self._shown.add_task(stage, total=1.0)
        try:
            yield lambda fraction: self._shown.update(task, completed=fraction)
        finally:
            self._shown.remove_task(task)
            if not self._shown.tasks:
                self._shown.stop()

    @contextmanager
    def hidden(self) -> Generator[None]:
        """Take the bars away while results are printed."""
        self._shown.stop()
        yield
        if self._shown.tasks:
            self._shown.start()

    def observer(self, folder: Path) -> RunObserver:
        """Create the observer that shows the progress of a scene in `folder`, and says which stages are done."""
        from ommatid.batch.remote import RunObserver
        from ommatid.runtime.machine import seconds_since_start

        def done(stage: str, made: bool) -> None:
            if not self._quiet:
                say_done(stage, made, folder / FILE_OF_STAGE[stage] if stage in FILE_OF_STAGE else None)

        return RunObserver(self.bar, done, seconds_since_start if self._alone else None)


@contextmanager
def progress_bar(stage: str, quiet: bool = False) -> Generator[Progress]:
    """Show a bar with the time left on stderr, where that is a terminal."""
    with Bars(quiet).bar(stage) as progress:
        yield progress


@contextmanager
def batch_bars(count: int, quiet: bool = False) -> Generator[Bars]:
    """Show the progress of a batch of so many scenes; quiet : True to show and say nothing."""
    bars = Bars(quiet, alone=count == 1)
    with nullcontext(no_progress) if count == 1 else bars.bar(f"{count} scenes") as bars.progress:
        yield bars


def print_lines(lines: Iterable[str], *, alarm: bool = False) -> None:
    """Print lines on stdout; with `alarm` the first in red where stdout is a terminal."""
    in_red = alarm and sys.stdout.isatty() and not os.environ.get("NO_COLOR")
    for number, line in enumerate(lines):
        words = printable(line, LONGEST_LINE)
        print(typer.style(words, fg="red", bold=True) if in_red and number == 0 else words)


def print_report(name: str, page: Path | None, report: RunReport, sections: Iterable[Section], detail: Detail) -> None:
    """Print the tables, the six lines or the verdict of a result.

    name : of the scene;  page : its report.html, None without one;  sections : its tables
    """
    from ommatid.reconstruct.output.facts import summary_lines, verdict_line

    if detail == "table":
        print_tables(sections)
        return
    lines = [verdict_line(name, report)] if detail == "verdict" else summary_lines(name, report, page)
    print_lines(lines, alarm=not report.verdict.trusted)
