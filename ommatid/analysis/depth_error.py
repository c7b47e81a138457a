"""The error that depth adds: H is calibrated on the target's plane, and what stands before or behind it is displaced.

Lengths are millimetres. A point at distance z that an ideal camera in the array's centre sees in a pixel of f is seen
by a lens at the offset b from that centre as if it lay b (Z/z - 1)/p_f pixels of f beside it, Z the target's distance
and p_f its pixels' pitch: similar triangles. That disparity is 0 on the target's plane, and -b/p_f infinitely far away.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.files import write_whole
from ommatid.scenes.camera import Camera
from ommatid.scenes.formats.exr import read
from ommatid.scenes.scene import TRUTH

Image = NDArray[np.float64]

PICTURE = "depth.png"
BINS = 10
FLAT = 1e-4  # relative range of distances below which all is one distance: depth is stored in float32


def offsets(camera: Camera) -> dict[str, float]:
    """Of each lens type, the rms over its sub-imagers of the distance of lenses from the array's centre, in mm."""
    squares: dict[str, list[float]] = {}
    for sub in camera.sub_imagers:
        squares.setdefault(sub.type.name, []).append(sub.lens[0] ** 2 + sub.lens[1] ** 2)
    return {name: float(np.mean(each)) ** 0.5 for name, each in squares.items()}


def disparity(camera: Camera, depth: Image | float) -> dict[str, Image]:
    """Of each lens type, the rms over its sub-imagers of the disparity at a distance, in pixels of f.

    depth : any shape, which the results have; infinite or NaN where there is nothing, so infinitely far away
    """
    nearness = np.nan_to_num(1 / np.asarray(depth, dtype=np.float64), nan=0.0)
    stretch = np.abs(camera.distance * nearness - 1) / camera.target_pitch
    return {name: offset * stretch for name, offset in offsets(camera).items()}


def describe(camera: Camera, depth: Image, error: Image, variance: Image, bins: int = BINS) -> list[dict[str, Any]]:
    """The error of an estimate by distance, nearest first, in JSON's types.

    depth, error, variance : (rows, columns) of the truth's distances in mm, NaN where there is nothing; of estimate
        minus truth; and of what Eq. 5 expects of its square
    The bins are equally wide in 1/z, so in disparity; a distance of None stands for nothing, infinitely far away.
    """
    if not depth.shape == error.shape == variance.shape:
        raise ValueError(f"expected maps of one shape, got {depth.shape}, {error.shape} and {variance.shape}")
    return [_bin(camera, depth[chosen], error[chosen], variance[chosen]) for chosen in _binned(depth, bins)]


def _binned(depth: Image, bins: int) -> list[NDArray[np.bool_]]:
    nothing = ~np.isfinite(depth)
    found: list[NDArray[np.bool_]] = []
    if not nothing.all():
        nearness = 1 / depth[~nothing]
        low, high = float(nearness.min()), float(nearness.max())
        count = 1 if high - low <= FLAT * high else bins
        place = np.full(depth.shape, -1)
        scaled = (high - nearness) / max(high - low, FLAT * high) * count
        place[~nothing] = np.clip(scaled.astype(np.int64), 0, count - 1)
        found = [place == number for number in range(count)]
    return [chosen for chosen in (*found, nothing) if chosen.any()]


def _bin(camera: Camera, depth: Image, error: Image, variance: Image) -> dict[str, Any]:
    by_type = {name: _rms(values) for name, values in disparity(camera, depth).items()}
    counts = {kind.name: kind.count for kind in camera.types}
    mean_square = sum(counts[name] * value**2 for name, value in by_type.items()) / sum(counts.values())
    seen = bool(np.isfinite(depth).all())
    return {
        "nearest": float(depth.min()) if seen else None,
        "farthest": float(depth.max()) if seen else None,
        "pixels": int(depth.size),
        "rms_error": _rms(error),
        "expected_deviation": float(np.mean(variance)) ** 0.5,
        "rms_disparity": mean_square**0.5,
        "rms_disparity_by_type": by_type,
    }


def _rms(values: Image) -> float:
    return float(np.mean(np.square(values))) ** 0.5


def rows(described: list[dict[str, Any]]) -> list[tuple[str, str]]:
    """The lines of the printed table: a distance, and what becomes of it."""
    return [
        (
            _distance(one),
            f"error {one['rms_error']:.3g} rms in {one['pixels']} pixels, expected {one['expected_deviation']:.3g};"
            f" disparity {one['rms_disparity']:.2g} pixels of f",
        )
        for one in described
    ]


def _distance(one: dict[str, Any]) -> str:
    if one["nearest"] is None:
        return "no surface"
    near, far = f"{one['nearest']:.4g}", f"{one['farthest']:.4g}"
    return f"{near} mm" if near == far else f"{near} to {far} mm"


def figure(path: Path, camera: Camera, described: list[dict[str, Any]], title: str = "") -> None:
    """Draw error and expected deviation against distance above, and each lens type's disparity below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullLocator

    drawn: Any = Figure(figsize=(6.4, 6.4), dpi=110, layout="constrained")
    FigureCanvasAgg(drawn)
    drawn.suptitle(title, parse_math=False)
    above, below = drawn.subplots(2, 1, sharex=True)
    below.set_xscale("log")
    seen = [one for one in described if one["nearest"] is not None]
    middle = [2 / (1 / one["nearest"] + 1 / one["farthest"]) for one in seen]
    reach = [
        [max(0.0, place - one["nearest"]) for place, one in zip(middle, seen, strict=True)],
        [max(0.0, one["farthest"] - place) for place, one in zip(middle, seen, strict=True)],
    ]
    errors = [one["rms_error"] for one in seen]
    above.errorbar(middle, errors, xerr=reach, fmt="o", capsize=3, label="measured, and its range of distances")
    expected = [one["expected_deviation"] for one in seen]
    above.plot(middle, expected, "k_", markersize=14, label="expected without depth (Eq. 5)")
    above.set_ylim(bottom=0)
    above.set_ylabel("rms error (units of the values, 0 to 255)")
    if middle:
        near = 0.95 * min(camera.distance, *(one["nearest"] for one in seen))
        far = 1.05 * max(camera.distance, *(one["farthest"] for one in seen))
        distances = near * (far / near) ** np.linspace(0, 1, 200)
        for name, values in disparity(camera, distances).items():
            below.plot(distances, values, label=f"type {name}")
    locator: Any = LogLocator(subs=(1, 1.5, 2, 3, 4, 5, 7))
    below.xaxis.set_major_locator(locator)
    below.xaxis.set_minor_locator(NullLocator())
    below.xaxis.set_major_formatter("{x:g}")
    below.set_xlabel("distance along the axis (mm)")
    below.set_ylabel("rms disparity (pixels of f)")
    for axes in (above, below):
        axes.axvline(camera.distance, color="0.6", linestyle=":", label="the target's plane")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    write_whole(path, lambda beside: drawn.savefig(beside, format="png"))


def of_run(folder: Path, camera: Camera) -> list[dict[str, Any]]:
    """What a finished run's files say of error against distance; draws it beside them. Empty without a depth map.

    Raises InputError for files that are missing or damaged.
    """
    known = read(folder / TRUTH)[0].channels
    made = read(folder / "estimate.exr")[0].channels
    if "depth" not in known or "truth" not in made:
        return []
    truth, estimate, variance, depth = (
        channel.astype(np.float64) for channel in (made["truth"], made["estimate"], made["variance"], known["depth"])
    )
    described = describe(camera, depth, estimate - truth, variance)
    figure(folder / PICTURE, camera, described, "Error against distance")
    return described
