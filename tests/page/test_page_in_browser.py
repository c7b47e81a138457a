"""The pages in headless Chromium, operated by mouse, keyboard and touch."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, ConsoleMessage, Error, Page, Request, sync_playwright

from ommatid.page import batch_index
from ommatid.page.data import Run
from ommatid.page.document import page as page_of
from ommatid.runtime.arrays import FloatArray
from ommatid.simulate.ideal import matrix_as_designed

from .runs import F, letter_run, synthetic

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
TIMEOUT = 30_000  # milliseconds, enough for a busy machine
MAPS = ("truth", "estimate", "error", "deviation")

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here; `make browser` installs Debian's")


@pytest.fixture(scope="module")
def browser() -> Generator[Browser]:
    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run of a letter F, 24 x 24."""
    return letter_run(tmp_path_factory.mktemp("letter"))


@pytest.fixture(scope="module")
def letter(run: Run) -> Path:
    """The page of this run."""
    path = run.folder / "report.html"
    path.write_text(page_of(run, lambda sub: matrix_as_designed(run.stack.camera, sub), None, "0"), encoding="utf-8")
    return path


Opened = Callable[..., Any]


@pytest.fixture
def shown(browser: Browser) -> Opened:
    """Open a page; afterwards there must have been no errors, warnings or requests."""

    @contextmanager
    def show(path: Path, *, width: int = 1600, dark: bool = False, touch: bool = False) -> Generator[Page]:
        messages: list[str] = []
        requests: list[str] = []

        def on_message(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning"):
                messages.append(message.text)

        def on_error(error: Error) -> None:
            messages.append(str(error))

        def on_request(request: Request) -> None:
            requests.append(request.url)

        context = browser.new_context(
            viewport={"width": width, "height": 900},
            color_scheme="dark" if dark else "light",
            has_touch=touch,
            is_mobile=touch,
        )
        context.set_default_timeout(TIMEOUT)
        page = context.new_page()
        page.on("console", on_message)
        page.on("pageerror", on_error)
        page.on("request", on_request)
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-printable=yes]", state="attached")
        yield page
        context.close()
        assert messages == []
        pictures = [url for url in requests if url.startswith(path.parent.as_uri()) and url.endswith(".png")]
        assert [url for url in requests if not url.startswith("data:") and url not in pictures] == [path.as_uri()]

    return show


def ranges(page: Page) -> dict[str, list[float]]:
    """Left, right, bottom and top of each map, from Bokeh's ranges."""
    script = """names => Object.fromEntries(names.map(name => {
        const { x_range: x, y_range: y } = Bokeh.documents[0].get_model_by_name(name);
        return [name, [x.start, x.end, y.start, y.end]];
    }))"""
    return page.evaluate(script, list(MAPS))


def same(ends: list[float]) -> dict[str, list[float]]:
    """The same ranges for all maps."""
    return dict.fromkeys(MAPS, ends)


def tip(page: Page, x: float, y: float) -> dict[str, str]:
    """Labels and values of the tooltip at a position of the pointer."""
    page.mouse.move(2, 2)
    page.mouse.move(x, y)
    shown = page.locator(".bk-Tooltip:visible").first
    shown.wait_for(state="visible")
    labels, values = (
        [text.strip() for text in shown.locator(f".bk-tooltip-row-{part}").all_inner_texts()]
        for part in ("label", "value")
    )
    return {label.rstrip(":"): value for label, value in zip(labels, values, strict=True)}


def position(page: Page, name: str, row: float, column: float) -> tuple[float, float]:
    """Position of a map's point (row, column) on the screen."""
    script = """([name, row, column]) => {
        const view = [...Bokeh.index.roots].find(candidate => candidate.model.name === name);
        const box = view.el.getBoundingClientRect();
        return [box.x + view.frame.x_scale.compute(column), box.y + view.frame.y_scale.compute(row)];
    }"""
    page.locator(f"#plot-{name}").scroll_into_view_if_needed()
    x, y = page.evaluate(script, [name, row, column])
    return x, y


def pixels(page: Page, name: str) -> FloatArray:
    """Colours on the canvas at the centres of all 24 x 24 pixels of a map: (24, 24, 3)."""
    script = """name => {
        const view = [...Bokeh.index.roots].find(candidate => candidate.model.name === name);
        const { canvas } = view.canvas_view.primary;
        const ratio = canvas.width / view.el.getBoundingClientRect().width;
        const copy = document.createElement("canvas");
        [copy.width, copy.height] = [canvas.width, canvas.height];
        const context = copy.getContext("2d", { willReadFrequently: true });
        context.drawImage(canvas, 0, 0);
        const colours = [];
        for (let row = 0; row < 24; row++) for (let column = 0; column < 24; column++) {
            const x = ratio * view.frame.x_scale.compute(column + 0.5);
            const y = ratio * view.frame.y_scale.compute(row + 0.5);
            colours.push([...context.getImageData(Math.round(x), Math.round(y), 1, 1).data.slice(0, 3)]);
        }
        return colours;
    }"""
    return np.array(page.evaluate(script, name), dtype=np.float64).reshape(24, 24, 3)


# --- appearance


def test_a_letter_is_upright_with_square_pixels(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        for name in ("truth", "estimate"):
            colours = pixels(page, name)
            np.testing.assert_array_equal(colours[..., 0], colours[..., 2])  # grey
            np.testing.assert_array_equal(colours[..., 0] > 128, F)
        (left, top), (right, bottom) = position(page, "truth", 0, 0), position(page, "truth", 24, 24)
        assert right - left == pytest.approx(bottom - top, abs=2)
        assert right - left > 200


def test_errors_are_the_difference_of_two_maps(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        maps = page.evaluate("""() => {
            const { truth, estimate, error } = Bokeh.documents[0].get_model_by_name("maps").data;
            return [truth, estimate, error].map(map => [...map[0]]);
        }""")
    truth, estimate, error = (np.array(values) for values in maps)
    np.testing.assert_allclose(error, estimate - truth, atol=1e-4)
    assert np.abs(error).max() > 0.01


@pytest.mark.parametrize("width", [390, 768, 1600])
def test_no_width_needs_horizontal_scrolling(width: int, letter: Path, shown: Opened) -> None:
    with shown(letter, width=width) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        boxes = [page.locator(f"#plot-{name}").bounding_box() for name in MAPS]
        tops = {round(box["y"]) for box in boxes if box}
        assert len(tops) == {390: 4, 768: 2, 1600: 1}[width]
        outside = page.evaluate("""() => [...document.querySelectorAll("figure")]
            .filter(figure => figure.getBoundingClientRect().right > innerWidth).length""")
        assert outside == 0


def test_a_dark_colour_scheme_darkens_page_and_figures_but_not_maps(letter: Path, shown: Opened) -> None:
    def look(page: Page) -> tuple[str, str, str]:
        background = page.evaluate("getComputedStyle(document.body).backgroundColor")
        axis = "Bokeh.documents[0].get_model_by_name('truth').below.find(part => part.type === 'LinearAxis')"
        return (
            background,
            page.evaluate(f"{axis}.major_label_text_color"),
            page.evaluate(f"{axis}.axis_label_text_color"),
        )

    with shown(letter) as page:
        light = look(page)
        before = pixels(page, "truth")
        page.emulate_media(color_scheme="dark")
        page.wait_for_selector("html[data-look=dark]", state="attached")
        dark = look(page)
        np.testing.assert_array_equal(pixels(page, "truth"), before)
    with shown(letter, dark=True) as page:
        assert look(page) == dark
    assert all(before != after for before, after in zip(light, dark, strict=True))
    assert light[0] == "rgb(255, 255, 255)"


# --- interaction


def test_the_wheel_zooms_all_maps_with_ctrl_and_scrolls_the_page_without(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        whole = ranges(page)
        assert whole == same([0, 24, 24, 0])
        page.mouse.move(*position(page, "error", 6, 6))
        page.mouse.wheel(0, 100)  # without Ctrl: scrolls the page
        page.mouse.move(*position(page, "error", 6, 6))
        page.keyboard.down("Control")
        page.mouse.wheel(0, -240)
        page.keyboard.up("Control")
        page.wait_for_function("Bokeh.documents[0].get_model_by_name('truth').x_range.end < 23.9")
        zoomed = ranges(page)
        assert zoomed == same(zoomed["truth"])
        left, right, bottom, top = zoomed["truth"]
        assert right - left == pytest.approx(bottom - top)
        assert left < 6 < right
        assert top < 6 < bottom


def test_dragging_moves_all_maps_and_reset_restores_them(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        x, y = position(page, "estimate", 12, 12)
        pitch = position(page, "estimate", 12, 13)[0] - x
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 3 * pitch, y - 2 * pitch, steps=4)
        page.mouse.up()
        page.wait_for_function("Bokeh.documents[0].get_model_by_name('truth').x_range.start < -2")
        moved = ranges(page)
        assert moved == same(moved["truth"])
        assert moved["truth"] == pytest.approx([-3, 21, 26, 2], abs=0.2)
        tools = page.locator("#image .tools")
        tools.get_by_role("button", name="Reset").click()
        assert ranges(page) == same([0, 24, 24, 0])
        tools.get_by_role("button", name="zoom in").press("Enter")
        assert ranges(page) == same([4, 20, 20, 4])


def test_a_finger_scrolls_the_page_until_a_map_is_zoomed(letter: Path, shown: Opened) -> None:
    moves = "Bokeh.documents[0].get_model_by_name('truth').toolbar.tools.find(tool => tool.type === 'PanTool').active"
    with shown(letter, width=390, touch=True) as page:
        tools = page.locator("#image .tools")
        assert not page.evaluate(moves)
        tools.get_by_role("button", name="zoom in").tap()
        assert page.evaluate(moves)
        tools.get_by_role("button", name="zoom out").tap()
        assert ranges(page) == same([0, 24, 24, 0])
        assert not page.evaluate(moves)


def test_the_pointer_shows_the_values_of_all_maps(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        maps = page.evaluate("""() => {
            const { data } = Bokeh.documents[0].get_model_by_name("maps");
            return Object.fromEntries(Object.entries(data).map(([name, map]) => [name, map[0][5 * 24 + 17]]));
        }""")
        for name in MAPS:
            shown_values = tip(page, *position(page, name, 5.5, 17.5))
            assert (shown_values.pop("row"), shown_values.pop("column")) == ("5", "17")
            shown_values["deviation"] = shown_values.pop("standard deviation")
            # Five digits are shown.
            assert {key: float(value) for key, value in shown_values.items()} == pytest.approx(maps, rel=1e-4)
        page.locator("#pixel [name=row]").fill("5")
        page.locator("#pixel [name=column]").fill("17")
        output = dict(item.rsplit(maxsplit=1) for item in page.locator("#pixel output").inner_text().split(", "))
        output["deviation"] = output.pop("standard deviation")
        assert {key: float(value) for key, value in output.items()} == pytest.approx(maps, rel=1e-4)
        page.locator("#pixel [name=row]").fill("99")
        assert page.locator("#pixel output").inner_text() == "outside the image"


def test_the_pointer_identifies_sub_images(letter: Path, run: Run, shown: Opened) -> None:
    with shown(letter) as page:
        row, column, k, l = page.evaluate("""() => {
            const { data } = Bokeh.documents[0].get_model_by_name("sensor");
            return [data.packed_row[1], data.packed_column[1], data.k[1], data.l[1]];
        }""")  # noqa: E741
        values = tip(page, *position(page, "packed", row + 1.5, column + 2.5))
    assert values["lens type"] == "A"
    assert values["sub-imager k, l"] == f"{k}, {l}"
    assert values["sensor row in the sub-image"] == "1"
    assert values["sensor column in the sub-image"] == "2"
    inverted = run.stack.images()[1][::-1, ::-1]
    # Rounded to 1/65534 of a range below 255, and shown with five digits.
    assert float(values["value"]) == pytest.approx(inverted[1, 2], abs=0.5 * 255 / 65534 + 0.005)


def test_a_lens_type_is_chosen_and_drawn(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        first, second = page.locator("#plot-response-A-measured"), page.locator("#plot-response-B-measured")
        assert first.is_visible()
        assert not second.is_visible()
        page.locator("#lens").select_option("B")
        second.locator("canvas").first.wait_for(state="visible")
        assert not first.is_visible()
        page.wait_for_function("document.querySelector('#print-response-B-measured').src.length > 1000")
        box = second.locator("canvas").first.bounding_box()
        assert box
        assert min(box["width"], box["height"]) > 100


# --- print


@pytest.mark.parametrize("dark", [False, True])
def test_print_is_light_with_every_figure_and_without_tools(dark: bool, letter: Path, shown: Opened) -> None:
    with shown(letter, dark=dark) as page:
        assert page.locator(".tools").first.is_visible()
        page.emulate_media(media="print", color_scheme="dark" if dark else "light")
        for selector in (".tools", "nav", ".pixel", ".choose", ".plot"):
            assert not any(element.is_visible() for element in page.locator(selector).all()), selector
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        for name in (*MAPS, "packed", "place", "errors", "response-A-measured"):
            picture = page.locator(f"#print-{name}")
            assert picture.is_visible()
            # Axes and text below a figure must be darker than paper.
            inked = """image => {
                const copy = document.createElement("canvas");
                [copy.width, copy.height] = [image.naturalWidth, image.naturalHeight];
                const context = copy.getContext("2d");
                context.drawImage(image, 0, 0);
                const top = image.naturalHeight - 40;
                const { data } = context.getImageData(0, top, image.naturalWidth, 40);
                let dark = 0;
                for (let at = 0; at < data.length; at += 4) dark += data[at + 3] > 200 && data[at] < 140;
                return dark;
            }"""
            assert picture.evaluate(inked) > 10
        assert len(page.pdf(format="A4")) > 50_000


# --- other pages


def test_a_calibrated_run_is_shown_without_errors(finished: Path, shown: Opened) -> None:
    with shown(finished / "report.html") as page:
        assert page.locator("h1").inner_text() == "Tiny"
        assert page.locator("#plot-response-I-difference canvas").first.is_visible()


def test_a_large_frame_is_drawn(run: Run, tmp_path: Path, shown: Opened) -> None:
    path = tmp_path / "report.html"
    path.write_text(page_of(synthetic(run, (1024, 1024)), None, None, "0"), encoding="utf-8")
    assert path.stat().st_size < 3_000_000
    with shown(path) as page:
        assert ranges(page)["truth"] == [0, 1024, 1024, 0]


def test_a_batch_is_shown(finished: Path, tmp_path: Path, shown: Opened) -> None:
    for name in ("a", "b"):
        shutil.copytree(finished, tmp_path / name)
    batch_index.cached_index(tmp_path, {tmp_path / "a": "", tmp_path / "b": "", tmp_path / "c": "c.toml: is not there"})
    for width in (390, 1600):
        with shown(tmp_path / "index.html", width=width) as page:
            assert page.evaluate("document.documentElement.scrollWidth") <= width
            assert page.locator("#plot-scenes canvas").first.is_visible()
            assert page.locator(".scenes img").first.evaluate("image => image.naturalWidth") == 12
            assert page.get_by_role("link", name="Tiny").first.get_attribute("href") == "a/report.html"
