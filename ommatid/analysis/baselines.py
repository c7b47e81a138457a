"""Other ways from a stack to an image, as baselines of the estimate: their pictures, errors and times.

- The best single sub-image, enlarged (`measured_error`).
- Pixel rearrangement: every sensor pixel is written to the pixel of f that it looks at, as in the TOMBO camera (Tanida
  et al. 2001; Kitamura et al. 2004).
- Shift-and-add: every sub-image is enlarged to f's grid at its known sub-pixel position and magnification, and the
  mean is taken.
- Total variation: f that minimises |Rv^-1/2 (g - H f)|^2 / 2 + w |D f|_1, with the differences D f along rows and
  columns, by PyLops' split Bregman iterations. w is the one of least error against the truth, which no camera knows.

Images are (rows, columns) in the units of f. The first three know the positions of the views as designed, the last
knows the calibrated H.
"""

from __future__ import annotations

import importlib
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.reconstruct.coarse_model import model_of_f
from ommatid.reconstruct.measured_error import (
    best_single_sub_image,
    enlarged,
    measure_error,
    positions,
    without_gaps,
)
from ommatid.reconstruct.methods.method import total_variance
from ommatid.reconstruct.noise import known_noise, usable_pixels
from ommatid.reconstruct.output.result_files import BASELINES
from ommatid.reconstruct.output.run_json import BaselineMethod, MethodReport
from ommatid.runtime.arrays import Float32Array, FloatArray
from ommatid.runtime.files import UNREADABLE, cached
from ommatid.runtime.machine import one_thread
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats import exr
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.model import Model
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.estimation import PriorTable

LARGEST = 2**18  # pixels of f up to which total variation takes minutes
HALF = 1e-6  # of a pixel, within which a position lies halfway between two
WEIGHTS = tuple(3.0**-power for power in range(-2, 8))  # per grey level
RISEN = 1.05  # ratio to the least error from which smaller weights are not tried
MOST_STEPS = 30  # of the inverse of a distorted view
STEPS = 40, 20  # of split Bregman, and of LSQR within each
THRESHOLD = 4.0  # grey levels
CONVERGED = 1e-3  # grey levels RMS between two steps


@dataclass(frozen=True)
class Baselines:
    """Reports of the methods in order, and their images, (rows, columns), by name."""

    reports: tuple[MethodReport, ...]
    images: dict[str, Float32Array]


def missing_methods(unknowns: int) -> str:
    """Return why total variation is left out, as a sentence; empty where it is not."""
    if unknowns > LARGEST:
        return f"total variation is left out: f has {unknowns} pixels, and {LARGEST} take minutes"
    if find_spec("pylops") is None:
        return "total variation is left out: it needs PyLops, `pip install pylops`"
    return ""


def cached_baselines(
    folder: Path, fingerprint: str, stack: Stack, model: Model, truth: FloatArray, progress: Progress = no_progress
) -> Baselines:
    """Return the baselines in the folder of a run, which are computed unless they are up to date.

    fingerprint : of the run's results;  truth : f, (N,) or (rows, columns)
    """

    def make() -> Baselines:
        return baselines(stack, model, truth, progress)

    def read(path: Path) -> tuple[Baselines, str | None]:
        found, made_from = _read(path)
        is_complete = "total_variation" in found.images or bool(missing_methods(truth.size))
        return found, made_from if is_complete else None

    return cached(folder / BASELINES, fingerprint, read, make, partial(_write, fingerprint))[0]


def known_baselines(folder: Path, fingerprint: str) -> Baselines | None:
    """Return the baselines in a folder, None without those of the results with this fingerprint."""
    with suppress(*UNREADABLE):
        found, made_from = _read(folder / BASELINES)
        return found if made_from == fingerprint else None
    return None


def _read(path: Path) -> tuple[Baselines, str | None]:
    part = exr.read(path)[0]
    reports = tuple(MethodReport.model_validate(each) for each in part.record["baselines"])
    return Baselines(reports, {each.method: part.channels[each.method] for each in reports}), part.record["fingerprint"]


def _write(fingerprint: str, path: Path, found: Baselines) -> None:
    record = {"fingerprint": fingerprint, "baselines": [each.plain() for each in found.reports]}
    exr.write(path, [exr.Part("baselines", found.images, record)])


@one_thread()
def baselines(stack: Stack, model: Model, truth: FloatArray, progress: Progress = no_progress) -> Baselines:
    """Return all methods that this machine has, with their errors against the truth, (N,) or (rows, columns)."""
    shape = stack.camera.shape
    truth = truth.reshape(shape)
    reports, images = list[MethodReport](), dict[str, Float32Array]()

    def add(method: BaselineMethod, image: FloatArray, seconds: float, **chosen: Any) -> None:
        error = measure_error(image.ravel(), truth.ravel(), shape)
        numbers = {"mse": error.mse, "psnr": error.psnr, "ssim": error.ssim, "seconds": seconds}
        reports.append(MethodReport(method=method, **numbers, **chosen))
        images[method] = image.astype(np.float32)

    begun = perf_counter()
    single = best_single_sub_image(stack, truth)
    if single is not None:
        add("single", single.image, perf_counter() - begun, sub_imager=single.name)
    begun = perf_counter()
    add("rearranged", rearranged(stack), perf_counter() - begun)
    begun = perf_counter()
    add("shift_and_add", shift_and_add(stack), perf_counter() - begun)
    if not missing_methods(truth.size):
        image, seconds, weight = tuned_total_variation(stack, model, truth, progress)
        add("total_variation", image, seconds, weight=weight)
    return Baselines(tuple(reports), images)


def rearranged(stack: Stack) -> FloatArray:
    """Return the image by pixel rearrangement: every sensor pixel at the nearest pixel of f, equally near ones alike.

    A pixel of f is the mean of the sensor pixels written to it, one without any has the value of the nearest other.
    """
    camera = stack.camera
    sums, counts = np.zeros(camera.shape), np.zeros(camera.shape)
    for sub, image in zip(camera.sub_imagers, stack.images(), strict=True):
        known, places = without_gaps(image) / float(sub.type.light), _places(camera, sub)
        nearest = [(np.ceil(place - 0.5 - HALF), np.floor(place + 0.5 + HALF)) for place in places]
        for rows in nearest[0]:
            for columns in nearest[1]:
                inside = (rows >= 0) & (rows < camera.rows) & (columns >= 0) & (columns < camera.columns)
                at = rows[inside].astype(int), columns[inside].astype(int)
                np.add.at(sums, at, known[inside])
                np.add.at(counts, at, 1.0)
    return without_gaps(np.divide(sums, counts, out=np.full(camera.shape, np.nan), where=counts > 0))


def _places(camera: Camera, sub: SubImager) -> tuple[FloatArray, FloatArray]:
    """Return where on f's grid the middles of a sub-imager's pixels look, as designed: rows and columns of its size.

    It inverts `positions` by the steps of its derivative in the middle of f, which are exact without distortion.
    """
    middle = np.array([[camera.rows / 2], [camera.columns / 2]])
    numbers = np.indices(sub.type.pixels, dtype=np.float64).reshape(2, -1)
    neighbours = middle + np.array([[0, 1, 0], [0, 0, 1]])
    at_middle = np.stack(positions(camera, sub, *neighbours))
    steps = np.linalg.inv(at_middle[:, 1:] - at_middle[:, :1])
    places = middle + np.zeros_like(numbers)
    for _ in range(MOST_STEPS):
        change = steps @ (numbers - np.stack(positions(camera, sub, *places)))
        places = places + change
        if np.abs(change).max() < HALF / 10:
            break
    rows, columns = places.reshape(2, *sub.type.pixels)
    return rows, columns


def shift_and_add(stack: Stack) -> FloatArray:
    """Return the mean of all sub-images, each enlarged by cubic convolution, over the parts of f that they see.

    A pixel of f that no sub-imager sees has the value of the nearest other.
    """
    camera = stack.camera
    rows, columns = np.arange(float(camera.rows)), np.arange(float(camera.columns))
    sums, counts = np.zeros(camera.shape), np.zeros(camera.shape)
    every = [grid.ravel() for grid in np.meshgrid(rows, columns, indexing="ij")]
    for sub, image in zip(camera.sub_imagers, stack.images(), strict=True):
        places = positions(camera, sub, every[0], every[1])
        inside = np.ones(camera.shape, dtype=np.bool_)
        for place, size in zip(places, sub.type.pixels, strict=True):
            inside &= (np.abs(place - (size - 1) / 2) <= size / 2 + HALF).reshape(camera.shape)
        sums[inside] += enlarged(camera, sub, image, rows)[inside]
        counts += inside
    return without_gaps(np.divide(sums, counts, out=np.full(camera.shape, np.nan), where=counts > 0))


def tuned_total_variation(
    stack: Stack, model: Model, truth: FloatArray, progress: Progress = no_progress
) -> tuple[FloatArray, float, float]:
    """Return the image of least error by total variation, (rows, columns), seconds of all weights, and the best one.

    truth : f, (rows, columns). Weights fall by factors of 3 until the error has risen, and by 1.7 around the best.
    """
    solve, begun = TotalVariation(stack, model), perf_counter()
    start = np.full(truth.size, float(np.nanmean(stack.values)))
    images: dict[float, FloatArray] = {}
    errors: dict[float, float] = {}

    def best() -> float:
        return min(errors, key=lambda weight: errors[weight])

    def attempt(weight: float, start: FloatArray) -> None:
        images[weight] = solve(weight, start)
        errors[weight] = float(np.mean((images[weight] - truth.ravel()) ** 2))
        progress(len(images) / (len(WEIGHTS) + 2))

    for weight in WEIGHTS:
        attempt(weight, start)
        start = images[weight]
        if errors[weight] > RISEN * errors[best()]:
            break
    for factor in (3**0.5, 3**-0.5):
        attempt(factor * best(), images[best()])
    return images[best()].reshape(truth.shape), perf_counter() - begun, best()


class TotalVariation:
    """The minimiser of the sum above for a stack and its H; dead and saturated pixels are left out."""

    def __init__(self, stack: Stack, model: Model) -> None:
        """Build PyLops' operators. Noise is that of rendering and sensor as known; without any, all weigh alike."""
        pylops: Any = importlib.import_module("pylops")
        of_f, usable = model_of_f(model, stack.camera, PriorTable()), usable_pixels(stack, model)
        observation = of_f.applied
        variance = np.array(total_variance(known_noise(stack)))
        least = variance[variance > 0].min(initial=np.inf)
        weights = np.where(usable.used, np.maximum(variance, least if np.isfinite(least) else 1.0) ** -0.5, 0.0)
        self._readings = np.where(usable.used, weights * stack.values, 0.0)

        def observe(image: FloatArray) -> FloatArray:
            return weights * observation.forward(image)

        def back(readings: FloatArray) -> FloatArray:
            return observation.adjoint(weights * readings)

        size = of_f.measurements, of_f.unknowns
        self._observed = pylops.FunctionOperator(observe, back, *size, dtype="float64")
        self._differences = [
            pylops.FirstDerivative(stack.camera.shape, axis=axis, kind="forward", dtype="float64") for axis in (0, 1)
        ]

    def __call__(self, weight: float, start: FloatArray) -> FloatArray:
        """Return the image, (N,), from a first one.

        PyLops minimises mu |..|^2 / 2 + eps^2 |D f|_1: its eps is the threshold of differences, and eps / mu the
        penalty that couples these to f. The threshold changes how fast the steps converge, and not where to.
        """
        sparsity: Any = importlib.import_module("pylops.optimization.sparsity")
        outer, inner = STEPS
        return np.asarray(
            sparsity.splitbregman(
                self._observed,
                self._readings,
                self._differences,
                x0=start,
                niter_outer=outer,
                niter_inner=1,
                mu=THRESHOLD**2 / weight,
                epsRL1s=[THRESHOLD, THRESHOLD],
                tol=CONVERGED * start.size**0.5,
                iter_lim=inner,
            )[0]
        )
