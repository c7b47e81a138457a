"""Windows of further sub-imagers, chosen where they lower a weighted error (Eq. 5) most, and a bound on every choice.

Each window is one of a lens type of the camera, and the places of a type lie one pixel of f apart, all over the target.
With C the posterior covariance of the pixels, W = diag(their weights), and B the whitened rows of H of a window, the
window lowers the weighted error tr(W C) by

    tr((I + B C B^T)^-1 B C W C B^T),

which is what the next one is chosen by, and C by an update of the rank of B. The bound is that of the convex problem in
which a window may count in part (`mixture`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from math import floor
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.reconstruct.methods.method import EstimationTask
from ommatid.reconstruct.prior import reflecting_root
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene, parse
from ommatid.scenes.tables.estimation import DesignTable

from .best_camera import check_known, frame_task
from .mixture import WaveGroups, best_mixture

MOST_ENTRIES = 30_000_000  # of H of all windows, stored with its zeros
TIGHT, EXCHANGES = 0.01, 10  # gap of the bound relative to the error, and exchanges, at which its steps end
PLACES, STEERED = "windows-", "steered-"  # names of lens types begin so


@dataclass(frozen=True)
class PlacedWindow:
    """A window. lens : type whose magnification and optics it has;  corner : row and column of f where it begins"""

    lens: str
    corner: tuple[Fraction, Fraction]


@dataclass(frozen=True)
class SteeredCamera:
    """Windows in the order of their choice, rows and columns of their sensor pixels, and the weighted mean error.

    before : without them;  errors : with the first, the first two, ...;  bound : no choice of as many has less
    variances : (2, rows, columns) of f's pixels, before and after
    """

    windows: tuple[PlacedWindow, ...]
    pixels: tuple[int, int]
    before: float
    errors: tuple[float, ...]
    bound: float
    variances: FloatArray
    scene: Scene


def weights_of(scene: Scene, region: tuple[tuple[int, int], tuple[int, int]]) -> FloatArray:
    """Return weights of 1 inside a region and 0 beside it. Raises InputError if it does not lie in the target.

    region : row and column of its corner, and its rows and columns
    """
    shape, ((row, column), (rows, columns)) = derive(scene).shape, region
    if min(rows, columns) < 1 or row + rows > shape[0] or column + columns > shape[1]:
        raise InputError(
            f"{scene.source}: --steer: expected a region inside the {shape[0]} x {shape[1]} pixels of the target, got"
            f" {rows} x {columns} pixels from row {row}, column {column}"
        )
    weights = np.zeros(shape)
    weights[row : row + rows, column : column + columns] = 1.0
    return weights


def steer(scene: Scene, weights: FloatArray) -> SteeredCamera:
    """Place the windows of [design]; weights : (rows, columns) of the errors of f's pixels, at least 0.

    Raises InputError for a scene whose H has no closed form on the grid of f, and for one that is too large.
    """
    table, camera = scene.design or DesignTable(), derive(scene)
    _check(scene, camera, weights)
    with one_thread():
        places = _places(scene, camera, table)
        task = frame_task(places)
        wider, rows = task.model.camera, task.model.to_sparse()
        whitened = sparse.csr_array(
            sparse.diags_array(task.on_all_measurements(task.expected_noise, np.inf) ** -0.5) @ rows
        )
        own = whitened[: camera.measurements]
        root = _posterior_root(task, own)
        covariance = root @ root.T
        share = (weights / weights.sum()).ravel()
        slices = wider.slices()[len(camera.sub_imagers) :]
        blocks = [whitened[part] for part in slices]
        chosen, errors, after = _greedy(covariance, share, blocks, table.windows)
        bound = _bound(root, share, blocks, table.windows)
    subs = wider.sub_imagers[len(camera.sub_imagers) :]
    windows = tuple(PlacedWindow(subs[index].type.name.removeprefix(PLACES), subs[index].window) for index in chosen)
    variances = np.array([np.diag(covariance), after]).reshape(2, *camera.shape)
    made, before = _with_windows(scene, windows, table), float(share @ np.diag(covariance))
    return SteeredCamera(windows, table.window, before, tuple(errors), bound, variances, made)


def _check(scene: Scene, camera: Camera, weights: FloatArray) -> None:
    where = str(scene.source)
    if weights.shape != camera.shape or not weights.sum() > 0:
        raise InputError(
            f"{where}: --steer: expected weights of {camera.rows} x {camera.columns} pixels, some above 0, got"
            f" {' x '.join(map(str, weights.shape))}"
        )
    distorted = any(lens.optics.distortion is not None for lens in camera.types)
    if camera.has_detail or camera.has_surfaces or camera.tolerance is not None or distorted:
        raise InputError(
            f"{where}: windows are placed for cameras in their places, without surfaces and distortion, in front of a"
            " target that is no finer than f"
        )
    if scene.world is not None or scene.sensor is not None:
        kind = "[world]" if scene.world is not None else "[sensor]"
        raise InputError(f"{where}: windows are placed by [noise] that is the same everywhere, got a {kind}")
    check_known(scene)
    if not scene.has_noise:
        raise InputError(f"{where}: windows are placed by the noise of their readings; set noise.variance")


def _places(scene: Scene, camera: Camera, table: DesignTable) -> Scene:
    """Return the scene with an array of all windows of each of its lens types."""
    tables = scene.plain()
    lenses, entries, (tall, wide) = list[dict[str, Any]](), 0, table.window
    for name, lens in _kinds(camera).items():
        array = [floor(size - lens.ratio * count) + 1 for size, count in zip(camera.shape, table.window, strict=True)]
        if min(array) > 0:
            entries += array[0] * array[1] * tall * wide * camera.unknowns
            lenses.append(
                {**_optics_of(scene, name), "name": f"{PLACES}{name}", "array": array, "pixels": [tall, wide]}
            )
    if not lenses or entries > MOST_ENTRIES:
        found = f"one of {entries:.0e} entries" if lenses else "no place for them"
        raise InputError(
            f"{scene.source}: design.window: expected windows of {tall} x {wide} sensor pixels that fit the target,"
            f" with an H of {MOST_ENTRIES:.0e} entries at most, got {found}; take fewer pixels, or another target"
        )
    widest = (
        max(max(lens.pixels) for lens in camera.types) * camera.pixel_pitch + max(camera.shape) * camera.target_pitch
    )
    described = {key: each for key, each in tables["camera"].items() if key != "sensor"}
    described |= {"lens": [*tables["camera"]["lens"], *lenses], "lens_pitch": f"{camera.lens_pitch + widest!r} mm"}
    return parse({**tables, "camera": described}, scene.source)


def _kinds(camera: Camera) -> dict[str, LensType]:
    """Return one lens type of each magnification, optics and open part, by name."""
    kinds: dict[str, LensType] = {}
    for lens in camera.types:
        alike = (
            each
            for each in kinds.values()
            if (each.ratio, each.optics, each.open) == (lens.ratio, lens.optics, lens.open)
        )
        if next(alike, None) is None:
            kinds[lens.name] = lens
    return kinds


def _optics_of(scene: Scene, name: str) -> dict[str, Any]:
    """Return the table of a lens type without its array and windows."""
    (table,) = (each for each in scene.plain()["camera"]["lens"] if each["name"] == name)
    return {key: each for key, each in table.items() if key not in ("step", "sub_imager")}


def _posterior_root(task: EstimationTask, rows: sparse.csr_array) -> FloatArray:
    """Return R with R R^T the posterior covariance of whitened rows of H, (N, N), by singular values.

    With P = L L^T they are those of the rows times L: however large, they leave the digits of the small ones.
    """
    precision = task.precision_on(task.shape)
    if not isinstance(precision, np.ndarray):
        prior = np.eye(rows.shape[1]) / precision**0.5
    else:
        prior = reflecting_root(1 / precision)
    seen: FloatArray = np.asarray(rows @ prior)
    if len(seen) < rows.shape[1]:
        seen = np.concatenate([seen, np.zeros((rows.shape[1] - len(seen), rows.shape[1]))])
    _, values, turned = np.linalg.svd(seen, full_matrices=False)
    return np.asarray((prior @ turned.T) / np.hypot(1.0, values), dtype=np.float64)


def _greedy(
    covariance: FloatArray, share: FloatArray, blocks: Sequence[sparse.csr_array], count: int
) -> tuple[list[int], list[float], FloatArray]:
    """Return the windows that are chosen one after another, the errors with them, and the variances with all.

    blocks : whitened rows of H of each window
    """
    covariance, chosen, errors = covariance.copy(), list[int](), list[float]()
    for _ in range(count):
        seen: list[FloatArray] = [np.asarray(block @ covariance) for block in blocks]
        inner: list[FloatArray] = [np.eye(len(each)) + each @ block.T for block, each in zip(blocks, seen, strict=True)]
        falls = [np.trace(np.linalg.solve(own, (each * share) @ each.T)) for own, each in zip(inner, seen, strict=True)]
        best = int(np.argmax(falls))
        covariance -= seen[best].T @ np.linalg.solve(inner[best], seen[best])
        chosen.append(best)
        errors.append(float(share @ np.diag(covariance)))
    return chosen, errors, np.diag(covariance)


def _bound(root: FloatArray, share: FloatArray, blocks: Sequence[sparse.csr_array], count: int) -> float:
    """Return a weighted error that no choice of so many windows falls below; root : R of the covariance R R^T."""
    rows: FloatArray = np.concatenate([np.asarray(block @ root) for block in blocks])
    counted = share > 0
    owners = np.repeat(np.arange(len(blocks)), [block.shape[0] for block in blocks])
    pixels: FloatArray = np.asarray(root.T[:, counted] * np.sqrt(share[counted]), dtype=np.float64)
    groups = WaveGroups(rows[None], pixels[None], owners, np.ones(len(blocks)), (1, 1))
    return best_mixture(groups, float(count), TIGHT, EXCHANGES).bound


def _with_windows(scene: Scene, windows: Sequence[PlacedWindow], table: DesignTable) -> Scene:
    """Return the scene with the windows as further lens types, one of each type whose optics they have.

    Raises InputError where their patches do not fit the sensor.
    """
    tables = scene.plain()
    lenses: list[dict[str, Any]] = list(tables["camera"]["lens"])
    for name in dict.fromkeys(window.lens for window in windows):
        corners = [window.corner for window in windows if window.lens == name]
        steered = [
            {"at": [0, number], "window": [str(each) for each in corner]} for number, corner in enumerate(corners)
        ]
        taken = {lens["name"] for lens in lenses}
        names = (f"{STEERED}{name}", *(f"{STEERED}{number}-{name}" for number in range(2, len(taken) + 3)))
        free = next(each for each in names if each not in taken)
        described = {"name": free, "array": [1, len(corners)], "pixels": list(table.window), "step": "0"}
        lenses.append({**_optics_of(scene, name), **described, "sub_imager": steered})
    made = parse({**tables, "camera": {**tables["camera"], "lens": lenses}}, scene.source)
    derive(made)
    return made


def rows(camera: SteeredCamera) -> list[tuple[str, str]]:
    """Return the windows and what they bring as rows of a table."""
    last = camera.errors[-1]
    lines = [("without them", f"weighted MSE {camera.before:.4g}")]
    for number, (window, error) in enumerate(zip(camera.windows, camera.errors, strict=True), 1):
        row, column = window.corner
        lines.append((f"{number}. window", f"type {window.lens}, from row {row}, column {column}: {error:.4g}"))
    above = f"{last / camera.bound - 1:.1%}" if camera.bound > 0 else "more"
    return [*lines, ("no choice is better than", f"{camera.bound:.4g}; this one is {above} above it")]


def describe(camera: SteeredCamera) -> dict[str, Any]:
    """Return the windows and what they bring in JSON's types."""
    windows = [
        {"lens": window.lens, "corner": [float(each) for each in window.corner], "weighted_mse": error}
        for window, error in zip(camera.windows, camera.errors, strict=True)
    ]
    return {"before": camera.before, "windows": windows, "bound": camera.bound}


@own_style()
def draw(path: Path, camera: SteeredCamera, weights: FloatArray, files: FigureFiles = SCREEN_PNG) -> None:
    """Draw the standard deviation of the pixels before and after, with the windows and where the weights are."""
    from matplotlib.patches import Rectangle

    figure = new_figure(10, 4.6, layout="constrained")
    panels, deviations = figure.subplots(1, 2), np.sqrt(camera.variances)
    titles = f"before: weighted MSE {camera.before:.4g}", f"with the windows: {camera.errors[-1]:.4g}"
    limits = {"vmin": deviations.min(), "vmax": deviations.max()}
    images = [panel.imshow(values, cmap="viridis", **limits) for panel, values in zip(panels, deviations, strict=True)]
    for panel, title in zip(panels, titles, strict=True):
        panel.set_title(title)

    def frame(panel: Any, row: float, column: float, rows: float, columns: float, **style: Any) -> None:
        panel.add_patch(Rectangle((column - 0.5, row - 0.5), columns, rows, fill=False, clip_on=False, **style))

    counted = [np.flatnonzero(weights.any(axis=axis)) for axis in (1, 0)]
    (top, left), (tall, wide) = ((int(each[0]) for each in counted), (int(np.ptp(each)) + 1 for each in counted))
    frame(panels[0], top, left, tall, wide, color="white", linestyle="--")
    ratios = {lens.name: float(lens.ratio) for lens in derive(camera.scene).types}
    for number, window in enumerate(camera.windows):
        (row, column), ratio = window.corner, ratios[window.lens]
        frame(
            panels[1],
            float(row),
            float(column),
            ratio * camera.pixels[0],
            ratio * camera.pixels[1],
            color=f"C{number}",
            linewidth=2,
        )
    figure.colorbar(images[0], ax=panels, label="expected RMS error of a pixel")
    files.replace(figure, path)
