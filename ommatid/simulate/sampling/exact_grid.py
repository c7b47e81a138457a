"""Grids of samples over a sensor pixel that leave no error: every cell lies within one pixel of f.

A pixel behind an ideal pinhole averages a constant over each cell, wherever in it the sample is. Two passes suffice
then: that they agree shows that nothing but the rounding of float32 is left.
"""

from __future__ import annotations

from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.tables.estimation import Sampler

from .passes import JITTERED, MOST_CELLS, ROUNDING, Plan

PASSES = 2  # of such a grid
ROUNDINGS = 16  # of float32, from the sensor to the target: more than add up on a ray's way
WIDEST_MARGIN = 0.125  # of a cell, beyond which float32 does not resolve the cells


def exact_plan(camera: Camera, index: int, sampler: Sampler) -> Plan | None:
    """Return the passes that show a flat target to sub-imager `index` without error; None if no grid does."""
    sub = camera.sub_imagers[index]
    ratio = sub.type.ratio
    ends = [float(start * ratio.denominator) for start in sub.window]
    fits = ratio.numerator <= MOST_CELLS and all(end.is_integer() for end in ends)
    is_ideal = camera.walls and camera.tolerance is None and sub.type.optics.is_pinhole and not sub.rotation
    if sampler not in JITTERED or not fits or not is_ideal or margin(camera, sub.type) > WIDEST_MARGIN:
        return None
    return Plan(PASSES, ratio.numerator**2)


def margin(camera: Camera, lens_type: LensType) -> float:
    """Return by how much of a cell rounding may move the point of the target that a ray of a lens type meets."""
    away = max(abs(place) for sub in camera.sub_imagers for place in sub.lens)
    extent = max(camera.shape) + away / camera.target_pitch  # pixels of f
    return ROUNDINGS * ROUNDING * extent * lens_type.ratio.denominator
