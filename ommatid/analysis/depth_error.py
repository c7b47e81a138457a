"""The error that depth adds: H is calibrated on the target's plane, and surfaces off that plane are displaced.

Lengths are millimetres. By similar triangles, a lens at offset b from the array's centre sees a point at distance z
displaced by b (Z/z - 1)/p_f pixels of f against an ideal camera in the centre, Z the target's distance and p_f the
pitch of its pixels. This disparity is 0 on the target's plane, and -b/p_f at infinity.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, new_figure, own_style
from ommatid.reconstruct.output.run_json import DepthBin
from ommatid.runtime.arrays import BoolArray, FloatArray
from ommatid.runtime.printable import printable_label
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.exr import read
from ommatid.scenes.scene import TRUTH

PICTURE = "depth.png"
BINS = 10
FLAT = 1e-4  # relative range of distances below which all is one distance: depth is stored in float32


def lens_offsets(camera: Camera) -> dict[str, float]:
    """Return the rms distance of the lenses of each type from the array's centre, in mm."""
    squares: dict[str, list[float]] = {}
    for sub in camera.sub_imagers:
        squares.setdefault(sub.type.name, []).append(sub.lens[0] ** 2 + sub.lens[1] ** 2)
    return {name: float(np.mean(values)) ** 0.5 for name, values in squares.items()}


def disparity(camera: Camera, depth: FloatArray | float) -> dict[str, FloatArray]:
    """Return the rms disparity over the sub-imagers of each lens type, in pixels of f and in the shape of `depth`.

    depth : distances in mm; infinite or NaN counts as infinitely far away
    """
    inverse = np.nan_to_num(1 / np.asarray(depth, dtype=np.float64), nan=0.0)
    stretch = np.abs(camera.distance * inverse - 1) / camera.target_pitch
    return {name: offset * stretch for name, offset in lens_offsets(camera).items()}


def error_by_depth(camera: Camera, depth: FloatArray, error: FloatArray, variance: FloatArray) -> tuple[DepthBin, ...]:
    """Return the error of an estimate by distance, nearest first.

    depth, error, variance : (rows, columns) distances in mm, NaN where there is no surface; estimate minus truth; its
        expected square (Eq. 5)
    The bins are equally wide in 1/z, and so in disparity. Raises ValueError if the shapes differ.
    """
    if not depth.shape == error.shape == variance.shape:
        raise ValueError(f"expected maps of one shape, got {depth.shape}, {error.shape} and {variance.shape}")
    return tuple(_bin(camera, depth[chosen], error[chosen], variance[chosen]) for chosen in _masks(depth))


def _masks(depth: FloatArray) -> list[BoolArray]:
    """Return the pixels of each bin, those without a surface last; none is empty."""
    empty = ~np.isfinite(depth)
    masks: list[BoolArray] = []
    if not empty.all():
        inverse = 1 / depth[~empty]
        low, high = float(inverse.min()), float(inverse.max())
        count = 1 if high - low <= FLAT * high else BINS
        index = np.full(depth.shape, -1)
        scaled = (high - inverse) / max(high - low, FLAT * high) * count
        index[~empty] = np.clip(scaled.astype(np.int64), 0, count - 1)
        masks = [index == number for number in range(count)]
    return [mask for mask in (*masks, empty) if mask.any()]


def _bin(camera: Camera, depth: FloatArray, error: FloatArray, variance: FloatArray) -> DepthBin:
    by_type = {name: _rms(values) for name, values in disparity(camera, depth).items()}
    counts = {lens_type.name: lens_type.count for lens_type in camera.types}
    mean_square = sum(counts[name] * value**2 for name, value in by_type.items()) / sum(counts.values())
    surface = bool(np.isfinite(depth).all())
    return DepthBin(
        nearest=float(depth.min()) if surface else None,
        farthest=float(depth.max()) if surface else None,
        pixels=int(depth.size),
        rms_error=_rms(error),
        expected_deviation=float(np.mean(variance)) ** 0.5,
        rms_disparity=mean_square**0.5,
        rms_disparity_by_type=by_type,
    )


def _rms(values: FloatArray) -> float:
    return float(np.mean(np.square(values))) ** 0.5


def rows(bins: Sequence[DepthBin]) -> list[tuple[str, str]]:
    """Return range of distances and error, one row per bin."""
    return [
        (
            _distance(depth_bin),
            f"error {depth_bin.rms_error:.3g} rms in {depth_bin.pixels} pixels, expected"
            f" {depth_bin.expected_deviation:.3g}; disparity {depth_bin.rms_disparity:.2g} pixels of f",
        )
        for depth_bin in bins
    ]


def _distance(depth_bin: DepthBin) -> str:
    if depth_bin.nearest is None:
        return "no surface"
    near, far = f"{depth_bin.nearest:.4g}", f"{depth_bin.farthest:.4g}"
    return f"{near} mm" if near == far else f"{near} to {far} mm"


@own_style()
def draw(
    path: Path,
    camera: Camera,
    bins: Sequence[DepthBin],
    title: str = "Error against distance",
    files: FigureFiles = SCREEN_PNG,
) -> None:
    """Draw error and expected deviation against distance above, and each lens type's disparity below."""
    from matplotlib.ticker import LogLocator, NullLocator

    figure = new_figure(6.4, 6.4, layout="constrained")
    figure.suptitle(printable_label(title))
    above, below = figure.subplots(2, 1, sharex=True)
    below.set_xscale("log")
    known = [(row.nearest, row.farthest, row) for row in bins if row.nearest is not None and row.farthest is not None]
    middles = [2 / (1 / near + 1 / far) for near, far, _ in known]
    reach = [
        [max(0.0, middle - near) for middle, (near, _, _) in zip(middles, known, strict=True)],
        [max(0.0, far - middle) for middle, (_, far, _) in zip(middles, known, strict=True)],
    ]
    errors = [depth_bin.rms_error for _, _, depth_bin in known]
    above.errorbar(middles, errors, xerr=reach, fmt="o", capsize=3, label="measured, and its range of distances")
    expected = [depth_bin.expected_deviation for _, _, depth_bin in known]
    above.plot(middles, expected, "k_", markersize=14, label="expected without depth (Eq. 5)")
    above.set_ylim(bottom=0)
    above.set_ylabel("RMS error (grey levels)")
    if known:
        near = 0.95 * min(camera.distance, *(near for near, _, _ in known))
        far = 1.05 * max(camera.distance, *(far for _, far, _ in known))
        distances = near * (far / near) ** np.linspace(0, 1, 200)
        for name, values in disparity(camera, distances).items():
            below.plot(distances, values, label=f"type {name}")
    locator: Any = LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7))
    below.xaxis.set_major_locator(locator)
    below.xaxis.set_minor_locator(NullLocator())
    below.xaxis.set_major_formatter("{x:g}")
    above.tick_params(labelbottom=True)
    below.set_ylabel("RMS disparity (target pixels)")
    for axes in (above, below):
        axes.set_xlabel("distance along the axis (mm)")
        axes.axvline(camera.distance, color="0.6", linestyle=":", label="the target's plane")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    files.replace(figure, path)


def depth_error_of_run(folder: Path, camera: Camera) -> tuple[DepthBin, ...]:
    """Return the error of a finished run by distance, and draw it beside its files; empty without a depth map.

    Raises InputError for files that are missing or damaged.
    """
    known = read(folder / TRUTH)[0].channels
    maps = read(folder / "estimate.exr")[0].channels
    if "depth" not in known or "truth" not in maps:
        return ()
    truth, estimate, variance, depth = (
        channel.astype(np.float64) for channel in (maps["truth"], maps["estimate"], maps["variance"], known["depth"])
    )
    bins = error_by_depth(camera, depth, estimate - truth, variance)
    draw(folder / PICTURE, camera, bins)
    return bins
