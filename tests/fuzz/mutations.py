"""Mutated scenes, lens files and records: valid grammar with extreme, missing or exchanged keys and values."""

from __future__ import annotations

import copy
from collections.abc import Callable
from random import Random
from typing import Any

import tomli_w

MARK = "@@{}@@"  # placeholder for text that no TOML library writes


def _texts(texts: str, *more: str) -> tuple[str, ...]:
    return (*texts.split("|"), *more)


def _quoted(texts: str, *more: str) -> tuple[str, ...]:
    return tuple(f'"{text}"' for text in _texts(texts, *more))


NUMBERS = _texts(
    "0|1|-1|2|3|16|1e-300|5e-324|1e-12|1e12|1e30|1e300|-1e300|1e400|nan|inf|-inf|0.5|-0.0|1_0|true|false|1000000"
    "|100000000|1000000000|9223372036854775807|18446744073709551616",
    *("9" * 400, "9" * 5000, "0x" + "f" * 5000, "0b" + "1" * 300),
)
LENGTHS = _quoted(
    "1 mm|0 m|-1 m|1|m|1e-300 m|1e300 m|1e-40 mm|1e40 km|1e999999999 m|9**9**9 m|9**9**9**9 m|1 m**9**9**9"
    "|(9**9)**(9**9) m|9⁹⁹⁹⁹⁹⁹⁹⁹ m|1 m squared squared|1/1000000000000000000000000 m|nan m|inf m|1 s|1 parsec|1 degC"
    "|1 dB|1 %|9 squared squared squared squared squared squared m|1 kilokilometer|1 m; import os|1e3 nm",
    *("1" * 30000 + " m", "1 " + "a" * 30000, "1 " + "m*" * 2000 + "m", "(" * 3000 + "1 m"),
)
RATIOS = (
    *_quoted("1/3|1/0|0/1|-1/3|1/1000000|999999/1000000|1e-9999999999|1e99999999|1/3/5|1e-6|1 / 3|nan"),
    *_quoted("1/" + "9" * 4000, "0." + "3" * 3000),
    "0.3333333333333333",
)
TEXTS = _quoted(
    "| |fit|auto|\\u0000|a\\u0000b.png|😀|\\u202e|[red]|\\n\\n|photo:|photo:../x|photo:camera|.|/|/dev/null|../.."
    "|scene.toml|frame|tiles|ideal|transport|exponential|power",
    *("\\u001b[31mred", "\\u001b]0;title\\u0007", "\\u009b2J", "\\u2028", "$\\\\frac$", "/dev/zero", "mosaic.npy"),
    *("x" * 300, "x" * 100000),
)
ARRAYS = _texts(
    "[]|{}|[[]]|[1]|[1, 1]|[0, 0]|[-1, 3]|[3, 3, 3]|[1.5, 2]|[nan, 1]|[1000000, 1000000]|[100000, 100000]"
    "|[30000, 30000]|[1000000000, 1000000000]|[300, 300]|[1, 40000]|[9223372036854775807, 1]|[1e300, 1e300]"
    '|[true, true]|[-1e6, 1e6]|{name = [1]}|[{}]|[{name = 1}]|[{name = "I"}, {name = "I"}]|["a", "b"]'
    "|1979-05-27|07:32:00|1979-05-27T07:32:00Z",
    *("[" + "9" * 400 + ", 1]", "[" * 100 + "]" * 100, "[" * 5000 + "]" * 5000),
    *("{a = " * 300 + "1" + "}" * 300, "[" + "1," * 5000 + "]"),
)
VALUES = (*NUMBERS, *LENGTHS, *RATIOS, *TEXTS, *ARRAYS)
JSON_VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 3, 1.5, -1e300, 1e300, 10**30, float("nan"), float("inf"), [], {}, [1], [1, 1]),
    *("", "x", "x" * 5000, "1 mm", "9**9**9 m", "1/3", "points", "ideal", "\x1b[31m", "\u202e", "/dev/zero", "../x"),
    *([10**6, 10**6], [[[[[[[[1]]]]]]]], {"a": {"b": 1}}, ["I"]),
)
DEEP = tuple(  # JSON, closed or not
    f"{start * depth}1{end * depth * closed}"
    for start, end in (("[", "]"), ('{"a":', "}"), ("[[],", "]"))
    for depth in (50, 900, 10000, 200000)
    for closed in (0, 1)
)
HEADERS = ("[target]", "[camera]", "[[camera.lens]]", "[noise]", "[render]", "[a.b.c]", "[[target]]", "[camera.lens.I]")

Path = tuple[str | int, ...]


def scene(rng: Random, original: dict[str, Any]) -> str:
    """Return the TOML of a scene after one to three changes of keys and values."""
    data = copy.deepcopy(original)
    raw: list[str] = []
    for _ in range(rng.choice((1, 1, 2, 3))):
        _change(rng, data, lambda old: _placeholder(rng, raw, old))
    text = tomli_w.dumps(data)
    for index, value in enumerate(raw):
        text = text.replace(f'"{MARK.format(index)}"', value)
    if rng.random() < 0.05:
        lines = text.splitlines()
        lines.insert(rng.randrange(len(lines) + 1), rng.choice((*HEADERS, *(f"x = {value}" for value in VALUES))))
        text = "\n".join(lines)
    return text


def record(rng: Random, original: Any) -> Any:
    """Return a JSON document after one or two changes of keys and values."""
    data = copy.deepcopy(original)
    for _ in range(rng.choice((1, 1, 2))):
        _change(rng, data, lambda _: copy.deepcopy(rng.choice(JSON_VALUES)))
    return data


def settings(rng: Random, keys: list[str]) -> list[str]:
    """Return one to three `--set` options, most of them with existing keys."""
    return [_setting(rng, keys) for _ in range(rng.choice((1, 1, 2, 3)))]


def _setting(rng: Random, keys: list[str]) -> str:
    unknown = ("", ".", "a.b", "x" * 3000, "a." * 3000, "camera.lens.X.y")
    key = rng.choice(keys if rng.random() < 0.9 else unknown)
    equals = "=" if rng.random() < 0.95 else rng.choice(("", "==", ":", " = "))
    value = rng.choice(VALUES if rng.random() < 0.9 else ("", " ", "[", '"', "\ud800", "1 mm", "\\", "{"))
    return f"{key}{equals}{value}".replace("\0", "")


def keys_of(data: dict[str, Any]) -> list[str]:
    """Return the keys of a scene in the notation of `--set`."""
    names = [lens["name"] for lens in data["camera"]["lens"]]
    keys: list[str] = []
    for path in _paths(data):
        words = list(path)
        if words[:2] == ["camera", "lens"] and len(words) > 2:
            words[2] = names[int(words[2])]
        if all(isinstance(word, str) for word in words):
            keys.append(".".join(map(str, words)))
    return keys


def _placeholder(rng: Random, raw: list[str], old: Any) -> str:
    raw.append(rng.choice(_of_same_type(old) if rng.random() < 0.7 else VALUES))
    return MARK.format(len(raw) - 1)


def _of_same_type(old: Any) -> tuple[str, ...]:
    if isinstance(old, str):
        return RATIOS if "/" in old else LENGTHS if old[:1].isdigit() else TEXTS
    return ARRAYS if isinstance(old, dict | list) else NUMBERS


def _change(rng: Random, data: Any, value: Callable[[Any], Any]) -> None:
    paths = _paths(data)
    if not paths:
        return
    path = rng.choice(paths)
    holder, key = _at(data, path[:-1]), path[-1]
    change = rng.choice(("value", "value", "value", "value", "remove", "double", "exchange", "rename"))
    if change == "value":
        holder[key] = value(holder[key])
    elif change == "remove":
        del holder[key]
    elif change == "double" and isinstance(holder, list):
        holder.append(copy.deepcopy(holder[key]))  # pyright: ignore[reportCallIssue, reportArgumentType]
    elif change == "exchange":
        holder[key] = copy.deepcopy(_at(data, rng.choice(paths)))
    elif isinstance(holder, dict):
        name = rng.choice(("x", "", "naem", "a b", "é", str(key) + "s"))
        holder[name] = holder[key] if change == "double" else holder.pop(key)


def _paths(data: Any, before: Path = ()) -> list[Path]:
    inner: list[tuple[str | int, Any]] = []
    if isinstance(data, dict):
        inner = list(data.items())
    elif isinstance(data, list):
        inner = list(enumerate(data))
    return [path for key, value in inner for path in ((*before, key), *_paths(value, (*before, key)))]


def _at(data: Any, path: Path) -> Any:
    for key in path:
        data = data[key]
    return data
