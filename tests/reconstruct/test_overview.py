"""The overview of a result: its headline, and no empty slot whatever is known."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from ommatid.reconstruct.output import run_json, verdict_words
from ommatid.reconstruct.output.facts import headline
from ommatid.reconstruct.output.overview import OVERVIEW, grid, write_overview
from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes import stack as stack_file

from ..kept_figures import KeptFigures


@pytest.mark.parametrize("count", range(3, 25))
def test_the_last_panel_fills_what_is_left(count: int) -> None:
    rows, columns = grid(count)
    assert rows * columns >= count > (rows - 1) * columns, "the last row begins with a panel of its own"


def drawn(folder: Path) -> Any:
    figures = KeptFigures()
    channels = read_estimate(folder / ESTIMATE).channels
    write_overview(folder, stack_file.read(folder / "stack.exr"), channels, run_json.read(folder), figures)
    return figures.kept[Path(OVERVIEW).stem]


@pytest.mark.parametrize("known", [True, False])
def test_every_slot_is_filled_and_every_axis_has_a_unit(known: bool, finished: Path, without_truth: Path) -> None:
    figure = drawn(finished if known else without_truth)
    panels = [axes for axes in figure.axes if axes.get_label() != "<colorbar>"]
    specs = [axes.get_subplotspec().get_topmost_subplotspec() for axes in panels]
    cells = [cell for spec in specs for cell in range(spec.num1, spec.num2 + 1)]
    rows, columns = specs[0].get_gridspec().get_geometry()
    assert sorted(cells) == list(range(rows * columns))
    titles = " ".join(axes.get_title() for axes in panels)
    assert ("Truth" in titles, "Error: estimate" in titles) == (known, known)
    for axes in figure.axes:
        labels = [axes.get_xlabel(), axes.get_ylabel()]
        assert any(label.endswith(("pixels)", "(%)", "levels)", "(0 to 255)")) for label in labels), labels


def test_the_headline_is_the_verdict_and_the_error(finished: Path) -> None:
    report = run_json.read(finished)
    error = report.error
    assert error.mse is not None
    assert error.expected_given_truth is not None
    root, expected = error.mse**0.5, error.expected_given_truth.mse**0.5
    assert headline(report).startswith(f"RMS error {root:.3g} grey levels (expected {expected:.3g})")
    words = [text.get_text() for text in drawn(finished).texts]
    heading = verdict_words.heading(report).capitalize()
    assert any(text.startswith(f"{heading}: RMS error") for text in words)


@pytest.mark.parametrize(("gain", "words"), [(8.25, "gain 8.2 dB"), (-1.5, "gain -1.5 dB"), (None, None)])
def test_the_gain_over_the_best_single_sub_image_is_said(gain: float | None, words: str | None, finished: Path) -> None:
    report = run_json.read(finished)
    error = report.error.model_copy(update={"gain": gain})
    said = headline(report.model_copy(update={"error": error}))
    assert (f"{words} (over the best sub-image, " in said) if words else ("sub-image" not in said)


def test_without_the_truth_the_error_is_expected(finished: Path) -> None:
    document = json.loads((finished / run_json.RUN).read_text(encoding="utf-8"))
    document["error"] = {name: document["error"][name] for name in ("predicted_mse", "budget")}
    report = RunReport.model_validate(document)
    assert (
        headline(report)
        == f"expected RMS error {report.error.predicted_mse**0.5:.3g} grey levels (the truth is not known)"
    )
