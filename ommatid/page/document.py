"""Templates of pages and charts, filled with escaped text; a page contains its style, program, pictures and numbers."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from ommatid.runtime.printable import printable_lines

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES = Path(__file__).parent / "templates"


def fill(template: str, content: Mapping[str, Any], program: str = "page.js") -> str:
    """Return a template with its content, style and program, the only one that its policy lets run.

    All text of the content is escaped, for HTML and for readers: control characters and those that reorder text are
    written as escapes.
    """
    files = {"css": "page.css", "print_css": "print.css", "js": program}
    trusted = {name: Markup((TEMPLATES / file).read_text(encoding="utf-8")) for name, file in files.items()}
    digest = b64encode(sha256(f"\n{trusted['js']}\n".encode()).digest()).decode()
    return printable_lines(rendered(template, {**content, **trusted, "js_digest": f"sha256-{digest}"}))


def rendered(template: str, content: Mapping[str, Any]) -> str:
    """Return a template with its content, which is escaped for HTML."""
    return _environment().get_template(template).render(content)


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
