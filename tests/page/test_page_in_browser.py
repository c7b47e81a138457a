"""The page of a run in a real browser: headless Chromium, driven by its mouse and keys."""

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
from ommatid.simulate.ideal import matrix_as_designed

from .runs import F, lettered, synthetic

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
PATIENCE = 30_000  # milliseconds, for a busy machine
MAPS = ("truth", "estimate", "error", "deviation")

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no chromium here; `make browser` installs Debian's")


@pytest.fixture(scope="module")
def browser() -> Generator[Browser]:
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=CHROMIUM, headless=True, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run of a letter F, 24 x 24."""
    return lettered(tmp_path_factory.mktemp("letter"))


@pytest.fixture(scope="module")
def letter(run: Run) -> Path:
    """Its page."""
    path = run.folder / "report.html"
    path.write_text(page_of(run, lambda sub: matrix_as_designed(run.stack.camera, sub), None, "0"), encoding="utf-8")
    return path


Opened = Callable[..., Any]


@pytest.fixture
def shown(browser: Browser) -> Opened:
    """A page as it is shown; when it is left, nothing may have been complained of and nothing asked for."""

    @contextmanager
    def show(path: Path, *, width: int = 1600, dark: bool = False, touch: bool = False) -> Generator[Page]:
        complaints: list[str] = []
        requests: list[str] = []

        def said(message: ConsoleMessage) -> None:
            if message.type in ("error", "warning"):
                complaints.append(message.text)

        def broke(error: Error) -> None:
            complaints.append(str(error))

        def asked(request: Request) -> None:
            requests.append(request.url)

        context = browser.new_context(
            viewport={"width": width, "height": 900},
            color_scheme="dark" if dark else "light",
            has_touch=touch,
            is_mobile=touch,
        )
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.on("console", said)
        page.on("pageerror", broke)
        page.on("request", asked)
        page.goto(path.as_uri())
        page.wait_for_selector("html[data-printable=yes]", state="attached")
        yield page
        context.close()
        assert complaints == []
        beside = [url for url in requests if url.startswith(path.parent.as_uri()) and url.endswith(".png")]
        assert [url for url in requests if not url.startswith("data:") and url not in beside] == [path.as_uri()]

    return show


def ranges(page: Page) -> dict[str, list[float]]:
    """What each map shows: left, right, bottom and top, as Bokeh knows it."""
    script = """names => Object.fromEntries(names.map(name => {
        const { x_range: x, y_range: y } = Bokeh.documents[0].get_model_by_name(name);
        return [name, [x.start, x.end, y.start, y.end]];
    }))"""
    return page.evaluate(script, list(MAPS))


def same(ends: list[float]) -> dict[str, list[float]]:
    """All maps showing one and the same part."""
    return dict.fromkeys(MAPS, ends)


def tip(page: Page, x: float, y: float) -> dict[str, str]:
    """What is told where the pointer is moved to."""
    page.mouse.move(2, 2)
    page.mouse.move(x, y)
    shown = page.locator(".bk-Tooltip:visible").first
    shown.wait_for(state="visible")
    labels, values = (
        [one.strip() for one in shown.locator(f".bk-tooltip-row-{part}").all_inner_texts()]
        for part in ("label", "value")
    )
    return {label.rstrip(":"): value for label, value in zip(labels, values, strict=True)}


def place(page: Page, name: str, row: float, column: float) -> tuple[float, float]:
    """Where a pixel of a map, (row, column), lies on the screen."""
    script = """([name, row, column]) => {
        const view = [...Bokeh.index.roots].find(one => one.model.name === name);
        const box = view.el.getBoundingClientRect();
        return [box.x + view.frame.x_scale.compute(column), box.y + view.frame.y_scale.compute(row)];
    }"""
    page.locator(f"#plot-{name}").scroll_into_view_if_needed()
    x, y = page.evaluate(script, [name, row, column])
    return x, y


def pixels(page: Page, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The colours in the middle of all 24 x 24 pixels of a map as they are on its canvas: (24, 24, 3)."""
    script = """name => {
        const view = [...Bokeh.index.roots].find(one => one.model.name === name);
        const { canvas } = view.canvas_view.primary;
        const ratio = canvas.width / view.el.getBoundingClientRect().width;
        const copy = document.createElement("canvas");
        [copy.width, copy.height] = [canvas.width, canvas.height];
        const context = copy.getContext("2d", { willReadFrequently: true });
        context.drawImage(canvas, 0, 0);
        const found = [];
        for (let row = 0; row < 24; row++) for (let column = 0; column < 24; column++) {
            const x = ratio * view.frame.x_scale.compute(column + 0.5);
            const y = ratio * view.frame.y_scale.compute(row + 0.5);
            found.push([...context.getImageData(Math.round(x), Math.round(y), 1, 1).data.slice(0, 3)]);
        }
        return found;
    }"""
    return np.array(page.evaluate(script, name), dtype=np.float64).reshape(24, 24, 3)


# --- what is seen


def test_a_letter_stands_upright_with_square_pixels(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        for name in ("truth", "estimate"):
            colours = pixels(page, name)
            np.testing.assert_array_equal(colours[..., 0], colours[..., 2])  # grey
            np.testing.assert_array_equal(colours[..., 0] > 128, F)
        (left, top), (right, bottom) = place(page, "truth", 0, 0), place(page, "truth", 24, 24)
        assert right - left == pytest.approx(bottom - top, abs=2)
        assert right - left > 200


def test_errors_are_the_difference_of_the_maps(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        found = page.evaluate("""() => {
            const { truth, estimate, error } = Bokeh.documents[0].get_model_by_name("maps").data;
            return [truth, estimate, error].map(one => [...one[0]]);
        }""")
    truth, estimate, error = (np.array(one) for one in found)
    np.testing.assert_allclose(error, estimate - truth, atol=1e-4)
    assert np.abs(error).max() > 0.01


@pytest.mark.parametrize("width", [390, 768, 1600])
def test_no_width_needs_a_scroll_sideways(width: int, letter: Path, shown: Opened) -> None:
    with shown(letter, width=width) as page:
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        boxes = [page.locator(f"#plot-{name}").bounding_box() for name in MAPS]
        tops = {round(box["y"]) for box in boxes if box}
        assert len(tops) == {390: 4, 768: 2, 1600: 1}[width]
        outside = page.evaluate("""() => [...document.querySelectorAll("figure")]
            .filter(one => one.getBoundingClientRect().right > innerWidth).length""")
        assert outside == 0


def test_in_the_dark_paper_and_figures_are_dark(letter: Path, shown: Opened) -> None:
    def look(page: Page) -> tuple[str, str, str]:
        paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
        axis = "Bokeh.documents[0].get_model_by_name('truth').below.find(one => one.type === 'LinearAxis')"
        return paper, page.evaluate(f"{axis}.major_label_text_color"), page.evaluate(f"{axis}.axis_label_text_color")

    with shown(letter) as page:
        light = look(page)
        before = pixels(page, "truth")
        page.emulate_media(color_scheme="dark")
        page.wait_for_selector("html[data-look=dark]", state="attached")
        dark = look(page)
        np.testing.assert_array_equal(pixels(page, "truth"), before)
    with shown(letter, dark=True) as page:
        assert look(page) == dark
    assert all(one != other for one, other in zip(light, dark, strict=True))
    assert light[0] == "rgb(255, 255, 255)"


# --- what is done


def test_the_wheel_zooms_all_four_maps_and_the_page_only_scrolls(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        whole = ranges(page)
        assert whole == same([0, 24, 24, 0])
        page.mouse.move(*place(page, "error", 6, 6))
        page.mouse.wheel(0, 100)  # without Ctrl it belongs to the page
        page.mouse.move(*place(page, "error", 6, 6))
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


def test_the_mouse_drags_all_four_maps_and_reset_brings_them_back(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        x, y = place(page, "estimate", 12, 12)
        pitch = place(page, "estimate", 12, 13)[0] - x
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
    moves = "Bokeh.documents[0].get_model_by_name('truth').toolbar.tools.find(one => one.type === 'PanTool').active"
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
            return Object.fromEntries(Object.entries(data).map(([name, one]) => [name, one[0][5 * 24 + 17]]));
        }""")
        for name in MAPS:
            told = tip(page, *place(page, name, 5.5, 17.5))
            assert (told.pop("row"), told.pop("column")) == ("5", "17")
            told["deviation"] = told.pop("posterior deviation")
            assert {other: float(value) for other, value in told.items()} == pytest.approx(maps, rel=1e-4)
        page.locator("#pixel [name=row]").fill("5")
        page.locator("#pixel [name=column]").fill("17")
        said = dict(one.split() for one in page.locator("#pixel output").inner_text().split(", "))
        assert {other: float(value) for other, value in said.items()} == pytest.approx(maps, rel=1e-4)
        page.locator("#pixel [name=row]").fill("99")
        assert page.locator("#pixel output").inner_text() == "no such pixel"


def test_the_pointer_tells_sub_images_apart(letter: Path, run: Run, shown: Opened) -> None:
    with shown(letter) as page:
        row, column, k, l = page.evaluate("""() => {
            const { data } = Bokeh.documents[0].get_model_by_name("sensor");
            return [data.packed_row[1], data.packed_column[1], data.k[1], data.l[1]];
        }""")  # noqa: E741
        told = tip(page, *place(page, "packed", row + 1.5, column + 2.5))
    assert told["lens type"] == "A"
    assert told["sub-imager k, l"] == f"{k}, {l}"
    assert told["its row on the sensor"] == "1"
    assert told["its column on the sensor"] == "2"
    turned = run.stack.images()[1][::-1, ::-1]
    assert float(told["value"]) == pytest.approx(turned[1, 2], abs=0.01)


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


# --- what is printed


@pytest.mark.parametrize("dark", [False, True])
def test_print_is_light_without_tools_and_with_every_figure(dark: bool, letter: Path, shown: Opened) -> None:
    with shown(letter, dark=dark) as page:
        assert page.locator(".tools").first.is_visible()
        page.emulate_media(media="print", color_scheme="dark" if dark else "light")
        for what in (".tools", "nav", ".pixel", ".choose", ".plot"):
            assert not any(one.is_visible() for one in page.locator(what).all()), what
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        for name in (*MAPS, "packed", "place", "errors", "response-A-measured"):
            drawn = page.locator(f"#print-{name}")
            assert drawn.is_visible()
            # Most of what is drawn below a figure is axes and text: it has to be darker than paper.
            inked = """one => {
                const copy = document.createElement("canvas");
                [copy.width, copy.height] = [one.naturalWidth, one.naturalHeight];
                const context = copy.getContext("2d");
                context.drawImage(one, 0, 0);
                const top = one.naturalHeight - 40;
                const { data } = context.getImageData(0, top, one.naturalWidth, 40);
                let dark = 0;
                for (let at = 0; at < data.length; at += 4) dark += data[at + 3] > 200 && data[at] < 140;
                return dark;
            }"""
            assert drawn.evaluate(inked) > 10
        assert len(page.pdf(format="A4")) > 50_000


# --- others


def test_a_real_run_is_shown_without_complaint(finished: Path, shown: Opened) -> None:
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
            assert page.locator(".scenes img").first.evaluate("one => one.naturalWidth") == 12
            assert page.get_by_role("link", name="Tiny").first.get_attribute("href") == "a/report.html"
