"""A run as one HTML page that needs nothing else: style, program, figures and numbers are all in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import error_groups, plots, point_response, sensor, tables, time_curves, words
from . import maps as images
from .data import Run, maps
from .point_response import Ideal
from .sensor import MOST_VALUES

HERE = Path(__file__).parent / "templates"
LARGEST = 2_950_000  # bytes of a page
SMALLEST = 4  # times fewer of the sensor's values, before a page may be larger than that


def page(run: Run, ideal: Ideal | None, bench: dict[str, Any] | None, stamp: str) -> str:
    """The report of a run as HTML.

    ideal : H of one sub-imager as designed, None where that is not known;  bench : curves of the same camera
    stamp : what the page was made from, by which it is known to be up to date
    """
    share = 1
    while True:
        made = _page(run, ideal, bench, stamp, MOST_VALUES // share)
        if len(made.encode()) <= LARGEST or share >= SMALLEST:
            return made
        share *= 2


def _page(run: Run, ideal: Ideal | None, bench: dict[str, Any] | None, stamp: str, values: int) -> str:
    shown, mosaic, found = maps(run), sensor.mosaic(run.stack, values), error_groups.groups(run)
    panels, kinds, curves = (
        images.panels(shown),
        point_response.responses(run.model, ideal),
        time_curves.time_curves(run, bench),
    )
    figures = [*images.figures(shown, panels), *sensor.figures(mosaic)]
    figures += [drawn for kind in kinds for drawn in point_response.figures(kind)]
    figures += [error_groups.figure(found)] if found else []
    figures += [time_curves.figure(curves)] if curves else []
    lenses, facts = tables.geometry(run)
    content: dict[str, Any] = {
        "title": run.title,
        "verdict": words.verdict(run.description),
        "agreement": words.agreement(run.description.error),
        "cautions": words.cautions(run.description),
        "key_numbers": words.key_numbers(run.description),
        "maps": shown,
        "panels": panels,
        "budget": words.budget(run.description.error),
        "groups": found,
        "group_words": error_groups.words(found) if found else "",
        "mosaic": mosaic,
        "mosaic_words": sensor.words(mosaic),
        "views": _views(mosaic),
        "responses": [(kind, point_response.words(kind), _titled(kind)) for kind in kinds],
        "curves": curves,
        "curve_words": time_curves.words(curves) if curves else "",
        "plan": tables.plan(run),
        "more_time": tables.more_time(run),
        "given_time": tables.given_time(run),
        "left_out": tables.skipped(run),
        "lenses": lenses,
        "facts": facts,
        "numbers": tables.numbers(run),
        "further": tables.further(run),
        "origins": tables.origins(run),
    }
    return fill("page.html", {**content, "document": plots.document(figures), "stamp": stamp})


def _views(mosaic: sensor.Mosaic) -> dict[str, float]:
    """Height over width of each view of the sensor."""
    found: dict[str, float] = {}
    for name in ("packed", "place"):
        left, right, top, bottom = sensor.extent(mosaic, name)
        found[name] = (bottom - top) / (right - left)
    return found


def _titled(kind: point_response.PointResponse) -> list[tuple[str, str, str]]:
    """Name, title and words of each map of a response; the ideal one was not measured."""
    titles = point_response.TITLES | ({"measured": "Response"} if kind.exact else {})
    return [
        (f"response-{kind.lens}-{name}", titles[name], images.values_in_words(image))
        for name, image in point_response.shown(kind)
    ]


def fill(template: str, content: Mapping[str, Any]) -> str:
    """A template with its content, style and programs. Text is escaped unless it comes from here."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    def code(text: str) -> Markup:
        """A sentence whose commands stand between backticks."""
        parts = text.split("`")
        marked = [Markup("<code>{}</code>").format(part) if place % 2 else part for place, part in enumerate(parts)]
        return Markup("").join(marked)

    house = Environment(
        loader=FileSystemLoader(HERE), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    house.filters["code"] = code
    files = {"css": "page.css", "paper": "print.css", "js": "page.js"}
    ours = {name: Markup((HERE / file).read_text(encoding="utf-8")) for name, file in files.items()}
    drawn = {"bokeh": Markup(plots.script()), "document": Markup(content["document"])} if content["document"] else {}
    return house.get_template(template).render({"bokeh": "", **content, **ours, **drawn})
