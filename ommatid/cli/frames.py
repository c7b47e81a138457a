"""The command `reconstruct` on several stacks of one camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ommatid.runtime.errors import InputError

from . import failures, output

if TYPE_CHECKING:
    from ommatid.batch.frames import Frame, Region
    from ommatid.reconstruct.output.run_json import RunReport


def reconstruct(
    stacks: Sequence[Path],
    model: Path,
    folder: Path,
    changes: tuple[str, ...],
    lenses: tuple[str, ...],
    regions: tuple[Region, ...],
    scheduler: str,
    workers: int | None,
    strict: bool,
    as_json: bool,
) -> None:
    """Reconstruct every stack with one model, and print a row or a JSON object for each.

    Raises InputError before anything is written if a stack is not of the model's camera, and BatchError at the end if a
    frame failed or, if `strict`, if one is not to be trusted.
    """
    from ommatid.batch.frames import FrameOptions, reconstruct_frames

    if not stacks:
        raise InputError(f"{model}: expected stacks and then their model, got one file; name a stack before it")
    if scheduler:
        raise InputError("--scheduler: sends the tiles of one stack, got several stacks; take --workers instead")
    documents: dict[Path, dict[str, Any]] = {}
    rows: dict[Path, tuple[str, str]] = {}
    codes = [0]
    with output.progress_bar("reconstruct") as progress:
        asked = FrameOptions(model, changes, lenses, regions)
        for frame, work in reconstruct_frames(stacks, folder, asked, workers, progress):
            documents[frame.stack], rows[frame.stack], code = _described(frame, work, strict)
            codes.append(code)
    section = f"{len(stacks)} frames: {folder}", [rows[stack] for stack in stacks]
    output.print_result([documents[stack] for stack in stacks], [section], as_json)
    if max(codes):
        raise failures.BatchError(max(codes))


def _described(
    frame: Frame, work: Callable[[], tuple[RunReport, bool]], strict: bool
) -> tuple[dict[str, Any], tuple[str, str], int]:
    """Finish a frame, and return its JSON object, its row and its exit code."""
    from ommatid.analysis.run_table import frame_row
    from ommatid.reconstruct.output.verdict_words import is_trusted

    name, heading = frame.output.name, {"file": str(frame.output), "stack": str(frame.stack)}
    try:
        report, made = work()
    except Exception as error:
        code = failures.report(error)
        return {**heading, "error": str(error), "exit_code": code}, (name, f"failed: {error}"), code
    output.say_done("reconstruct", made, frame.output)
    code = failures.NOT_TRUSTED if strict and not is_trusted(report) else 0
    return {**heading, **report.plain()}, frame_row(name, report), code
