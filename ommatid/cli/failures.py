"""Convert the outcome of a command into an exit code, and every failure into one sentence on stderr.

Exit codes are 0, 2 for a scene, option or file to correct, 1 for a failure of the machine, and 3 with --strict for
results that are not to be trusted.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ommatid.runtime.errors import InputError, MachineError, NotStartedError, shortened
from ommatid.runtime.execution.library_warnings import TRACEBACK
from ommatid.runtime.outputs.kinds import input_error
from ommatid.runtime.printable import printable
from ommatid.scenes.tables.gallery import gallery_names

from .output import print_result, say

if TYPE_CHECKING:
    from ommatid.pipeline.batches import BatchOutcome

# Options and commands that are no longer, with what takes their place.
_TLS = "name the file in Dask's own configuration, as by DASK_DISTRIBUTED__COMM__TLS__"
_FIGURES = "write --format svg,pdf; text and lines of these files are sharp at any size"
WITHDRAWN = {
    "--candidates": 'write --set design.magnifications="1/2,...,1/9", or compare scenes by `ommatid predict A B C`',
    "--complete": "write --set render.complete=true",
    "--figure-dpi": _FIGURES,
    "--figure-format": _FIGURES,
    "--list": "`ommatid init` alone lists the scenes of the gallery",
    "--seconds": 'write --within "240 s"',
    "--tls-ca": f"{_TLS}CA_FILE",
    "--tls-cert": f"{_TLS}CLIENT__CERT",
    "--tls-key": f"{_TLS}CLIENT__KEY",
}
WITHDRAWN_COMMANDS = {"export-model": "write `ommatid export model.npz -o H.npz`"}

PHRASES = (  # of the library that reads numbers, and plain ones
    (r"Input should be a valid (integer|number).*", r"expected a number, as in 4"),
    (r"Input should be greater than or equal to ", "expected a number of at least "),
    (r"Input should be less than or equal to ", "expected a number of at most "),
)
NOT_TRUSTED = 3  # exit code of --strict
INTERRUPTED = 130  # exit code of a command stopped by Ctrl-C


class BatchError(Exception):
    """Scenes failed or are not to be trusted, as has been reported for each; `exit_code` is the worst of theirs."""

    def __init__(self, exit_code: int) -> None:
        """Stop a command with an exit code after its results and failures have been reported."""
        super().__init__(exit_code)
        self.exit_code = exit_code


def finish_batch(outcome: BatchOutcome, as_json: bool, strict: bool = False, job_words: str = "") -> None:
    """Print the documents of a batch, or the table of a sweep, and a sentence on the job that ran it, if any.

    Raises BatchError if a scene failed or, if `strict`, if the results of one are not to be trusted.
    """
    print_result(outcome.documents, outcome.sections, as_json)
    if job_words:
        say(job_words)
    verdicts = [document["verdict"]["trusted"] for document in outcome.documents if "verdict" in document]
    code = max(outcome.exit_code, NOT_TRUSTED if strict and not all(verdicts) else 0)
    if code:
        raise BatchError(code)


def exit_code_of(command: Callable[[], object]) -> int:
    """Run a command line, report what stops it, and return the exit code."""
    try:
        try:
            code = command()
            if code == INTERRUPTED:
                raise KeyboardInterrupt
        except Exception as error:
            code = report(error)
    except KeyboardInterrupt:
        say("ommatid: stopped; finished files stay, the next run carries on from them")
        code = 1
    return _delivered(code if isinstance(code, int) else 0)


def report(error: Exception) -> int:
    """Say in one sentence what went wrong, and return the exit code. Raises KeyboardInterrupt if that was Ctrl-C."""
    cause = error.__cause__
    while cause is not None:  # a library that is stopped while it is imported raises ImportError from it
        if isinstance(cause, KeyboardInterrupt):
            raise cause
        cause = cause.__cause__
    if isinstance(error, OSError) and isinstance(error.filename, str):
        error = input_error(Path(error.filename), error) or error
    if isinstance(error, BatchError):
        return error.exit_code
    if isinstance(error, NotStartedError):
        return 1
    if hasattr(error, "format_message"):  # raised by the parser of the command line
        message = _parser_message(cast(Any, error))
        if type(error).__name__ == "NoArgsIsHelpError":
            print(message, file=sys.stderr)
        else:
            say(f"ommatid: {message}")
        return 2
    if isinstance(error, InputError | MachineError):
        say(f"ommatid: {error}")
        return 2 if isinstance(error, InputError) else 1
    if os.environ.get(TRACEBACK):
        raise error
    if isinstance(error, MemoryError):
        say("ommatid: not enough memory; crop the target or close other programs")
    elif isinstance(error, OSError):
        say(f"ommatid: {error.filename or 'the machine'}: {error.strerror or error}")
    else:
        what = printable(f"{type(error).__name__}: {error}")
        say(f"ommatid: unexpected {what}; set {TRACEBACK}=1 to see where, and report it")
    return 1


def _parser_message(error: Any) -> str:
    """Return the sentence of an error in the command line itself, with what takes the place of what is withdrawn."""
    option, message = getattr(error, "option_name", ""), str(error.format_message())
    if option in WITHDRAWN:
        return f"{option}: this option is withdrawn; {WITHDRAWN[option]}"
    if option and message.startswith("No such option"):
        return _unknown_option(option, message)
    match = re.match(r"No such command '(.*?)'\.", message, re.DOTALL)
    if match is None:
        return _plain(error, message)
    name = match[1]
    if name in WITHDRAWN_COMMANDS:
        return f"{name}: this command is withdrawn; {WITHDRAWN_COMMANDS[name]}"
    if name in gallery_names() or name.endswith(".toml"):
        return f"{shortened(name)}: expected a command before the scene, as in: ommatid run {shortened(name)}"
    return message if "Did you mean" in message else f"{message} `ommatid -h` lists the commands"


def _unknown_option(option: str, message: str) -> str:
    """Return what an unknown option should be: one of two dashes, or a key of the scene."""
    single = next((word for word in sys.argv if word.startswith(option) and len(word) > len(option)), "")
    if len(option) == 2 and single:
        return f"{shortened(single)}: no such option; long ones begin with two dashes, as in -{shortened(single)}"
    from ommatid.scenes.scene import Scene
    from ommatid.scenes.tables.messages import known_keys

    name = option.lstrip("-").replace("-", "_")
    keys = [key for key in known_keys(Scene) if key.rsplit(".", 1)[-1] == name]
    return f"{option}: no such option; it is a key of the scene, as in --set {keys[0]}=VALUE" if keys else message


def _plain(error: Any, message: str) -> str:
    """Return a message of the parser in plain words, with where to read what is missing."""
    if message.startswith("Missing"):
        return f"{message.rstrip('.')}; `{error.ctx.command_path} -h` says what it is"
    for phrase, words in PHRASES:
        message = re.sub(phrase, words, message)
    return message


def _delivered(code: int) -> int:
    """Flush stdout and return the exit code. Python itself would report an error of it with a traceback."""
    try:
        print(end="", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # else Python flushes again when it ends
        return code or report(error)
    return code
