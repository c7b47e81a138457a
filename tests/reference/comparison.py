"""What differs between two finished runs, as a number for each quantity, in a unit of that quantity.

A number is zero if and only if the quantity is the same bit for bit. `differences` compares values; `deviations`
compares two draws of the same statistics, for changes that move seeds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

Array = NDArray[Any]

UNITS = {
    "stack": "of the largest reading",
    "variance": "(relative, of the rendering)",
    "H": "of the largest entry",
    "estimate": "standard deviations of the posterior",
    "deviation": "(relative)",
    "truth": "of the largest value",
    "interval": "(relative)",
    "numbers": "(relative)",
    "record": "(relative)",
    "verdict": "(changed)",
}
# Of two draws: standard deviations of the normal law with the probability of the largest of all deviations (Sidak),
# but for H and the error bars relative differences (root mean square).
LIMITS = {"stack": 4.0, "H": 0.05, "estimate": 4.0, "deviation": 0.05, "interval": 4.0, "numbers": 4.0, "verdict": 0.0}
LEAST = float(np.nextafter(0, 1))  # bits differ, values do not: -0 and 0, float32 and float64
TIMES = ("fingerprint", "command", "date", "host", "spent", "versions", "seconds")  # keys of run.json that may differ
INTERVAL, VERDICT = "error.expected_given_truth.", "verdict.trusted"
NUMBERS = ("error.", "diagnostics.", "measurements", "unknowns", "depth.", "study.")


@dataclass(frozen=True)
class Difference:
    """The largest difference of a quantity, in its unit, and where it is."""

    quantity: str
    size: float
    where: str

    def __str__(self) -> str:
        return f"{self.quantity} {self.size:.2g} {UNITS[self.quantity]} at {self.where}"


@dataclass(frozen=True)
class Content:
    """Numbers of a finished run."""

    channels: dict[str, dict[str, Array]]  # of stack.exr and estimate.exr: by channel, then by part
    matrix: Any  # H, in compressed rows
    report: dict[str, Any]  # leaves of run.json by their path of keys


def read(result: Path, matrix: Path) -> Content:
    """Read a folder of results and the exported H."""
    channels = parts(result / "stack.exr") | parts(result / "estimate.exr", "estimate.")
    report = dict(leaves(json.loads((result / "run.json").read_text(encoding="utf-8"))))
    return Content(channels, sparse.csr_array(sparse.load_npz(matrix)), report)


def parts(path: Path, prefix: str = "") -> dict[str, dict[str, Array]]:
    """Pixels of an OpenEXR file by channel and part."""
    import OpenEXR

    pixels: dict[str, dict[str, Array]] = {}
    with OpenEXR.File(str(path)) as file:  # pyright: ignore[reportAttributeAccessIssue]
        for part in file.parts:
            for name, channel in part.channels.items():
                pixels.setdefault(prefix + name, {})[str(part.header["name"])] = np.array(channel.pixels)
    return pixels


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Values of a JSON document by their path of keys, without times and names; of lists also the length."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key not in TIMES:
                yield from leaves(inner, f"{path}.{key}" if path else key)
    elif isinstance(value, list):
        yield f"{path}.length", len(value)
        for number, inner in enumerate(value):
            yield from leaves(inner, f"{path}.{number}")
    else:
        yield path, value


def differences(before: Content, after: Content) -> list[Difference]:
    """The largest difference of each quantity that both runs have, in the order of the stages."""

    def channel(quantity: str, name: str, unit: Callable[[Array], Any], change: Callable[[Array], Array]) -> Difference:
        return arrays(quantity, before.channels.get(name, {}), after.channels.get(name, {}), unit, change)

    variances = before.channels["estimate.variance"]
    found = [channel("stack", name, peak, same) for name in ("Y", "dark", "flat")]
    found.append(channel("variance", "variance", same, same))
    found.append(matrices(before.matrix, after.matrix))
    found.append(channel("estimate", "estimate.estimate", lambda _: np.sqrt(next(iter(variances.values()))), same))
    found.append(channel("deviation", "estimate.variance", np.sqrt, np.sqrt))
    found.append(channel("truth", "estimate.truth", peak, same))
    found += [
        Difference(quantity_of(path), leaf_difference(before.report[path], after.report[path]), path)
        for path in before.report
        if path in after.report
    ]
    return [max((item for item in found if item.quantity == name), key=size, default=none(name)) for name in UNITS]


def size(item: Difference) -> float:
    """Sort key: the larger difference."""
    return item.size


def none(quantity: str) -> Difference:
    """No difference: neither run has the quantity."""
    return Difference(quantity, 0.0, "")


def same(values: Array) -> Array:
    """The values themselves."""
    return values


def peak(values: Array) -> float:
    """The largest magnitude."""
    return float(np.nanmax(np.abs(values), initial=0.0, where=np.isfinite(values)))


def arrays(
    quantity: str,
    before: dict[str, Array],
    after: dict[str, Array],
    unit: Callable[[Array], Any],
    change: Callable[[Array], Array],
) -> Difference:
    """The largest difference of two sets of arrays; change : what is compared, such as the root of a variance."""
    if before.keys() != after.keys():
        return Difference(quantity, math.inf, f"parts that only one side has: {sorted(before.keys() ^ after.keys())}")
    worst = none(quantity)
    for part, old in before.items():
        found, index = array_difference(old, after[part], unit(old), change)
        if found > worst.size:
            worst = Difference(quantity, found, f"{part} {index}")
    return worst


def array_difference(old: Array, new: Array, unit: Any, change: Callable[[Array], Array]) -> tuple[float, str]:
    """The largest difference of two arrays, and its place."""
    if old.shape != new.shape:
        return math.inf, f"shape {old.shape}, then {new.shape}"
    if old.dtype == new.dtype and old.tobytes() == new.tobytes():
        return 0.0, ""
    with np.errstate(all="ignore"):
        relative = np.abs(change(new.astype(float)) - change(old.astype(float))) / unit
    relative[(old == new) | (np.isnan(old) & np.isnan(new))] = 0.0
    relative[np.isnan(relative)] = math.inf
    index = np.unravel_index(int(np.argmax(relative)), old.shape)
    return max(float(relative[index]), LEAST), f"({', '.join(map(str, index))})"


def matrices(old: Any, new: Any) -> Difference:
    """The largest difference of two H, in units of the largest entry."""
    if old.shape != new.shape:
        return Difference("H", math.inf, f"shape {old.shape}, then {new.shape}")
    if all(np.array_equal(getattr(old, name), getattr(new, name)) for name in ("indptr", "indices", "data")):
        return none("H")
    change = sparse.coo_array(abs(new - old))
    rows, columns = change.coords
    if not change.nnz or not np.any(change.data):
        return Difference("H", LEAST, "entries that one side does not store")
    entry = int(np.argmax(change.data))  # of numbers that are none, the first
    found = float(change.data[entry]) / peak(old.data)
    return Difference(
        "H", math.inf if math.isnan(found) else found, f"measurement {rows[entry]}, pixel {columns[entry]}"
    )


def quantity_of(path: str) -> str:
    """The quantity to which a key of run.json belongs."""
    if path.startswith(INTERVAL):
        return "interval"
    return "verdict" if path == VERDICT else "numbers" if path.startswith(NUMBERS) else "record"


def leaf_difference(old: Any, new: Any) -> float:
    """The relative difference of two numbers, infinite for other values that differ."""
    if old == new:
        return 0.0
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in (old, new)):
        return math.inf
    return abs(new - old) / max(abs(old), abs(new))


def deviations(before: Content, after: Content) -> list[Difference]:
    """How far two runs of the same scene with other seeds are apart, in the terms of LIMITS."""
    old, new = before.report, after.report
    found = [stack_deviation(before.channels["Y"], after.channels["Y"])]
    if before.matrix.shape == after.matrix.shape:
        scale = float(np.linalg.norm(before.matrix.data))
        found.append(Difference("H", float(sparse.linalg.norm(after.matrix - before.matrix)) / scale, "all entries"))
    else:
        found.append(matrices(before.matrix, after.matrix))
    estimates = [plain(side.channels, "estimate.estimate") for side in (before, after)]
    variances = [plain(side.channels, "estimate.variance") for side in (before, after)]
    pixels = np.abs(estimates[1] - estimates[0]) / np.sqrt(variances[0] + variances[1])
    place = np.unravel_index(int(np.argmax(pixels)), pixels.shape)
    worst = largest(2 * float(stats.norm.sf(pixels[place])), pixels.size)
    found.append(Difference("estimate", worst, f"({', '.join(map(str, place))})"))
    means = [math.sqrt(float(variance.mean())) for variance in variances]
    found.append(Difference("deviation", abs(means[1] / means[0] - 1), "all pixels (root mean square)"))
    found.append(Difference("interval", error_deviation(old, new), "error.mse"))
    found.append(Difference("numbers", residual_deviation(old, new), "diagnostics.chi_squared"))
    found.append(Difference("verdict", leaf_difference(old.get(VERDICT), new.get(VERDICT)), VERDICT))
    return found


def plain(channels: dict[str, dict[str, Array]], name: str) -> Array:
    """The channel of a file with one part, in double precision."""
    return next(iter(channels[name].values())).astype(float)


def largest(probability: float, count: int) -> float:
    """Standard deviations of the normal law as improbable as the largest of `count` deviations of this probability."""
    return float(stats.norm.isf(-math.expm1(count * math.log1p(-min(probability, 1 - 1e-16))) / 2))


def stack_deviation(before: dict[str, Array], after: dict[str, Array]) -> Difference:
    """Whether the mean of some sub-image has moved, by Student's test of its pixels' changes."""
    worst = none("stack")
    for part in before:
        change = (after[part].astype(float) - before[part]).ravel()
        change = change[np.isfinite(change)]
        if change.size > 1 and np.ptp(change):
            found = largest(float(stats.ttest_1samp(change, 0).pvalue), len(before))
            worst = max(worst, Difference("stack", found, f"{part} (mean)"), key=size)
    return worst


def error_deviation(old: dict[str, Any], new: dict[str, Any]) -> float:
    """Whether errors agree: their ratio, and where a run is trusted each in the interval of the other.

    The 99 % interval of an error is taken as one of its logarithm.
    """
    if f"{INTERVAL}low" not in old or f"{INTERVAL}low" not in new:
        return 0.0
    errors, spreads, centres = [], [], []
    for report in (old, new):
        low, high = math.log(report[f"{INTERVAL}low"]), math.log(report[f"{INTERVAL}high"])
        errors.append(math.log(report["error.mse"]))
        spreads.append((high - low) / (2 * stats.norm.isf(0.005)))
        centres.append((high + low) / 2)
    found = abs(errors[1] - errors[0]) / math.hypot(*spreads)
    if old[VERDICT] and new[VERDICT]:
        found = max(found, abs(errors[0] - centres[1]) / spreads[1], abs(errors[1] - centres[0]) / spreads[0])
    return float(found)


def residual_deviation(old: dict[str, Any], new: dict[str, Any]) -> float:
    """Difference of the two chi-squared in standard deviations; a misfit of both makes each spread more."""
    path = "diagnostics.chi_squared."
    if f"{path}expected" not in old or f"{path}expected" not in new:
        return 0.0
    excess = [report[f"{path}chi_squared"] - report[f"{path}expected"] for report in (old, new)]
    spreads = [
        math.sqrt(report[f"{path}deviation"] ** 2 + 4 * max(found, 0.0))
        for report, found in zip((old, new), excess, strict=True)
    ]
    return abs(excess[1] - excess[0]) / math.hypot(*spreads)
