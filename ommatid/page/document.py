"""The report of a run as one HTML page that contains its style, program, figures and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ommatid.analysis.held_out import maps as held_out_maps
from ommatid.analysis.held_out import table
from ommatid.bench.table import BenchTable
from ommatid.reconstruct.detail.detailed_model import model_of_f
from ommatid.reconstruct.output import verdict_words
from ommatid.scenes.tables.estimation import PriorTable

from . import error_groups, plots, point_response, sensor, tables, time_curves, words
from . import maps as result_maps
from .data import Run, maps
from .point_response import IdealMatrix
from .sensor import MOST_VALUES

TEMPLATES = Path(__file__).parent / "templates"
LARGEST = 2_950_000  # bytes of a page
LARGEST_REDUCTION = 4  # of the number of the sensor's values, to keep a page below LARGEST


def page(run: Run, ideal: IdealMatrix | None, bench: BenchTable | None, stamp: str) -> str:
    """Return the report of a run as HTML.

    ideal : H of one sub-imager as designed, None if not known;  bench : results of `ommatid bench` for the camera
    stamp : fingerprint of the content, by which an up-to-date page is recognised
    """
    reduction = 1
    while True:
        html = _page(run, ideal, bench, stamp, MOST_VALUES // reduction)
        if len(html.encode()) <= LARGEST or reduction >= LARGEST_REDUCTION:
            return html
        reduction *= 2


def _page(run: Run, ideal: IdealMatrix | None, bench: BenchTable | None, stamp: str, sensor_values: int) -> str:
    shown, mosaic, groups = maps(run), sensor.mosaic(run.stack, sensor_values), error_groups.groups(run)
    panels = result_maps.panels(shown)
    responses = point_response.responses(model_of_f(run.model, run.stack.camera, PriorTable()), ideal)
    curves = time_curves.time_curves(run, bench)
    figures = [*result_maps.figures(shown, panels), *sensor.figures(mosaic)]
    figures += [figure for response in responses for figure in point_response.figures(response)]
    figures += [error_groups.figure(groups)] if groups else []
    figures += [time_curves.figure(curves)] if curves else []
    lenses, facts = tables.geometry(run)
    content: dict[str, Any] = {
        "title": run.title,
        "heading": verdict_words.heading(run.report),
        "grounds": words.grounds(run.report),
        "notes": words.notes(run.report),
        "summary": words.summary(run.report),
        "agreement": words.agreement(run.report.error) if verdict_words.is_trusted(run.report) else "worse",
        "cautions": words.cautions(run.report),
        "key_numbers": words.key_numbers(run.report),
        "maps": shown,
        "panels": panels,
        "budget": words.budget(run.report.error),
        "groups": groups,
        "group_words": error_groups.words(groups) if groups else "",
        **_held_out(run),
        "mosaic": mosaic,
        "mosaic_words": sensor.words(mosaic),
        "responses": [(response, point_response.words(response), _titled(response)) for response in responses],
        "curves": curves,
        "curve_words": time_curves.words(curves) if curves else "",
        "stages": tables.stages(run),
        "more_samples": tables.more_samples(run),
        "time_limit": tables.time_limit(run),
        "skipped": tables.skipped(run),
        "lenses": lenses,
        "facts": facts,
        "numbers": tables.numbers(run),
        "further": tables.further(run),
        "origins": tables.origins(run),
    }
    return fill("page.html", {**content, "document": plots.document(figures), "stamp": stamp})


def _held_out(run: Run) -> dict[str, Any]:
    report = run.report.held_out
    if report is None:
        return {"held_out": None}
    rows = table.rows(report)
    return {
        "held_out": report,
        "held_out_words": f"{rows[0][1][:1].upper()}{rows[0][1][1:]}",
        "held_out_prior": table.prior_words(report.prior),
        "held_out_maps": held_out_maps.lens_type_maps(report),
        "held_out_table": tables.held_out(rows),
    }


def _titled(response: point_response.PointResponse) -> list[tuple[str, str, str]]:
    """Return figure name, title and description of each map of a response."""
    titles = point_response.titles(response)
    return [
        (f"response-{response.lens}-{name}", titles[name], result_maps.value_words(image))
        for name, image in response.maps.items()
    ]


def fill(template: str, content: Mapping[str, Any]) -> str:
    """Return a template with its content, style and programs; all text of the content is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

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
    files = {"css": "page.css", "print_css": "print.css", "js": "page.js"}
    trusted = {name: Markup((TEMPLATES / file).read_text(encoding="utf-8")) for name, file in files.items()}
    trusted["bokeh"] = Markup("")
    if content["document"]:
        trusted |= {"bokeh": Markup(plots.script()), "document": Markup(content["document"])}
    return environment.get_template(template).render({**content, **trusted})
