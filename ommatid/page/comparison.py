"""comparison.html: two runs side by side, with their numbers, pictures, and the keys in which their scenes differ."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import replace
from math import hypot, sqrt
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import numpy as np

from ommatid.reconstruct.output import facts, verdict_words
from ommatid.reconstruct.output.result_files import check_run_folder
from ommatid.reconstruct.output.run_json import ErrorReport
from ommatid.runtime.files import make_folder, write_text
from ommatid.runtime.input_files import real_path
from ommatid.runtime.outputs.kinds import check_output
from ommatid.scenes.scene import Scene

from . import maps
from .cached import REPORT, check_own_page
from .data import PageTable, Run, block_of, maps_of, read_run
from .document import fill

COMPARISON = "comparison.html"
NAMES = "A", "B"
MAPS = 7  # on the page: the truth, and estimate, error and error bar of either run
NAMED_TABLES = "name"  # key by which a list of tables is told apart


def write_comparison(first: Path, second: Path, output: Path) -> Path:
    """Write the page that compares the runs in two folders, and return its path.

    Raises InputError for folders without a finished run, and for another program's page in the way.
    """
    for folder in (first, second):
        check_run_folder(folder)
    runs = read_run(first), read_run(second)
    make_folder(output)
    path = output / COMPARISON
    check_output(path)
    check_own_page(path)
    urls = [quote(os.fsencode(os.path.relpath(folder / REPORT, output))) for folder in (first, second)]
    write_text(path, page(*runs, urls))
    return path


def page(first: Run, second: Run, urls: list[str]) -> str:
    """Return the page of two runs as HTML; urls : of their own pages."""
    runs = first, second
    names = [f"{name}: {run.title}" for name, run in zip(NAMES, runs, strict=True)]
    content: dict[str, Any] = {
        "title": "Two runs compared",
        "names": names,
        "folders": [real_path(run.folder).name for run in runs],
        "headings": [verdict_words.heading(run.report) for run in runs],
        "words": difference_words(first, second),
        "numbers": _numbers(runs),
        "differences": scene_differences(first.stack.scene, second.stack.scene),
        "report_urls": urls,
        "stamp": "0" * 64,
        **_pictures(runs),
    }
    return fill("comparison.html", content)


def difference_words(first: Run, second: Run) -> list[str]:
    """Return whose error is smaller and by how much, and what makes the two hard to compare, as sentences."""
    errors = first.report.error, second.report.error
    words = [_measured_words(*errors)] if None not in (errors[0].mse, errors[1].mse) else [_predicted_words(*errors)]
    if first.truth is not None and second.truth is not None and not np.array_equal(first.truth, second.truth):
        words.append("The targets differ, so that the errors are those of different pictures.")
    if first.report.measurements != second.report.measurements:
        words.append(
            f"The cameras take {first.report.measurements} and {second.report.measurements} measurements: more of them"
            " reduce the error in any case."
        )
    for name, run in zip(NAMES, (first, second), strict=True):
        if not run.report.verdict.trusted:
            words.append(f"{name} is not to be trusted: its numbers rest on assumptions that do not hold.")
    return words


def _measured_words(first: ErrorReport, second: ErrorReport) -> str:
    """Compare the measured errors.

    Either scatters about its expectation for its image as its 99 % interval says. If both expectations were equal, the
    difference would lie within the root of the sum of squares of the distances to the ends that face each other.
    """
    small, large, name = (first, second, "A") if (first.mse or 0) <= (second.mse or 0) else (second, first, "B")
    low, high = small.mse or 0.0, large.mse or 0.0
    words = f"{name} has the smaller error: {sqrt(low):.3g} against {sqrt(high):.3g} grey levels RMS"
    if low == high:
        words = f"Both have the same error, {sqrt(low):.3g} grey levels RMS"
    below, above = small.expected_given_truth, large.expected_given_truth
    if below is None or above is None:
        return f"{words}. Its uncertainty is not known: one of the runs states no interval for its image."
    uncertainty = hypot(below.mse - below.low, above.high - above.mse)
    is_larger = high - low > uncertainty
    return (
        f"{words}. The difference of the mean squared errors, {high - low:.4g}, is"
        f" {'larger' if is_larger else 'not larger'} than its uncertainty, {uncertainty:.3g} (99 %)"
        f"{'' if is_larger else ': it may be chance'}."
    )


def _predicted_words(first: ErrorReport, second: ErrorReport) -> str:
    """Compare the expected errors, which have no scatter, where a truth is not known."""
    roots = [sqrt(error.predicted_mse) for error in (first, second)]
    which = "A" if roots[0] < roots[1] else "B"
    return (
        f"A truth is not known. {which} is expected to have the smaller error on average over the prior's images:"
        f" {min(roots):.3g} against {max(roots):.3g} grey levels RMS."
    )


def scene_differences(first: Scene, second: Scene) -> PageTable:
    """Return the keys in which two scenes differ, with the values of both; absent ones are empty."""
    pairs = [dict(_keys(scene.plain())) for scene in (first, second)]
    names = sorted(pairs[0].keys() | pairs[1].keys())
    rows = [(name, *(str(each.get(name, "")) for each in pairs)) for name in names]
    return PageTable("Keys of the scenes that differ", ("key", *NAMES), [row for row in rows if row[1] != row[2]])


def _keys(content: Mapping[str, Any], before: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the keys of a scene with their values, as `--set` takes them: tables of a list by their names."""
    for name, value in content.items():
        if isinstance(value, Mapping):
            yield from _keys(cast(Mapping[str, Any], value), f"{before}{name}.")
        elif value and isinstance(value, list) and all(isinstance(item, Mapping) for item in cast(list[Any], value)):
            for number, item in enumerate(cast(list[Mapping[str, Any]], value)):
                yield from _keys(item, f"{before}{name}.{item.get(NAMED_TABLES, number)}.")
        else:
            yield f"{before}{name}", value


def _numbers(runs: tuple[Run, Run]) -> PageTable:
    """Return the facts that sum up both results, and those of their cameras, side by side."""
    columns: list[dict[str, str]] = []
    for run in runs:
        found = {fact.name: fact.words for fact in facts.on_topic(run.report, "error", "quality", "limit", "time")}
        area = run.stack.camera.measurements * run.stack.camera.pixel_pitch**2
        found |= {"measurements": str(run.report.measurements), "area of their pixels": f"{area:.4g} mm²"}
        columns.append(found)
    names = list(dict.fromkeys((*columns[0], *columns[1])))
    rows = [(name, *(column.get(name, "") for column in columns)) for name in names]
    return PageTable("Numbers of both runs", ("quantity", *NAMES), rows)


def _pictures(runs: tuple[Run, Run]) -> dict[str, Any]:
    """Return the maps of both runs with common colours, which move together where the images are equally large."""
    block, shapes = max(block_of(run.estimate.shape, MAPS) for run in runs), [run.estimate.shape for run in runs]
    pictures = [maps_of(run, block) for run in runs]
    scales = maps.scales_of(pictures)
    shown = [
        [
            replace(panel, name=f"{panel.name}-{name}", title=f"{panel.title}, {name}", difference=None)
            for panel in maps.panels(images, maps.TITLES, {}, scales)
        ]
        for name, images in zip(NAMES, pictures, strict=True)
    ]
    if shapes[0] == shapes[1]:
        groups = [maps.group("maps", [*shown[0], *shown[1]], block, shapes[0])]
    else:
        pairs = zip(NAMES, shown, shapes, strict=True)
        groups = [maps.group(f"maps-{name}", panels, block, shape) for name, panels, shape in pairs]
    names = [groups[0]["name"], groups[-1]["name"]]
    by_name = {panel.name: panel for panels in shown for panel in panels}
    cells = [
        (by_name.get(f"{kind}-{name}"), group, maps.ratio(*shape))
        for kind in maps.TITLES
        if any(kind in images for images in pictures)
        for name, group, shape in zip(NAMES, names, shapes, strict=True)
    ]
    tools = list(dict.fromkeys(names))
    return {"cells": cells, "block": block, "document": maps.document(groups), "group_names": tools}
