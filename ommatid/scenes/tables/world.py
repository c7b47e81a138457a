"""The table of a Mitsuba scene in the scene file, [world], and where that scene stands before the camera.

The coordinates of the file, p, become millimetres before the camera by

    unit * to_world * (scale * p),

with the camera at the origin, looking along +z with +y up, so that +x points to its left.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, isfinite, sin
from typing import Annotated, Any, Literal, cast

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer, WithJsonSchema, model_validator

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import shortened_repr

from .table import LARGEST, Table
from .units import SIGNED_ANGLE, FileName

FROM_FILE = "from file"
MILLIMETRES = {"um": 1e-3, "mm": 1.0, "cm": 10.0, "m": 1e3, "km": 1e6, "in": 25.4, "ft": 304.8}
UNLIKE = 1e-5  # relative, by which axes may differ in length and from right angles: of matrices with six digits
STEPS = ("rotate", "translate", "scale")


def _transform(value: object) -> tuple[float, ...]:
    """Convert 16 numbers, 4 rows or a list of steps to 16 numbers, row by row. Raises ValueError."""
    items: list[object] = list(cast(Sequence[object], value)) if isinstance(value, list | tuple) else []
    if items and all(isinstance(item, dict) for item in items):
        matrix = np.eye(4)
        for item in items:
            matrix = _step_matrix(cast(dict[str, object], item)) @ matrix
    else:
        rows = [number for row in items for number in (cast(list[object], row) if isinstance(row, list) else [row])]
        matrix = np.array(_numbers(rows, 16, "4 rows of 4 numbers, or a list of steps", cast(object, value))).reshape(
            4, 4
        )
    _check_similarity(matrix)
    return tuple(matrix.ravel().tolist())


def _step_matrix(step: dict[str, object]) -> FloatArray:
    names = [name for name in STEPS if name in step]
    if len(names) != 1 or set(step) != {*names, *(("angle",) if names == ["rotate"] else ())}:
        raise ValueError(
            'expected steps such as { rotate = [0, 1, 0], angle = "180 deg" }, { translate = [0, -1.4, 4] } or'
            f" {{ scale = 2 }}, got {shortened_repr(step)}"
        )
    (name,) = names
    matrix, value = np.eye(4), step[name]
    if name == "scale":
        matrix[:3, :3] *= _numbers([value], 1, "one number", value)[0]
        return matrix
    vector = _numbers(value, 3, f"3 numbers for {name}", value)
    if name == "translate":
        matrix[:3, 3] = vector
        return matrix
    length = hypot(*vector)
    if length == 0:
        raise ValueError("expected an axis to rotate about, got [0, 0, 0]")
    x, y, z = (component / length for component in vector)
    turn = SIGNED_ANGLE.read(step["angle"])
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix[:3, :3] += sin(turn) * across + (1 - cos(turn)) * across @ across
    return matrix


def _numbers(values: object, count: int, expected: str, said: object) -> list[float]:
    items = list(cast(Sequence[object], values)) if isinstance(values, list | tuple) else []
    numbers = [float(item) for item in items if isinstance(item, int | float) and not isinstance(item, bool)]
    if len(numbers) != len(items) or len(items) != count:
        raise ValueError(f"expected {expected}, got {shortened_repr(said)}")
    if not all(isfinite(number) and abs(number) <= LARGEST for number in numbers):
        raise ValueError(f"expected numbers up to {LARGEST:g}, got {shortened_repr(said)}")
    return numbers


def _check_similarity(matrix: FloatArray) -> None:
    """Raise ValueError unless a transform moves, rotates, mirrors and scales alike along all axes."""
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise ValueError(f"expected the last row 0, 0, 0, 1, got {shortened_repr(matrix[3].tolist())}")
    if not is_similarity(matrix[:3, :3]):
        raise ValueError(
            "expected a transform that moves, rotates and scales alike along all axes, got"
            f" {shortened_repr(matrix.tolist())}; shear or stretch shapes in the Mitsuba file"
        )


def is_similarity(linear: FloatArray) -> bool:
    """Return True if a (3, 3) matrix rotates, mirrors or scales alike along all axes."""
    gram: FloatArray = linear.T @ linear
    square = float(np.trace(gram)) / 3
    return square > 0 and float(np.abs(gram - square * np.eye(3)).max()) <= 2 * UNLIKE * square


def _plain_transform(numbers: tuple[float, ...]) -> list[float]:
    return list(numbers)  # `list[float]` itself as a serializer fails where Python knows a signature of it (3.12.3)


Transform = Annotated[
    tuple[float, ...],
    BeforeValidator(_transform),
    PlainSerializer(_plain_transform),
    WithJsonSchema(
        {
            "type": "array",
            "items": {"type": ["number", "array", "object"]},
            "description": "4 rows of 4 numbers, row by row, or a list of steps: rotate and angle, translate, scale",
        }
    ),
]


class WorldTable(Table):
    """A Mitsuba scene behind the target or, where the target has no picture, in its place."""

    file: FileName = Field(
        description="a Mitsuba scene file; without the keys below in millimetres, with the camera at the origin looking"
        " along +z, +y up"
    )
    white: Annotated[float, Field(gt=0, le=LARGEST)] | Literal["auto"] = Field(
        default=1.0, description='radiance of a value of 255; "auto": that of the brightest part of the view'
    )
    unit: Literal["um", "mm", "cm", "m", "km", "in", "ft"] = Field(
        default="mm", description="unit of the lengths in the file"
    )
    scale: float = Field(default=1.0, gt=0, le=1e12, description="factor by which the world is enlarged")
    to_world: Transform | None = Field(
        default=None,
        description="where the world stands before the camera: 16 numbers, or steps; lengths in the file's unit",
    )
    camera: Literal["from file"] | None = Field(
        default=None, description='"from file": the camera stands where the sensor of the file does; absent: the origin'
    )

    @model_validator(mode="after")
    def _check_pose(self) -> WorldTable:
        if self.camera is not None and self.to_world is not None:
            raise ValueError('camera = "from file" takes the pose of the file\'s sensor, got to_world too; remove one')
        factor = 1.0 if self.to_world is None else float(np.linalg.norm(self.to_world[:3]))
        if not 1 / LARGEST <= self.unit_length * factor <= LARGEST:
            raise ValueError(
                f"expected a length of 1 in the file to become {1 / LARGEST:g} to {LARGEST:g} mm by unit, scale and"
                f" to_world, got {self.unit_length * factor:g} mm; change scale"
            )
        return self

    @property
    def unit_length(self) -> float:
        """Millimetres that a length of 1 in the file becomes, before `to_world`."""
        return MILLIMETRES[self.unit] * self.scale

    def describe_place(self) -> dict[str, Any]:
        """Describe where the world stands, for a fingerprint; empty for millimetres around the camera."""
        return self.model_dump(mode="json", exclude={"file", "white"}, exclude_defaults=True)
