"""Checks, before any work is done, that a scene can be rendered and calibrated here."""

from __future__ import annotations

from collections.abc import Iterable
from math import ceil

from ommatid.runtime.errors import naming_source
from ommatid.runtime.machine import check_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.setup import Setup

from .adaptive_render import check_noise_target
from .renderer.variant import check_fast_variant, check_transport_variant, choose
from .world_view import check_world

ENTRY = 12 + 8 + 8 * 4  # bytes per entry of H: the entry, its variance, its batches
SWEPT = 3 * 8 + 8 * 4 + 10 * 8  # bytes per reading of a sensor pixel: tallies, batches, and sorting into entries
BESIDE = 2  # pixels of f around a footprint
SENSOR, TARGET = 12 * 8, 6 * 8  # bytes that a rendering takes per measurement and per pixel of f


def check_scene(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError, which names the scene file, for errors that would otherwise appear after some work.

    calibrates : True if H is to be determined as well as the light
    """
    scene = setup.scene
    with naming_source(scene.source):
        check_scene_memory(setup, calibrates)
        variant = choose(scene.render.variant)
        check_lenses(setup.camera)
        check_fast_variant(setup.world.simulated, variant)
        if scene.render.samples == "auto":
            check_noise_target(scene)
        if calibrates and scene.calibration.method == "transport":
            check_transport_variant(variant)
        if scene.world is not None:
            check_world(setup)


def check_scene_memory(setup: Setup, calibrates: bool = True) -> None:
    """Raise InputError if memory does not hold a rendering or, if it `calibrates`, H with its uncertainty."""
    camera, world = setup.calibrated.camera, setup.world.camera
    rendering = SENSOR * camera.measurements + TARGET * world.unknowns
    check_memory(rendering, "rendering", "make target.shape or the lens arrays smaller")
    if not calibrates or setup.is_applied:
        return
    check_entries(setup.calibrated, camera.types)


def check_lenses(camera: Camera) -> None:
    """Raise InputError for surfaces that form no image, and for distortion that folds the image."""
    for lens_type in camera.types:
        if lens_type.optics.surfaces is not None:
            from ommatid.scenes.optics.field import prescription_of

            prescription_of(camera, lens_type)
        if lens_type.optics.distortion is not None:
            from ommatid.scenes.optics.distortion import largest_field

            largest_field(camera, lens_type)


def check_entries(setup: Setup, types: Iterable[LensType], why: str = "") -> None:
    """Raise InputError if memory does not hold H of some lens types with the uncertainty of its entries.

    setup : on the grid of H's columns;  why : H has entries
    """
    camera = setup.camera
    entries = [lens.measurements * min(_visible_pixels(camera, lens), camera.unknowns) for lens in types]
    needed = ENTRY * sum(entries) + (SWEPT * max(entries, default=0) if setup.renders_points else 0)
    remedy = "crop the target or use fewer sub-imagers"
    if setup.scene.calibration.method != "ideal" and camera.is_applied:
        remedy = f"set calibration.method to 'ideal', whose kernels need no entries, or {remedy}"
    check_memory(needed, f"{why}H of {camera.measurements} x {camera.unknowns}", remedy)


def _visible_pixels(camera: Camera, lens_type: LensType) -> int:
    """Approximate number of pixels of f that a sensor pixel may see."""
    side = ceil(lens_type.ratio) + BESIDE
    if camera.is_blurred(lens_type):
        from ommatid.scenes.optics.field import light_reach

        side += 2 * ceil(light_reach(camera, lens_type))
    return side**2
