"""The command line is a shell: its functions are short, and every option of a command has a help text."""

from __future__ import annotations

import ast
from typing import Any, cast

import typer.main

from ommatid.cli.app import app

from ..modules import modules

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
