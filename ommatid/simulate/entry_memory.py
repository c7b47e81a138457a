"""Memory of an H with entries, before any of them is measured."""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil

from ommatid.runtime.memory import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType

ENTRY = 12 + 8 + 8 * 4  # bytes per entry of H: the entry, its variance, its batches
SWEPT = 3 * 8 + 8 * 4 + 10 * 8  # bytes per reading of a sensor pixel: tallies, batches, and sorting into entries
BESIDE = 2  # pixels of f around a footprint


def check_entries(camera: Camera, types: Iterable[LensType], method: str, why: str = "") -> None:
    """Raise InputError if memory does not hold H of some lens types with the uncertainty of its entries.

    method : of the calibration;  why : H has entries
    """
    entries = [lens.measurements * min(_visible_pixels(camera, lens), camera.unknowns) for lens in types]
    needed = ENTRY * sum(entries) + (SWEPT * max(entries, default=0) if method == "points" else 0)
    remedy = "crop the target or use fewer sub-imagers"
    if method != "ideal" and camera.is_applied:
        remedy = f"set calibration.method to 'ideal', whose kernels need no entries, or {remedy}"
    check_memory(needed, f"{why}H of {camera.measurements} x {camera.unknowns}", remedy)


def _visible_pixels(camera: Camera, lens_type: LensType) -> int:
    """Approximate number of pixels of f that a sensor pixel may see."""
    side = ceil(lens_type.ratio) + BESIDE
    if lens_type.optics.surfaces is not None:
        side += 2 * ceil(_diffraction_reach(camera, lens_type))
    elif camera.is_blurred(lens_type):
        from ommatid.scenes.optics.blur import blur_of

        side += 2 * ceil(blur_of(camera, lens_type).reach)
    return side**2


def _diffraction_reach(camera: Camera, lens_type: LensType) -> float:
    """How far, in pixels of f, the point-spread function of surfaces is computed in focus."""
    from .lenses.prescription import prescription_of
    from .lenses.wavefront import GRID_REACH

    depth = camera.depth(lens_type)
    working = prescription_of(camera, lens_type).working_f_number(depth)
    return GRID_REACH * (camera.wavelength or 0.0) * working * camera.distance / depth / camera.target_pitch
