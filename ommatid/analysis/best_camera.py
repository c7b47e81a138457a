"""The camera of least expected error that can be made of given lens types, and a bound on that of every other.

Errors are those of Eq. 5 far from the edges, by transfer functions, with a perfect H and a perfect rendering. They are
those of lenses in their places and without distortion, whatever the scene has: the bound is that of shift-invariant
cameras.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import product

import numpy as np

from ommatid.reconstruct.assumptions import assumptions_at
from ommatid.reconstruct.frame.bands import Bands
from ommatid.reconstruct.frame.conjugate_gradients import frame_system
from ommatid.reconstruct.method_choice import MethodChoice
from ommatid.reconstruct.methods.method import EstimationTask, Execution
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.scene import Scene, parse, with_tables
from ommatid.scenes.setup import Setup
from ommatid.scenes.tables.estimation import DesignTable, PriorTable

from .design import LensCandidate, check_detail
from .mixture import TIGHT, Evaluation, Mixture, WaveGroups, WholeMixture, best_mixture, best_whole
from .predicted_recording import prior_without_stack, recording_without_rays

SIDE, FINE_SIDE = 119, 59  # pixels of f of the square whose waves are summed; of one in front of a finer world
LARGEST = 2**16  # pixels of a target whose own waves are summed
MOST_CANDIDATES = 200
MOST_READINGS = 100.0  # per pixel of f, of a camera that reaches an error
NEARLY = 1e-3  # gap relative to the value, of mixtures that are drawn or lead to whole arrays
SHOWN = 3  # cameras of whole arrays
ROUNDING = 1e-9  # of costs and depths
WIDER = (1.0, 1.05, 1.1, 1.2, 1.35, 1.5)  # distances of lenses on a sensor that is to be filled, times the least
MORE = (1.02, 1.1, 1.25, 1.5, 2.0, 3.0, 5.0)  # times the least cost of a mixture, that whole arrays may take
CLOSE = 0.01  # of the least cost that reaches an error


@dataclass(frozen=True)
class BestCamera:
    """The best mixture of lens types that costs `budget`, and the best cameras of whole arrays, which cost no more."""

    space: DesignSpace
    budget: float
    mixture: Mixture
    whole: tuple[WholeMixture, ...]

    def above(self, found: Evaluation) -> float:
        """Return by how much a value exceeds the bound, relative to it."""
        return (found.value - self.mixture.bound) / abs(self.mixture.bound)


@dataclass(frozen=True)
class DesignSpace:
    """The lens types that a scene's camera may have, what each tells of the target, and what it costs.

    groups : costs are in readings per pixel of f or, with design.sensor_area, in mm2 of the sensor
    depths : (types,) distances of their sensors from their lenses, mm
    cells : (types,) sides of the square that a lens takes on the sensor, mm;  budget : the scene's
    own : the scene's camera, None where it has other arrays;  refused : lens types that it cannot have, with the reason
    """

    scene: Scene
    types: tuple[LensCandidate, ...]
    groups: WaveGroups
    depths: FloatArray
    cells: FloatArray
    budget: float
    own: WholeMixture | None
    refused: dict[str, str]

    @property
    def unit(self) -> str:
        """The unit of costs."""
        return "readings per pixel of f" if _area(self.scene) is None else "mm2 of the sensor"

    def information(self, camera: WholeMixture) -> float:
        """Return the information that a camera's readings hold, in bits per pixel of f."""
        return self.groups.information(np.array(camera.counts, dtype=np.float64))

    def cost(self, camera: WholeMixture) -> float:
        """Return what a camera costs."""
        return float(self.groups.costs @ np.array(camera.counts))

    def best(self, budget: float, most: int = SHOWN, tight: float = TIGHT) -> BestCamera:
        """Return the best mixture and the best `most` cameras for a budget. Raises InputError if it buys no array.

        tight : as of `best_mixture`
        """
        least = float(self.groups.costs.min())
        if budget < least * (1 - ROUNDING):
            key = "readings" if _area(self.scene) is None else "sensor_area"
            raise InputError(
                f"{self.scene.source}: design.{key}: the smallest array takes {least:.3g} {self.unit}, got"
                f" {budget:.4g}; raise it"
            )
        with one_thread():
            mixture = best_mixture(self.groups, budget, tight)
            whole = best_whole(self.groups, budget * (1 + ROUNDING), mixture, most, self.fits)
        return BestCamera(self, budget, mixture, tuple(whole))

    def cheapest(self, error: float) -> tuple[float, BestCamera]:
        """Return a cost below which no mixture has so small an error, and cameras of nearly the least that have it.

        Raises InputError, which names the least error within reach, if none has.
        """
        low = float(self.groups.costs.min())
        most = MOST_READINGS * float((self.groups.costs / [each.readings for each in self.types]).max())

        def mixed(budget: float) -> bool:
            return best_mixture(self.groups, budget, NEARLY).bound <= error

        def made(budget: float) -> bool:
            whole = self.best(budget, 1, NEARLY).whole
            return bool(whole) and whole[0].found.error <= error

        with one_thread():
            least = _least(low / MOST_READINGS, most, mixed) / (1 + CLOSE) if mixed(most) else most
            reached = next((budget for share in MORE if made(budget := max(least * share, low))), None)
        if reached is None:
            within = self.best(most, 1, NEARLY)
            nearest = f"the least is {within.whole[0].found.error:.4g}" if within.whole else "none fits the sensor"
            raise InputError(
                f"{self.scene.source}: design.error: no camera of these lens types that costs up to {most:.3g}"
                f" {self.unit} has an error of {error:g}; {nearest}"
            )
        return least, self.best(_least(max(low, least), reached, made))

    def fits(self, counts: tuple[int, ...]) -> bool:
        """Return True if whole arrays fit the sensor, where the scene gives one."""
        if not any(counts) or (self.scene.camera.sensor is None and _area(self.scene) is None):
            return True
        try:
            derive(self.camera(counts))
        except InputError:
            return False
        return True

    def camera(self, counts: Sequence[int]) -> Scene:
        """Return the scene of a camera of whole arrays. Raises InputError where it is impossible."""
        numbers = [index for index, count in enumerate(counts) for _ in range(count)]
        types, outline = [self.types[index] for index in numbers], self.scene.design and self.scene.design.sensor_area
        if not outline:
            return scene_of(self.scene, types)
        cell = float(self.cells[numbers].max())
        for wider in WIDER:
            made = scene_of(self.scene, types, wider * cell, outline)
            try:
                derive(made)
                return made
            except InputError:  # patches of neighbouring types may overlap
                continue
        return scene_of(self.scene, types, cell, outline)

    def thinner(self, depth: float) -> DesignSpace:
        """Return the lens types whose sensors are at most so far from their lenses, mm."""
        kept = self.depths <= depth * (1 + ROUNDING)
        types = tuple(each for each, held in zip(self.types, kept, strict=True) if held)
        depths, cells = self.depths[kept], self.cells[kept]
        return replace(self, types=types, groups=self.groups.only(kept), depths=depths, cells=cells, own=None)


def _least(low: float, high: float, reached: Callable[[float], bool]) -> float:
    """Return the least budget that reaches something, as `high` does, to a hundredth."""
    while high > low * (1 + CLOSE):
        middle = (low * high) ** 0.5
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def candidates(scene: Scene, magnifications: Sequence[Fraction]) -> list[LensCandidate]:
    """Return every magnification with every aperture and fill factor of [design]. Raises InputError for very many."""
    table, last = scene.design or DesignTable(), derive(scene).types[-1]
    apertures = [None if each == last.optics.aperture else each for each in table.apertures] or [None]
    opened = [None if each == last.open else each for each in table.fill_factors] or [None]
    found = [LensCandidate(1 / each, width, part) for each, width, part in product(magnifications, apertures, opened)]
    if len(found) > MOST_CANDIDATES:
        raise InputError(f"design: expected at most {MOST_CANDIDATES} lens types, got {len(found)}; name fewer")
    return found


def design_space(scene: Scene, wanted: Sequence[LensCandidate]) -> DesignSpace:
    """Return what lens types and the scene's own bring. Raises InputError without a bound, and as a prediction does."""
    table = scene.design or DesignTable()
    camera, described = derive(scene), scene
    _check(scene, camera)
    scene = _in_place(scene)
    own = _own_arrays(camera)
    types, refused = dict[LensCandidate, tuple[float, float]](), dict[str, str]()
    for candidate in sorted({*own, *wanted}, key=lambda each: (each.ratio, each.aperture or 0.0, each.open or ())):
        try:
            types[candidate] = _measures(scene, candidate)
        except InputError as error:
            refused[candidate.words] = _reason(scene, error)
    if not types:
        raise _impossible(scene, refused)
    with one_thread():
        prior, _ = prior_without_stack(Setup.from_scene(scene).calibrated)
        bands, kept, others = _possible(scene, prior, list(types))
        depths, cells = np.array([types[each] for each in kept]).T
        area = _area(scene)
        sides = np.array([each.side for each in kept])
        costs = [each.readings for each in kept] if area is None else np.square(sides * cells).tolist()
        groups = WaveGroups.of(bands, costs, table.goal)
        counts = [own[each] for each in kept]
        known = own and own.keys() <= set(kept)
        found = WholeMixture(tuple(counts), groups.evaluate(np.array(counts, dtype=np.float64))) if known else None
    readings = sum(own.values()) if own else camera.measurements / camera.unknowns
    budget = area or table.readings or readings
    return DesignSpace(described, tuple(kept), groups, depths, cells, budget, found, {**refused, **others})


def _area(scene: Scene) -> float | None:
    """Return the area of the sensor that limits a camera, mm2, None where readings do."""
    size = None if scene.design is None else scene.design.sensor_area
    return None if size is None else size[0] * size[1]


def _in_place(scene: Scene) -> Scene:
    """Return the scene with lenses in their places and without distortion."""
    tables = scene.plain()
    camera = {key: each for key, each in tables["camera"].items() if key not in ("tolerance", "sensor")}
    camera["lens"] = [{key: each for key, each in lens.items() if key != "distortion"} for lens in camera["lens"]]
    return with_tables(parse({**tables, "camera": camera}, scene.source), design=scene.design)


def _measures(scene: Scene, candidate: LensCandidate) -> tuple[float, float]:
    """Return the depth of a lens type's sensor, and the side of a lens on it, mm.

    Raises InputError for a lens type that the camera cannot have.
    """
    if candidate.ratio.denominator != 1:
        raise InputError("the bound takes magnifications 1/m of a whole m, whose pixels all lie alike on those of f")
    thickness, widest = scene.design.thickness if scene.design else None, scene.camera.lens_pitch
    widest += max(derive(scene).shape) * scene.camera.pixel_pitch + (candidate.aperture or 0.0)
    single = scene_of(scene, [candidate], None if _area(scene) is None else widest)
    camera = derive(single)
    check_detail(scene, single)
    (lens,) = camera.types
    # Patches of neighbouring lenses lie apart by less than the lenses where their windows move on.
    depth, larger, moved = camera.depth(lens), camera.optical_magnification(lens), float(max(lens.step))
    cell = (max(lens.pixels) * camera.pixel_pitch + larger * moved * camera.target_pitch) / (1 + larger)
    if thickness is not None and depth > thickness * (1 + ROUNDING):
        raise InputError(f"its sensor stands {depth:.3g} mm behind its lenses, design.thickness is {thickness:g} mm")
    return depth, scene.camera.lens_pitch if lens.optics.surfaces else max(cell, lens.optics.aperture or 0.0)


def scene_of(
    scene: Scene,
    types: Sequence[LensCandidate],
    pitch: float | None = None,
    outline: tuple[float, float] | None = None,
) -> Scene:
    """Return the scene with an array of each of these lens types. Raises InputError where the camera is impossible.

    pitch : distance of neighbouring lenses, mm;  outline : height and width of the sensor, mm; None: those of the scene
    """
    tables = scene.plain()
    camera, last = tables["camera"], tables["camera"]["lens"][-1]
    lenses = [each.table(last, f"L{number}") for number, each in enumerate(types, 1)]
    changed = {} if pitch is None else {"lens_pitch": f"{pitch!r} mm"}
    changed |= {} if outline is None else {"sensor": {"size": [f"{side!r} mm" for side in outline]}}
    return parse({**tables, "camera": {**camera, **changed, "lens": lenses}}, scene.source)


def _check(scene: Scene, camera: Camera) -> None:
    """Raise InputError for a scene whose error no transfer functions give, or whose readings have no noise."""
    where, table = str(scene.source), scene.design or DesignTable()
    if scene.world is not None:
        raise InputError(f"{where}: the bound is that of flat targets, got a [world]")
    if not camera.walls:
        raise InputError(f"{where}: the bound is that of lenses that see their own patch, got camera.walls = false")
    if camera.has_surfaces and camera.with_grid_of_matrix.unknowns <= MOST_DENSE:
        raise InputError(
            f"{where}: the bound takes lenses with surfaces in front of more than {MOST_DENSE} pixels, got"
            f" {camera.unknowns}; compare scenes with `ommatid predict A B`"
        )
    if not scene.has_noise:
        raise InputError(f"{where}: without noise every mixture is exact or has a null space; set noise.variance")
    check_known(scene)
    if table.bits and scene.camera.binning == "sum":
        raise InputError(f"{where}: design.bits are of averages, got camera.binning = 'sum'; remove one")
    if table.error is not None and table.goal != "error":
        raise InputError(f"{where}: design.error is reached at least cost, design.goal is '{table.goal}'; remove one")
    if table.sensor_area is not None and table.readings is not None:
        raise InputError(f"{where}: design.readings and design.sensor_area both limit the camera; remove one")


def check_known(scene: Scene) -> None:
    """Raise InputError for an estimator that takes noise or prior for others than they are."""
    for key in ("noise_variance", "prior_variance"):
        if getattr(scene.estimator, key) is not None:
            raise InputError(
                f"{scene.source}: the bound is that of an estimator that knows noise and prior, got estimator.{key};"
                " remove it"
            )


def _own_arrays(camera: Camera) -> Counter[LensCandidate]:
    """Return the arrays of the scene's camera by lens type; nothing if not all are whole and of one optics."""
    last, found = camera.types[-1], Counter[LensCandidate]()
    for lens in camera.types:
        candidate = LensCandidate(lens.ratio)
        most = tuple((size - candidate.side + 1) // lens.ratio for size in camera.shape)
        whole = lens.array == (candidate.side, candidate.side) and not lens.steered and lens.is_sliding
        if not whole or lens.pixels != most or (lens.optics, lens.open) != (last.optics, last.open):
            return Counter()
        found[candidate] += 1
    return found


def _bands(scene: Scene, prior: PriorTable, types: Sequence[LensCandidate]) -> Bands:
    """Return the transfer functions of a camera of all types.

    They are those in front of the scene's target or, where that is small or very large, of a square of pixels. What
    surfaces do varies over the field: they have the scene's target. Noise that depends on light is that of each type
    alone in front of the target, so that no candidate changes another's.
    """
    camera, side, shown = derive(scene), FINE_SIDE if scene.target.detail > 1 else SIDE, scene
    if not camera.has_surfaces and (min(camera.shape) < side or camera.unknowns > LARGEST):
        tables = scene.plain()
        tables["target"] = {key: each for key, each in tables["target"].items() if key not in ("image", "origin")}
        shown = parse({**tables, "target": {**tables["target"], "shape": [side, side]}}, scene.source)
    task = _task(shown, prior, types)
    bands = frame_system(task).bands
    if scene.sensor is None:
        return bands
    alone = [_weights(_task(scene, prior, [each]))[0] for each in types]
    together = zip(bands.weights, alone, _weights(task), strict=True)
    weights = [each * own / here if here > 0 else 0.0 for each, own, here in together]
    return replace(bands, weights=tuple(weights))


def _task(scene: Scene, prior: PriorTable, types: Sequence[LensCandidate]) -> EstimationTask:
    """Return what the estimator of a camera of these types is given, apart far enough for any of them."""
    tables, camera = scene.plain(), scene.camera
    width = max((max(derive(scene).shape) + each.ratio) / each.ratio for each in types) * camera.pixel_pitch
    tables["camera"] = {key: each for key, each in tables["camera"].items() if key not in ("sensor", "lens_pitch")}
    tables["camera"]["lens_pitch"] = f"{max(float(width), camera.lens_pitch)!r} mm"
    tables["estimator"] = {**tables.get("estimator", {}), "method": "frame"}
    return frame_task(with_tables(scene_of(parse(tables, scene.source), types), prior=prior))


def frame_task(scene: Scene) -> EstimationTask:
    """Return what the estimator of a scene's frame is given, of a perfect H and a perfect rendering."""
    recording, choice = recording_without_rays(Setup.from_scene(scene)), MethodChoice("frame", "", 0, 0.0)
    return assumptions_at(recording.stack, recording.model, choice, recording.image, Execution(quick=True)).method.task


def _weights(task: EstimationTask) -> list[float]:
    """Return the mean weight of the readings of each lens type."""
    weights = task.on_all_measurements(1 / task.expected_noise, 0.0)
    return [float(weights[rows].mean()) for rows in task.model.camera.type_slices()]


def _possible(
    scene: Scene, prior: PriorTable, types: Sequence[LensCandidate]
) -> tuple[Bands, list[LensCandidate], dict[str, str]]:
    """Return the transfer functions of the lens types that the camera can have, these types, and why not the others.

    Raises InputError if it can have none.
    """
    refused: dict[str, str] = {}
    try:
        return _bands(scene, prior, types), list(types), refused
    except InputError as error:
        if len(types) == 1:
            raise InputError(f"{scene.source}: {types[0].words}: {_reason(scene, error)}") from error
    kept: list[LensCandidate] = []
    for each in types:
        try:
            _bands(scene, prior, [each])
            kept.append(each)
        except InputError as error:
            refused[each.words] = _reason(scene, error)
    if not kept:
        raise _impossible(scene, refused)
    return _bands(scene, prior, kept), kept, refused


def _impossible(scene: Scene, refused: dict[str, str]) -> InputError:
    reason = next((f"{words}: {why}" for words, why in refused.items()), "none is given")
    return InputError(f"{scene.source}: no lens type is possible: {reason}")


def _reason(scene: Scene, error: InputError) -> str:
    return str(error).removeprefix(f"{scene.source}: ")
