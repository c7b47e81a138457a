"""The command `reconstruct` on several stacks of one camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable_sentence

from . import failures, output

if TYPE_CHECKING:
    from ommatid.batch.frames import Frame, FrameOptions
    from ommatid.reconstruct.output.run_json import RunReport


def reconstruct(
    stacks: Sequence[Path],
    shared: FrameOptions,
    folder: Path,
    scheduler: str,
    workers: int | None,
    strict: bool,
    detail: output.Detail | None,
) -> None:
    """Reconstruct every stack with one model, and print a row, a table or a verdict for each; None: as JSON.

    Raises InputError before anything is written if a stack is not of the model's camera, and BatchError at the end if a
    frame failed or, if `strict`, if one is not to be trusted.
    """
    from ommatid.batch.frames import reconstruct_frames

    if not stacks:
        raise InputError(f"{shared.model}: expected stacks and then their model, got one file; name a stack before it")
    if scheduler:
        raise InputError("--scheduler: sends the tiles of one stack, got several stacks; take --workers instead")
    described: dict[Path, DescribedFrame] = {}
    with output.progress_bar("reconstruct") as progress:
        for frame, work in reconstruct_frames(stacks, folder, shared, workers, progress):
            described[frame.stack] = _described(frame, work, strict, quiet=detail == "verdict")
    _print(folder, [described[stack] for stack in stacks], detail)
    worst = max(frame.code for frame in described.values())
    if worst:
        raise failures.BatchError(worst)


@dataclass(frozen=True)
class DescribedFrame:
    """A frame's JSON object, its row, its exit code, and its report; None for one that failed."""

    document: dict[str, Any]
    row: tuple[str, str]
    code: int
    report: RunReport | None


def _print(folder: Path, frames: Sequence[DescribedFrame], detail: output.Detail | None) -> None:
    from ommatid.analysis import run_table
    from ommatid.pipeline.sections import verdict_line

    if detail is None:
        output.print_json([frame.document for frame in frames])
    elif detail == "verdict":
        output.print_lines(verdict_line(frame.row[0], frame.report) for frame in frames if frame.report is not None)
    elif detail == "table":
        pairs = [(frame.row[0], frame.report) for frame in frames if frame.report is not None]
        output.print_tables((name, run_table.rows(report)) for name, report in pairs)
    else:
        output.print_tables([(f"{len(frames)} frames: {folder}", [frame.row for frame in frames])])


def _described(frame: Frame, work: Callable[[], tuple[RunReport, bool]], strict: bool, quiet: bool) -> DescribedFrame:
    """Finish a frame, and return what is printed of it."""
    from ommatid.analysis.run_table import frame_row
    from ommatid.reconstruct.output.verdict_words import is_trusted

    name, heading = frame.output.name, {"file": str(frame.output), "stack": str(frame.stack)}
    try:
        report, made = work()
    except Exception as error:
        code, reason = failures.report(error), printable_sentence(error)
        document = {**heading, "error": reason, "exit_code": code}
        return DescribedFrame(document, (name, f"failed: {reason}"), code, None)
    if not quiet:
        output.say_done("reconstruct", made, frame.output)
    code = failures.NOT_TRUSTED if strict and not is_trusted(report) else 0
    return DescribedFrame({**heading, **report.plain()}, frame_row(name, report), code, report)
