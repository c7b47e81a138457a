"""Which way to the estimate: one dense problem, tiles, or the whole frame; what each needs of memory and time."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from ommatid.runtime.errors import InputError
from ommatid.runtime.memory import free_memory
from ommatid.runtime.processors import processors
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene

from .estimator.memory import needed_memory
from .frame.frame_method import FrameMethod
from .frame.preconditioner import is_sliding
from .methods.dense_method import DenseMethod
from .methods.method import Method
from .methods.tile_method import TileMethod
from .misalignment.misaligned_methods import AlignedMethod, RobustMethod

BASE = 300_000_000  # bytes, of the program itself and its libraries
DENSE = 4000  # pixels, up to which the dense problem, exact and with every form, takes seconds
TILES_ARE_WITHIN = 0.3  # posterior standard deviations of the exact answer, on average; 0.17 where types see all edges

WAYS: dict[str, type[Method]] = {
    "dense": DenseMethod,
    "robust": RobustMethod,
    "fit": AlignedMethod,
    "tiles": TileMethod,
    "frame": FrameMethod,
}
WORDS = {
    "dense": "one dense problem",
    "robust": "one dense problem, misalignment as more noise",
    "fit": "one dense problem, H found from the stack",
    "tiles": "tile by tile",
    "frame": "the whole frame at once",
}


@dataclass(frozen=True)
class MethodChoice:
    """A way, why this one, and about how much memory and time it takes on two cores of 2026."""

    method: str
    why: str
    memory: int
    seconds: float

    def plan(self) -> dict[str, str]:
        """For people: what will run, and what it takes."""
        return {
            "method": WORDS[self.method],
            "why": self.why,
            "about": f"{max(self.seconds, 0.1):.2g} s and {max(self.memory, 10**8) / 1e9:.1f} GB",
        }


def choose_method(scene: Scene, camera: Camera, exact: bool) -> MethodChoice:
    """The cheapest way that is as right as `estimator` asks. Raises InputError where none fits into memory.

    exact : whether H is that of a perfect camera
    """
    told, allowed = scene.estimator, allowed_memory(scene.estimator.memory)
    if told.misalignment != "trust":
        return _misaligned(scene, camera, exact, allowed)
    sliding = all(is_sliding(kind) for kind in camera.types)
    silent = told.noise_variance == 0 or (told.noise_variance is None and exact and not _noise(scene))
    if told.method == "tiles":
        names, why = ["tiles"], "asked for"
    elif told.method == "frame":
        names, why = ["frame"], "asked for"
    elif told.method != "auto":
        names, why = ["dense"], f"the {told.method} form was asked for"
    elif camera.unknowns <= DENSE:
        names, why = ["dense", "tiles"], f"{camera.unknowns} pixels are few"
    elif silent:
        names, why = ["tiles"], "measurements without noise need a dense form"
    elif told.accuracy >= TILES_ARE_WITHIN:
        names, why = ["tiles"], f"an accuracy of {told.accuracy:g} posterior standard deviations is what tiles reach"
    elif sliding:
        names, why = ["frame", "tiles"], f"{camera.unknowns} pixels, and every lens type sees the same everywhere"
    else:
        names, why = ["tiles"], "the lens types do not see the same everywhere: not all are m x m one pixel apart"
    needs = {name: _needed(name, scene, camera, exact) for name in names}
    for place, name in enumerate(names):
        if needs[name] <= allowed:
            reason = why if place == 0 else f"{names[0]} would need {needs[names[0]] / 1e9:.1f} GB"
            return MethodChoice(name, reason, needs[name], _seconds(name, scene, camera, exact))
    raise InputError(
        f"the {' or '.join(names)} estimator needs {min(needs.values()) / 1e9:.1f} GB for {camera.unknowns} pixels,"
        f" {allowed / 1e9:.1f} GB are allowed; raise estimator.memory, or crop the target with target.origin and"
        " target.shape"
    )


def _misaligned(scene: Scene, camera: Camera, exact: bool, allowed: int) -> MethodChoice:
    """The way of an estimator that expects a misaligned camera, and begins with H as designed."""
    how, form = scene.estimator.misalignment, scene.estimator.method
    key = f"{scene.source}: estimator.misalignment '{how}'"
    if camera.tolerance is None:
        raise InputError(f"{key} needs to know what may be misaligned, got no [camera.tolerance]; add one")
    if camera.unknowns > DENSE:
        raise InputError(f"{key} serves up to {DENSE} pixels of f, got {camera.unknowns}; crop the target")
    if not (camera.has_box_footprints and camera.has_sharp_footprints):
        raise InputError(f"{key} serves pinholes and thin lenses in focus, got blurred or distorted ones; calibrate")
    if form in ("tiles", "frame"):
        raise InputError(f"{key} takes a dense form, got estimator.method '{form}'; set that to 'auto'")
    if not exact:
        raise InputError(f"{key} begins with H as designed, got a calibrated one; set calibration.method to 'ideal'")
    largest = max(kind.pixels[0] * kind.pixels[1] for kind in camera.types)
    blocks = 3 * 8 * camera.measurements * (largest + camera.unknowns)  # of Rv, and H whitened by them
    memory = _needed("dense", scene, camera, exact=False) + blocks
    if memory > allowed:
        raise InputError(
            f"{key} needs {memory / 1e9:.1f} GB, {allowed / 1e9:.1f} GB are allowed; raise estimator.memory"
        )
    return MethodChoice(
        how, f"estimator.misalignment is '{how}'", memory, _seconds("dense", scene, camera, exact=False)
    )


def allowed_memory(told: int | None) -> int:
    """Bytes that may be used: what the scene says, else half of what is free; never more than that."""
    free = free_memory()
    return free // 2 if told is None else min(told, free)


def _noise(scene: Scene) -> bool:
    if scene.sensor is not None:
        return True
    return scene.noise is not None and scene.noise.variance + scene.noise.quantisation_variance > 0


def _needed(way: str, scene: Scene, camera: Camera, exact: bool) -> int:
    entries = 0 if exact else 12 * 10 * camera.measurements * _footprint(camera)
    if way == "dense":
        correlated = scene.prior.kind != "independent"
        method = scene.estimator.method
        form = (
            ("covariance" if camera.measurements < camera.unknowns else "information") if method == "auto" else method
        )
        return needed_memory(form, camera.measurements, camera.unknowns, correlated=correlated) + entries
    images = 8 * (5 * camera.measurements + 16 * camera.unknowns)
    if way == "tiles":
        side = scene.tiles.size**2
        return BASE + images + entries + 2 * processors() * needed_memory("information", 3 * side, side)
    widest = max(ceil(kind.ratio) for kind in camera.types)
    longest = max(camera.shape)
    strips = 8 * 4 * longest * (5 * widest) * (5 * widest * (widest - 1) + widest)
    if exact:
        return BASE + images + strips + 8 * 2 * longest * 81 * widest**2 * (widest - 1)
    together = 12 * 3 * (2 * widest + 1) ** 2 * camera.unknowns  # K, stored
    return BASE + images + entries + strips + together + 2 * 8 * 2 * longest * widest * (40 + 10 * widest) ** 2


def _footprint(camera: Camera) -> int:
    return max(ceil(kind.ratio) for kind in camera.types) ** 2


def _seconds(way: str, scene: Scene, camera: Camera, exact: bool) -> float:
    """Measured on two cores, to within a factor of two or so."""
    count = camera.unknowns
    if way == "dense":
        return max(0.1, 7e-11 * count**3 * (10 if scene.prior.kind != "independent" else 1))
    each = 0.15 * (scene.tiles.size / 35) ** 6 / (scene.tiles.size - 2 * scene.tiles.overlap) ** 2
    if way == "tiles":
        return 1.0 + count * (each if not exact else 2e-6)
    return 1.5 + count * (1.2e-5 if exact else 1.5e-4 + each / 2)
