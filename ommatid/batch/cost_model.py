"""Estimated cost of scenes, and the number of processes that finishes a batch soonest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from ommatid.reconstruct.method_choice import PROGRAM_MEMORY, allowed_memory, choose_method
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import IN_PLACE_OF_AUTO
from ommatid.simulate.calibration.point_sources import RENDERINGS

from .batch import Member

# Measured on two cores of 2026, to within a factor of about two; mostly the ratios between scenes matter.
RAYS = 3e7  # per second
FIXED = 2.0  # seconds that every scene takes for its pictures and its page
START = 2.0  # seconds to start a process
PARALLEL = 0.6  # fraction of a scene's work that uses all processors; the rest uses one (Amdahl)


@dataclass(frozen=True)
class CostEstimate:
    """Seconds on one processor, and bytes."""

    seconds: float
    memory: int


def estimate_cost(member: Member, changes: Sequence[str], lenses: Sequence[str]) -> CostEstimate:
    """Estimate the cost of a scene of a batch; 0 for one with errors, which are reported when it is run."""
    try:
        setup = Setup.from_scene(read(member.scene, (*changes, *member.changes), lenses))
        choice = choose_method(setup.scene, setup.camera, setup.may_have_boxes)
    except InputError:
        return CostEstimate(0.0, 0)
    calibration, samples = setup.scene.calibration, setup.scene.calibration.samples
    rays_per_sample = {"points": RENDERINGS, "transport": 1.0, "ideal": 0.0}[calibration.method]
    calibration_rays = rays_per_sample * (IN_PLACE_OF_AUTO if samples == "auto" else samples)
    rays = setup.camera.measurements * (setup.scene.render.sample_count + calibration_rays)
    return CostEstimate(FIXED + rays / RAYS + choice.seconds, PROGRAM_MEMORY + choice.memory)


def concurrent_by_memory(memory: Sequence[int]) -> int:
    """Return how many tasks that need these bytes fit into memory together, whichever they are; at least 1."""
    allowed = allowed_memory(None)
    return max(1, sum(total <= allowed for total in accumulate(sorted(memory, reverse=True))))


def fastest_process_count(seconds: Sequence[float], most: int, shared: int) -> int:
    """Return the number of processes, 1 or `most`, that finishes tasks soonest.

    seconds : of each task on one of the `shared` processors
    A single process has all processors, but uses them only for the parallel part of a task. Several have a share each,
    and the batch takes as long as the last of them, which is long if one task is much larger than the others.
    """
    if most < 2:
        return 1
    one_process = sum(seconds) * (1 - PARALLEL + PARALLEL / shared)
    return most if START + _makespan(seconds, most) < one_process else 1


def _makespan(seconds: Sequence[float], count: int) -> float:
    """Return the time at which the last process ends, if each takes the next task as soon as it is free."""
    busy = [0.0] * count
    for task in seconds:
        busy[busy.index(min(busy))] += task
    return max(busy)
