"""What a result shows: its overview, panels for slides, and its times."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.figures.panels import FigurePanel
from ommatid.reconstruct.output import run_json, slide, verdict_words
from ommatid.reconstruct.output.facts import headline
from ommatid.reconstruct.output.overview import OVERVIEW, grid, placed_sub_image, result_panels, write_overview
from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate
from ommatid.reconstruct.output.run_json import PAGE, RunReport
from ommatid.scenes import stack as stack_file

from ..cli.test_figures import STARTS
from ..conftest import Command
from ..examples import not_none
from ..kept_figures import KeptFigures
from ..runs import report_of


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
    root, expected = not_none(error.mse) ** 0.5, not_none(error.expected_given_truth).mse ** 0.5
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


# --- panels for slides


@pytest.fixture(scope="module")
def panels(finished: Path) -> dict[str, FigurePanel]:
    found = result_panels(read_estimate(finished / "estimate.exr").channels)
    stack = stack_file.read(finished / "stack.exr")
    return {**found, "sub-image": placed_sub_image(stack, None, found["estimate"].scale)}


def test_a_sub_image_stands_where_it_looks_at(panels: dict[str, FigurePanel]) -> None:
    """Behind pinholes a pixel is the mean of the truth in the square that it is drawn on, and in no other one."""
    truth, shown = panels["truth"].image, panels["sub-image"]
    place, side = tuple(map(int, shown.place[:2])), int(shown.place[2])
    rows, columns = shown.image.shape
    errors: dict[tuple[int, int], float] = {}
    for row in range(truth.shape[0] - rows * side + 1):
        for column in range(truth.shape[1] - columns * side + 1):
            seen = truth[row : row + rows * side, column : column + columns * side]
            means = seen.reshape(rows, side, columns, side).mean(axis=(1, 3))
            errors[row, column] = float(np.mean((shown.image - means) ** 2))
    assert len(errors) >= 4
    assert min(errors, key=lambda each: errors[each]) == place


def test_all_panels_show_one_part_and_grey_ones_have_one_scale(panels: dict[str, FigurePanel]) -> None:
    region, pitch = ((1, 2), (4, 6)), 0.5
    cropped: Any = slide._cropped  # pyright: ignore[reportPrivateUsage]
    figure = slide.slide([cropped(panels[name], region) for name in slide.PANELS], region, pitch, dark=True)
    shown = dict(zip(slide.PANELS, figure.axes, strict=False))
    for name, axes in shown.items():
        assert (axes.get_xlim(), axes.get_ylim()) == ((1.5, 7.5), (4.5, 0.5))
        if name != "sub-image":
            np.testing.assert_array_equal(axes.images[0].get_array(), panels[name].image[1:5, 2:8])
    assert len({shown[name].images[0].get_clim() for name in ("truth", "sub-image", "estimate")}) == 1
    low, high = shown["error"].images[0].get_clim()
    assert low == -high
    assert high == np.abs(panels["error"].image[1:5, 2:8]).max()
    bars = figure.axes[len(slide.PANELS) :]
    assert [bar.get_xlabel().split(" (")[0] for bar in bars] == ["grey level", "error", "standard deviation"]
    (bar,) = shown["truth"].patches
    (words,) = shown["truth"].texts
    assert (bar.get_width() * pitch, words.get_text()) == (1.0, "1 mm"), "35 % of 3 mm, rounded down"


@pytest.mark.parametrize(("most", "length"), [(1.0, 1.0), (4.99, 2.0), (0.06, 0.05), (999.0, 500.0)])
def test_the_scale_bar_is_a_round_length(most: float, length: float) -> None:
    assert slide.round_length(most) == pytest.approx(length, rel=1e-12)


def test_the_suffix_decides_the_format(finished: Path, tmp_path: Path, ommatid: Command) -> None:
    for suffix, start in STARTS.items():
        file = tmp_path / f"slide{suffix}"
        ended = ommatid("figure", finished, "-o", file, "--panels", "estimate,error", "--dark-ground", "--json")
        assert ended.code == 0, ended.err
        assert json.loads(ended.out) == {"file": str(file), "panels": ["estimate", "error"]}
        assert file.read_bytes().startswith(start)
    assert b"/FontFile2" in (tmp_path / "slide.pdf").read_bytes(), "the font is embedded"
    assert slide.DARK[0] in (tmp_path / "slide.svg").read_text(encoding="utf-8")


def test_what_cannot_be_drawn(finished: Path, without_truth: Path, tmp_path: Path, ommatid: Command) -> None:
    for run, arguments, message in (
        (finished, ("-o", "x.jpg"), ".png, .svg, .pdf, got '.jpg'"),
        (finished, ("-o", "x.png", "--panels", "truth,map"), "sub-image, estimate, error, deviation, got 'map'"),
        (finished, ("-o", "x.png", "--crop", "0,0,99,9"), "--crop: a region of 99 x 9 pixels"),
        (finished, ("-o", "x.png", "--crop", "0,0,9"), "--crop: expected ROW,COLUMN,ROWS,COLUMNS"),
        (finished, ("-o", "none/x.png"), "does not exist"),
        (without_truth, ("-o", "x.png", "--panels", "error"), "choose some of sub-image, estimate, deviation"),
        (tmp_path, ("-o", "x.png"), "expected the folder of a run, got one without estimate.exr"),
    ):
        ended = ommatid("figure", run, *arguments)
        assert (ended.code, len(ended.err.splitlines())) == (2, 1)
        assert message in ended.err
    assert list(tmp_path.iterdir()) == []
    assert ommatid("figure", without_truth, "-o", "x.svg").code == 0
    assert "Truth" not in (tmp_path / "x.svg").read_text(encoding="utf-8")


# --- times


BUDGET = {"null_space": 0.0, "noise": 1.0, "quantisation": 0.0, "rendering": 0.5, "calibration": 0.25, "detail": 0.0}


def timed(**spent: object) -> RunReport:
    """A report of 3.5 s in three stages, with these fields of its times."""
    stages = {
        "render": {"seconds": 2.0, "samples": 64, "sampler": "multijitter"},
        "calibrate": {"seconds": 1.0, "method": "points"},
        "reconstruct": {"seconds": 0.5},
    }
    return report_of(stages=stages, error={"predicted_mse": 1.75, "budget": BUDGET}, spent=spent)


def test_every_stage_counts_in_the_total_and_those_that_sample_in_the_time_with_more_samples() -> None:
    """Twice the samples take twice the 3 s of the stages that take samples, and 0.5 s as before."""
    report = timed().with_times(files=0.25, start_up=0.3).with_stage(PAGE, 0.75)
    assert report.seconds == pytest.approx(4.5)
    assert list(report.stages) == ["render", "calibrate", "reconstruct", "files", "page"]
    assert report.more_samples[0].seconds == pytest.approx(2 * 3 + 0.5)
    assert report.more_samples[0].predicted_mse == pytest.approx(1 + 0.75 * 2**-1.5)
    assert (report.noise_alone, report.spent.start_up) == (1.0, 0.3)


def test_a_time_limit_keeps_the_time_of_all_its_trials() -> None:
    report = timed(within=20.0, seconds=17.0, chosen={"render.samples": 64}).with_stage(PAGE, 0.75)
    assert (report.spent.within, report.spent.seconds, report.spent.chosen) == (20.0, 17.0, {"render.samples": 64})


@pytest.mark.parametrize("spent", [{}, {"within": 20.0, "seconds": 17.0}], ids=["plain", "time limit"])
def test_the_report_of_the_stages_is_the_same_whatever_time_files_and_page_took(spent: dict[str, float]) -> None:
    report = timed(**spent)
    for files, page in ((0.25, 0.75), (0.5, 1.0)):
        assert report.with_times(files, 0.3).with_stage(PAGE, page).of_stages().plain() == report.plain()
    assert report.with_stage("study", 0.5).of_stages().plain() != report.plain()
