"""Print tables and JSON documents on stdout, and messages and progress bars on stderr."""

from __future__ import annotations

import json
import sys
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ommatid.batch.remote import RunObserver
    from ommatid.pipeline.sections import Section
    from ommatid.runtime.progress import Progress

FILE_OF_STAGE = {"render": "stack.exr", "report": "report.html"}


def say(text: str) -> None:
    """Print a sentence on stderr."""
    print(text, file=sys.stderr)


def say_all(command: str, sentences: Iterable[str]) -> None:
    """Print the warnings of a command on stderr, a line each."""
    for sentence in sentences:
        say(f"{command}: {sentence}")


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
        print(footer)


def print_tables(sections: Iterable[Section]) -> None:
    """Print titled tables of two columns on stdout. Brackets and colons in a title have no special meaning."""
    from rich.console import Console
    from rich.table import Table

    for title, lines in sections:
        table = Table("", "", title=title, title_justify="left", show_header=False)
        for name, value in lines:
            table.add_row(name, value, style="bold red" if (name, value[:3]) == ("verdict", "not") else None)
        Console(markup=False, emoji=False).print(table)


@contextmanager
def progress_bar(stage: str) -> Generator[Progress]:
    """Show a bar with the time left on stderr, where that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn(f"{stage:10}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(stage, total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)


def observer(folder: Path, *, alone: bool = False) -> RunObserver:
    """Create the observer that shows the progress of a run in `folder`, and says which stages are done.

    alone : True if the process runs this scene alone, so that its start belongs to the run
    """
    from ommatid.batch.remote import RunObserver
    from ommatid.runtime.processors import seconds_since_start

    def done(stage: str, made: bool) -> None:
        say_done(stage, made, folder / FILE_OF_STAGE[stage] if stage in FILE_OF_STAGE else None)

    return RunObserver(progress_bar, done, seconds_since_start if alone else None)
