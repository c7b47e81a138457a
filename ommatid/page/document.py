"""The report of a run as one HTML page that contains its style, program, pictures and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from ommatid.bench.table import BenchTable
from ommatid.runtime.errors import InputError
from ommatid.runtime.printable import printable_lines

from . import sections
from .data import Run, read_contents
from .panels.point_response import IdealMatrix
from .panels.sensor import MOST_VALUES

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parent / "templates"
LARGEST = 2_950_000  # bytes of a page
LARGEST_REDUCTION = 4  # of the number of the sensor's values, to keep a page below LARGEST


def page(run: Run, ideal: IdealMatrix | None, bench: BenchTable | None, stamp: str) -> str:
    """Return the report of a run as HTML.

    ideal : H of one sub-imager as designed, None if not known;  bench : results of `ommatid bench` for the camera
    stamp : fingerprint of the content, by which an up-to-date page is recognised
    """
    content, most = sections.of_run(run, ideal, bench), MOST_VALUES
    while True:
        html = fill("page.html", {**content, **sections.of_sensor(run.stack, content["groups"], most), "stamp": stamp})
        if len(html.encode()) <= LARGEST or most <= MOST_VALUES // LARGEST_REDUCTION:
            return html
        most //= 2


def page_of(folder: Path) -> str:
    """Return a page of what a folder holds: a run, or some of stack.exr, model.npz and estimate.exr.

    Raises InputError where there is none of them, or where one is damaged.
    """
    from functools import partial

    from ommatid.simulate.ideal import matrix_as_designed

    contents = read_contents(folder)
    run = contents.run
    if run is not None:
        return page(run, partial(matrix_as_designed, run.stack.camera), None, run.report.fingerprint)
    if contents.stack is None and contents.model is None and contents.estimate is None:
        raise InputError(f"{folder}: expected stack.exr, model.npz or estimate.exr, got none; run a scene first")
    return fill("parts_page.html", {**sections.of_contents(contents), "stamp": ""})


def fill(template: str, content: Mapping[str, Any]) -> str:
    """Return a template with its content, style and program.

    All text of the content is escaped, for HTML and for readers: control characters and those that reorder text are
    written as escapes.
    """
    files = {"css": "page.css", "print_css": "print.css", "js": "page.js"}
    trusted = {name: Markup((TEMPLATES / file).read_text(encoding="utf-8")) for name, file in files.items()}
    return printable_lines(_environment().get_template(template).render({**content, **trusted}))


@cache
def _environment() -> Environment:
    """Return the templates, which are compiled once."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    def code(text: str) -> Markup:
        """Mark commands between backticks."""
        parts = text.split("`")
        marked = [Markup("<code>{}</code>").format(part) if index % 2 else part for index, part in enumerate(parts)]
        return Markup("").join(marked)

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["code"] = code
    return environment
