"""Files of figures: PNG for screens and slides, SVG and PDF for print, and SVG inside a page.

All files of a figure have one name and the suffixes of their formats. Equal figures give equal bytes.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, cast

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import write_whole

FORMATS = ("png", "svg", "pdf")
SCREEN, SLIDE = 110, 300  # dots per inch of PNG files
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#B8860B", "#56B4E9")  # Okabe and Ito; legible on dark, too
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "*")
INK = "#000000"  # of text and axes, which a page replaces by its own colour
# Text stays text, which a drawing program can edit; names in SVG and dates in PDF do not differ from run to run; titles
# stand at the axes, since looking for what is above these takes a tenth of the time of a figure.
SETTINGS: dict[str, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "ommatid",
    "pdf.fonttype": 42,
    "axes.titley": 1.0,
    "font.sans-serif": ["DejaVu Sans"],
}
PLACES = re.compile(r' (?:d|x|y|transform)="[^"]*"')  # attributes of SVG that hold places
QUICK = 3  # of zlib's 9 levels: maps take half the time of 6 and as many bytes
DATE = {"png": None, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


@dataclass(frozen=True)
class FigureFiles:
    """The formats in which a command writes each of its figures."""

    formats: tuple[str, ...] = ("png",)

    def replace(self, figure: Any, path: Path) -> None:
        """Write a figure in every format, and remove its files in others, which show something older.

        Raises InputError or MachineError.
        """
        save_figure(figure, path, self.formats)
        for name in set(FORMATS) - set(self.formats):
            path.with_suffix(f".{name}").unlink(missing_ok=True)


SCREEN_PNG = FigureFiles()


def figure_format(path: Path) -> str:
    """Return the format that the suffix of a figure's file names. Raises InputError for another one."""
    name = path.suffix.lstrip(".").lower()
    if name not in FORMATS:
        raise InputError(f"{path}: expected a file that ends in .{', .'.join(FORMATS)}, got '{path.suffix}'")
    return name


@contextmanager
def own_style() -> Generator[None]:
    """Draw with Matplotlib's defaults, whatever a matplotlibrc or a notebook has set. Also usable as a decorator.

    A character that the font lacks is drawn as a box, without a warning.
    """
    import matplotlib

    module: Any = matplotlib
    defaults = {key: value for key, value in module.rcParamsDefault.items() if key != "backend"}
    with module.rc_context({**defaults, **SETTINGS}), warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"Glyph \d+ .* missing from font", UserWarning)
        yield


def new_figure(width: float, height: float, **options: Any) -> Any:
    """Return an empty figure of a size in inches, which needs no screen; options : of Matplotlib's Figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **options)
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Any, path: Path, formats: Sequence[str] = ("png",), resolution: int = SCREEN) -> None:
    """Write a figure beside `path` in each format; the suffix of `path` is replaced. Raises InputError or MachineError.

    resolution : of PNG files, and of pictures inside the others, in dots per inch
    """
    with own_style():
        for name in formats:
            options: dict[str, Any] = {"format": name, "dpi": resolution, "metadata": DATE[name]}
            options |= {"pil_kwargs": {"compress_level": QUICK}} if name == "png" else {}
            write_whole(path.with_suffix(f".{name}"), lambda file, options=options: figure.savefig(file, **options))


def log_ticks(axis: Any) -> None:
    """Label 1, 2 and 5 of each decade of a logarithmic Matplotlib axis by plain numbers."""
    from matplotlib.ticker import LogLocator, NullFormatter

    locator: Any = LogLocator(subs=(1, 2, 5))
    axis.set_major_locator(locator)
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def svg_text(figure: Any, name: str, description: str = "") -> str:
    """Return a figure as an `svg` element for a page: transparent, with black in the colour of the page's text.

    Its width is that of the element around it.

    name : unique on the page, the element's identity;  description : for readers who do not see it
    """
    import matplotlib

    file, module = io.StringIO(), cast(Any, matplotlib)
    with own_style(), module.rc_context({"svg.hashsalt": name}):
        figure.savefig(file, format="svg", transparent=True, metadata=DATE["svg"])
    text = re.sub(r"\A.*?(?=<svg)|<metadata>.*?</metadata>|<!--.*?-->", "", file.getvalue(), flags=re.DOTALL)
    text = PLACES.sub(lambda found: re.sub(r"(\.\d\d)\d+", r"\1", found[0]), text)  # 1/100 of 1/72 inch
    used = set(re.findall(r"#([\w.-]+)", text))
    text = re.sub(r' id="([^"]*)"', lambda found: found[0] if found[1] in used else "", text)  # groups of any figure
    head, rest = text.split(">", 1)
    head = re.sub(r' (width|height)="[^"]*"', "", head)
    words = f' aria-label="{escape(description)}"' if description else ""
    return f'{head} id="{name}" role="img"{words} fill="currentColor">{rest.replace(INK, "currentColor")}'
