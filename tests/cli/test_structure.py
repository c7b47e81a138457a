"""The command line is a shell: its functions are short, and every option of a command has a help text."""

from __future__ import annotations

import ast
from typing import Any, cast

import pytest
import typer.main

from ommatid.cli.app import app

from ..modules import modules

LONGEST = 50  # lines of a function, its signature and docstring included
COMMANDS: dict[str, Any] = cast(Any, typer.main.get_command(app)).commands


@pytest.mark.parametrize("module", [name for name in modules() if name.startswith("ommatid.cli.")])
def test_no_function_is_long(module: str) -> None:
    functions = [
        node
        for node in ast.walk(ast.parse(modules()[module].read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    ]
    lengths = {node.name: (node.end_lineno or node.lineno) - node.lineno + 1 for node in functions}
    assert {name: length for name, length in lengths.items() if length > LONGEST} == {}


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_and_option_has_a_help_text(command: str) -> None:
    assert COMMANDS[command].help
    assert [parameter.name for parameter in COMMANDS[command].params if not parameter.help] == []
