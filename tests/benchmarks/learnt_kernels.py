"""Learnt kernels of lenses with surfaces: `python -m tests.benchmarks.learnt_kernels` draws docs/kernels.png.

Rays through every sensor pixel of the 19 x 19 tile give entries of H; the mean kernel of a lens type, its first two
components and the first one's coefficient over the field follow from them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ommatid.scenes.fitted.kernels import KernelFootprints, basis
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.kernel_fit.kernel_fit import fit_kernels
from ommatid.simulate.sampling.passes import plan

from ..examples import GALLERY
from ..modules import ROOT

RAYS = 131072  # per sensor pixel
LENS = 1  # the lens type of magnification 1/5
SHOWN = 6  # pixels of f beyond the footprint


def learnt(name: str) -> KernelFootprints:
    """Learn the kernels of a lens type of a scene of the gallery."""
    setup = Setup.from_scene(read(GALLERY / f"{name}.toml", ["target.detail=1"])).calibrated
    camera = setup.simulated
    lens_type = camera.types[LENS]
    responses = responses_from_rays(setup, plans={each.name: plan(RAYS) for each in camera.types})
    fit = fit_kernels(responses, camera, lens_type)
    print(name, fit.record())
    if fit.footprints is None:
        raise RuntimeError(f"{name}: {fit.reason}")
    return fit.footprints


def draw_row(figure: Figure, row: Any, title: str, footprints: KernelFootprints) -> None:
    """Draw the mean kernel, two components and a coefficient; components in units of their largest effect on H."""
    places = footprints.places
    crop = slice(places.margin - SHOWN, places.width - places.margin + SHOWN)
    half = float(places.lens_type.ratio) / 2 + SHOWN
    extent = (-half, half, half, -half)
    field = places.positions(np.arange(places.lens_type.measurements))
    shares = basis(field, footprints.degree) @ footprints.coefficients.T
    mean = np.maximum(footprints.shapes.kernels[0, crop, crop], 1e-6)
    images = [row[0].imshow(np.log10(mean), extent=extent, cmap="magma")]
    row[0].set_title(f"{title}\nmean kernel, log10 of H")
    for number in (1, 2):
        effect = footprints.shapes.kernels[number, crop, crop] * np.abs(shares[:, number]).max() * 1e4
        most = np.abs(effect).max()
        images.append(row[number].imshow(effect, extent=extent, cmap="RdBu_r", vmin=-most, vmax=most))
        row[number].set_title(f"component {number}\nlargest effect on H (1e-4)")
    x, y = field[:, ::-1].T * places.scale * places.camera.target_pitch
    most = np.abs(shares[:, 1]).max()
    images.append(row[3].scatter(x, y, c=shares[:, 1] / most, cmap="RdBu_r", s=9))
    row[3].set_title("coefficient of component 1\nrelative to its largest value")
    row[3].set_aspect("equal")
    row[3].invert_yaxis()
    for axes, image in zip(row, images, strict=True):
        axes.set_xlabel("right of the middle (pixels of f)")
        axes.set_ylabel("below the middle (pixels of f)")
        figure.colorbar(image, ax=axes, shrink=0.8)
    row[3].set_xlabel("right of the lens's axis (mm)")
    row[3].set_ylabel("below the lens's axis (mm)")


def main() -> None:
    """Draw the figure."""
    figure = Figure(figsize=(17, 8), layout="constrained")
    table = figure.subplots(2, 4)
    for row, name in zip(table, ("doublet", "planoconvex"), strict=True):
        draw_row(figure, row, f"{name}, magnification 1/5", learnt(name))
    figure.savefig(ROOT / "docs" / "kernels.png", dpi=90)


if __name__ == "__main__":
    main()
