"""Panels of a run for slides: the part that is shown, its scales, the scale bar, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.figures.panels import FigurePanel
from ommatid.reconstruct.output import slide
from ommatid.reconstruct.output.overview import placed_sub_image, result_panels
from ommatid.reconstruct.output.result_files import read_estimate
from ommatid.scenes import stack as stack_file

from ..cli.test_figures import STARTS
from ..conftest import Command


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
