"""The tables of docs/commands.md, made from the commands: `python -m tests.commands_page` writes them anew."""

from __future__ import annotations

import re
from typing import Any

import typer.main

from ommatid.cli.app import app

from .documentation import DOCS

PAGE = DOCS / "commands.md"
COMMANDS: dict[str, Any] = dict(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
TABLE = re.compile(r"(<!-- (commands|options) -->\n).*?(<!-- end -->)", re.DOTALL)


def with_tables(text: str) -> str:
    """Return the text of the page with both tables anew."""
    tables = {"commands": _commands, "options": _options}
    return TABLE.sub(lambda match: f"{match[1]}{tables[match[2]]()}\n{match[3]}", text)


def _commands() -> str:
    rows: list[tuple[str, ...]] = [("command", "purpose"), ("---", "---")]
    for name, command in COMMANDS.items():
        words = [each.metavar for each in command.params if each.param_type_name == "argument"]
        words += [f"-o {each.metavar}" for each in command.params if each.name == "file" and each.opts[0] == "-o"]
        rows.append((f"`{' '.join([name, *words])}`", command.help.splitlines()[0]))
    return _table(rows)


def _options() -> str:
    """Return a row for each help text of an option, with the commands that have it."""
    found: dict[tuple[str, str], list[str]] = {}
    for name, command in COMMANDS.items():
        for each in command.params:
            if each.param_type_name == "option" and each.name != "help":
                names = ", ".join(f"`{option}`" for option in (*each.opts, *each.secondary_opts))
                value = f" `{each.metavar}`" if each.metavar and each.name != "steer" else ""
                found.setdefault((names + value, each.help), []).append(name)
    rows: list[tuple[str, ...]] = [("option", "effect (commands)"), ("---", "---")]
    for (option, effect), names in sorted(found.items(), key=lambda item: -len(item[1])):
        having = "all" if len(names) == len(COMMANDS) else ", ".join(names)
        rows.append((option, f"{effect} ({having})"))
    return _table(rows)


def _table(rows: list[tuple[str, ...]]) -> str:
    cells = ([re.sub(r"([|*])", r"\\\1", cell) for cell in row] for row in rows)
    return "\n".join(f"| {' | '.join(row)} |" for row in cells)


if __name__ == "__main__":
    PAGE.write_text(with_tables(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
