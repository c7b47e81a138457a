"""The views of a lens type's sub-imagers from the rows of H of a chart: as few numbers as explain them.

The centroid of a row moves as the view does, exactly so while the row is whole, so that the numbers of a view follow
from those of its pixels by linear least squares. Some of the numbers may be the lens type's, the same for all of its
sub-imagers, or as designed: from four numbers of each sub-imager and the type's distortion, step by step, tests against
the scatter of the batches remove what the centroids do not need. Rows of different pixels share no rays, so that the
covariance is that of independent centroids whose variances the batches show (sandwich estimator: White 1980,
Econometrica 48, 817).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse, special

from ommatid.runtime.arrays import BoolArray, FloatArray, IntArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.fitted_matrix import Views
from ommatid.scenes.fitted.view import (
    COLUMN,
    COUNT,
    K1,
    MAGNIFICATION,
    ROTATION,
    ROW,
    designed,
    displacements,
    entries,
    offsets,
    scales,
)
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.shrinkage import shrink_variances

from .chart import ChartRows

STRAIGHT = 1e-4  # rad, and relative of k1: below, footprints are boxes to within 0.1 ray of 1024
SIGNIFICANCE = 0.01  # of all tests of a kind together, at which a correct model is rejected
STEPS = 12  # of Gauss and Newton; 2 but where views are displaced by more than a pixel of f, or rotated
SETTLED = 0.01  # of a ray's share of a centroid, below which another step changes nothing
LEAST_LIGHT = 0.3  # of a pixel's rays that have to meet the target for its centroid to be used, and
LOST = 0.02  # of them that may miss it where footprints are no boxes as designed
MOVE = 0.05  # pixels of f, for derivatives of rows
DARK = 1e-9  # added to the squares of these derivatives, which are 0 for a pixel without light
NEAR = 0.05  # pixels of f from the target's edge to that of a footprint, within which centroids move unevenly
REDUCTIONS = (
    ((K1,), "designed"),
    ((ROTATION,), "shared"),
    ((ROTATION,), "designed"),
    ((MAGNIFICATION,), "shared"),
    ((MAGNIFICATION,), "designed"),
    ((ROW, COLUMN), "designed"),
)
Interval = tuple[FloatArray, float]  # where boxes begin, and how long they are
Structure = tuple[str, ...]  # of each number "own", "shared" or "designed"
SHIFTS: Structure = ("own", "own", "designed", "designed", "designed")
FREE: Structure = ("own", "own", "own", "own", "shared")  # distortion is the lens type's


def predicted(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Return the rows of H of the chart's pixels by the numbers of the view: (pixels, W, V)."""
    return (_boxes if has_boxes(sub, numbers) else _exact)(camera, sub, numbers, chart)


def has_boxes(sub: SubImager, numbers: FloatArray) -> bool:
    """Return True if all footprints of a view are boxes, or nearly so."""
    return abs(numbers[ROTATION]) <= STRAIGHT and abs(numbers[K1]) <= STRAIGHT and _designed_boxes(sub)


def _designed_boxes(sub: SubImager) -> bool:
    """Return True if all footprints of a view are boxes as designed."""
    return not sub.rotation and sub.type.optics.distortion is None


def _boxes(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Take every footprint for a box, displaced as its middle is by rotation and distortion."""
    shares = [
        _overlap(start, width, first, size)
        for (start, width), first, size in zip(
            _intervals(camera, sub, numbers, chart), (chart.row, chart.column), chart.values.shape[1:], strict=True
        )
    ]
    return shares[0][:, :, None] * shares[1][:, None, :]


def _intervals(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> list[Interval]:
    """Return where these boxes begin, in rows and in columns of f, (pixels,) each, and how long they are."""
    down, across = offsets(sub, (chart.down, chart.across))
    moved = (numbers - designed(sub)) * (np.arange(numbers.size) != MAGNIFICATION)
    rows, columns = (each @ moved for each in displacements(camera, sub, (chart.down, chart.across)))
    growth = 1 + float(numbers[MAGNIFICATION])
    widths = [float(side) / growth for side in sub.type.footprint]
    return [
        (centre + offset / growth + move - width / 2, width)
        for centre, offset, move, width in zip(
            sub.type.middle(sub.window), (down, across), (rows, columns), widths, strict=True
        )
    ]


def _overlap(start: FloatArray, width: float, first: IntArray, size: int) -> FloatArray:
    """Return the shares of `size` cells from `first` on in intervals from `start` on: (pixels, size)."""
    cells = first[:, None] + np.arange(size)
    shared = np.minimum(start[:, None] + width, cells + 1.0) - np.maximum(start[:, None], cells)
    return np.maximum(shared, 0.0) / width


def _exact(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> FloatArray:
    """Take the exact areas of overlap."""
    rows = _rows(camera, sub, numbers, chart)
    cells = np.repeat(np.arange(chart.row.size), np.diff(rows.indptr))
    row, column = np.divmod(rows.indices.astype(np.int64), camera.columns)
    row, column = row - chart.row[cells], column - chart.column[cells]
    values = np.zeros_like(chart.values)
    inside = (row >= 0) & (row < values.shape[1]) & (column >= 0) & (column < values.shape[2])
    values[cells[inside], row[inside], column[inside]] = rows.data[inside]
    return values


def _rows(camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows) -> sparse.csr_array:
    """Return the exact rows of H of the chart's pixels, over the light that they receive: (pixels, N)."""
    rows = entries(camera, sub, numbers)[(chart.down * sub.type.pixels[1] + chart.across).astype(np.int64)]
    return sparse.csr_array(rows / float(sub.type.light))


def _expected(
    camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows, intervals: list[Interval]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the light and the centroids of the chart's pixels, (pixels,) each, also outside the chart's windows."""
    if has_boxes(sub, numbers):
        shares, middles = list[FloatArray](), list[FloatArray]()
        for (start, width), size in zip(intervals, camera.shape, strict=True):
            first, last = np.maximum(start, 0), np.minimum(start + width, size)
            shares.append(np.maximum(last - first, 0) / width)
            middles.append((first + last) / 2)
        return shares[0] * shares[1], middles
    rows = _rows(camera, sub, numbers, chart)
    light = rows @ np.ones(camera.unknowns)
    places = np.divmod(np.arange(camera.unknowns), camera.columns)
    return light, [rows @ (place + 0.5) / np.maximum(light, np.finfo(float).tiny) for place in places]


@dataclass(frozen=True)
class Centroids:
    """The linear problem of one sub-imager: moves of its centroids, rows first and then columns of f.

    design : (2 pixels, 5) per unit of each number, in `scales`;  moved : (2 pixels,) from the design
    variance : (2 pixels,) of these, from so many `batches`;  unseen : variance that no ray shows
    """

    design: FloatArray
    moved: FloatArray
    variance: FloatArray
    unseen: float
    batches: int


@dataclass(frozen=True)
class ViewSolution:
    """Numbers of all sub-imagers, in `scales` and from the design, for one structure.

    freedom : degrees of freedom of the variances
    """

    numbers: FloatArray
    own: FloatArray
    shared: FloatArray
    freedom: int


def fit_views(
    camera: Camera, subs: list[SubImager], charts: list[ChartRows], rays: int, *, matched: bool = False
) -> tuple[Views, dict[str, float]]:
    """Fit the views of a lens type's sub-imagers. Returns the chances of the tests of their structure, too.

    rays : per pixel, of all passes;  matched : as of `_centroids`, where entries without light are noisy, too
    """
    start = np.array([designed(sub) for sub in subs])
    smallest = np.min([scales(camera, sub) for sub in subs], axis=0)
    units = np.tile(smallest, (len(subs), 1))  # the same for all, who may share numbers

    def problems_at(numbers: FloatArray, matched: bool) -> list[Centroids]:
        moved = (numbers - start) / units
        return _shrunk(
            [
                _centroids(camera, sub, numbers[n], charts[n], units[n], rays, moved[n], matched=matched)
                for n, sub in enumerate(subs)
            ]
        )

    def iterated(
        numbers: FloatArray, structure: Structure, matched: bool
    ) -> tuple[FloatArray, list[Centroids], ViewSolution]:
        problems = problems_at(numbers, matched)
        for _ in range(STEPS):
            solution = solve(problems, structure)
            before, numbers = numbers, start + solution.numbers * units
            if np.abs((numbers - before) / units).max(initial=0.0) < SETTLED / rays:
                break
            problems = problems_at(numbers, matched)
        return numbers, problems, solve(problems, structure)

    # Of views that are far from the design, pixels at the target's edge would pass for other numbers.
    numbers, _, _ = iterated(start, SHIFTS, False)
    numbers, problems, _ = iterated(numbers, FREE, matched)
    structure, chances = _structure(problems)
    numbers, problems, solution = iterated(numbers, structure, matched)
    own, shared = (each * units[:, :, None] for each in _errors_of_design(problems, structure, solution))
    return Views(numbers, np.ones(len(subs), dtype=np.bool_), own, shared, structure), chances


def _errors_of_design(
    problems: list[Centroids], structure: Structure, solution: ViewSolution
) -> tuple[FloatArray, FloatArray]:
    """Return the factors of the errors, with those of the numbers that the structure simplifies.

    Sub-imagers whose numbers could not be told apart may differ by as much as would have gone unnoticed: the excess of
    their scatter over that of their errors, and its standard error. A number of the type that could not be told from
    the design may deviate by as much as it was measured to, or by its standard error if that is larger.
    """
    free, count = solve(problems, FREE), len(problems)
    common = solve(problems, tuple("own" if number in (ROW, COLUMN) else "shared" for number in range(COUNT)))
    own, shared = [solution.own], [solution.shared]
    for number, kind in enumerate(structure):
        if FREE[number] == "own" and kind != "own":
            variance = np.square(free.own[:, number]).sum(axis=1)
            values = free.numbers[:, number]
            if number not in (ROW, COLUMN):
                values = values - values.mean()
            between = (
                max(float((np.square(values) - variance).mean()), 0.0) + float(variance.mean()) * (2 / count) ** 0.5
            )
            own.append(_column(count, number, between**0.5))
        if number not in (ROW, COLUMN) and kind == "designed":
            error = float(np.square(common.shared[0, number]).sum()) ** 0.5
            shared.append(_column(count, number, max(abs(float(common.numbers[0, number])), error)))
    return np.concatenate(own, axis=2), np.concatenate(shared, axis=2)


def _column(count: int, number: int, deviation: float) -> FloatArray:
    """Return a factor of the error of one number: (sub-imagers, 5, 1)."""
    column = np.zeros((count, COUNT, 1))
    column[:, number] = deviation
    return column


def _shrunk(problems: list[Centroids]) -> list[Centroids]:
    """Return the problems with variances that their batches alone would leave too uncertain for tests."""
    variances = shrink_variances(np.concatenate([problem.variance for problem in problems]), problems[0].batches)
    parts = np.split(variances, np.cumsum([problem.variance.size for problem in problems])[:-1])
    return [replace(problem, variance=part + problem.unseen) for problem, part in zip(problems, parts, strict=True)]


def _centroids(
    camera: Camera,
    sub: SubImager,
    numbers: FloatArray,
    chart: ChartRows,
    units: FloatArray,
    rays: int,
    from_design: FloatArray,
    *,
    matched: bool,
) -> Centroids:
    """Return the moves of the centroids from the design, linear around these numbers.

    matched : True takes the moves that explain a row's entries best, which noise far from its light does not disturb
    """
    boxes, intervals = _designed_boxes(sub), _intervals(camera, sub, numbers, chart)
    light, expected = _expected(camera, sub, numbers, chart, intervals)
    least = LEAST_LIGHT if boxes else 1 - LOST
    kept, slopes = (light > least) & (chart.light > least), np.ones((2, light.size))
    for slope, (start, width), size in zip(slopes, intervals, camera.shape, strict=True):
        for beyond in (-start, start + width - size) if boxes else ():
            slope[beyond > 0] -= 0.0 if matched else 0.5  # of a box that the edge cuts the other end alone moves
            kept &= np.abs(beyond) > NEAR
    if matched:
        moves, scatter = _matched_moves(camera, sub, numbers, chart)
    else:
        moves = [one - other for one, other in zip(chart.centroids, expected, strict=True)]
        scatter = chart.batch_centroids
    design = np.concatenate(displacements(camera, sub, (chart.down, chart.across))) * units
    design *= slopes.ravel()[:, None]
    both = np.tile(kept, 2)
    moved = np.concatenate(moves) + design @ from_design
    count = len(scatter[0])
    variance = np.square(np.concatenate(scatter, axis=1)).sum(axis=0) / (count * (count - 1))
    # A view that moves by less than m / 2 rays of all its pixels together moves none of them across an edge.
    unseen = (float(sub.type.ratio) / (2 * rays)) ** 2 / max(kept.sum(), 1)
    return Centroids(design[both], moved[both], variance[both], unseen, count)


def _matched_moves(
    camera: Camera, sub: SubImager, numbers: FloatArray, chart: ChartRows
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Return by how much rows lie beside those of the numbers, (2, pixels), and the deviations of the batches.

    By least squares over the entries that were measured.
    """
    slopes: list[FloatArray] = []
    for number in (ROW, COLUMN):
        step = np.zeros(COUNT)
        step[number] = MOVE
        ahead, behind = (predicted(camera, sub, numbers + sign * step, chart) for sign in (1, -1))
        slopes.append((ahead - behind) / (2 * MOVE) * chart.known)
    cells = chart.values.shape[1] * chart.values.shape[2]
    along = np.stack(slopes).reshape(2, -1, cells)
    squares: FloatArray = np.einsum("ipc,jpc->pij", along, along) + DARK * np.eye(2)
    gain = np.einsum("pij,jpc->ipc", np.linalg.inv(squares), along)
    residual = (chart.values - predicted(camera, sub, numbers, chart)).reshape(-1, cells)
    batches = chart.batches.reshape(len(chart.batches), -1, cells)
    down, across = np.einsum("ipc,bpc->ibp", gain, batches)
    return np.einsum("ipc,pc->ip", gain, residual), (down, across)


def solve(problems: list[Centroids], structure: Structure) -> ViewSolution:
    """Solve for the numbers of all sub-imagers, with the factors of their errors."""
    own, shared = (np.array([each == kind for each in structure]) for kind in ("own", "shared"))
    typical = _typical(problems)
    reduced = [_reduced(problem, own, shared, typical) for problem in problems]
    size = int(shared.sum())
    common, root = np.zeros(size), np.zeros((size, size))
    if size:
        information = sum((each.rest.T @ each.rest for each in reduced), typical * np.eye(size))
        pairs = list(zip(problems, reduced, strict=True))
        slope = sum((each.rest.T @ problem.moved for problem, each in pairs), np.zeros(size))
        scatter = sum(((each.rest.T * problem.variance) @ each.rest for problem, each in pairs), np.zeros((size, size)))
        inverse = np.linalg.inv(information)
        common, root = inverse @ slope, _root(inverse @ scatter @ inverse)
    numbers = np.zeros((len(problems), COUNT))
    errors, common_errors = np.zeros((len(problems), COUNT, int(own.sum()))), np.zeros((len(problems), COUNT, size))
    for n, (problem, each) in enumerate(zip(problems, reduced, strict=True)):
        numbers[n, shared] = common
        numbers[n, own] = each.gain @ problem.moved - each.link @ common
        errors[n][own] = _root(each.covariance)
        common_errors[n][shared] = root
        common_errors[n][own] = -each.link @ root
    freedom = (problems[0].batches - 1) * max(sum(problem.moved.size for problem in problems), 1)
    return ViewSolution(numbers, errors, common_errors, freedom)


@dataclass(frozen=True)
class _Reduced:
    """A sub-imager's problem without its own numbers: own = gain moved - link shared."""

    gain: FloatArray
    link: FloatArray
    rest: FloatArray
    covariance: FloatArray


def _reduced(problem: Centroids, own: BoolArray, shared: BoolArray, typical: float) -> _Reduced:
    mine, others = problem.design[:, own], problem.design[:, shared]
    # A number that the centroids do not determine stays within a pixel of f of its design, and as uncertain.
    inverse = np.linalg.inv(mine.T @ mine + typical * np.eye(mine.shape[1]))
    gain = inverse @ mine.T
    link = gain @ others
    covariance = (gain * problem.variance) @ gain.T + np.square(typical) * inverse @ inverse
    return _Reduced(gain, link, others - mine @ link, covariance)


def _typical(problems: list[Centroids]) -> float:
    """Return the mean variance of a centroid."""
    total = sum(problem.variance.size for problem in problems)
    return float(sum(problem.variance.sum() for problem in problems)) / max(total, 1) or 1.0


def _structure(problems: list[Centroids]) -> tuple[Structure, dict[str, float]]:
    """Remove numbers one after the other, as long as F tests allow it. Returns their chances too."""
    structure, chances = FREE, dict[str, float]()
    current = solve(problems, structure)
    for numbers, kind in REDUCTIONS:
        changed = tuple(kind if number in numbers else each for number, each in enumerate(structure))
        if kind == "designed" and any(structure[number] == "own" for number in numbers) and numbers != (ROW, COLUMN):
            continue  # each sub-imager needs its own
        if numbers == (ROW, COLUMN) and any(each != "designed" for each in structure[2:]):
            continue  # nothing simpler: the box footprints are displaced anyway
        chance = _chance(current, numbers, kind)
        chances[f"{' and '.join(NAMES[number] for number in numbers)} {kind}"] = chance
        if chance >= SIGNIFICANCE / len(REDUCTIONS):
            structure = changed
            current = solve(problems, structure)
    return structure, chances


def _chance(solution: ViewSolution, numbers: tuple[int, ...], kind: str) -> float:
    """Return the probability of numbers that differ as much if they are the same, or as designed (Wald's test)."""
    squares, freedom = 0.0, 0
    for number in numbers:
        values, variance = solution.numbers[:, number], np.square(solution.own[:, number]).sum(axis=1)
        common = float(np.square(solution.shared[0, number]).sum())
        if kind != "shared" and not variance.any():
            values, variance = values[:1], np.array([common])
        known = variance > 0  # centroids of a single pixel may depend on no number
        values, variance = values[known], variance[known]
        if kind == "shared" and values.size:
            weights = 1 / variance
            values = values - float(weights @ values / weights.sum())
            freedom -= 1
        squares += float((np.square(values) / variance).sum())
        freedom += values.size
    return float(special.fdtrc(freedom, solution.freedom, squares / freedom)) if freedom else 1.0


NAMES = ("row", "column", "magnification", "rotation", "k1")


def _root(covariance: FloatArray) -> FloatArray:
    """Return a square root of a covariance matrix that may be singular."""
    values, axes = np.linalg.eigh(covariance)
    return axes * np.sqrt(np.maximum(values, 0.0))
