"""What differs between two finished runs, as a number for each quantity, in a unit of that quantity.

A number is zero if and only if the quantity is the same bit for bit. `differences` compares values; `deviations`
compares two draws of the same statistics, for changes that move seeds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse, stats

Array = NDArray[Any]
MODEL = "model.npz"

UNITS = {
    "stack": "of the largest reading",  # of a sub-image, with its dark and flat frame
    "variance": "(relative)",  # of the rendering, in the stack
    "H": "of the largest entry",
    "scatter": "(ratio beyond 1)",  # of two draws of H, to their stated variances
    "estimate": "error bars",
    "deviation": "(relative)",  # the error bars
    "truth": "of the largest value",
    "interval": "(relative)",
    "numbers": "(relative)",  # errors, budget, diagnostics, studies and depths of run.json
    "record": "(relative)",  # all else in run.json
    "verdict": "(changed)",
}
# Of two draws: standard deviations of the normal law with the probability of the largest of all deviations (Sidak),
# but for H and the error bars relative differences (root mean square), and for the scatter of H see `scatter`.
LIMITS = {
    "stack": 4.0,
    "H": 0.05,
    "scatter": 0.2,
    "estimate": 4.0,
    "deviation": 0.05,
    "interval": 4.0,
    "numbers": 4.0,
    "verdict": 0.0,
}
LEAST = float(np.nextafter(0, 1))  # bits differ, values do not: -0 and 0, float32 and float64
FILES = {
    "stack": ("stack.exr", "Y", "dark", "flat"),
    "variance": ("stack.exr", "variance"),
    "estimate": ("estimate.exr", "estimate"),
    "deviation": ("estimate.exr", "variance"),
    "truth": ("estimate.exr", "truth"),
}  # quantities that are pixels: the file and its channels
TIMES = ("fingerprint", "command", "date", "host", "spent", "versions", "seconds")  # keys of run.json that may differ
INTERVAL, CHI_SQUARED, VERDICT = "error.expected_given_truth.", "diagnostics.chi_squared.", "verdict.trusted"
NUMBERS = ("error.", "diagnostics.", "measurements", "unknowns", "depth.", "study.")


@dataclass(frozen=True)
class Difference:
    """The largest difference of a quantity, in its unit, and where it is."""

    quantity: str
    size: float = 0.0
    where: str = ""

    def __str__(self) -> str:
        return f"{self.quantity} {self.size:.2g} {UNITS[self.quantity]} at {self.where}"


@dataclass(frozen=True)
class Content:
    """Numbers of a finished run."""

    pixels: dict[str, dict[str, Array]]  # of each quantity of FILES, by part and channel
    matrix: Any  # H, in compressed rows
    variance: Any  # stated variances of entries of H, likewise; without entries where none is stated
    report: dict[str, Any]  # values of run.json by their path of keys


def read(result: Path, matrix: Path) -> Content:
    """Read a folder of results and the exported H."""
    import OpenEXR

    pixels: dict[str, dict[str, Array]] = {quantity: {} for quantity in FILES}
    for quantity, (name, *channels) in FILES.items():
        with OpenEXR.File(str(result / name)) as file:  # pyright: ignore[reportAttributeAccessIssue]
            for part in file.parts:
                found = {
                    channel: np.array(part.channels[channel].pixels) for channel in channels if channel in part.channels
                }
                pixels[quantity] |= {f"{part.header['name']} {channel}": values for channel, values in found.items()}
    report = dict(values_of(json.loads((result / "run.json").read_text(encoding="utf-8"))))
    exported = sparse.csr_array(sparse.load_npz(matrix))
    return Content(pixels, exported, stated_variance(result / MODEL, exported.shape), report)


def stated_variance(model: Path, shape: tuple[int, int]) -> Any:
    """Variances of the entries of H that a model file holds: `export` writes H alone."""
    with np.load(model) as arrays:
        if "data" not in arrays:  # few numbers, or nothing: their entries have no variances of their own
            return sparse.csr_array(shape)
        return sparse.csr_array((arrays["variance"], arrays["indices"], arrays["indptr"]), shape=shape)


def values_of(document: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Values of a JSON document by their path of keys, without times and names; of lists also the length."""
    if isinstance(document, dict):
        for key, inner in document.items():
            if key not in TIMES:
                yield from values_of(inner, f"{path}.{key}" if path else key)
    elif isinstance(document, list):
        yield f"{path}.length", len(document)
        for number, inner in enumerate(document):
            yield from values_of(inner, f"{path}.{number}")
    else:
        yield path, document


def differences(before: Content, after: Content) -> list[Difference]:
    """The largest difference of each quantity, in the order of UNITS; values of run.json that both runs have."""
    found = [pixel_difference(quantity, before.pixels, after.pixels) for quantity in FILES]
    found.append(matrix_difference(before.matrix, after.matrix))
    found += [
        Difference(quantity_of(path), value_difference(old, after.report[path]), path)
        for path, old in before.report.items()
        if path in after.report
    ]
    return [largest([item for item in found if item.quantity == quantity], quantity) for quantity in UNITS]


def largest(found: list[Difference], quantity: str) -> Difference:
    """The largest of these differences of a quantity."""
    return max(found, key=lambda item: item.size, default=Difference(quantity))


def pixel_difference(
    quantity: str, before: dict[str, dict[str, Array]], after: dict[str, dict[str, Array]]
) -> Difference:
    """The largest difference of a quantity that is an image or a set of images."""
    old, new = before[quantity], after[quantity]
    if old.keys() != new.keys():
        return Difference(quantity, math.inf, f"parts that one side lacks: {sorted(old.keys() ^ new.keys())}")
    found: list[Difference] = []
    for part, values in old.items():
        with np.errstate(all="ignore"):
            if quantity == "estimate":
                unit: Any = np.sqrt(next(iter(before["deviation"].values())))
            elif quantity == "deviation":
                unit = 2 * values  # the error bar's change is half that of its square
            else:
                unit = values if quantity == "variance" else peak(values)
            size, place = array_difference(values, new[part], unit)
        found.append(Difference(quantity, size, f"{part} {place}"))
    return largest(found, quantity)


def peak(values: Array) -> float:
    """The largest finite magnitude."""
    return float(np.max(np.abs(values), initial=0.0, where=np.isfinite(values)))


def array_difference(old: Array, new: Array, unit: Any) -> tuple[float, str]:
    """The largest difference of two arrays in a unit, and its place; infinite where one alone is no number."""
    if old.shape != new.shape:
        return math.inf, f"(shape {old.shape}, then {new.shape})"
    if old.dtype == new.dtype and old.tobytes() == new.tobytes():
        return 0.0, ""
    relative = np.abs(new.astype(float) - old) / unit
    relative[np.isnan(relative)] = math.inf
    relative[(old == new) | (np.isnan(old) & np.isnan(new))] = 0.0
    place = np.unravel_index(int(np.argmax(relative)), old.shape)
    return max(float(relative[place]), LEAST), named(place)


def named(place: tuple[Any, ...]) -> str:
    """An index as text."""
    return f"({', '.join(map(str, place))})"


def matrix_difference(old: Any, new: Any) -> Difference:
    """The largest difference of two H, in units of the largest entry."""
    if old.shape != new.shape:
        return Difference("H", math.inf, f"shape {old.shape}, then {new.shape}")
    pattern = all(np.array_equal(getattr(old, name), getattr(new, name)) for name in ("indptr", "indices"))
    if pattern and old.data.tobytes() == new.data.tobytes():
        return Difference("H")
    change = sparse.coo_array(abs(new - old))
    if not np.any(change.data):
        return Difference("H", LEAST, "zeros that are stored or signed otherwise")
    entry = int(np.argmax(change.data))  # of numbers that are none, the first
    size = float(change.data[entry]) / peak(old.data)
    row, column = (int(index[entry]) for index in change.coords)
    return Difference("H", math.inf if math.isnan(size) else size, f"measurement {row}, pixel {column}")


def quantity_of(path: str) -> str:
    """The quantity to which a key of run.json belongs."""
    if path == VERDICT:
        return "verdict"
    return "interval" if path.startswith(INTERVAL) else "numbers" if path.startswith(NUMBERS) else "record"


def value_difference(old: Any, new: Any) -> float:
    """The relative difference of two numbers, infinite for other values that differ."""
    if old == new:
        return 0.0
    if any(isinstance(value, bool) or not isinstance(value, int | float) for value in (old, new)):
        return math.inf
    return abs(new - old) / max(abs(old), abs(new))


def deviations(before: Content, after: Content) -> list[Difference]:
    """How far two runs of the same scene with other seeds are apart, in the terms of LIMITS."""
    old, new = before.report, after.report
    images = [
        {name: next(iter(side.pixels[name].values())).astype(float) for name in ("estimate", "deviation")}
        for side in (before, after)
    ]
    bars = [math.sqrt(float(side["deviation"].mean())) for side in images]
    pixels = np.abs(images[1]["estimate"] - images[0]["estimate"])
    pixels /= np.sqrt(images[0]["deviation"] + images[1]["deviation"])
    place = np.unravel_index(int(np.argmax(pixels)), pixels.shape)
    worst = of_many(2 * float(stats.norm.sf(pixels[place])), pixels.size)
    change: Any = after.matrix - before.matrix
    variance: Any = before.variance + after.variance
    uncertain = change.multiply(variance > 0)
    designed = float(sparse.linalg.norm(change - uncertain) / sparse.linalg.norm(before.matrix))
    return [
        stack_deviation(before.pixels["stack"], after.pixels["stack"]),
        Difference("H", designed, "entries without a stated variance"),
        Difference("scatter", scatter(uncertain.data, variance.data), "entries with a stated variance"),
        Difference("estimate", worst, named(place)),
        Difference("deviation", abs(bars[1] / bars[0] - 1), "all pixels"),
        Difference("interval", error_deviation(old, new), "error.mse"),
        Difference("numbers", residual_deviation(old, new), CHI_SQUARED + "chi_squared"),
        Difference("verdict", value_difference(old.get(VERDICT), new.get(VERDICT)), VERDICT),
    ]


def scatter(change: Array, variance: Array) -> float:
    """By how much two draws of H are farther apart, or closer, than the sum of their stated variances says.

    The ratio of the root mean squares is 1 for honest variances. With n = (sum of variances)^2 / (sum of their squares)
    entries that count, its standard error is (2 n)^-1/2, and 4 of these are no difference: on an exact
    grid two entries hold all the variance. Pairs of seeds gave 0.965 to 1.023 (tile19 by points and distorted, entry by
    entry); a bias of three deviations of a draw makes it 2.3, variances of half their size 1.4: the limit of 0.2 lies
    between. The same H on both sides is one draw, of which nothing is said.
    """
    if not np.any(change) or not np.any(variance):
        return 0.0
    ratio = math.sqrt(np.square(change).sum() / variance.sum())
    count = variance.sum() ** 2 / np.square(variance).sum()
    return max(abs(ratio - 1) - 4 / math.sqrt(2 * count), 0.0)


def of_many(probability: float, count: int) -> float:
    """Normal deviate as improbable as the largest of `count` deviations, if one has this probability (Sidak)."""
    return float(stats.norm.isf(-math.expm1(count * math.log1p(-min(probability, 1 - 1e-16))) / 2))


def stack_deviation(before: dict[str, Array], after: dict[str, Array]) -> Difference:
    """Whether the mean of some sub-image has moved, by Student's test of its pixels' changes."""
    found: list[Difference] = []
    for part, old in before.items():
        change = (after[part].astype(float) - old).ravel()
        change = change[np.isfinite(change)]
        if change.size > 1 and np.ptp(change):
            probability = float(stats.ttest_1samp(change, 0).pvalue)
            found.append(Difference("stack", of_many(probability, len(before)), f"{part} (mean)"))
    return largest(found, "stack")


def error_deviation(old: dict[str, Any], new: dict[str, Any]) -> float:
    """Whether errors agree: their ratio, and where runs are trusted each in the interval of the other.

    The 99 % interval of an error is taken as one of its logarithm.
    """
    if f"{INTERVAL}low" not in old or f"{INTERVAL}low" not in new:
        return 0.0
    ends = [[math.log(report[INTERVAL + end]) for end in ("low", "high")] for report in (old, new)]
    spreads = [(high - low) / (2 * float(stats.norm.isf(0.005))) for low, high in ends]
    first, second = (math.log(report["error.mse"]) for report in (old, new))
    found = abs(second - first) / math.hypot(*spreads)
    if old[VERDICT] and new[VERDICT]:
        inside = ((first, ends[1], spreads[1]), (second, ends[0], spreads[0]))
        found = max(found, *(abs(error - sum(others) / 2) / spread for error, others, spread in inside))
    return found


def residual_deviation(old: dict[str, Any], new: dict[str, Any]) -> float:
    """Difference of the two chi-squared in standard deviations; a misfit that both share makes each spread more."""
    if f"{CHI_SQUARED}expected" not in old or f"{CHI_SQUARED}expected" not in new:
        return 0.0
    excess = [report[f"{CHI_SQUARED}chi_squared"] - report[f"{CHI_SQUARED}expected"] for report in (old, new)]
    variances = [report[f"{CHI_SQUARED}deviation"] ** 2 for report in (old, new)]
    return abs(excess[1] - excess[0]) / math.sqrt(sum(variances) + 4 * sum(max(value, 0.0) for value in excess))
