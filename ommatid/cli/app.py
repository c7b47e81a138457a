"""The command line: parses options, calls the packages that do the work, and prints what they return.

Results go to stdout, as tables or with --json as one document; progress and failures go to stderr. Modules that load
NumPy or more are imported inside the commands, so that `ommatid --help` answers at once.
"""

from __future__ import annotations

import sys
from functools import partial
from importlib.metadata import version as version_of
from typing import Annotated

import typer

from ommatid.runtime.execution.library_warnings import library_warnings
from ommatid.runtime.library_caches import library_caches
from ommatid.runtime.versions import command_line

from . import calibrate, output, predict, reconstruct, run, show, studies
from .failures import exit_code_of
from .streams import prepare_streams, use_utf8_names

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
    reconstruct.check,
):
    with_arguments()(command)
with_arguments("import")(calibrate.import_frames)
with_arguments("export-model")(calibrate.export_model)
for command in (predict.predict, predict.design, studies.bench, show.show, show.export, show.init):
    with_arguments()(command)
for command in (studies.paper, studies.stability, show.schema, show.doctor):
    app.command()(command)


Version = Annotated[bool, typer.Option("--version", help="Print the version and exit.", is_eager=True)]


@app.callback(invoke_without_command=True)
def start(version: Version = False) -> None:
    """Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars."""
    if version:
        print(f"ommatid {version_of('ommatid')}")
        raise typer.Exit


def main() -> None:
    """Run the command line and exit."""
    prepare_streams()
    use_utf8_names()
    with command_line(["ommatid", *sys.argv[1:]]), library_caches(), library_warnings(output.warn):
        code = exit_code_of(partial(app, prog_name="ommatid", standalone_mode=False))
    sys.exit(code)
