"""The command line: parses options, calls the packages that do the work, and prints what they return.

Results go to stdout, as tables or with --json as one document; progress and failures go to stderr. Modules that load
NumPy or more are imported inside the commands, so that `ommatid --help` answers at once.
"""

from __future__ import annotations

import sys
from functools import partial

import typer

from ommatid.runtime.versions import command_line

from . import calibrate, predict, reconstruct, run, show, studies
from .failures import exit_code_of

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars.",
)
for command in (run.run, run.render, calibrate.calibrate, reconstruct.reconstruct, reconstruct.check):
    app.command()(command)
app.command("import")(calibrate.import_frames)
app.command("export-model")(calibrate.export_model)
for command in (predict.predict, predict.design, studies.paper, studies.stability, studies.bench):
    app.command()(command)
for command in (show.show, show.export, show.init, show.schema, show.doctor):
    app.command()(command)


def main() -> None:
    """Run the command line and exit."""
    with command_line(["ommatid", *sys.argv[1:]]):
        code = exit_code_of(partial(app, standalone_mode=False))
    sys.exit(code)
