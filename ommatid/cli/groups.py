"""Groups of options: a frozen dataclass of annotated fields, which is one parameter of every command that has them."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, cast, get_type_hints


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command for the parser, which has an option for each field of a group in place of the group itself."""
    signature = inspect.signature(command, eval_str=True)
    annotations: dict[str, Any] = {name: each.annotation for name, each in signature.parameters.items()}
    groups = {name: cast(type[Any], each) for name, each in annotations.items() if is_dataclass(each)}
    parameters = [
        each
        for name, parameter in signature.parameters.items()
        for each in (_options_of(groups[name]) if name in groups else [parameter])
    ]
    named = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]

    @wraps(command)
    def called(**values: Any) -> None:
        collected = {
            name: group(**{field.name: values.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**values, **collected)

    called.__signature__ = signature.replace(parameters=named)  # type: ignore[attr-defined]
    called.__annotations__ = {each.name: each.annotation for each in named}
    return called


def _options_of(group: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in fields(group)
    ]
