"""About what a scene takes, and in how many processes a batch of them is done soonest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from ommatid.reconstruct.method_choice import PROGRAM_MEMORY, allowed_memory, choose_method
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import IN_PLACE_OF_AUTO, Scene, read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.point_sources import RENDERINGS

from .batch import Member

# Measured on two cores of 2026, to within a factor of two or so; only ratios between scenes matter much.
RAYS = 3e7  # a second
LEAST = 2.0  # seconds: what every scene takes for its pictures and its page
START = 2.0  # seconds until a process can begin
ALIKE = 0.6  # of the work of a scene by itself: what all processors share; the rest keeps one of them busy


@dataclass(frozen=True)
class CostEstimate:
    """Seconds on one processor, and bytes."""

    seconds: float
    memory: int


def estimate_cost(member: Member, changes: Sequence[str], lenses: Sequence[str]) -> CostEstimate:
    """Of a scene of a batch; none of one that is refused, which will be told in its turn."""
    try:
        setup = Setup.from_scene(read(member.scene, (*changes, *member.changes), lenses))
        choice = choose_method(setup.scene, setup.camera, setup.has_structured_matrix)
    except InputError:
        return CostEstimate(0.0, 0)
    rays = _rays(setup.scene, setup.camera) / RAYS
    return CostEstimate(LEAST + rays + choice.seconds, PROGRAM_MEMORY + choice.memory)


def _rays(scene: Scene, camera: Camera) -> float:
    method, asked = scene.calibration.method, scene.calibration.samples
    several = {"points": RENDERINGS, "transport": 1.0, "ideal": 0.0}[method]
    return camera.measurements * (
        scene.render.sample_count + several * (IN_PLACE_OF_AUTO if asked == "auto" else asked)
    )


def concurrent_by_memory(memory: Sequence[int]) -> int:
    """How many pieces of work that need these bytes can be done side by side, whichever they are; at least one."""
    allowed = allowed_memory(None)
    return max(1, sum(together <= allowed for together in accumulate(sorted(memory, reverse=True))))


def fastest_process_count(seconds: Sequence[float], most: int, shared: int) -> int:
    """How many processes, 1 to `most`, do pieces of work that take so long on one of `shared` processors.

    One process has all processors, but is alone for the part of a piece that they cannot share (Amdahl); several have
    a share each, and wait for the last of them, which a piece much larger than the others makes long.
    """
    if most < 2:
        return 1
    alone = sum(seconds) * (1 - ALIKE + ALIKE / shared)
    return most if START + _until_the_last(seconds, most) < alone else 1


def _until_the_last(seconds: Sequence[float], count: int) -> float:
    """When the last process ends, each taking the next piece as soon as it is free."""
    busy = [0.0] * count
    for piece in seconds:
        first = busy.index(min(busy))
        busy[first] += piece
    return max(busy)
