"""The plan of a run: what each stage would do, what it costs, and which results are up to date. Nothing is written.

Costs also say how many processes finish a batch soonest.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

from ommatid.analysis import summary
from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.method_choice import PROGRAM_MEMORY, allowed_memory, choose_method
from ommatid.reconstruct.output.result_files import fingerprint_of, read_results, truth_beside
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import UNREADABLE
from ommatid.runtime.machine import processors
from ommatid.scenes import model_file, stack
from ommatid.scenes.formats import exr
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import IN_PLACE_OF_AUTO
from ommatid.simulate import calibrate, render
from ommatid.simulate.calibration.fit.fit import first_measured
from ommatid.simulate.calibration.point_sources import RENDERINGS
from ommatid.simulate.renderer import variant
from ommatid.simulate.validation import check_scene

from .batch import Member, check_files

TO_MAKE, CURRENT = "to be made", "up to date"
STAGES = "render", "calibrate", "reconstruct"

# Measured on two cores of 2026, to within a factor of about two; mostly the ratios between scenes matter.
RAYS = 3e7  # per second
FIXED = 2.0  # seconds that every scene takes for its pictures and its page
START = 2.0  # seconds to start a process
PARALLEL = 0.6  # fraction of a scene's work that uses all processors; the rest uses one (Amdahl)


def plan(member: Member, setup: Setup, force: bool = False) -> dict[str, Any]:
    """Describe what a run of a scene would do, in JSON's types.

    Each stage has a `state`, "to be made" or "up to date"; `seconds` and `memory` (bytes) are those of a run from the
    beginning, to within a factor of about two. With `force` all stages are to be made.
    Raises InputError as the run would.
    """
    check_scene(setup)
    check_files(setup, member.folder)
    choice = choose_method(setup.scene, setup.camera, setup.is_applied)
    described = summary.describe(setup, variant.choose(setup.scene.render.variant), choice)
    states = dict.fromkeys(STAGES, TO_MAKE) if force else _states(member.folder, setup)
    cost = estimate_cost(member)
    return {
        "folder": str(member.folder),
        "title": setup.scene.title,
        "measurements": described["measurements"],
        "unknowns": described["unknowns"],
        "plan": {name: {"state": states[name], **stage} for name, stage in described["plan"].items()},
        "seconds": cost.seconds,
        "memory": cost.memory,
    }


def lines(name: str, described: dict[str, Any]) -> list[str]:
    """Return the printed lines of a plan."""
    sizes = f"{described['measurements']} measurements, {described['unknowns']} unknowns"
    stages: list[str] = []
    for stage, details in described["plan"].items():
        words = ", ".join(f"{key} {value}" for key, value in details.items() if key != "state")
        stages.append(f"  {stage:12} {details['state']}: {words}")
    cost = f"about {described['seconds']:.2g} s of one processor and {described['memory'] / 1e9:.1f} GB, if all is made"
    return [f"{name}: {sizes}", *stages, f"  {'cost':12} {cost}", f"  {'folder':12} {described['folder']}"]


def _states(folder: Path, setup: Setup) -> dict[str, str]:
    """Return the state of each stage. A stage is up to date only if those before it are."""
    states: dict[str, str] = dict.fromkeys(STAGES, TO_MAKE)
    with suppress(*UNREADABLE):
        record = exr.read_first_record(folder / "stack.exr")["record"]
        if record["fingerprint"] != render.made_from(setup):
            return states
        states["render"] = CURRENT
        recorded = stack.read(folder / "stack.exr")
        rule = for_stack(recorded) if calibrate.is_adaptive(setup.scene) else None
        model = model_file.read(folder / "model.npz")
        if model.record.get("fingerprint") != calibrate.made_from(setup, rule):
            return states
        states["calibrate"] = CURRENT
        if recorded.scene.plain() == setup.resolved.plain():
            current = fingerprint_of(recorded, model, truth_beside(folder / "stack.exr", recorded))
            states["reconstruct"] = CURRENT if read_results(folder)[1] == current else TO_MAKE
    return states


@dataclass(frozen=True)
class CostEstimate:
    """Seconds on one processor, and bytes."""

    seconds: float
    memory: int


def estimate_cost(member: Member) -> CostEstimate:
    """Estimate the cost of a scene of a batch; 0 for one with errors, which are reported when it is run."""
    try:
        setup = Setup.from_scene(member.content)
        choice = choose_method(setup.scene, setup.camera, setup.is_applied)
    except InputError:
        return CostEstimate(0.0, 0)
    samples = IN_PLACE_OF_AUTO if setup.scene.calibration.samples == "auto" else setup.scene.calibration.samples
    rays = setup.camera.measurements * setup.scene.render.sample_count + _calibrated_pixels(setup) * samples
    return CostEstimate(FIXED + rays / RAYS + choice.seconds, PROGRAM_MEMORY + choice.memory)


def _calibrated_pixels(setup: Setup) -> float:
    """Return the number of pixels that are rendered to calibrate H, each once for every rendering."""
    if setup.scene.calibration.method == "ideal":
        return 0
    pixels, with_kernels = 0, setup.scene.calibration.fit != "geometry"
    subsets = first_measured(setup.simulated, with_kernels) if calibrate.fits(setup) else {}
    for lens in setup.simulated.types:
        subset = subsets.get(lens.name)
        pixels += lens.measurements if subset is None else subset.size
    return pixels * (RENDERINGS if setup.renders_points else 1)


def process_count(members: Sequence[Member]) -> int:
    """Return the number of processes that finishes a batch soonest, of as many as fit into memory."""
    if min(len(members), processors()) < 2:
        return 1
    costs = [estimate_cost(member) for member in members]
    most = min(concurrent_by_memory([cost.memory for cost in costs]), len(members), processors())
    return fastest_process_count([cost.seconds for cost in costs], most, processors())


def concurrent_by_memory(memory: Sequence[int]) -> int:
    """Return how many tasks that need these bytes fit into memory together, whichever they are; at least 1."""
    allowed = allowed_memory(None)
    return max(1, sum(total <= allowed for total in accumulate(sorted(memory, reverse=True))))


def fastest_process_count(seconds: Sequence[float], most: int, shared: int) -> int:
    """Return the number of processes, 1 or `most`, that finishes tasks soonest.

    seconds : of each task on one of the `shared` processors
    A single process has all processors, but uses them only for the parallel part of a task. Several have a share each,
    and the batch takes at least as long as its largest task.
    """
    if most < 2:
        return 1
    one_process = sum(seconds) * (1 - PARALLEL + PARALLEL / shared)
    return most if START + max(sum(seconds) / most, *seconds) < one_process else 1
