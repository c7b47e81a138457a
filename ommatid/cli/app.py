"""The command line: parses options, calls the packages that do the work, and prints what they return.

Standard streams are open and print every character in some way, and names of files are UTF-8, on any machine.
Results go to stdout, as tables or with --json as one document; progress and failures go to stderr. Modules that load
NumPy or more are imported inside the commands, so that `ommatid --help` answers at once.
"""

from __future__ import annotations

import codecs
import gc
import io
import os
import sys
from functools import partial
from importlib.metadata import version as version_of
from typing import Annotated

import typer

from ommatid.runtime.errors import InputError
from ommatid.runtime.execution.interrupts import heed_interrupts
from ommatid.runtime.execution.library_warnings import library_warnings
from ommatid.runtime.library_caches import library_caches
from ommatid.runtime.printable import printable
from ommatid.runtime.versions import command_line

from . import calibrate, output, reconstruct, run, show, studies
from .failures import exit_code_of
from .options import grouped

ERRORS = "ommatid.ascii"
# what a terminal without Unicode shows in place of the characters that this program prints
ALTERNATIVES = {
    "±": "+-", "×": "x", "·": "*", "÷": "/", "°": " deg", "µ": "u", "μ": "u", "σ": "sigma", "λ": "lambda", "²": "^2",
    "³": "^3", "√": "sqrt", "≤": "<=", "≥": ">=", "≈": "~", "→": "->", "…": "...", "–": "-", "—": "-", "−": "-",
    "’": "'", "‘": "'", "“": '"', "”": '"', "Ω": "Ohm", "∞": "inf", "é": "e", "\N{NO-BREAK SPACE}": " ",
}  # fmt: skip

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars.",
)
with_arguments = partial(app.command, no_args_is_help=True)  # without any, they print their help
for command in (
    run.run,
    run.render,
    calibrate.calibrate,
    reconstruct.reconstruct,
    reconstruct.report,
    reconstruct.figure,
    reconstruct.check,
):
    with_arguments()(grouped(command))
with_arguments("import")(grouped(calibrate.import_frames))
for command in (run.predict, run.design, studies.bench, show.show, show.export):
    with_arguments()(grouped(command))
for command in (show.init, studies.paper, studies.stability, show.schema, show.doctor):
    app.command()(grouped(command))


Version = Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)]


@app.callback(invoke_without_command=True)
def start(version: Version = False) -> None:
    """Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars."""
    if version:
        print(f"ommatid {version_of('ommatid')}")
        raise typer.Exit


def main() -> None:
    """Run the command line and exit."""
    heed_interrupts()
    prepare_streams()
    use_utf8_names()
    with command_line(["ommatid", *sys.argv[1:]]), library_caches(), library_warnings(output.warn):
        code = exit_code_of(_run)
    gc.freeze()  # the process ends: looking for cycles among the libraries' objects would take half a second
    sys.exit(code)


def _run() -> object:
    """Run the command line. Raises InputError for an argument that is not UTF-8: JSON and pages cannot name it."""
    for argument in sys.argv[1:]:
        if any(0xD800 <= ord(character) < 0xE000 for character in argument):
            raise InputError(f"expected names and values in UTF-8, got {printable(argument, 80)}; rename the file")
    return app(prog_name="ommatid", standalone_mode=False)


def prepare_streams() -> None:
    """Open closed standard streams on the null device, and let every character be printed.

    A file that the program opens would otherwise take the number of a closed stream, and libraries would write into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # takes the lowest free number
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", encoding="utf-8", closefd=False))
    codecs.register_error(ERRORS, _alternative)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=ERRORS)


def _alternative(error: UnicodeError) -> tuple[str, int]:
    """Return what is printed in place of characters that an encoding lacks: a word in ASCII, or an escape."""
    if not isinstance(error, UnicodeEncodeError):
        raise error
    missing = error.object[error.start : error.end]
    words = (ALTERNATIVES.get(character) or character.encode("unicode_escape").decode("ascii") for character in missing)
    return "".join(words), error.end


def use_utf8_names() -> None:
    """Start this program again with names of files in UTF-8, where the locale has another encoding.

    OpenEXR and Mitsuba take UTF-8 in every locale, so that they would open another file. Output keeps the encoding of
    the locale.
    """
    if sys.getfilesystemencoding().lower() in ("utf-8", "utf8") or sys.flags.utf8_mode:
        return
    os.environ.setdefault("PYTHONIOENCODING", f"{sys.stdout.encoding}:backslashreplace")
    executable = sys.executable
    os.execv(executable, [executable, "-P", "-X", "utf8", *sys.orig_argv[1:]])
