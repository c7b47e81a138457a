"""The drawing of a camera: lengths, units and light as in the camera, and figures as files and in pages."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from ommatid.figures.camera_drawing import camera_drawing
from ommatid.figures.saving import FigureFiles, save_figure, svg_text
from ommatid.figures.sensor_drawing import length_words
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.geometry.optical_terms import ThroughFocus
from ommatid.scenes.scene import read

from ..examples import slow
from ..modules import ROOT

CASES = ("tile19", "sensor", *(slow(name) for name in ("single", "corridor")))
BLACK_TARGET = 4  # line width of the target


@pytest.fixture(scope="module", params=CASES)
def drawn(request: pytest.FixtureRequest) -> tuple[Camera, Any]:
    scene = read(Path(request.param))
    camera = derive(scene)
    return camera, camera_drawing(scene, camera)


def test_light_ends_at_the_edges_of_the_window_on_the_target(drawn: tuple[Camera, Any]) -> None:
    """Rays are drawn from the patch through the lens; the window follows from the grid of the target alone."""
    camera, figure = drawn
    far = figure.axes[1]
    ends = sorted(line.get_ydata()[-1] for line in far.lines if len(line.get_xdata()) == 3)
    edges: list[float] = []
    for lens_type in camera.types:
        k, l = (count // 2 for count in lens_type.array)  # noqa: E741
        start = float(lens_type.view(k, l).window[1])
        columns = start, start + float(lens_type.ratio) * lens_type.pixels[1]
        edges += [camera.position(0, column)[0] for column in columns]
    assert ends == pytest.approx(sorted(edges), rel=1e-9, abs=1e-9 * camera.target_pitch)
    [target] = [line for line in far.lines if line.get_linewidth() == BLACK_TARGET]
    assert np.ptp(target.get_ydata()) == pytest.approx(camera.columns * camera.target_pitch)
    assert set(target.get_xdata()) == {camera.distance}


def test_every_axis_has_ticks_and_a_unit(drawn: tuple[Camera, Any]) -> None:
    _, figure = drawn
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            inside = [tick for tick in axis.get_ticklocs() if low <= tick <= high]
            assert not inside or axis.get_label_text().endswith(("(mm)", "(µm)"))
        assert len(axes.xaxis.get_ticklocs()) > 1


def test_the_break_states_how_the_scales_differ(drawn: tuple[Camera, Any]) -> None:
    """Inches per millimetre are measured on the finished figure."""
    _, figure = drawn
    near, far = figure.axes[:2]
    scales: list[Any] = []
    for axes in (near, far):
        corners = axes.transData.transform([(0.0, 0.0), (1.0, 1.0)])
        scales.append(corners[1] - corners[0])
    along, across = scales[0] / scales[1]
    [words] = [text.get_text() for text in figure.texts if "break" in text.get_text()]
    stated = [float(word) for word in words.split() if word[0].isdigit()]
    assert stated == pytest.approx([max(along, 1 / along), max(across, 1 / across)], rel=6e-3)  # three digits


def test_all_patches_are_drawn_where_they_are(drawn: tuple[Camera, Any]) -> None:
    camera, figure = drawn
    face = figure.axes[2]
    paths = [path.vertices[:4] for drawing in face.collections for path in drawing.get_paths() if len(path) == 5]
    assert len(paths) == len(camera.sub_imagers)
    for corners, sub in zip(paths, camera.sub_imagers, strict=True):
        assert corners.mean(axis=0) == pytest.approx(sub.patch)
        assert np.ptp(corners, axis=0) == pytest.approx(np.array(sub.type.pixels)[::-1] * camera.pixel_pitch)
    left, right = face.get_xlim()
    assert left > right, "x runs to the left in a view from behind"


def test_the_outline_of_the_sensor_is_drawn_around_the_sub_images() -> None:
    scene = read(Path("sensor"), ['camera.sensor.size=["4.55 mm", "6.17 mm"]'])
    camera = derive(scene)
    face = camera_drawing(scene, camera).axes[2]
    [outline] = face.patches
    assert (outline.get_height(), outline.get_width()) == pytest.approx((4.55, 6.17))
    left, low = outline.get_xy()
    for sub in camera.sub_imagers:
        assert left < sub.patch[0] < left + 6.17
        assert low < sub.patch[1] < low + 4.55
    ends = sorted(face.get_xlim())
    assert ends[0] < left < left + 6.17 < ends[1]
    used = 100 * camera.measurements * camera.pixel_pitch**2 / (4.55 * 6.17)
    assert any(f"4.55 mm x 6.17 mm, {used:.2g} % used" in text.get_text() for text in face.texts)


def test_svg_for_a_page_takes_the_page_s_colour() -> None:
    scene = read(Path("single"))
    figure = camera_drawing(scene, derive(scene))
    text = svg_text(figure, "drawing")
    root = ElementTree.fromstring(text)
    assert root.tag.endswith("svg")
    assert not {"width", "height"} & set(root.attrib)
    assert "#000000" not in text
    assert "#ffffff" not in text
    assert "currentColor" in text
    assert any("break" in (element.text or "") for element in root.iter())
    assert text == svg_text(figure, "drawing")


def test_figures_are_written_in_every_format_and_the_same_again(tmp_path: Path) -> None:
    from matplotlib.figure import Figure

    kinds = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        figure: Any = Figure(figsize=(2, 2))
        figure.subplots().plot([1, 2], label="a")
        FigureFiles(("png", "svg", "pdf")).replace(figure, folder / "camera.png")
    assert {path.name for path in (tmp_path / "a").iterdir()} == {f"camera.{name}" for name in kinds}
    for name, start in kinds.items():
        content = (tmp_path / "a" / f"camera.{name}").read_bytes()
        assert content.startswith(start)
        assert content == (tmp_path / "b" / f"camera.{name}").read_bytes()


def test_dots_per_inch_are_those_asked_for(tmp_path: Path) -> None:
    from matplotlib.figure import Figure
    from skimage import io

    save_figure(Figure(figsize=(2, 1)), tmp_path / "f.png", resolution=300)
    pixels: Any = io.imread(tmp_path / "f.png")  # pyright: ignore[reportUnknownMemberType]
    assert pixels.shape[:2] == (300, 600)


def test_lengths_have_the_unit_that_suits_them() -> None:
    lengths = [length_words(length) for length in (0.006, 1000.0, 19.0, 4.1e-5, 1.0)]
    assert lengths == ["6 µm", "1 m", "19 mm", "41 nm", "1 mm"]


def test_the_drawing_in_the_documentation_is_that_of_the_program(tmp_path: Path) -> None:
    """All words and numbers of docs/camera.svg are those of a new drawing of the scene that the page names."""
    scene = read(Path("sensor"))
    save_figure(camera_drawing(scene, derive(scene)), tmp_path / "camera.svg", ["svg"])
    assert words_of(ROOT / "docs" / "camera.svg") == words_of(tmp_path / "camera.svg")


def words_of(path: Path) -> list[str]:
    """All texts of a drawing but the one that names Matplotlib's version."""
    root = ElementTree.parse(path).getroot()
    texts = (element.text.strip() for element in root.iter() if element.text and element.text.strip())
    return sorted(text for text in texts if not text.startswith("Matplotlib v"))


def test_contrast_through_focus_is_drawn_where_there_are_curves() -> None:
    """Solid on the axis and dashed at the rim, in the colour of the type; the title has half of Nyquist, 1 / 4 p."""
    scene = read(Path("sensor"))
    camera = derive(scene)
    shifts = np.linspace(-0.1, 0.1, 5)
    curves = [ThroughFocus("II", shifts, 1 - np.abs(shifts), 0.5 - shifts)]
    without, drawn_axes = (camera_drawing(scene, camera, curves=each).axes for each in ([], curves))
    assert len(drawn_axes) == len(without) + 1
    axes = drawn_axes[-1]
    solid, dashed = axes.lines[:2]
    np.testing.assert_allclose(solid.get_xydata(), np.stack([100 * np.linspace(-1, 1, 5), curves[0].axis], axis=1))
    np.testing.assert_allclose(dashed.get_ydata(), curves[0].rim)
    assert (solid.get_linestyle(), dashed.get_linestyle()) == ("-", "--")
    assert f"{1 / (4 * camera.pixel_pitch):.3g} cycles/mm" in axes.get_title(loc="left")
