"""Expected error of the 19 x 19 tile against the f-number of its lenses: perfect ones, achromats, plano-convex ones.

Small f-numbers suffer from aberrations, large ones from diffraction. `python -m tests.benchmarks.f_numbers` also draws
docs/diffraction.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.scene import parse, read
from ommatid.simulate.ideal import ideal_matrix

from ..modules import ROOT

F_NUMBERS = (1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0)
NOISE = 1e-3
PITCH = 12e-3  # mm, of sensor pixels
WIDEST = "3 mm"  # lens pitch
WIDEST_STOP = {"perfect": 1.4, "doublet": 2.0, "planoconvex": 2.8}  # f-numbers; the light of wider ones is not waves
COLOURS = {"perfect": "black", "doublet": "tab:blue", "planoconvex": "tab:orange"}


@dataclass(frozen=True)
class FNumberRow:
    """Expected squared errors of one lens at an f-number: with diffraction and with rays alone."""

    lens: str
    f_number: float
    waves: float
    rays: float


def rows(lenses: Sequence[str] = tuple(COLOURS), f_numbers: Sequence[float] = F_NUMBERS) -> list[FNumberRow]:
    """Return the rows of all lenses and f-numbers down to the widest stop of each."""
    return [
        FNumberRow(lens, number, *(error(camera_of(lens, number, wavelength)) for wavelength in ("550 nm", "none")))
        for lens in lenses
        for number in f_numbers
        if number >= WIDEST_STOP[lens]
    ]


def camera_of(lens: str, f_number: float, wavelength: str) -> Camera:
    """Return the tile's camera behind lenses whose cones of light on the axis have an f-number."""
    data = read(ROOT / "scenes" / f"{'tile19' if lens == 'perfect' else lens}.toml").plain()
    data["target"].pop("detail", None)
    data["prior"]["kind"] = "independent"
    data["camera"] |= {"pixel_pitch": f"{PITCH} mm", "lens_pitch": WIDEST, "wavelength": wavelength}
    for lens_type in data["camera"]["lens"]:
        if lens == "perfect":
            lens_type["aperture"] = f"{1000 * PITCH * _number(lens_type['magnification']) / f_number} mm"
        else:
            lens_type["surfaces"] = [_opened(surface, 2.0 / f_number) for surface in lens_type["surfaces"]]
    return derive(parse(data, Path("benchmark")))


def _number(ratio: str) -> float:
    above, _, below = str(ratio).partition("/")
    return float(above) / float(below or 1)


def _opened(surface: dict[str, Any], diameter: float) -> dict[str, Any]:
    """Return a surface of a lens of focal length 2 mm with a stop of that diameter, and rims that do not vignette."""
    half = diameter / 2 * (1.0 if surface.get("stop") else 1.08)
    return {**surface, "semi_diameter": f"{half} mm"}


def error(camera: Camera, variance: float = 5461.25) -> float:
    """Return the mean of Eq. 5 for independent pixels."""
    matrix: FloatArray = ideal_matrix(camera).toarray()
    return float(
        np.trace(np.linalg.inv(matrix.T @ matrix / NOISE + np.eye(camera.unknowns) / variance)) / camera.unknowns
    )


def draw(path: Path, table: Sequence[FNumberRow]) -> None:
    """Draw the rows: errors with diffraction as lines, with rays alone dashed."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 5.2), layout="constrained")
    axes = figure.subplots()
    for lens, colour in COLOURS.items():
        shown = [row for row in table if row.lens == lens]
        numbers = [row.f_number for row in shown]
        axes.loglog(numbers, [row.waves for row in shown], "o-", color=colour, label=f"{lens}, 550 nm")
        axes.loglog(numbers, [row.rays for row in shown], ".--", color=colour, alpha=0.6, label=f"{lens}, rays alone")
    axes.set_xticks(F_NUMBERS, [f"f/{number:g}" for number in F_NUMBERS], minor=False)
    axes.minorticks_off()
    axes.set_xlabel("f-number of the lenses")
    axes.set_ylabel("expected squared error per pixel (squared units of f)")
    axes.set_title(f"19 x 19 tile, pixels of {PITCH * 1e3:g} um, noise variance {NOISE:g}")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=9)
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    found = rows()
    for row in found:
        print(f"{row.lens:12} f/{row.f_number:<4g} {row.waves:10.4g} {row.rays:10.4g}")
    draw(ROOT / "docs" / "diffraction.png", found)
