"""What `ommatid design` shows of the best camera: rows of a table, JSON, and the front of error against cost."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.figures.saving import SCREEN_PNG, FigureFiles, log_ticks, new_figure, own_style
from ommatid.runtime.files import write_csv

from .best_camera import NEARLY, BestCamera, DesignSpace
from .mixture import PART, Evaluation, WholeMixture

SHARES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)  # of the budget, along the front
BARS = 8  # lens types, at most, whose arrays are drawn
COLUMNS = ("bits", "limit", "budget", "depth", "bound", "mixture", "camera", "cost", "mse", "information", "scene")


@dataclass(frozen=True)
class FrontPoint:
    """The best camera within one limit. limit : "cost" or "depth", that of its sensors behind their lenses, mm."""

    bits: int | None
    limit: str
    depth: float
    best: BestCamera

    @property
    def camera(self) -> WholeMixture | None:
        """The best camera of whole arrays, None where none is possible."""
        return self.best.whole[0] if self.best.whole else None

    @property
    def cost(self) -> float:
        """Cost of that camera; 0 without one."""
        return 0.0 if self.camera is None else self.best.space.cost(self.camera)


def front(space: DesignSpace, bits: int | None, budget: float) -> Iterator[FrontPoint]:
    """Yield the best cameras of several costs around a budget, then of several depths for this budget."""
    least, deepest = float(space.groups.costs.min()), float(space.depths.max())
    for share in SHARES:
        if share * budget >= least:
            yield FrontPoint(bits, "cost", deepest, space.best(share * budget, 1, NEARLY))
    for depth in sorted(set(space.depths.round(9).tolist())):
        thinner = space.thinner(depth)
        if thinner.types and budget >= float(thinner.groups.costs.min()):
            yield FrontPoint(bits, "depth", depth, thinner.best(budget, 1, NEARLY))


def words_of(amounts: Sequence[float], space: DesignSpace) -> str:
    """Return amounts of lens types in words: "1/3 + 2 x 1/4", or "1.16 x 1/3 + 1.05 x 1/4"."""
    named = [(amount, each.words) for amount, each in zip(amounts, space.types, strict=True) if amount > PART]
    return " + ".join(words if abs(amount - 1) < PART / 2 else f"{amount:.3g} x {words}" for amount, words in named)


def rows(best: BestCamera, with_edges: Sequence[float | str]) -> list[tuple[str, str]]:
    """Return the proof as rows of a table; with_edges : errors of the cameras of whole arrays, or why there is none."""
    mixture, space = best.mixture, best.space
    name, bound = _claim(best)
    which = (
        f"{len(space.types)} lens types, {best.budget:.4g} {space.unit}, windows on whole pixels, far from the edges"
    )
    lines = [
        (name, f"{bound}: {which}"),
        ("best mixture", f"{words_of(mixture.amounts.tolist(), space)}: {_value(best, mixture.found)}"),
    ]
    for number, (each, edges) in enumerate(zip(best.whole, with_edges, strict=True), 1):
        known = f"{edges:.4g} with edges" if isinstance(edges, float) else edges
        lines.append((f"{number}. whole arrays", f"{words_of(each.counts, space)}: {_found(best, each)}; {known}"))
    if not best.whole:
        lines.append(("whole arrays", "none fit the sensor"))
    if space.own is not None:
        cost = space.cost(space.own)
        others = "" if abs(cost / best.budget - 1) < PART else f", which costs {cost:.3g} {space.unit}"
        lines.append(("the scene's camera", f"{words_of(space.own.counts, space)}{others}: {_found(best, space.own)}"))
    if space.scene.camera.tolerance is not None:
        lines.append(("tolerance", "counts in the errors with edges; the bound is that of lenses in their places"))
    by_reason = groupby(sorted(space.refused.items(), key=lambda each: each[1]), key=lambda each: each[1])
    return lines + [(f"not {', '.join(name for name, _ in named)}", reason) for reason, named in by_reason]


def bits_row(bits: int, best: BestCamera) -> tuple[str, str]:
    """Return the best camera of so many bits as a row of a table."""
    camera = best.whole[0] if best.whole else None
    found = "no camera" if camera is None else f"{words_of(camera.counts, best.space)}: {_found(best, camera)}"
    return f"{bits} bits", found


def wish_row(error: float, least: float, best: BestCamera) -> tuple[str, str]:
    """Return what a wish for an error costs as a row of a table; least : cost below which no mixture has it."""
    cost, unit = best.space.cost(best.whole[0]), best.space.unit
    return f"an error of {error:g}", f"takes {cost:.3g} {unit} by whole arrays; no mixture has it below {least:.3g}"


def _claim(best: BestCamera) -> tuple[str, str]:
    """Return the bound in words: what no camera does, and the number."""
    goal, bound = best.space.groups.goal, best.mixture.bound
    if goal == "information":
        return "no such camera holds more than", f"{-bound:.4g} bits of information per pixel"
    return "no such camera is better than", f"MSE {bound:.4g}{' in waves below four pixels' * (goal == 'resolution')}"


def _value(best: BestCamera, found: Evaluation) -> str:
    return (
        f"{-found.value:.4g} bits of information per pixel"
        if best.space.groups.goal == "information"
        else f"{found.value:.4g}"
    )


def _found(best: BestCamera, each: WholeMixture) -> str:
    """Return what a camera brings in words, and how it differs from the bound."""
    above, goal = best.above(each.found), best.space.groups.goal
    if goal == "information":
        return f"{_value(best, each.found)}, {above:.1%} below; error {each.found.error:.4g}"
    differs = f"{abs(above):.1%} {'above' if above >= 0 else 'below'}" if above < 1 else f"{above + 1:.3g} times that"
    return f"{_value(best, each.found)}, {differs}; {best.space.information(each):.3g} bits of information per pixel"


def describe(best: BestCamera, with_edges: Sequence[float | str]) -> dict[str, Any]:
    """Return the proof in JSON's types; with_edges : as of `rows`."""
    space, mixture = best.space, best.mixture
    sign = -1 if space.groups.goal == "information" else 1

    def described(each: WholeMixture) -> dict[str, Any]:
        found = {"mse": each.found.error, "information": space.information(each), "value": sign * each.found.value}
        return {"arrays": list(each.counts), **found, "above": best.above(each.found)}

    return {
        "goal": space.groups.goal,
        "types": [each.words for each in space.types],
        "depths": space.depths.tolist(),
        "costs": space.groups.costs.tolist(),
        "cost_unit": space.unit,
        "budget": best.budget,
        "bound": sign * mixture.bound,
        "mixture": {
            "arrays": mixture.amounts.tolist(),
            "value": sign * mixture.found.value,
            "mse": mixture.found.error,
            "gap": mixture.gap,
        },
        "cameras": [
            {**described(each), "with_edges": edges if isinstance(edges, float) else None}
            for each, edges in zip(best.whole, with_edges, strict=True)
        ],
        "own": space.own and described(space.own),
        "refused": space.refused,
    }


def write_front(path: Path, points: Sequence[FrontPoint], scenes: Sequence[str]) -> None:
    """Write the front as CSV, a line per limit; scenes : files of the best cameras, "" where there is none."""
    lines: list[tuple[object, ...]] = []
    for point, name in zip(points, scenes, strict=True):
        best, camera = point.best, point.camera
        space, limit = best.space, (point.bits, point.limit, best.budget, point.depth)
        mixture = best.mixture.bound, words_of(best.mixture.amounts.tolist(), space)
        if camera is None:
            lines.append((*limit, *mixture, *([None] * 4), name))
            continue
        found = point.cost, camera.found.error, space.information(camera)
        lines.append((*limit, *mixture, words_of(camera.counts, space), *found, name))
    write_csv(path, COLUMNS, lines)


@own_style()
def draw_front(path: Path, points: Sequence[FrontPoint], best: BestCamera, files: FigureFiles = SCREEN_PNG) -> None:
    """Draw error against cost and against depth, the arrays of the best cameras, and what they recover of each wave."""
    figure = new_figure(11, 8, layout="constrained")
    (by_cost, by_depth), (arrays, waves) = figure.subplots(2, 2)
    figure.suptitle(_sentence(best), fontsize=11)
    several = len({point.bits for point in points}) > 1
    for number, (bits, alike) in enumerate(groupby(points, key=lambda point: point.bits)):
        of_bits, style = list(alike), {"color": f"C{number}"}
        label = f"{bits} bits: " if several else ""
        by_limit = {limit: [each for each in of_bits if each.limit == limit] for limit in ("cost", "depth")}
        mixtures = [(point.best.budget, point.best.mixture.found.error) for point in by_limit["cost"]]
        made = [(point.cost, each.found.error) for point in by_limit["cost"] if (each := point.camera)]
        thin = [(point.depth, each.found.error) for point in by_limit["depth"] if (each := point.camera)]
        _draw_line(by_cost, mixtures, "-", label=f"{label}best mixture", **style)
        _draw_line(by_cost, made, "o", label=f"{label}whole arrays", **style)
        _draw_line(by_depth, thin, "o-", drawstyle="steps-post", label=f"{label}whole arrays", **style)
    space, own = best.space, best.space.own
    if own is not None:
        by_cost.plot(space.cost(own), own.found.error, "k*", markersize=11, label="the scene's camera")
    by_cost.set(xscale="log", yscale="log", xlabel=f"cost, {space.unit}", ylabel="expected squared error")
    by_depth.set(yscale="log", xlabel="sensor behind its lenses, at most, mm", ylabel="expected squared error")
    for axis in (by_cost.xaxis, by_cost.yaxis, by_depth.yaxis):
        log_ticks(axis)
    by_cost.legend(fontsize=8)
    by_depth.legend(fontsize=8)
    _draw_arrays(arrays, best)
    _draw_waves(waves, best)
    files.replace(figure, path)


def _draw_line(axes: Any, points: Sequence[tuple[float, float]], form: str, **style: Any) -> None:
    axes.plot([x for x, _ in points], [y for _, y in points], form, **style)


def _sentence(best: BestCamera) -> str:
    """Return what the figure shows in a sentence of two lines."""
    name, bound = _claim(best)
    kind = "" if best.space.groups.goal == "information" else "MSE "
    made = f"{words_of(best.whole[0].counts, best.space)}: {kind}{_found(best, best.whole[0])}\n" if best.whole else ""
    types = f"{len(best.space.types)} lens types, {best.budget:.4g} {best.space.unit}"
    return f"{made}{name} {bound} ({types})"


def _named(best: BestCamera) -> Iterator[tuple[str, Sequence[float]]]:
    """Yield the arrays of the best mixture, the best camera and the scene's own, by name."""
    yield "best mixture", best.mixture.amounts.tolist()
    if best.whole:
        yield "best camera", best.whole[0].counts
    if best.space.own is not None:
        yield "the scene's camera", best.space.own.counts


def _draw_arrays(axes: Any, best: BestCamera) -> None:
    named = list(_named(best))
    most = np.max([amounts for _, amounts in named], axis=0)
    shown = [int(index) for index in np.argsort(-most)[:BARS] if most[index] > PART]
    shown.sort()
    height = 0.8 / len(named)
    for number, (name, amounts) in enumerate(named):
        places = np.arange(len(shown)) + (number - (len(named) - 1) / 2) * height
        axes.barh(places, [amounts[index] for index in shown], height, label=name)
    axes.set_yticks(range(len(shown)), [best.space.types[index].words for index in shown])
    axes.invert_yaxis()
    axes.set(xlabel="arrays of each lens type")
    axes.legend(fontsize=8)


def _draw_waves(axes: Any, best: BestCamera) -> None:
    for name, amounts in _named(best):
        errors = best.space.groups.errors(np.array(amounts, dtype=np.float64))[0]
        axes.plot(np.arange(errors.size) / (2 * errors.size), errors, label=name)
    axes.set(
        yscale="log", xlabel="waves along a row, periods per pixel of f", ylabel="expected squared error of a wave"
    )
    axes.legend(fontsize=8)
