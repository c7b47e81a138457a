"""Python processes of this program, which import nothing from the current folder and read no configuration there.

A folder of scenes may hold a file json.py. Python puts the current folder first on the path of `python -c` and
`python -m`, an empty entry of PYTHONPATH means it, and some libraries read settings from it, which could name code.
"""

# ruff: noqa: PTH100, PTH117, PTH120, PTH121
# Other modules, such as pathlib and __future__, could still come from the current folder here.
import os
import sys

# Matplotlib reads it from the current folder, without an option that forbids it.
CONFIGURATIONS = frozenset({"matplotlibrc"})

_FLAGS = {"isolated": "-I", "ignore_environment": "-E", "no_user_site": "-s", "dont_write_bytecode": "-B"}
_START = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1))"
_IGNORE = "from ommatid.runtime.execution.interpreter import ignore_configurations; ignore_configurations()"


def leave_current_folder() -> None:
    """Take the current folder off the path of modules, and ignore the settings in it; for processes of this program.

    A script or a notebook is the user's process: it keeps both.
    """
    sys.path[:] = import_path()
    ignore_configurations()


def import_path() -> list[str]:
    """Return sys.path without the current folder and relative entries; this program's own folder stays, as the last."""
    entries = [entry for entry in sys.path if os.path.isabs(entry) and not _is_current(entry)]
    own = os.path.abspath(__file__)
    for _ in range(__name__.count(".") + 1):
        own = os.path.dirname(own)
    return entries if own in entries else [*entries, own]


def ignore_configurations() -> None:
    """Let libraries find none of CONFIGURATIONS in the current folder; they look for them by os.path.exists."""
    exists = os.path.exists

    def exists_elsewhere(path: int | str | bytes | os.PathLike[str] | os.PathLike[bytes]) -> bool:
        return (not isinstance(path, str) or path not in CONFIGURATIONS) and exists(path)

    os.path.exists = exists_elsewhere


def python_command(code: str, *arguments: str) -> list[str]:
    """Return the command of a Python process that executes `code` and finds the modules that this process finds.

    The process needs `python_environment()`.
    """
    import json

    options = ["-P", *(option for flag, option in _FLAGS.items() if getattr(sys.flags, flag))]
    options += [f"-Xutf8={int(sys.flags.utf8_mode)}", *(f"-W{option}" for option in sys.warnoptions)]
    return [sys.executable, *options, "-c", f"{_START}\n{_IGNORE}\n{code}", json.dumps(import_path()), *arguments]


def python_environment() -> dict[str, str]:
    """Return the variables of the environment for a Python process: no entry of PYTHONPATH is the current folder."""
    variables = dict(os.environ)
    entries = [entry for entry in variables.pop("PYTHONPATH", "").split(os.pathsep) if os.path.isabs(entry)]
    if entries:
        variables["PYTHONPATH"] = os.pathsep.join(entries)
    return {**variables, "PYTHONSAFEPATH": "1"}


def _is_current(entry: str) -> bool:
    try:
        return os.path.samefile(entry, os.curdir)
    except OSError:
        return False
