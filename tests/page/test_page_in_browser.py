"""The pages in headless Chromium, operated by mouse, keyboard and touch."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import Browser, CDPSession, ConsoleMessage, Error, Locator, Page, Request, sync_playwright
from skimage import io

from ommatid.page.batch_index import BatchEntry
from ommatid.page.batch_index import page as index_of
from ommatid.page.data import Run
from ommatid.page.sections import page as page_of
from ommatid.runtime.arrays import FloatArray

from .runs import F, letter_run

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
    path.write_text(page_of(run, None, "0"), encoding="utf-8")
    return path


Opened = Callable[..., Any]


@pytest.fixture
def shown(browser: Browser) -> Opened:
    """Open a page; afterwards there must have been no errors, warnings or requests."""

    @contextmanager
    def show(
        path: Path,
        *,
        width: int = 1600,
        height: int = 900,
        dark: bool = False,
        touch: bool = False,
        program: bool = True,
    ) -> Generator[Page]:
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
            viewport={"width": width, "height": height},
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
        if program:
            page.wait_for_selector("html[data-ready=yes]", state="attached")
        yield page
        context.close()
        assert messages == []
        pictures = [url for url in requests if url.startswith(path.parent.as_uri()) and url.endswith(".png")]
        assert [url for url in requests if not url.startswith(("data:", "blob:")) and url not in pictures] == [
            path.as_uri()
        ]

    return show


def area(page: Page, group: str = "maps") -> list[float]:
    """Left, top, width and height that the maps of a group show."""
    return page.evaluate(
        """group => {
        const { left, top, width, height } = window.ommatid.views.get(group);
        return [left, top, width, height];
    }""",
        group,
    )


def canvas(page: Page, name: str) -> Locator:
    return page.locator(f'canvas[data-map="{name}"]')


def position(page: Page, name: str, row: float, column: float, group: str = "maps") -> tuple[float, float]:
    """Position of a map's point (row, column) on the screen."""
    canvas(page, name).scroll_into_view_if_needed()
    box = canvas(page, name).bounding_box()
    assert box
    left, top, width, height = area(page, group)
    scale = min(box["width"] / width, box["height"] / height)
    x, y = (box["width"] - scale * width) / 2, (box["height"] - scale * height) / 2
    return box["x"] + x + scale * (column - left), box["y"] + y + scale * (row - top)


def pixels(page: Page, name: str, size: int = 24) -> FloatArray:
    """Colours on the canvas at the centres of all pixels of a map of `size` x `size`: (size, size, 3)."""
    script = """([name, size]) => {
        const canvas = document.querySelector(`canvas[data-map="${name}"]`);
        const { width, height } = canvas;
        const copy = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
        copy.drawImage(canvas, 0, 0);
        const { data } = copy.getImageData(0, 0, width, height);
        const colours = [];
        for (let row = 0; row < size; row++) for (let column = 0; column < size; column++) {
            const [x, y] = [column, row].map(index => Math.floor((index + 0.5) * width / size));
            colours.push([...data.slice(4 * (y * width + x), 4 * (y * width + x) + 3)]);
        }
        return colours;
    }"""
    return np.array(page.evaluate(script, [name, size]), dtype=np.float64).reshape(size, size, 3)


# --- appearance


def test_a_letter_is_upright_with_square_pixels(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        for name in ("truth", "estimate"):
            colours = pixels(page, name)
            np.testing.assert_array_equal(colours[..., 0], colours[..., 2])  # grey
            np.testing.assert_array_equal(colours[..., 0] > 128, F)
        (left, top), (right, bottom) = position(page, "truth", 0, 0), position(page, "truth", 24, 24)
        assert right - left == pytest.approx(bottom - top, abs=1)


@pytest.mark.parametrize("width", [1280, 390])
def test_pictures_of_a_row_line_up_though_a_heading_wraps(width: int, letter: Path, shown: Opened) -> None:
    with shown(letter, width=width) as page:
        pictures = [canvas(page, name) for name in ("truth", "single")]
        tops = [picture.evaluate("picture => picture.getBoundingClientRect().top") for picture in pictures]
        headings = [picture.evaluate("picture => picture.previousElementSibling.offsetHeight") for picture in pictures]
        assert headings[1] > 1.5 * headings[0]
        assert tops[0] == pytest.approx(tops[1], abs=0.5)


@pytest.mark.slow
def test_errors_are_the_difference_of_two_maps(letter: Path, run: Run, shown: Opened) -> None:
    assert run.truth is not None
    error = run.estimate - run.truth
    with shown(letter) as page:
        colours = pixels(page, "error")
    limit = np.percentile(np.abs(error), 99.5)
    strong = np.abs(error) > 0.3 * limit
    assert strong.any()
    np.testing.assert_array_equal((colours[..., 0] > colours[..., 2])[strong], error[strong] > 0)  # red or blue


@pytest.mark.slow
def test_a_dark_colour_scheme_darkens_page_and_charts_but_not_maps(letter: Path, shown: Opened) -> None:
    def look(page: Page) -> list[str]:
        return page.evaluate("""() => [
            getComputedStyle(document.body).backgroundColor,
            getComputedStyle(document.querySelector("#chart-transfer text")).fill,
            getComputedStyle(document.querySelector(".camera-drawing svg")).fill,
        ]""")

    with shown(letter) as page:
        light, before = look(page), pixels(page, "truth")
        page.emulate_media(color_scheme="dark")
        dark = look(page)
        np.testing.assert_array_equal(pixels(page, "truth"), before)
    assert all(one != other for one, other in zip(light, dark, strict=True))
    assert light[0] == "rgb(255, 255, 255)"


# --- interaction


@pytest.mark.slow
def test_the_wheel_zooms_all_maps_with_ctrl_and_scrolls_the_page_without(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        page.mouse.move(*position(page, "error", 6, 6))
        page.mouse.wheel(0, 40)
        assert area(page) == [0, 0, 24, 24]
        x, y = position(page, "error", 6, 6)
        page.mouse.move(x, y)
        page.keyboard.down("Control")
        page.mouse.wheel(0, -240)
        page.keyboard.up("Control")
        page.wait_for_function("window.ommatid.views.get('maps').width < 24")
        left, top, width, height = area(page)
        assert width == height == pytest.approx(24 * np.exp(-0.8))
        assert position(page, "error", 6, 6) == pytest.approx((x, y), abs=1)
        assert left > 0
        assert top > 0


@pytest.mark.slow
def test_dragging_moves_all_maps_and_keys_and_buttons_zoom(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        tools = page.locator("#image .tools")
        tools.get_by_role("button", name="zoom in").press("Enter")
        assert area(page) == [4, 4, 16, 16]
        x, y = position(page, "estimate", 12, 12)
        pitch = position(page, "estimate", 12, 13)[0] - x
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 3 * pitch, y - 2 * pitch, steps=4)
        page.mouse.up()
        assert area(page) == pytest.approx([1, 6, 16, 16], abs=0.1)
        # All maps show it: the colours of two maps of nearly equal values agree pixel by pixel.
        np.testing.assert_allclose(pixels(page, "truth", 16), pixels(page, "estimate", 16), atol=16)
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x - 40 * pitch, y, steps=4)  # no further than the edge
        page.mouse.up()
        assert area(page)[0] == pytest.approx(8)
        tools.get_by_role("button", name="Reset").click()
        assert area(page) == [0, 0, 24, 24]
        canvas(page, "truth").focus()
        page.keyboard.press("+")
        assert area(page) == [4, 4, 16, 16]
        page.keyboard.press("ArrowRight")
        assert area(page) == pytest.approx([5.6, 4, 16, 16])
        page.keyboard.press("0")
        assert area(page) == [0, 0, 24, 24]


def touches(session: CDPSession, kind: str, *points: tuple[float, float]) -> None:
    fingers = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(points)]
    session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})


@pytest.mark.slow
def test_two_fingers_zoom_and_one_scrolls_the_page_until_a_map_is_zoomed(letter: Path, shown: Opened) -> None:
    with shown(letter, width=390, height=844, touch=True) as page:
        assert canvas(page, "compare").evaluate("canvas => canvas.style.touchAction") == "pan-y"
        x, y = position(page, "compare", 12, 12)
        session = page.context.new_cdp_session(page)
        touches(session, "touchStart", (x - 20, y), (x + 20, y))
        for apart in (25, 30, 35, 40):
            touches(session, "touchMove", (x - apart, y), (x + apart, y))
        touches(session, "touchEnd")
        page.wait_for_function("window.ommatid.views.get('maps').width < 24")
        left, top, width, _ = area(page)
        assert width == pytest.approx(12, rel=0.05)
        assert (left + width / 2, top + width / 2) == pytest.approx((12, 12), abs=0.3)
        assert canvas(page, "compare").evaluate("canvas => canvas.style.touchAction") == "none"
        scrolled = page.evaluate("scrollY")
        touches(session, "touchStart", (x + 60, y + 60))  # beside the line between the images
        for moved in (50, 30, 10, -10):
            touches(session, "touchMove", (x + 60, y + moved))
        touches(session, "touchEnd")
        assert area(page)[1] > top + 1
        assert page.evaluate("scrollY") == scrolled


@pytest.mark.slow
def test_a_slider_divides_any_two_images(letter: Path, shown: Opened) -> None:
    with shown(letter) as page:
        compared = page.locator(".compare")
        assert compared.locator("select").first.input_value() == "single"
        compared.locator("[data-side=left]").select_option("truth")
        compared.locator("[data-side=right]").select_option("error")
        for share in (500, 250):
            page.locator("#divider").fill(str(share))
            both, middle = pixels(page, "compare"), 24 * share // 1000
            np.testing.assert_array_equal(both[:, : middle - 1], pixels(page, "truth")[:, : middle - 1])
            np.testing.assert_array_equal(both[:, middle + 1 :], pixels(page, "error")[:, middle + 1 :])
        x, y = position(page, "compare", 12, 6)  # the line itself can be dragged
        pitch = position(page, "compare", 12, 7)[0] - x
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + 12 * pitch, y, steps=3)
        page.mouse.up()
        assert int(page.locator("#divider").input_value()) == pytest.approx(750, abs=2)
        assert area(page) == [0, 0, 24, 24], "the maps stay where they are"


@pytest.mark.slow
def test_the_pointer_and_the_keyboard_read_values(letter: Path, run: Run, shown: Opened) -> None:
    assert run.truth is not None
    with shown(letter) as page:
        page.mouse.move(*position(page, "deviation", 5.5, 7.5))
        form = page.locator("form.pixel")
        assert form.locator("[name=row]").input_value() == "5"
        assert form.locator("[name=column]").input_value() == "7"
        read = form.locator("output").inner_text()
        values = dict(part.rsplit(" ", 1) for part in read.split(", "))
        # Four digits are shown.
        for name, value in (("truth", run.truth), ("estimate", run.estimate), ("error bar", np.sqrt(run.variance))):
            assert float(values[name]) == pytest.approx(float(value[5, 7]), rel=5e-4)
        assert float(values["error"]) == pytest.approx(float(run.estimate[5, 7] - run.truth[5, 7]), rel=5e-4)
        page.mouse.move(2, 2)
        form.locator("[name=row]").fill("3")
        assert f"{run.truth[3, 7]:.4g}" in form.locator("output").inner_text()
        form.locator("[name=row]").fill("24")
        assert form.locator("output").inner_text() == "outside the image"


@pytest.mark.slow
def test_images_are_saved_as_arrays_tables_and_pictures(letter: Path, run: Run, tmp_path: Path, shown: Opened) -> None:
    assert run.truth is not None
    with shown(letter) as page:
        for name, expected in (("estimate", run.estimate), ("error", run.estimate - run.truth)):
            page.locator("form.pixel [name=map]").select_option(name)
            for kind in ("npy", "csv", "png"):
                with page.expect_download() as download:
                    page.locator(f"[data-save={kind}]").click()
                assert download.value.suggested_filename == f"{name}.{kind}"
                path = tmp_path / f"{name}.{kind}"
                download.value.save_as(path)
                if kind == "npy":
                    np.testing.assert_array_equal(np.load(path), expected)
                elif kind == "csv":
                    values = np.loadtxt(path, delimiter=",")
                    np.testing.assert_array_equal(values.astype(np.float32), expected)
                else:
                    assert io.imread(path).shape[:2] == (24, 24)


# --- print


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True])
def test_print_is_light_and_without_tools(dark: bool, letter: Path, shown: Opened) -> None:
    with shown(letter, dark=dark) as page:
        assert page.locator(".tools").first.is_visible()
        page.emulate_media(media="print", color_scheme="dark" if dark else "light")
        for selector in (".tools", ".pixel", "#divider"):
            assert not any(element.is_visible() for element in page.locator(selector).all()), selector
        assert page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        ink = page.evaluate("getComputedStyle(document.querySelector('#chart-transfer text')).fill")
        assert max(int(part) for part in re.findall(r"\d+", ink)[:3]) < 128
        assert canvas(page, "estimate").is_visible()
        assert len(page.pdf(format="A4")) > 50_000


# --- other pages


def test_the_table_of_a_batch_is_sorted_by_its_headings(run: Run, tmp_path: Path, shown: Opened) -> None:
    errors = {"a": 3.0, "b": 20.0, "c": 100.0}
    entries = [
        BatchEntry(name, run.report.with_changes(error=run.report.error.model_copy(update={"mse": mse})))
        for name, mse in (("b", 20.0), ("c", 100.0), ("a", 3.0))
    ]
    path = tmp_path / "index.html"
    text = index_of([BatchEntry("lost", failure="no such file"), *entries], "0", title="Batch: batch")
    path.write_text(re.sub("<img[^>]*>", "", text), encoding="utf-8")
    with shown(path, width=390) as page:
        assert page.evaluate("document.documentElement.scrollWidth") == 390, "the text above the table wraps"
        heading = page.locator("th", has_text="MSE, measured")
        names = page.locator("tbody tr th small")
        for order, expected in (("ascending", sorted(errors)), ("descending", sorted(errors, reverse=True))):
            heading.get_by_role("button").click()
            assert heading.get_attribute("aria-sort") == order
            assert names.all_inner_texts() == expected, "rows that failed come last"
            assert "failed" in page.locator("tbody tr").last.inner_text()
