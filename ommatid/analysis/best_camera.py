"""The camera of least expected error that can be made of given lens types, and a bound on that of every other.

Errors are those of Eq. 5 far from the edges, by transfer functions, with a perfect H and a perfect rendering.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np

from ommatid.reconstruct.assumptions import assumptions_at
from ommatid.reconstruct.frame.bands import Bands
from ommatid.reconstruct.frame.conjugate_gradients import frame_system
from ommatid.reconstruct.method_choice import MethodChoice
from ommatid.reconstruct.methods.method import Execution
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.scene import Scene, parse, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import DesignTable

from .design import LensCandidate, check_detail
from .mixture import PART, Evaluation, Mixture, WaveGroups, WholeMixture, best_mixture, best_whole
from .predicted_recording import prior_without_stack, recording_without_rays

SIDE, FINE_SIDE = 119, 59  # pixels of f of the square whose waves are summed; of one in front of a finer world
LARGEST = 2**16  # pixels of a target whose own waves are summed
MOST_CANDIDATES = 200
SHOWN = 3  # cameras of whole arrays
ROUNDING = 1e-9  # of readings


@dataclass(frozen=True)
class BestCamera:
    """The best mixture of lens types, the best cameras of whole arrays, and the scene's own camera.

    readings : per pixel of f;  own : arrays of the scene's camera and their error, None where it has other arrays
    refused : lens types that the camera cannot have, with the reason
    """

    types: tuple[LensCandidate, ...]
    readings: float
    mixture: Mixture
    whole: tuple[WholeMixture, ...]
    own: tuple[tuple[float, ...], Evaluation] | None
    refused: tuple[tuple[str, str], ...]

    def above(self, error: float) -> float:
        """Return by how much an error exceeds the bound, relative to it."""
        return error / self.mixture.bound - 1


def candidates(scene: Scene, magnifications: Sequence[Fraction]) -> list[LensCandidate]:
    """Return every magnification with every aperture and fill factor of [design]. Raises InputError for very many."""
    table, last = scene.design or DesignTable(), derive(scene).types[-1]
    apertures = [None if each == last.optics.aperture else each for each in table.apertures] or [None]
    opened = [None if each == last.open else each for each in table.fill_factors] or [None]
    found = [LensCandidate(1 / each, width, part) for each, width, part in product(magnifications, apertures, opened)]
    if len(found) > MOST_CANDIDATES:
        raise InputError(f"design: expected at most {MOST_CANDIDATES} lens types, got {len(found)}; name fewer")
    return found


def best_camera(scene: Scene, wanted: Sequence[LensCandidate]) -> BestCamera:
    """Choose among lens types and the scene's own. Raises InputError without a bound, and as a prediction does."""
    camera = derive(scene)
    _check(scene, camera)
    own = _own_arrays(camera)
    types, refused = list[LensCandidate](), dict[str, str]()
    for candidate in sorted({*own, *wanted}, key=lambda each: (each.ratio, each.aperture or 0.0, each.open or ())):
        try:
            single = scene_of(scene, [candidate])
            derive(single)
            check_detail(scene, single)
            types.append(candidate)
        except InputError as error:
            refused[candidate.words] = _reason(scene, error)
    if not types:
        raise InputError(f"{scene.source}: no lens type is possible: {': '.join(next(iter(refused.items())))}")
    own_readings = sum(lens.count / float(lens.ratio) ** 2 for lens in camera.types)
    readings = own_readings if scene.design is None or scene.design.readings is None else scene.design.readings
    least = min(each.readings for each in types)
    if readings < least * (1 - ROUNDING):
        raise InputError(
            f"{scene.source}: design.readings: the smallest array takes {least:.3g} readings per pixel of f, got"
            f" {readings:g}; raise it"
        )
    with one_thread():
        groups, types, others = _possible(scene, types)
        mixture = best_mixture(groups, readings)
        whole = best_whole(groups, readings * (1 + ROUNDING), mixture, SHOWN)
        counts = tuple(float(own[each]) for each in types)
        evaluated = (counts, groups.evaluate(np.array(counts))) if own and own.keys() <= set(types) else None
    return BestCamera(tuple(types), readings, mixture, tuple(whole), evaluated, tuple({**refused, **others}.items()))


def scene_of(scene: Scene, types: Sequence[LensCandidate]) -> Scene:
    """Return the scene with an array of each of these lens types. Raises InputError where the camera is impossible."""
    tables = scene.plain()
    last = tables["camera"]["lens"][-1]
    lenses = [each.table(last, f"L{number}") for number, each in enumerate(types, 1)]
    return parse({**tables, "camera": {**tables["camera"], "lens": lenses}}, scene.source)


def _check(scene: Scene, camera: Camera) -> None:
    """Raise InputError for a scene whose error no transfer functions give, or whose readings have no noise."""
    where = str(scene.source)
    if scene.world is not None:
        raise InputError(f"{where}: the bound is that of flat targets, got a [world]")
    if camera.tolerance is not None:
        raise InputError(f"{where}: the bound is that of lenses in their places, got camera.tolerance; remove it")
    if not camera.walls or any(lens.optics.distortion is not None for lens in camera.types):
        raise InputError(f"{where}: the bound is that of lenses that see the same everywhere")
    if camera.has_surfaces and camera.with_grid_of_matrix.unknowns <= MOST_DENSE:
        raise InputError(
            f"{where}: the bound takes lenses with surfaces in front of more than {MOST_DENSE} pixels, got"
            f" {camera.unknowns}; rank types with --candidates"
        )
    if not scene.has_noise:
        raise InputError(f"{where}: without noise every mixture is exact or has a null space; set noise.variance")


def _own_arrays(camera: Camera) -> Counter[LensCandidate]:
    """Return the arrays of the scene's camera by lens type; nothing if not all are whole and of one optics."""
    last, found = camera.types[-1], Counter[LensCandidate]()
    for lens in camera.types:
        candidate = LensCandidate(lens.ratio)
        whole = lens.array == (candidate.side, candidate.side) and not lens.steered and lens.is_sliding
        if not whole or (lens.optics, lens.open) != (last.optics, last.open):
            return Counter()
        found[candidate] += 1
    return found


def _bands(scene: Scene, types: Sequence[LensCandidate]) -> Bands:
    """Return the transfer functions of a camera of all types.

    They are those in front of the scene's target or, where that is small or very large, of a square of pixels, with the
    light of the target. What surfaces do varies over the field: they have the scene's target.
    """
    camera, side = derive(scene), FINE_SIDE if scene.target.detail > 1 else SIDE
    if camera.has_surfaces or (min(camera.shape) >= side and camera.unknowns <= LARGEST):
        return _bands_and_weights(scene, scene, types, camera.shape)[0]
    tables = scene.plain()
    tables["target"] = {key: each for key, each in tables["target"].items() if key not in ("image", "origin")}
    square = parse({**tables, "target": {**tables["target"], "shape": [side, side]}}, scene.source)
    bands, weights = _bands_and_weights(square, scene, types, (side, side))
    if scene.sensor is None:
        return bands
    _, own = _bands_and_weights(scene, scene, types, camera.shape)
    actual = [each * here / there for each, here, there in zip(bands.weights, own, weights, strict=True)]
    return replace(bands, weights=tuple(actual))


def _bands_and_weights(
    scene: Scene, original: Scene, types: Sequence[LensCandidate], shape: tuple[int, int]
) -> tuple[Bands, list[float]]:
    """Return the transfer functions in front of a target of some shape, and the mean weight of each type's readings.

    original : the scene whose prior it is
    """
    camera, tables = derive(original), scene.plain()
    prior, _ = prior_without_stack(Setup.from_scene(original).calibrated)
    width = max((max(shape) + each.ratio) / each.ratio for each in types) * camera.pixel_pitch
    tables["camera"] = {key: each for key, each in tables["camera"].items() if key not in ("sensor", "lens_pitch")}
    tables["camera"]["lens_pitch"] = f"{max(float(width), camera.lens_pitch)!r} mm"
    tables["estimator"] = {**tables.get("estimator", {}), "method": "frame"}
    setup = Setup.from_scene(with_tables(scene_of(parse(tables, scene.source), types), prior=prior))
    recording, choice = recording_without_rays(setup), MethodChoice("frame", "", 0, 0.0)
    task = assumptions_at(recording.stack, recording.model, choice, recording.image, Execution(quick=True)).method.task
    bands = frame_system(task).bands
    if bands is None:
        raise InputError(f"{scene.source}: the bound is that of lenses that see the same everywhere")
    weights = task.on_all_measurements(1 / task.expected_noise, 0.0)
    return bands, [float(weights[rows].mean()) for rows in setup.camera.type_slices()]


def _possible(scene: Scene, types: Sequence[LensCandidate]) -> tuple[WaveGroups, list[LensCandidate], dict[str, str]]:
    """Return the groups of waves of the lens types that the camera can have, these types, and why not the others.

    Raises InputError if it can have none.
    """
    refused: dict[str, str] = {}
    try:
        return WaveGroups.of(_bands(scene, types), [each.readings for each in types]), list(types), refused
    except InputError as error:
        if len(types) == 1:
            raise InputError(f"{scene.source}: {types[0].words}: {_reason(scene, error)}") from error
    kept: list[LensCandidate] = []
    for each in types:
        try:
            _bands(scene, [each])
            kept.append(each)
        except InputError as error:
            refused[each.words] = _reason(scene, error)
    if not kept:
        raise InputError(f"{scene.source}: no lens type is possible: {': '.join(next(iter(refused.items())))}")
    return WaveGroups.of(_bands(scene, kept), [each.readings for each in kept]), kept, refused


def _reason(scene: Scene, error: InputError) -> str:
    return str(error).removeprefix(f"{scene.source}: ")


def words_of(amounts: Sequence[float], types: Sequence[LensCandidate]) -> str:
    """Return amounts of lens types in words: "1/3 + 2 x 1/4", or "1.16 x 1/3 + 1.05 x 1/4"."""
    named = [(amount, each.words) for amount, each in zip(amounts, types, strict=True) if amount > PART]
    return " + ".join(words if abs(amount - 1) < PART / 2 else f"{amount:.3g} x {words}" for amount, words in named)


def _above(best: BestCamera, error: float) -> str:
    """Return an error, and how it exceeds the bound."""
    above = best.above(error)
    return f"{error:.4g}, {above:.1%} above" if above < 1 else f"{error:.4g}, {above + 1:.3g} times that"


def rows(best: BestCamera, with_edges: Sequence[float | str]) -> list[tuple[str, str]]:
    """Return the proof as rows of a table; with_edges : errors of the cameras of whole arrays, or why there is none."""
    mixture, types = best.mixture, best.types
    lines = [
        (
            "no such camera is better than",
            f"MSE {mixture.bound:.4g}: {len(types)} lens types, {best.readings:.3g} readings per pixel of f, windows on"
            " whole pixels, far from the edges",
        ),
        ("best mixture", f"{words_of(mixture.amounts.tolist(), types)}: {mixture.error:.4g}"),
    ]
    for number, (each, edges) in enumerate(zip(best.whole, with_edges, strict=True), 1):
        known = f"{edges:.4g} with edges" if isinstance(edges, float) else edges
        lines.append(
            (
                f"{number}. whole arrays",
                f"{words_of(each.counts, types)}: {_above(best, each.error)}; {each.information:.3g} bits per pixel;"
                f" {known}",
            )
        )
    if best.own is not None:
        counts, found = best.own
        words = f"{_above(best, found.error)}; {found.information:.3g} bits per pixel"
        lines.append(("this camera", f"{words_of(counts, types)}: {words}"))
    return lines + [(f"not {words}", reason) for words, reason in best.refused]


def describe(best: BestCamera, with_edges: Sequence[float | str]) -> dict[str, Any]:
    """Return the proof in JSON's types; with_edges : as of `rows`."""
    own = best.own and {"arrays": list(best.own[0]), "mse": best.own[1].error, "information": best.own[1].information}
    return {
        "types": [each.words for each in best.types],
        "readings": best.readings,
        "bound": best.mixture.bound,
        "mixture": {"arrays": best.mixture.amounts.tolist(), "mse": best.mixture.error, "gap": best.mixture.gap},
        "cameras": [
            {
                "arrays": list(each.counts),
                "mse": each.error,
                "above": best.above(each.error),
                "information": each.information,
                "with_edges": edges if isinstance(edges, float) else None,
            }
            for each, edges in zip(best.whole, with_edges, strict=True)
        ],
        "own": own,
        "refused": dict(best.refused),
    }
