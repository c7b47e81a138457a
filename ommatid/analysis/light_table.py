"""The table of the electrons that each lens type's pixels collect."""

from __future__ import annotations

from typing import Any


def rows(light: dict[str, Any]) -> list[tuple[str, str]]:
    """The table's lines, label and text, of a `radiometry.summary`."""
    lines = [("light", _spectrum_words(light))] + [
        (f"lens type {row['name']}", _lens_words(row)) for row in light["lens_types"]
    ]
    for name, share in light.get("transmitted", {}).items():
        lines.append((f"surfaces of {name}", f"transmit {share:.1%} of the light"))
    if light["dark"] > 0:
        lines.append(("without light", f"{light['dark']:.4g} electrons in every pixel"))
    if light["cut_off"]:
        why = "noise of the dark signal is cut off at 0 DN, so dim values come out too low; raise sensor.black_level"
        lines.append(("warning", why))
    return lines


def _spectrum_words(light: dict[str, Any]) -> str:
    words, wavelengths = f"{light['efficacy']:.4g} lm/W", [1e6 * at for at, _ in light["wavelengths"]]
    if not wavelengths:
        return words
    return f"{words}; {len(wavelengths)} wavelengths from {wavelengths[0]:.0f} to {wavelengths[-1]:.0f} nm stand for it"


def _lens_words(row: dict[str, Any]) -> str:
    if row["noise"] is None:
        return "too little light: the readings do not exceed the dark signal"
    text = (
        f"{row['white']:.4g} electrons per pixel at 255, {row['mean']:.4g} at the prior's mean,"
        f" where the standard deviation of a value is {row['noise']:.3g}"
    )
    return f"{text}; full from {row['saturation']:.4g} on" if row["saturates"] else f"{text}; never full"
