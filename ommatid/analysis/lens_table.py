"""The table of a camera's lens types by quantities, which `show` prints and the page of a run contains."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

Lens = dict[str, Any]  # of `summary.describe`, with what `sharpness.describe` adds
NO_LIGHT = "no light"
ROUNDING = 1e-9  # below what any unit of the table resolves


def lens_rows(lens_types: Sequence[Lens], optics: Sequence[Lens] = ()) -> list[tuple[str, ...]]:
    """Return names of quantities and their values for each lens type, without quantities that none of them has.

    lens_types, optics : descriptions as of `summary.describe` and of `sharpness.describe`
    """
    added = {lens["lens"]: lens for lens in optics}
    lenses = [lens | added.get(lens["name"], {}) for lens in lens_types]
    rows = [(name, *(words(lens) if key in lens else "" for lens in lenses)) for name, key, words in QUANTITIES]
    return [row for row in rows if any(row[1:])]


def _length(millimetres: float | None) -> str:
    return "infinity" if millimetres is None else f"{millimetres:.4g}"


def _scaled(scale: float, digits: str = ".3g") -> Callable[[float | None], str]:
    def formatted(value: float | None) -> str:
        if value is None:
            return NO_LIGHT
        shown = value * scale if abs(value * scale) > ROUNDING else 0.0
        return format(shown, digits if abs(shown) < 1000 else ".0f")

    return formatted


def _product(pair: Sequence[int]) -> str:
    return f"{pair[0]} x {pair[1]}"


def _ratio(magnification: float) -> str:
    return f"{magnification:.4g}" if magnification >= 1 else f"1/{1 / magnification:.4g}"


def _range(ends: Sequence[float]) -> str:
    return " to ".join(f"{end:g}" for end in ends)


def _view(angles: Sequence[float]) -> str:
    height, width = (f"{angle:.3g}" for angle in angles)
    return height if height == width else f"{height} x {width}"


def _if_any(words: Callable[[Any], str]) -> Callable[[Any], str]:
    return lambda value: "" if value is None else words(value)


def _sharp(lens: Lens) -> str:
    return "nowhere" if lens["near"] is None else f"{_length(lens['near'])} to {_length(lens['far'])}"


def _of(key: str, words: Callable[[Any], str]) -> tuple[str, Callable[[Lens], str]]:
    return key, lambda lens: words(lens[key])


def _axis_and_rim(key: str, words: Callable[[Any], str]) -> tuple[str, Callable[[Lens], str]]:
    def formatted(lens: Lens) -> str:
        values = (
            NO_LIGHT if lens[f"spot_{place}"] is None else words(lens[f"{key}_{place}"]) for place in ("axis", "rim")
        )
        return " / ".join(values)

    return f"{key}_axis", formatted


def _of_waves(key: str) -> tuple[str, Callable[[Lens], str]]:
    """Return a quantity that light as rays does not have."""
    name, words = _axis_and_rim(key, _scaled(1, ".3f"))
    return name, lambda lens: "" if lens[name] is None else words(lens)


AXIS_AND_RIM = "a / b: on the lens's axis / at the sensor point farthest from it"
QUANTITIES: tuple[tuple[str, str, Callable[[Lens], str]], ...] = (
    ("lens", *_of("kind", str)),
    ("magnification", *_of("magnification", str)),
    ("on the sensor", *_of("optical_magnification", _ratio)),
    ("sub-images", *_of("array", _product)),
    ("pixels of each", *_of("pixels", _product)),
    ("steered", *_of("steered", str)),
    ("width of each, mm", *_of("sub_image_width", _scaled(1))),
    ("rows of f seen", *_of("sees_rows", _range)),
    ("columns of f seen", *_of("sees_columns", _range)),
    ("measurements", *_of("measurements", str)),
    ("fill factor", *_of("fill_factor", str)),
    ("pixel blur, um", *_of("pixel_blur", _scaled(1e3))),
    ("pixel's contrast at Nyquist", *_of("pixel_contrast", _scaled(1))),
    ("field of view, °", *_of("field_of_view", _view)),
    ("focal length, mm", *_of("focal_length", _length)),
    ("lens to sensor, mm", *_of("sensor_depth", _length)),
    ("f-number", *_of("f_number", _if_any(_scaled(1)))),
    ("at the sensor", *_of("working_f_number", _scaled(1))),
    ("Airy disk, um", *_of("airy_diameter", _scaled(1e3))),
    ("Airy disk, pixels", *_of("airy_pixels", _if_any(_scaled(1)))),
    ("sharp, mm", "near", _sharp),
    ("paraxial focus, mm", *_of("focus", _length)),
    ("sharpest at, mm", *_axis_and_rim("sharpest", _length)),
    ("field curvature, um", *_of("curvature", _scaled(1e3))),
    ("spot, rms um", *_axis_and_rim("spot", _scaled(1e3))),
    ("wavefront, rms waves", *_of_waves("wavefront")),
    ("Strehl ratio", *_of_waves("strehl")),
    ("contrast at Nyquist/2", *_of_waves("contrast")),
    ("distortion, %", *_of("distortion", _scaled(100))),
    ("light at the rim, %", *_of("illumination", _scaled(100))),
)
