"""The scenes of a batch: one for every combination of swept values, each with its own folder, and the shares of jobs.

`--sweep noise.variance=1e-6,1e-4 --sweep camera.lens.I.magnification=1/2,1/3` makes four scenes of one. Values are
read like those of `--set`, and dots stand for values between (`series`). `--job I/N` takes every N-th scene of this
list, from the I-th on.
"""

from __future__ import annotations

import hashlib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path

from pydantic import ValidationError

from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.outputs.kinds import check_name, shortened_name
from ommatid.scenes.scene import read
from ommatid.scenes.tables.series import continued

from .batch import Member

EXAMPLE = "such as --sweep noise.variance=1e-6,1e-4"
MOST_SCENES = 100_000
LONGEST = 40  # characters of a value in a folder's name
MOST_JOBS = 100_000
INDICES = ("SLURM_ARRAY_TASK_ID", "PBS_ARRAY_INDEX")  # the number of a job of an array, as SLURM and PBS say it
_PAIRS = {"]": "[", "}": "{", ")": "("}


@dataclass(frozen=True)
class SweepAxis:
    """A key of the scene file and its values, as they were written."""

    key: str
    values: tuple[str, ...]


def sweep_axes(options: Iterable[str]) -> tuple[SweepAxis, ...]:
    """Read the KEY=VALUE,VALUE,... of every `--sweep`. Raises InputError, which names the option."""
    axes: list[SweepAxis] = []
    for option in options:
        key, equals, text = (part.strip() for part in option.partition("="))
        values = _values(text, option)
        if not key or not equals or not all(values):
            raise InputError(
                f"--sweep {shortened(option)}: expected KEY=VALUE,VALUE,... without an empty value, {EXAMPLE}"
            )
        option = shortened(option)
        repeated = [value for value, count in Counter(values).items() if count > 1]
        if repeated:
            raise InputError(f"--sweep {option}: expected every value once, got '{shortened(repeated[0])}' twice")
        if key in {axis.key for axis in axes}:
            raise InputError(f"--sweep {option}: expected every key once, got it twice; join its values by commas")
        axes.append(SweepAxis(key, values))
    return tuple(axes)


def _values(text: str, option: str) -> tuple[str, ...]:
    if re.search(r"\d\.\.+\d", text):
        raise InputError(f"--sweep {shortened(option)}: dots stand between commas, as in noise.bits=8,...,12")
    try:
        return tuple(continued(_split(text)))
    except ValueError as error:
        raise InputError(f"--sweep {shortened(option)}: {error}") from error


def members(
    scenes: Sequence[Path],
    axes: Sequence[SweepAxis],
    output: Path,
    common: Sequence[str] = (),
    lenses: Sequence[str] = (),
) -> list[Member]:
    """List every scene with every combination of values, in folders of `output` that are named after them.

    Raises InputError if two of them would share a folder, for a scene with a name that no folder can have, and for more
    than MOST_SCENES of them.
    """
    count = len(scenes) * prod(len(axis.values) for axis in axes)
    if count > MOST_SCENES:
        raise InputError(f"--sweep: expected at most {MOST_SCENES} combinations of values, got {count}; sweep fewer")
    names = [_folder_names(axis) for axis in axes]
    by_folder: dict[Path, Member] = {}
    for scene in scenes:
        check_name(scene.stem, scene)
    for scene, values in product(scenes, product(*(axis.values for axis in axes))):
        parts = [f"{_safe(axis.key)}={name[value]}" for axis, name, value in zip(axes, names, values, strict=True)]
        folder = output / shortened_name("+".join([scene.stem, *parts]))
        if folder in by_folder:
            raise InputError(f"{folder}: two scenes of the batch are called '{scene.stem}'; rename one of them")
        changes = tuple(f"{axis.key}={value}" for axis, value in zip(axes, values, strict=True))
        by_folder[folder] = Member(scene, folder, changes, tuple(common), tuple(lenses))
    return list(by_folder.values())


def job_numbers(text: str, environment: Mapping[str, str]) -> tuple[int, int]:
    """Read `--job I/N`: the number of a job, from 1, and that of all jobs. `/N` takes I from a job array.

    Raises InputError, also for an array that is not numbered from 1.
    """
    match = re.fullmatch(r"(\d{0,9})/(\d{1,9})", text.strip(), re.ASCII)
    if match is None or int(match[2]) > MOST_JOBS:
        also = "; `auto` is withdrawn, since N is part of the command" if text.strip() == "auto" else ""
        raise InputError(
            f"--job {shortened(text)}: expected I/N, such as 2/8, or /N in a job array, with N up to {MOST_JOBS}{also}"
        )
    variable = "" if match[1] else next((name for name in INDICES if environment.get(name)), "")
    if not match[1] and not variable:
        raise InputError(
            f"--job {text}: neither {' nor '.join(INDICES)} is set, so this is no job of an array; write I/N"
        )
    number, count = match[1] or environment[variable], int(match[2])
    if re.fullmatch(r"\d{1,9}", number, re.ASCII) is None or not 1 <= int(number) <= count:
        origin = f", which is {variable}; submit the jobs as an array from 1 to {count}" if variable else ""
        raise InputError(
            f"--job {shortened(text)}: expected a job from 1 to {count}, got '{shortened(number)}'{origin}"
        )
    return int(number), count


def check_keys(scene: Path, axes: Sequence[SweepAxis], changes: Sequence[str], lenses: Sequence[str]) -> None:
    """Raise InputError if the scene file does not know a swept key.

    Other errors in the scene, and errors in values, are reported when the scene concerned is run.
    """
    if not axes or _key_error(scene, changes, lenses, None):
        return
    for axis in axes:
        error = _key_error(scene, (*changes, f"{axis.key}={axis.values[0]}"), lenses, axis.key)
        if error:
            raise InputError(f"--sweep {shortened(axis.key)}: {error}")


def _key_error(scene: Path, changes: Sequence[str], lenses: Sequence[str], key: str | None) -> InputError | None:
    """Return the error of a change that names no table, or a `key` that the scene file does not know."""
    try:
        read(scene, changes, lenses)
    except InputError as error:
        cause = error.__cause__
        if isinstance(cause, InputError):
            return error
        if key is not None and isinstance(cause, ValidationError):
            unknown = {problem["loc"][-1] for problem in cause.errors() if problem["type"] == "extra_forbidden"}
            return error if unknown & set(key.split(".")) else None
    return None


def _split(text: str) -> list[str]:
    """Split at commas outside brackets and quotation marks: "[2,2],[3,3]" are two values."""
    parts, brackets, quote = [""], [""], ""
    for letter in text:
        if letter == "," and not quote and len(brackets) == 1:
            parts.append("")
            continue
        parts[-1] += letter
        if quote:
            quote = "" if letter == quote else quote
        elif letter in "\"'":
            quote = letter
        elif letter in _PAIRS.values():
            brackets.append(letter)
        elif brackets[-1] == _PAIRS.get(letter):
            brackets.pop()
    return [part.strip() for part in parts]


def _folder_names(axis: SweepAxis) -> dict[str, str]:
    """Map values to parts of folder names; values that would share a name, or have a long one, get a hash."""
    plain = {value: _safe(value) for value in axis.values}
    texts = Counter(plain.values())
    return {
        value: text
        if texts[text] == 1 and 0 < len(text) <= LONGEST
        else f"{text[:LONGEST]}~{hashlib.sha256(value.encode()).hexdigest()[:6]}"
        for value, text in plain.items()
    }


def _safe(text: str) -> str:
    """Replace characters that not every file system allows: 1/3 becomes 1-3, [2, 2] becomes 2,2."""
    return re.sub(r"[^A-Za-z0-9._,=-]", "_", re.sub(r"[\s\"'+\[\]]", "", text).replace("/", "-"))
