"""Options of every command: a help text, and numbers that are bounded on both sides, or refused by a short sentence."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path
from typing import Any, cast, get_args, get_type_hints

import pytest
import typer.main

from ommatid.batch.sweep import job_numbers, members, sweep_axes
from ommatid.cli import options
from ommatid.cli.app import app
from ommatid.runtime.errors import InputError

from ..conftest import Command
from ..modules import modules

UNBOUNDED = {"flat_value", "point_value"}  # checked by `options.positive`


def numeric() -> dict[str, Any]:
    """Typer's description of all options that take a number, of all commands."""
    found: dict[str, Any] = {}
    for command in app.registered_commands:
        assert command.callback is not None
        for name, hint in get_type_hints(
            command.callback, vars(inspect.getmodule(command.callback)), None, True
        ).items():
            inner = get_args(hint)
            if inner and {int, float} & {inner[0], *get_args(inner[0])} and hasattr(inner[1], "min"):
                found[name] = inner[1]
    return found


def test_numbers_of_options_have_bounds() -> None:
    options_with_numbers = numeric()
    assert {"workers", "seed", *UNBOUNDED} <= options_with_numbers.keys()
    for name, option in options_with_numbers.items():
        assert None not in (option.min, option.max) or name in UNBOUNDED, name


def test_extreme_numbers_are_refused(here: Path, ommatid: Command) -> None:
    for seconds in ("inf", "nan", "-1", "", "9" * 5000):
        ended = ommatid("bench", here / "tiny.toml", "--within", f"{seconds} s")
        assert (ended.code, ended.out) == (2, "")
    for value in (0.0, -1.0, 1e13, float("inf"), float("nan")):
        with pytest.raises(InputError, match="expected a value above 0"):
            options.positive("--flat-value", value)
    for number in (str(2**63), "9" * 5000, "-" + "9" * 30, "1e5", "inf", "", "\0"):
        for read, text in (
            (lambda text: options.Frames(origin=text).settings, f"{number},1"),
            (lambda text: options.region("--region", text), f"0,0,{number},1"),
            (lambda text: job_numbers(text, {}), f"1/{number}"),
            (lambda text: job_numbers("/4", {"PBS_ARRAY_INDEX": text}), number or "x"),
        ):
            with pytest.raises(InputError) as refusal:
                read(text)
            assert len(str(refusal.value)) <= 300


def test_combinations_of_a_sweep_are_counted_before_they_are_made() -> None:
    values = ",".join(map(str, range(2000)))
    axes = sweep_axes([f"noise.variance={values}", f"render.seed={values}", f"prior.variance={values}"])
    with pytest.raises(InputError, match="at most 100000 combinations of values, got 8000000000"):
        members([Path("s.toml")], axes, Path("out"))
    with pytest.raises(InputError, match="twice") as refusal:
        sweep_axes([f"noise.variance={values},7"])
    assert len(str(refusal.value)) <= 300
    assert len(members([Path("s.toml")], axes[:1], Path("out"))) == 2000


# --- the command line is a shell: its functions are short, and every option of a command has a help text


LONGEST = 50  # lines of a function, its signature and docstring included
COMMANDS: dict[str, Any] = cast(Any, typer.main.get_command(app)).commands


def test_no_function_is_long() -> None:
    for module in [name for name in modules() if name.startswith("ommatid.cli.")]:
        for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                assert (node.end_lineno or node.lineno) - node.lineno < LONGEST, node.name


def test_every_command_and_option_has_a_help_text() -> None:
    for name, command in COMMANDS.items():
        assert command.help, name
        assert [parameter.name for parameter in command.params if not parameter.help] == []
