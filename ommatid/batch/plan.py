"""The plan of a run: what each stage would do, and which results are up to date. Nothing is written."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ommatid.analysis import summary
from ommatid.analysis.calibration_goal import for_stack
from ommatid.reconstruct.method_choice import choose_method
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.result_files import fingerprint_of
from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file, stack
from ommatid.scenes.formats import exr
from ommatid.scenes.setup import Setup
from ommatid.simulate import calibrate, render
from ommatid.simulate.renderer import variant
from ommatid.simulate.validation import check_scene

from .batch import Member, check_files
from .cost_model import estimate_cost

TO_MAKE, CURRENT = "to be made", "up to date"
STAGES = "render", "calibrate", "reconstruct"


def plan(
    member: Member, setup: Setup, changes: Sequence[str], lenses: Sequence[str], force: bool = False
) -> dict[str, Any]:
    """Describe what a run of a scene would do, in JSON's types.

    Each stage has a `state`, "to be made" or "up to date"; `seconds` and `memory` (bytes) are those of a run from the
    beginning, to within a factor of about two. With `force` all stages are to be made.
    Raises InputError as the run would.
    """
    check_scene(setup)
    check_files(setup, member.folder)
    choice = choose_method(setup.scene, setup.camera, setup.may_have_boxes)
    described = summary.describe(setup, variant.choose(setup.scene.render.variant), choice)
    states = dict.fromkeys(STAGES, TO_MAKE) if force else _states(member.folder, setup)
    cost = estimate_cost(member, changes, lenses)
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
    with suppress(OSError, ValueError, KeyError, TypeError, InputError):
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
            same = run_json.read(folder).fingerprint == fingerprint_of(recorded, model)
            states["reconstruct"] = CURRENT if same else TO_MAKE
    return states
