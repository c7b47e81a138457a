"""The choice among one dense problem, tiles and the whole frame, from the memory and time that each needs."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import free_memory, processors, used_memory
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.scene import Scene

from .estimator.estimate import needed_memory
from .frame.conjugate_gradients import band_width, band_work, serves
from .frame.frame_method import FrameMethod
from .frame.reading_space import MOST_READINGS, MOST_UNKNOWNS
from .frame.readings import leaves_null_space
from .frame.variance_map import LONG
from .frame.windows import CORE, LONG_HALO
from .methods.dense_method import DenseMethod
from .methods.method import Method
from .methods.tile_method import TileMethod
from .misalignment.alignment import AlignedMethod

PROGRAM_MEMORY = 500_000_000  # bytes, of the program itself and its libraries, the renderer with them
VECTORS = 18  # of all measurements and of all pixels, that a run holds at once; measured at 1019 x 1019 pixels
WORLD_IMAGES = 200  # of a world finer than f, that its solver holds at once; measured at 239 x 239 pixels of f
MATRICES = 8  # of a small frame or of windows, that are held at once
MOST_CORRELATED = 500  # pixels of a dense problem of correlated pixels where a frame serves: a second
TILE_ACCURACY = 0.3  # posterior standard deviations from the exact answer, on average; 0.17 where types see all edges

METHODS: dict[str, type[Method]] = {
    "dense": DenseMethod,
    "fit": AlignedMethod,
    "tiles": TileMethod,
    "frame": FrameMethod,
}


@dataclass(frozen=True)
class MethodChoice:
    """A method, the reason for it, and about how much memory (bytes) and time (s) it takes on two cores of 2026."""

    method: str
    why: str
    memory: int
    seconds: float


def choose_method(scene: Scene, camera: Camera, exact: bool) -> MethodChoice:
    """Choose the cheapest method with the accuracy that `estimator` asks for.

    exact : whether H is applied by boxes and kernels
    Raises InputError where no method fits into memory.
    """
    allowed = allowed_memory(scene.estimator.memory)
    if scene.estimator.misalignment != "trust":
        return _misaligned(scene, camera, exact, allowed)
    of_world = _of_world(scene, camera)
    if camera.has_detail and of_world is None:  # the model of f has no boxes
        exact = exact and camera.unknowns > MOST_DENSE and not camera.has_box_footprints
    names, why = of_world or _candidates(scene, camera, exact)
    memory = {name: _memory(name, scene, camera, exact) for name in names}
    for name in names:
        if memory[name] <= allowed:
            reason = why if name == names[0] else f"{names[0]} would need {memory[names[0]] / 1e9:.1f} GB"
            return MethodChoice(name, reason, memory[name], _seconds(name, scene, camera, exact))
    raise InputError(
        f"the {' or '.join(names)} estimator needs {min(memory.values()) / 1e9:.1f} GB for {camera.unknowns} pixels,"
        f" {allowed / 1e9:.1f} GB are allowed; raise estimator.memory, or crop the target with target.origin and"
        " target.shape"
    )


def _of_world(scene: Scene, camera: Camera) -> tuple[list[str], str] | None:
    """Return the method for a world finer than f of which the prior says something, and why; None without one."""
    if not camera.has_detail or scene.prior.kind == "independent":
        return None
    if scene.estimator.method not in ("auto", "frame"):
        raise InputError(
            f"{scene.source}: estimator.method '{scene.estimator.method}' does not serve {camera.unknowns} pixels in"
            " front of a world finer than f; set it to 'auto'"
        )
    return ["frame"], f"{camera.unknowns} pixels in front of a world finer than f"


def _candidates(scene: Scene, camera: Camera, exact: bool) -> tuple[list[str], str]:
    """Return methods in the order of preference, and why the first one is."""
    estimator = scene.estimator
    noiseless = estimator.noise_variance == 0 or (estimator.noise_variance is None and exact and not scene.has_noise)
    if exact and camera.is_sliding and not camera.has_box_footprints:
        if estimator.method not in ("auto", "frame"):
            raise InputError(
                f"{scene.source}: estimator.method '{estimator.method}' takes H with its entries, and blurred lenses"
                f" have too many for {camera.unknowns} pixels; set it to 'auto' or 'frame'"
            )
        return ["frame"], "kernels of the lens types apply H"
    if estimator.method in ("tiles", "frame"):
        return [estimator.method], "asked for"
    correlated = scene.prior.kind != "independent"
    if not camera.has_sharp_footprints and camera.unknowns > MOST_DENSE:
        reason = f"{camera.unknowns} pixels behind blurred lenses, whose footprints are wider than tiles"
        if noiseless:
            return ["dense"], reason
        return ["frame"] if camera.is_sliding or correlated else ["dense", "frame"], reason
    if correlated and not noiseless and camera.unknowns > MOST_CORRELATED:
        return ["frame", "dense" if camera.unknowns <= MOST_DENSE else "tiles"], f"{camera.unknowns} correlated pixels"
    if camera.unknowns <= MOST_DENSE:
        return ["dense", "tiles"], f"{camera.unknowns} pixels are few"
    if noiseless:
        return ["tiles"], "measurements without noise need a dense solution"
    if estimator.accuracy >= TILE_ACCURACY:
        return ["tiles"], f"tiles reach an accuracy of {estimator.accuracy:g} posterior standard deviations"
    if camera.is_sliding and leaves_null_space(camera) and not serves(camera):
        return ["tiles"], "the lens types leave a null space, and the pixels are too many for a frame's error bars"
    if camera.is_sliding:
        return ["frame", "tiles"], f"{camera.unknowns} pixels, and every lens type sees the same everywhere"
    if serves(camera):
        return ["frame", "tiles"], f"{camera.unknowns} pixels, whose lens types do not see the same everywhere"
    return ["tiles"], "the lens types do not see the same everywhere: not all are m x m one pixel apart"


def _misaligned(scene: Scene, camera: Camera, exact: bool, allowed: int) -> MethodChoice:
    """Choose the fit of H to the stack, which starts from H as designed."""
    method, other = scene.estimator.misalignment, scene.estimator.method
    key = f"{scene.source}: estimator.misalignment '{method}'"
    if camera.tolerance is None:
        raise InputError(f"{key} needs to know what may be misaligned, got no [camera.tolerance]; add one")
    if camera.unknowns > MOST_DENSE:
        raise InputError(f"{key} serves up to {MOST_DENSE} pixels of f, got {camera.unknowns}; crop the target")
    if camera.detail > 1:
        raise InputError(f"{key} takes a world made of f's pixels, got target.detail {camera.detail}; remove it")
    if not (camera.has_box_footprints and camera.has_sharp_footprints):
        raise InputError(f"{key} serves pinholes and thin lenses in focus, got blurred or distorted ones; calibrate")
    if other != "auto":
        raise InputError(f"{key} takes one dense problem, got estimator.method '{other}'; set that to 'auto'")
    if not exact:
        raise InputError(f"{key} starts from H as designed, got a calibrated one; set calibration.method to 'ideal'")
    memory = _memory("dense", scene, camera, exact=False) + 3 * 8 * camera.measurements * camera.unknowns
    if memory > allowed:
        raise InputError(
            f"{key} needs {memory / 1e9:.1f} GB, {allowed / 1e9:.1f} GB are allowed; raise estimator.memory"
        )
    seconds = _seconds("dense", scene, camera, exact=False)
    return MethodChoice(method, f"estimator.misalignment is '{method}'", memory, seconds)


def allowed_memory(limit: float | None) -> int:
    """Return the bytes that may be used: the limit, at most what is free.

    Without a limit half of what was free before this program, so that a run that began is not refused when it has
    loaded its renderer.
    """
    free = free_memory()
    return min((free + used_memory()) // 2 if limit is None else int(limit), free)


def _memory(method: str, scene: Scene, camera: Camera, exact: bool) -> int:
    """Return an upper estimate of the bytes that a method needs."""
    widest, correlated = max(ceil(lens_type.ratio) for lens_type in camera.types), scene.prior.kind != "independent"
    entries = 0 if exact else 12 * 10 * camera.measurements * widest**2
    if method == "dense":
        return needed_memory(camera.measurements, camera.unknowns, correlated=correlated) + entries
    images = 8 * VECTORS * (camera.measurements + camera.unknowns)
    if method == "tiles":
        side = scene.tiles.size**2
        return PROGRAM_MEMORY + images + entries + 2 * processors() * needed_memory(3 * side, side)
    if camera.has_detail and scene.prior.kind != "independent":
        few = camera.measurements <= MOST_READINGS and camera.world.unknowns <= MOST_UNKNOWNS
        columns = WORLD_IMAGES + (2 * camera.measurements if few else 0)  # H and its product with the prior
        return PROGRAM_MEMORY + images + entries + 8 * columns * camera.world.unknowns
    if not correlated and serves(camera):
        band = 8 * camera.unknowns * band_width(camera)
        return PROGRAM_MEMORY + images + entries + 5 * band  # the factor, a copy, and two matrices per block of lines
    side = LONG if leaves_null_space(camera) else CORE + 2 * LONG_HALO  # of small frames or windows
    cut_out = 0 if camera.is_sliding else 12 * camera.measurements * (widest + 1) ** 2  # H, of which windows are parts
    return PROGRAM_MEMORY + images + entries + cut_out + 8 * MATRICES * side**4


def _seconds(method: str, scene: Scene, camera: Camera, exact: bool) -> float:
    """Return the time that a method takes on two cores, measured to within a factor of two or so."""
    count, correlated = camera.unknowns, scene.prior.kind != "independent"
    if method == "dense":
        return max(0.1, 7e-11 * count**3 * (10 if correlated else 1))
    per_pixel = 0.15 * (scene.tiles.size / 35) ** 6 / (scene.tiles.size - 2 * scene.tiles.overlap) ** 2
    if method == "tiles":
        return 1.0 + count * (per_pixel if not exact else 2e-6)
    if not correlated and serves(camera):
        return 1.5 + 1.5e-9 * band_work(camera)
    if correlated and not (camera.is_sliding and camera.tolerance is None):
        return 1.5 + 2.2e-4 * count
    return 1.5 + count * (1.2e-5 if exact else 1.5e-4 + per_pixel / 2)
