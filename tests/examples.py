"""Small scenes for the tests, and their common statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse, stats

from ommatid.reconstruct.estimator.estimate import estimate
from ommatid.reconstruct.prior import Prior, independent
from ommatid.reconstruct.problem import Form, Problem
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.streams import sampler_seeds
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.pose import Misalignment
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.variant import unusable_reason

if TYPE_CHECKING:  # a test asserts that scenes of pinholes load no module of lenses
    from ommatid.reconstruct.restore import Reconstruction
    from ommatid.simulate.renderer.renderer import Renderer

GALLERY = Path(__file__).parent.parent / "scenes"
Lenses = tuple[tuple[Any, Any, Any], ...]

VARIANTS = ["scalar_rgb", "llvm_ad_mono"]
slow = partial(pytest.param, marks=pytest.mark.slow)  # a case of the long form of a test
SLOW_SCALAR = [slow("scalar_rgb"), "llvm_ad_mono"]  # the long form of a law


def scene(shape: tuple[int, int] = (19, 19), lenses: Lenses = (("1/3", [3, 3], [5, 5]),), **tables: Any) -> Scene:
    """A scene with lens types A, B, ... of (magnification, array, pixels) and more tables by name.

    A calibrated H has entries, which most tests are about, unless `calibration` names another fit, and the numbers of
    samples are fixed unless `render` and `calibration` name others. Pixels are independent unless `prior` says more.
    Keys of `target` and `camera` are added to those here.
    """
    calibration = {"samples": 256} | tables.get("calibration", {})
    if calibration.get("method") != "ideal":
        calibration = {"fit": "none"} | calibration
    tables = tables | {"render": {"samples": 256} | tables.get("render", {}), "calibration": calibration}
    names = "ABCDEFGH"
    data: dict[str, Any] = {
        **tables,
        "target": {
            "image": "photo:camera",
            "origin": [96, 224],
            "shape": list(shape),
            "pixel_pitch": "1 mm",
            "distance": "1 m",
            **tables.get("target", {}),
        },
        "camera": {
            "pixel_pitch": "6 um",
            "lens_pitch": "0.5 mm",
            "lens": [
                {"name": name, "magnification": magnification, "array": array, "pixels": pixels}
                for name, (magnification, array, pixels) in zip(names, lenses, strict=False)
            ],
            **tables.get("camera", {}),
        },
        "prior": {"kind": "independent"} | tables.get("prior", {}),
    }
    return parse(data, Path("test.toml"))


def with_keys(described: Scene, **tables: Mapping[str, Any]) -> Scene:
    """The scene with some keys of its tables changed, which are not validated again."""
    changed = {name: getattr(described, name).model_copy(update=keys) for name, keys in tables.items()}
    return described.model_copy(update=changed)


THREE = (("1/3", [3, 3], [5, 5]), ("1/5", [5, 5], [3, 3]), ("1/4", [4, 4], [4, 4]))


TWO = THREE[:2]


def camera(shape: tuple[int, int] = (19, 19), lenses: Lenses = THREE) -> Camera:
    """The camera of such a scene."""
    return derive(scene(shape, lenses))


def with_optics(
    lens: dict[str, Any],
    camera_table: dict[str, Any],
    lenses: Lenses = TWO,
    shape: tuple[int, int] = (19, 19),
    **tables: Any,
) -> tuple[Scene, Camera]:
    """A scene with more keys in every lens type and in the table [camera], and its camera."""
    sensor = {"sensor": tables.pop("sensor")} if "sensor" in tables else {}  # which pinholes do not have
    data = scene(shape, lenses, **tables).plain() | sensor
    for table in data["camera"]["lens"]:
        table.update(lens)
    data["camera"].update(camera_table)
    described = parse(data, Path("test.toml"))
    return described, derive(described)


def random_problem(seed: int = 0, m: int = 7, n: int = 5, *, correlated: bool = False) -> Problem:
    """A dense problem of M random measurements of N pixels with random noise variances."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n)) if correlated else np.sqrt(rng.uniform(1, 50, n))
    matrix = sparse.csr_array(rng.normal(size=(m, n)))
    return Problem(matrix, Prior(rng.normal(size=n), root), rng.uniform(0.1, 2, m))


def tile_problem(lens_types: int, noise: float) -> Problem:
    """The problem of a 19 x 19 tile with up to three lens types and the paper's prior."""
    tile = camera(lenses=THREE[:lens_types])
    return Problem(ideal_matrix(tile), independent(127.5, 5461.25, 361), np.full(tile.measurements, noise))


def form_of(problem: Problem) -> Form:
    """The form that estimates an image equal to f0, whose posterior variances are accurate to the tolerance."""
    return estimate(problem, problem.matrix @ problem.prior.mean).form


OPTICS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # for `with_optics`
    "pinhole": ({}, {}),
    "out of focus": ({"aperture": "0.4 mm", "focus": "900 mm"}, {"wavelength": "none"}),
    "diffraction": ({"aperture": "0.8 mm"}, {"wavelength": "550 nm", "lens_pitch": "1 mm"}),
    "distortion": ({"distortion": [0.05, 0.02]}, {}),
    "misaligned": ({}, {"tolerance": {"position": "1 um", "rotation": "1 deg", "tilt": "1 deg"}}),
}


def sets(*changes: str) -> list[str]:
    """Options of a command that make these changes to its scene."""
    return [word for change in changes for word in ("--set", change)]


Value = TypeVar("Value")


def not_none(value: Value | None) -> Value:
    """The value of something that may be missing, and must not be."""
    assert value is not None
    return value


def inside_interval(result: Reconstruction) -> bool:
    """Whether the measured error lies in the 99 % interval that is expected of it."""
    interval = not_none(result.interval)
    return interval.low < not_none(result.error).mse < interval.high


def needs(variant: str) -> None:
    """Skip the test if a variant does not work on this machine."""
    reason = unusable_reason(variant)
    if reason:
        pytest.skip(reason)


def posterior_covariance(form: Form, pixels: Sequence[int] = ()) -> NDArray[np.float64]:
    """Columns of the posterior covariance, (N, pixels); all of them, (N, N), if no pixels are named."""
    u, _ = form.pixel_solutions(np.array(pixels or range(form.problem.unknowns), dtype=np.intp))
    return form.problem.prior.apply_root(u)


def gain_and_error(
    h: FloatArray,
    prior: FloatArray,
    noise: float | FloatArray,
    actual_prior: FloatArray | None = None,
    actual_noise: float | FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """A of Eq. 4, (N, M), and the covariance of the error by Eq. 5, (N, N), with inverses; noise : variances."""
    expected, actual = (
        np.diag(np.broadcast_to(noise if each is None else each, len(h))) for each in (noise, actual_noise)
    )
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + expected)
    hidden = np.eye(len(prior)) - gain @ h
    missing = hidden @ (prior if actual_prior is None else actual_prior) @ hidden.T
    return gain, np.asarray(missing + gain @ actual @ gain.T, dtype=np.float64)


def covariance_of(prior: Prior) -> FloatArray:
    """P0 of a prior: (N, N)."""
    return np.diag(prior.root**2) if prior.independent else prior.root @ prior.root.T


def familywise(tests: int, significance: float = 0.01) -> float:
    """Significance of each of many tests such that all pass with probability 1 - significance (Sidak)."""
    return float(-np.expm1(np.log1p(-significance) / tests))


def assert_student(difference: NDArray[np.float64], variance: NDArray[np.float64], passes: int) -> None:
    """Assert that differences agree with variances from `passes` passes, at a familywise significance of 1 %."""
    limit = float(stats.t.isf(familywise(difference.size) / 2, passes - 1))
    score = np.abs(difference) / np.sqrt(variance)
    assert score.max() < limit, f"t = {score.max():.1f} at {int(score.argmax())}, the limit is {limit:.1f}"


def mean_weights(renderer: Renderer, group: str, samples: int) -> NDArray[np.float64]:
    """Return the mean weight of each pixel's rays, (pixels,): its relative light from a uniform world."""
    weights = [
        renderer.hits(block, samples, sampler_seeds(0, "data", 0, 1))[1]
        for block in renderer.blocks(renderer.pixels(group), samples)
    ]
    return np.concatenate([weight.mean(axis=1) for weight in weights if weight is not None])


def as_table(misalignments: tuple[Misalignment, ...]) -> FloatArray:
    """Return misalignments as an array: (sub-imagers, 6)."""
    return np.array([[*each.position, *each.tilt, each.rotation, each.focal_length] for each in misalignments])


PAIR: Lenses = (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit"))
POSITION = {"position": "40 nm"}  # of lenses 1 and 2 mm before the sensor: 0.01 to 0.03 pixels of f
TOLERANCES = {**POSITION, "tilt": "1 deg", "rotation": "3 mrad", "focal_length": 2e-3}


def misaligned_camera(
    side: int = 12, tolerance: Mapping[str, Any] = POSITION, lenses: Lenses = PAIR, *, seed: int = 0
) -> Camera:
    """A small camera with a tolerance."""
    table = ToleranceTable.model_validate({"seed": seed, **tolerance})
    return replace(derive(scene((side, side), lenses)), tolerance=table)


def drawn_from(prior: Prior, rng: np.random.Generator) -> FloatArray:
    """An image drawn from a prior: (N,)."""
    return prior.mean + prior.apply_root(rng.standard_normal(prior.dimension))
