"""Likely causes of a residual larger than expected, chosen from what the scene, the stack and H say of themselves."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack

from ..output.run_json import ResidualPart

DARK = 0.5  # share of the light of a type's other sub-imagers below which one counts as dark, and
UNEXPLAINED = 0.8  # share of the light that the estimate predicts, since a part of the target may be dark
FEW = 0.2  # share of the sub-imagers that are few
MOST_NAMED = 5  # sub-imagers in one sentence


@dataclass(frozen=True)
class RunEvidence:
    """What is known about a run besides its residual.

    dark : sub-imagers that receive far less light than the others of their type, by name
    deep : True if there is a world, which may lie before or behind the target's plane
    designed : True if H is that of the design, and the camera is misaligned or has lenses of surfaces
    calibrated : True if H was measured;  unflattened : True for recorded frames without a flat frame
    of_pixels : True if detail finer than f matters to this camera, and the estimate takes the world as made of f's
        pixels;  detailed : True if it takes finer detail into account
    """

    dark: tuple[str, ...]
    deep: bool
    designed: bool
    calibrated: bool
    recorded: bool
    unflattened: bool
    of_pixels: bool
    detailed: bool


def evidence_of(
    stack: Stack, model: Model, used: BoolArray, light: Callable[[], FloatArray], independent: bool
) -> RunEvidence:
    """Collect what may explain a residual.

    used : (M,) True for measurements that are used;  light : yields the light, (M,), that the estimate predicts
    """
    camera, scene = stack.camera, stack.scene
    ideal = model.record["method"] == "ideal"
    recorded = stack.record.get("method") == "imported"
    return RunEvidence(
        dark=_dark(stack, used, light),
        deep=scene.world is not None,
        designed=ideal and (camera.tolerance is not None or _has_surfaces(camera)),
        calibrated=not ideal,
        recorded=recorded,
        unflattened=recorded and stack.record.get("flat") is False,
        of_pixels=not camera.covers_whole_pixels and (independent or not camera.has_detail),
        detailed=camera.has_detail and not independent,
    )


def _has_surfaces(camera: Camera) -> bool:
    return any(lens_type.optics.surfaces is not None for lens_type in camera.types)


def without_pixels(camera: Camera, used: BoolArray) -> tuple[str, ...]:
    """Return the names of the sub-imagers none of whose pixels is used."""
    pairs = zip(camera.sub_imagers, camera.slices(), strict=True)
    return tuple(sub.name for sub, part in pairs if not used[part].any())


def _dark(stack: Stack, used: BoolArray, light: Callable[[], FloatArray]) -> tuple[str, ...]:
    camera = stack.camera
    means = _means(stack.values, used, camera)
    darker: list[int] = []
    for lens_type in camera.types:
        index = [number for number, sub in enumerate(camera.sub_imagers) if sub.type is lens_type]
        typical = float(np.nanmedian(means[index])) if np.isfinite(means[index]).any() else 0.0
        darker += [number for number in index if means[number] < DARK * typical]
    if not darker:
        return ()
    predicted = _means(light(), used, camera)
    return tuple(
        camera.sub_imagers[number].name for number in darker if means[number] < UNEXPLAINED * predicted[number]
    )


def _means(values: FloatArray, used: BoolArray, camera: Camera) -> FloatArray:
    """Return the mean of each sub-imager's measurements that are used."""
    if used.all():
        return np.array([_mean(values[part]) for part in camera.slices()])
    return np.array([_mean(values[part][used[part]]) for part in camera.slices()])


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if values.size else float("nan")


def likely_causes(parts: Sequence[ResidualPart], evidence: RunEvidence) -> str:
    """Return the likely causes of a residual that is larger than expected in some of all `parts`, as one clause."""
    if evidence.dark:
        verb = "is" if len(evidence.dark) == 1 else "are"
        return f"{listed(evidence.dark)} {verb} dark, covered or dead"
    if evidence.deep:
        return "parts of the world lie before or behind the target's plane, for which alone H holds"
    few, fine = _few(parts), evidence.recorded or evidence.of_pixels
    if evidence.designed:
        return "H as designed is not this camera's; calibrate it, or fit its misalignment"
    if few and not fine:
        beside = "" if len(few) == 1 else ", or one beside it,"
        return f"{named(few[:1])}{beside} is not where H places it"
    causes = ["the pixels differ in gain, for which no flat frame was given (--flat)"] if evidence.unflattened else []
    causes += ["the world has detail finer than the pixels of f"] if fine else []
    causes += ["the world is rougher than its prior"] if evidence.detailed else []
    causes.append(f"H{'' if evidence.calibrated else ', which was not calibrated,'} is not this camera's")
    causes.append("the noise is larger than stated")
    return f"{', '.join(causes[:-1])} or {causes[-1]}"


def _few(parts: Sequence[ResidualPart]) -> list[str]:
    """Return the few sub-imagers that bring more than half of all the excess, the worst first, if they do."""
    subs = sorted(
        (part for part in parts if part.kind == "sub-imager"), key=lambda part: part.expected - part.chi_squared
    )
    total = sum(max(part.chi_squared - part.expected, 0.0) for part in subs)
    most, excess = subs[: min(MOST_NAMED, int(FEW * len(subs)))], 0.0
    for number, part in enumerate(most, 1):
        excess += part.chi_squared - part.expected
        if excess > 0.5 * total:
            return [part.name for part in most[:number]]
    return []


def listed(names: Sequence[str]) -> str:
    """Return sub-imagers in words, the first few of many."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return named(names[:MOST_NAMED]) + more


def named(names: Sequence[str]) -> str:
    """Return sub-imagers in words, such as "sub-imagers (0, 7), (1, 7) of type I", from their names."""
    by_type: dict[str, list[str]] = {}
    for name in names:
        lens, k, l = name.rsplit(".", 2)  # noqa: E741  (the paper's letter)
        by_type.setdefault(lens, []).append(f"({int(k)}, {int(l)})")
    word = "sub-imager" if len(names) == 1 else "sub-imagers"
    groups = [f"{', '.join(places)} of type {lens}" for lens, places in by_type.items()]
    return f"{word} {' and '.join(groups)}"
