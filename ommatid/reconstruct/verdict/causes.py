"""Causes of readings that H, the noise and the prior do not explain, and what to do about each: the table CAUSES.

A fault changes the readings g by D c with few numbers c, such as the slopes of the picture times a displacement, or by
a known change, such as another order. With S = H P0 H^T + Rv and m = S^-1 (g - H f0), their chi-squared is without it

    m^T (g - H f0) - 2 c^T D^T m + c^T D^T S^-1 D c,   least for c = (D^T S^-1 D)^-1 D^T m.

The likely fault reduces it most, in units of the noise that the best one leaves and less log M for every number (the
criterion of Schwarz). It is the cause if the check that found something wrong finds less than half of it without the
fault. S^-1 is a matrix for up to MOST_EXACT readings of a dense problem; elsewhere Rv^-1 takes its place, which is
larger, so that faults explain less. Where no fault does, the squares of the residual tell causes apart: they are alike
everywhere by noise, larger at slopes by detail finer than f, and at slopes far off the axis by depth.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any, cast

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import MOST_DENSE
from ommatid.scenes.model import RECORDED
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.sensor import FULL_SCALE

from ..methods.dense_method import DenseMethod
from ..methods.method import EstimationTask, Method
from .residual import regions

MOST_EXACT = 4000  # readings
MOST_SEARCHED = 200_000  # readings; beyond, the search takes longer than the estimate
EXPLAINED = 0.5  # share of the excess that a cause explains at least, and
CLEAR = 0.75  # the one that it explains, to first order, where more numbers explain more
STRUCTURED = 0.2  # share of the excess that a fault explains where readings hold more than noise
WORST = 3  # sub-imagers that are examined one by one
MOST_PIXELS, NUMBERS = 10, 3  # damaged pixels, and numbers that the choice of one of them counts for
DARK = 0.5  # share of the light that the other sub-imagers predict, below which one counts as dark
FEWEST_CLIPPED = 3  # readings of exactly the largest value
LEAST = 1e-300  # divisor
SEEN = 0.05  # expected square of a whitened residual, from which it tells something
MOST_NAMED = 5  # sub-imagers in one sentence
TURNS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("upside down", lambda image: image[::-1]),
    ("mirrored left to right", lambda image: image[:, ::-1]),
    ("rotated by 180 degrees", lambda image: image[::-1, ::-1]),
    ("with rows and columns exchanged", lambda image: image.T),
)


@dataclass(frozen=True)
class Cause:
    """A cause in words, of its numbers and of the sub-imagers `where` it is, and what to do about it (`remedies`)."""

    name: str
    words: str
    remedy: str


CAUSES = (
    Cause("gain", "a gain of {0:.4g} in {where}", "{flat}"),
    Cause("offset", "an offset of {0:.3g} grey levels in {where}", "{dark}"),
    Cause("black level", "a black level of {0:.3g} grey levels", "{dark}"),
    Cause("shift", "a view {0:.2g} pixels of f too far {1} and {2:.2g} {3} in {where}", "{calibrate}"),
    Cause("rotation", "a view rotated by {0:.2g} degrees in {where}", "{calibrate}"),
    Cause("scale", "a view {0:.3g} times as wide in {where}", "{calibrate}"),
    Cause("flip", "a picture {0} in {where}", "{turn}"),
    Cause("swap", "exchanged readings of {where}", "give the sub-images in the order of measurements"),
    Cause("dead", "little or no light in {where}, dark, covered or dead", "uncover it, or make its readings NaN"),
    Cause("clipping", "{0:.0f} readings clipped at {1:.4g}", "set noise.saturation = {1:.4g}"),
    Cause("depth", "a world at {0:.4g} mm", "set target.distance = '{0:.4g} mm'"),
    Cause(
        "depths",
        "parts of the world before or behind the target's plane, for which alone H holds",
        "crop the target to what is at its distance",
    ),
    Cause("pixels", "damaged pixels in {where}, {0:.0f} in all", "make their readings NaN"),
    Cause("sub-imager", "readings of {where} that no known cause explains", "make them NaN, or {calibrate}"),
    Cause("bits", "readings in steps of {0:.3g}", "set noise.bits = {1:.3g}, or add {2:.3g} to noise.variance"),
    Cause("noise", "noise of {0:.3g} times the stated variance", "{noise}"),
    Cause("detail", "detail finer than the pixels of f", "{detail}"),
    Cause("either", "detail finer than f, or noise of {0:.3g} times the stated variance", "{detail}; or {noise}"),
    Cause("unknown", "no known cause explains most of it; H may not be this camera's", "{unknown}"),
)


def remedies(stack: Stack, task: EstimationTask) -> dict[str, str]:
    """Return what to do where that depends on how the stack and H were made; nothing that has been done already."""
    imported = stack.record.get("method") == "imported"
    way, tolerance = task.model.record["method"], "" if stack.camera.tolerance else "[camera.tolerance] and "
    points = "from recorded point sources (ommatid calibrate --points)" if imported else "with the scene of the stack"
    calibrate = f"calibrate H {points}"
    if way == RECORDED:
        calibrate = "record the point sources again, since which the camera has changed"
    elif way == "ideal" and task.settings.misalignment != "fit" and _serves_fit(stack.camera):
        calibrate += f", or set {tolerance}estimator.misalignment = 'fit'"
    flat = "record the flat frames again" if stack.record.get("flat") else "import with a flat frame (--flat)"
    unscaled = imported and stack.record.get("flat") is False
    finer = "raise target.detail" if stack.camera.has_detail else "set target.detail = 2 or more"
    noise = f"set noise.variance to that many times {float(np.mean(task.expected_noise)):.3g}"
    return {
        "calibrate": calibrate,
        "unknown": f"{flat}, or {calibrate}" if unscaled else calibrate,
        "flat": flat if imported else "divide the readings by it",
        "dark": "import with dark frames of the same exposure (--dark)" if imported else "subtract it",
        "turn": f"turn it upright{' (--upright or --turned of ommatid import)' if imported else ''}",
        "noise": noise if stack.scene.sensor is None else "measure the read noise and the gain of the [sensor]",
        "detail": f"{finer} with prior.kind = 'fit', or take a smaller target.pixel_pitch",
    }


def _serves_fit(camera: Camera) -> bool:
    """Return True if the misalignments of such a camera can be fitted to a stack."""
    sharp = camera.has_box_footprints and camera.has_sharp_footprints
    return sharp and camera.unknowns <= MOST_DENSE and camera.detail == 1


@dataclass(frozen=True)
class Fault:
    """What may be wrong with the readings.

    columns : (measurements used, k) D;  freedoms : numbers that are chosen
    words : numbers of the cause's sentence and where it is, from c, (k,)
    known : True if c is 1;  groups : sub-imagers whose parts of c add up to 0, since a common one is another picture
    """

    cause: str
    columns: sparse.csr_array
    freedoms: int
    words: Callable[[FloatArray], tuple[Sequence[float | str], str]]
    known: bool = False
    groups: int = 0

    def numbers(self, products: FloatArray, along: FloatArray) -> FloatArray:
        """Return c from D^T S^-1 D and D^T m."""
        if self.known:
            return np.ones(1)
        lstsq, mixed = cast(Any, np.linalg.lstsq), np.eye(along.size)
        if self.groups:
            mixed -= np.tile(np.eye(along.size // self.groups), (self.groups, self.groups)) / self.groups
        return mixed @ lstsq(mixed @ products @ mixed, mixed @ along, rcond=1e-9)[0]


@dataclass(frozen=True)
class Found:
    """A fault with its c and its criterion, which is less the more likely it is, and 0 of readings without a fault."""

    fault: Fault
    coefficients: FloatArray
    criterion: float

    @property
    def change(self) -> FloatArray:
        """D c: (measurements used,)."""
        return self.fault.columns @ self.coefficients


def likely_cause(
    method: Method, stack: Stack, excess: Callable[[FloatArray, FloatArray], float], named: Sequence[int] = ()
) -> str:
    """Return the likely cause of what a check finds wrong, the share that it explains, and what to do: one clause.

    excess : what is wrong with readings, (M,), whose whitened residual has these squares, (measurements used,)
    named : sub-imagers that are examined before others
    """
    if method.task.recorded.size > MOST_SEARCHED:
        return f"its cause is not sought among more than {MOST_SEARCHED} readings; crop the target to see it"
    search, recorded = _Search(method, stack, named), method.task.recorded
    before = excess(recorded, search.squares(np.zeros(search.m.size)))
    found, where, share, least_left = search.best(), "", "", before
    likely = sorted(found, key=lambda one: one.criterion)
    simplest = [
        (one, EXPLAINED if one is min(found[place:], key=likely.index) else CLEAR) for place, one in enumerate(found)
    ]
    for one, least in (*simplest, *((one, EXPLAINED) for one in likely)):
        left = excess(recorded - method.task.on_all_measurements(one.change, 0.0), search.squares(one.change))
        least_left = min(left, least_left)
        if left < (1 - least) * before:
            name, (numbers, where) = one.fault.cause, one.fault.words(one.coefficients)
            share = f", which explains {100 - 100 * max(left, 0.0) / before:.0f} % of it"
            break
    else:
        name, numbers = search.cause_of_squares(least_left < (1 - STRUCTURED) * before)
    [cause] = (cause for cause in CAUSES if cause.name == name)
    how = cause.remedy.format(*numbers, **remedies(stack, method.task))
    return f"{cause.words.format(*numbers, where=where)}{share}; {how}"


class _Search:
    """The faults of a stack, and how likely they are."""

    def __init__(self, method: Method, stack: Stack, named: Sequence[int]) -> None:
        self.method, self.task, self.stack, self.named = method, method.task, stack, named
        operators = method.operators()
        if operators is None:
            raise TypeError("expected noise in every measurement, without which no check finds anything wrong")
        self.camera, self.used, self.operators = method.task.model.camera, method.task.used, operators
        filled = np.where(self.used, self.task.recorded, self.task.model.forward(method.image))
        pairs = zip(self.camera.sub_imagers, self.camera.slices(), strict=True)
        self.images = [filled[part].reshape(sub.type.pixels) for sub, part in pairs]
        self.of_sub = np.repeat(np.arange(len(self.images)), [image.size for image in self.images])[self.used]
        self.readings = self.task.recorded[self.used]
        self.residual = self.readings - method.observe(method.image)
        self.exact = isinstance(method, DenseMethod) and self.readings.size <= MOST_EXACT
        self.m = self._without_level(self.operators.weigh(self.residual))

    def _left(self, values: FloatArray) -> FloatArray:
        """Return Rv S^-1 x = x - H A x: (measurements used,) or with columns."""
        return values - self.method.observe(self.operators.gain(values))

    def _without_level(self, values: FloatArray) -> FloatArray:
        """Return S^-1 x for an image of unknown common level, which no fault is to explain, from S^-1 x."""
        light, weighed = self._level
        return values - np.multiply.outer(weighed, light @ values) / (light @ weighed)

    @cached_property
    def _level(self) -> tuple[FloatArray, FloatArray]:
        light = self.method.observe(np.ones(self.method.image.size))
        return light, self.operators.weigh(self._left(light))

    @cached_property
    def precision(self) -> Any:
        """S^-1, or Rv^-1 as a sparse matrix: (measurements used,) squared."""
        if self.exact:
            return self._without_level(self.operators.weigh(self._left(np.eye(self.m.size))))
        return sparse.csr_array(sparse.diags_array(self.operators.weigh(np.ones(self.m.size))))

    def _on(self, rows: BoolArray | IntArray, values: FloatArray) -> FloatArray:
        """Return x where the block of S^-1 on these readings times x is `values`."""
        if not self.exact:
            return values / self.precision.diagonal()[rows]
        return cast(Any, np.linalg.solve)(self.precision[rows][:, rows], values)

    @cached_property
    def expected(self) -> FloatArray:
        """Expected squares of the whitened residual without a fault: (measurements used,)."""
        return self.task.expected_noise * self.precision.diagonal()

    def squares(self, change: FloatArray) -> FloatArray:
        """Return the squares of the whitened residual of readings without a change: (measurements used,)."""
        return np.square(self.residual - self._left(change)) / self.task.expected_noise

    def best(self) -> list[Found]:
        """Return the most likely fault of few numbers, of many by sub-imager or region, and of single readings."""
        noise, freedoms = self.task.expected_noise, float(self.expected.sum())
        scale, kinds = float(noise @ self.m**2) / freedoms, list[list[Found]]()
        for faults in (self._alike(), self._each(), self._apart()):
            kinds.append([])
            for fault in faults:
                weighed = self.precision @ fault.columns
                products: Any = fault.columns.T @ weighed
                products, along = products if self.exact else products.toarray(), fault.columns.T @ self.m
                c = fault.numbers(products, along)
                kinds[-1].append(Found(fault, c, float(c @ products @ c - 2 * along @ c)))
                if len(kinds) < 3 and freedoms > 2 * fault.freedoms:
                    rest = float(noise @ np.square(self.m - weighed @ c))
                    scale = min(scale, rest / (freedoms - fault.freedoms))
        scale, each = max(scale, 1.0), np.log(self.m.size)
        for kind in kinds:
            kind[:] = (replace(one, criterion=one.criterion / scale + each * one.fault.freedoms) for one in kind)
        return [min(kind, key=lambda one: one.criterion) for kind in kinds]

    def _alike(self) -> Iterator[Fault]:
        """Yield faults of few numbers: of lens types, of all sub-imagers alike, of the worst ones, and of the world."""
        types, every = [lens_type.name for lens_type in self.camera.types], np.arange(len(self.images))
        of_type = np.array([types.index(sub.type.name) for sub in self.camera.sub_imagers])
        groups = [(f"lens type {name}", every[of_type == number]) for number, name in enumerate(types)]
        effects = self._effects(self.method.image)
        for where, subs in groups if groups[1:] else ():
            yield from self._common(effects, where, subs)
        yield from self._turned([*groups, ("all sub-imagers", every)])
        yield Fault("black level", _column(effects["offset"]), 1, lambda c: (c.tolist(), ""))
        moved = (effects["shift"] * self._parallax).sum(axis=1)
        yield Fault("depth", _column(moved), 1, lambda c: ([self.camera.distance / (1 + c[0])], ""))
        for index in self._worst:
            yield from self._of_one(index)
        largest = float(self.readings.max())
        clipped = self.readings == largest
        if clipped.sum() >= FEWEST_CLIPPED:
            change = np.zeros(self.m.size)
            change[clipped] = np.minimum(self._on(clipped, self.m[clipped]), 0.0)
            yield Fault("clipping", _column(change), 1, lambda _: ([float(clipped.sum()), largest], ""), known=True)

    def _apart(self) -> Iterator[Fault]:
        """Yield the most likely damaged pixels, and all readings of one of the worst sub-imagers."""
        unit, left, chosen = sparse.eye_array(self.m.size, format="csc"), self.m, list[int]()
        weights = self.precision.diagonal()
        for index in self._worst:
            error, where = self._error_of(index), self._named([index])
            count = int((self.of_sub == index).sum())
            yield Fault("sub-imager", _column(error), count, lambda _, where=where: ([], where), known=True)
        for count in range(1, min(MOST_PIXELS, self.m.size // 10) + 1):
            gains = np.divide(left**2, weights, out=np.zeros_like(left), where=weights > 0)
            gains[chosen] = 0.0
            if not gains.any():  # no reading that counts is left
                return
            chosen.append(int(np.argmax(gains)))
            rows = np.array(chosen)
            left = self.m - self.precision @ (unit[:, rows] @ self._on(rows, self.m[rows]))
            where = self._named(list(dict.fromkeys(self.of_sub[rows].tolist())))
            yield Fault("pixels", unit[:, rows].tocsr(), NUMBERS * count, lambda c, where=where: ([c.size], where))

    def _effects(self, image: FloatArray) -> dict[str, FloatArray]:
        """Return D of every effect on a sub-imager that sees this image: (measurements used, k) each."""
        slopes = np.gradient(image.reshape(self.task.shape))
        down, across = (self.task.finer * self.method.observe(np.ravel(slope)) for slope in slopes)
        y, x = self._places
        return {
            "gain": self.readings[:, None],
            "offset": np.ones_like(self.readings)[:, None],
            "shift": np.stack([down, across], axis=1),
            "rotation": (x * down - y * across)[:, None],
            "scale": (y * down + x * across)[:, None],
        }

    @cached_property
    def _places(self) -> FloatArray:
        """Rows and columns of the readings from the middle of their views, in pixels of f: (2, measurements used)."""
        types = [sub.type for sub in self.camera.sub_imagers]
        grids = [np.indices(each.pixels) - (np.array(each.pixels)[:, None, None] - 1) / 2 for each in types]
        places = [float(each.ratio) * grid.reshape(2, -1) for each, grid in zip(types, grids, strict=True)]
        return np.concatenate(places, axis=1)[:, self.used]

    @cached_property
    def _parallax(self) -> FloatArray:
        """Rows and columns of f from the axis to the lens of each reading: (measurements used, 2).

        At a distance Z / (1 + c) that lens sees c times as far on in the target's plane. Upright, x and y are opposite.
        """
        lenses = np.array([sub.lens[::-1] for sub in self.camera.sub_imagers])
        return -lenses[self.of_sub] / self.camera.target_pitch

    def _common(self, effects: dict[str, FloatArray], where: str, subs: Sequence[int] | IntArray) -> Iterator[Fault]:
        """Yield what these sub-imagers have in common."""
        inside = np.isin(self.of_sub, subs)[:, None]
        for name, values in effects.items():
            columns = sparse.csr_array(values * inside)
            yield Fault(name, columns, values.shape[1], lambda c, name=name: (_numbers(name, c), where))

    def _each(self) -> Iterator[Fault]:
        """Yield what every sub-imager or every region of the world has by itself."""
        count, effects = len(self.images), self._effects(self.method.image)
        moved = (effects["shift"] * self._parallax).sum(axis=1, keepdims=True)
        labels = np.unique(regions(self.camera)[self.used], return_inverse=True)[1]
        by_region = _by_group(moved, labels, int(labels.max()) + 1)
        yield Fault("depths", by_region, by_region.shape[1], lambda _: ([], ""))
        for name, columns in effects.items():
            k = columns.shape[1]

            def words(coefficients: FloatArray, name: str = name, k: int = k) -> tuple[Sequence[float | str], str]:
                by_sub = coefficients.reshape(count, k)
                worst = int(np.square(by_sub).sum(axis=1).argmax())
                return _numbers(name, by_sub[worst]), f"{self._named([worst])}, and others in other sub-imagers"

            yield Fault(name, _by_group(columns, self.of_sub, count), (count - 1) * k, words, groups=count)

    def _turned(self, groups: Sequence[tuple[str, Sequence[int] | IntArray]]) -> Iterator[Fault]:
        """Yield sub-images that are mirrored or rotated."""
        for (where, subs), (how, turn) in product(groups, TURNS):
            turned = {index: turn(self.images[index]) for index in subs}
            if all(image.shape == self.images[index].shape for index, image in turned.items()):
                yield Fault("flip", self._change(turned), 1, lambda _, how=how, where=where: ([how], where), known=True)

    def _change(self, changed: dict[int, FloatArray]) -> sparse.csr_array:
        """Return the readings less those of other sub-images: (measurements used, 1)."""
        images = [image - changed.get(index, image) for index, image in enumerate(self.images)]
        return _column(np.concatenate([image.ravel() for image in images])[self.used])

    @cached_property
    def _worst(self) -> list[int]:
        """The sub-imagers that the others contradict most."""
        excess: list[float] = []
        for index in range(len(self.images)):
            rows = self.of_sub == index
            excess.append(float(self.m[rows] @ self._on(rows, self.m[rows])) - rows.sum())
        return list(dict.fromkeys([*self.named, *np.argsort(excess)[::-1].tolist()]))[:WORST]

    def _error_of(self, index: int) -> FloatArray:
        """Return what a sub-imager reads more than all others predict: (measurements used,)."""
        rows, error = self.of_sub == index, np.zeros(self.m.size)
        error[rows] = self._on(rows, self.m[rows])
        return error

    def _of_one(self, index: int) -> Iterator[Fault]:
        """Yield the faults of one sub-imager, by the image and the light that the others predict."""
        rows, where, error = self.of_sub == index, self._named([index]), self._error_of(index)
        effects = self._effects(self.method.image - self.operators.gain(error))
        if self.readings[rows].sum() < DARK * (self.readings - error)[rows].sum():
            del effects["gain"]
            yield Fault("dead", _column(error), 1, lambda _: ([], where), known=True)
        yield from self._common(effects, where, [index])
        yield from self._turned([(where, [index])])
        for other, image in enumerate(self.images):
            if other != index and image.shape == self.images[index].shape:
                change, both = self._change({index: image, other: self.images[index]}), self._named([index, other])
                yield Fault("swap", change, 1, lambda _, both=both: ([], both), known=True)

    def _named(self, subs: Sequence[int]) -> str:
        return listed([self.camera.sub_imagers[index].name for index in subs])

    def cause_of_squares(self, structured: bool) -> tuple[str, Sequence[float]]:
        """Return the cause that the squares of the residual show, with its numbers.

        structured : True if there is more than noise, since a fault explains a part
        """
        noise, squares, seen = self.task.expected_noise, self.squares(np.zeros(self.m.size)), self.expected > SEEN
        scene, step, expected = self.stack.scene, _step(self.readings), self.expected[seen]
        added = step**2 / 12 - (0.0 if scene.noise is None else scene.noise.quantisation_variance)
        excess = (squares[seen] - expected).sum()
        if added > step**2 / 24 and (expected * added / noise[seen]).sum() > EXPLAINED * excess:
            return "bits", [step, float(np.log2(FULL_SCALE / step)), added]
        if not seen.any():
            return "unknown", []
        slopes = self._effects(self.method.image)["shift"]
        found = {
            "noise": self._growth(np.ones(noise.size)),
            "detail": self._growth(np.square(slopes).sum(axis=1)),
            "depths": self._growth(np.square((slopes * self._parallax).sum(axis=1))),
        }
        name = min(found, key=lambda name: found[name][0])
        fits = self.stack.record.get("method") == "imported" or not self.camera.covers_whole_pixels
        possible = {"noise": not structured, "detail": fits, "depths": True}
        if not possible[name]:
            return "unknown", []
        return "either" if name == "noise" and fits else name, [found[name][1]]

    def _growth(self, shape: FloatArray) -> tuple[float, float]:
        """Return the deviance of squares whose variance grows in this shape, (measurements used,), and by how much."""
        seen, squares = self.expected > SEEN, self.squares(np.zeros(self.m.size))
        grown = (shape / self.task.expected_noise)[seen]
        sizes = np.geomspace(0.05, 1e4, 100)[:, None]
        variance = self.expected[seen] * (1 + sizes * grown / max(grown.mean(), LEAST))
        deviance = (np.log(variance) + squares[seen] / variance).sum(axis=1)
        return float(deviance.min()), 1 + float(sizes[deviance.argmin(), 0])


def _column(values: FloatArray) -> sparse.csr_array:
    return sparse.csr_array(values.reshape(-1, 1))


def _by_group(columns: FloatArray, groups: IntArray, count: int) -> sparse.csr_array:
    """Return columns, (measurements used, k), of each group by itself: (measurements used, count k)."""
    size, k = len(columns), int(columns.shape[1])
    index = np.repeat(k * groups, k) + np.arange(columns.size) % k
    return sparse.csr_array((columns.ravel(), index, k * np.arange(size + 1)), shape=(size, count * k))


def _step(readings: FloatArray) -> float:
    """Return the step of readings that are multiples of one, 0 where they are not."""
    values = np.unique(readings)
    steps: FloatArray = (values - values[0]) / np.diff(values, append=np.inf).min()
    whole = 1 < values.size < readings.size and np.abs(steps - np.round(steps)).max() < 1e-3
    return float(np.diff(values).min()) if whole else 0.0


def _numbers(name: str, c: FloatArray) -> Sequence[float | str]:
    """Return the numbers in the words of an effect."""
    if name == "shift":
        down, right = c.tolist()
        return [abs(down), "down" if down > 0 else "up", abs(right), "right" if right > 0 else "left"]
    if name == "gain":  # g - c g is right
        return [1 / max(1 - float(c[0]), 1e-3)]
    if name == "rotation":
        return [float(np.degrees(c[0]))]
    return [1 + float(c[0])] if name == "scale" else c.tolist()


def listed(names: Sequence[str]) -> str:
    """Return sub-imagers in words, the first few of many."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return named(names[:MOST_NAMED]) + more


def named(names: Sequence[str]) -> str:
    """Return sub-imagers in words, such as "sub-imagers (0, 7), (1, 7) of type I", from their names."""
    by_type: dict[str, list[str]] = {}
    for name in names:
        lens, k, l = name.rsplit(".", 2)  # noqa: E741  (the paper's letter)
        by_type.setdefault(lens, []).append(f"({int(k)}, {int(l)})")
    word = "sub-imager" if len(names) == 1 else "sub-imagers"
    groups = [f"{', '.join(places)} of type {lens}" for lens, places in by_type.items()]
    return f"{word} {' and '.join(groups)}"
