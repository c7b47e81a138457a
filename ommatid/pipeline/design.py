"""`ommatid design`: the best camera of some lens types with its proof, its front and its scene files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ommatid.analysis import design_report, steering
from ommatid.analysis.best_camera import BestCamera, candidates, design_space
from ommatid.analysis.design import magnifications
from ommatid.analysis.design_report import FrontPoint, words_of
from ommatid.analysis.predict import predict_scene
from ommatid.figures.saving import FigureFiles
from ommatid.reconstruct.output.result_files import ESTIMATE, read_estimate
from ommatid.runtime.errors import InputError, shortened
from ommatid.runtime.files import make_folder
from ommatid.runtime.progress import Progress
from ommatid.scenes.scene import Scene, with_tables, write
from ommatid.scenes.tables.estimation import DesignTable
from ommatid.scenes.tables.sensor import NoiseTable

Rows = list[tuple[str, str]]
Item = TypeVar("Item")


def prove_best_camera(
    scene: Scene, folder: Path | None, figures: FigureFiles, progress: Progress
) -> tuple[dict[str, Any], Rows]:
    """Choose the best camera of the lens types of [design]; return the proof in JSON's types and as rows of a table.

    folder : of the scene files of the best cameras, the front and its figure, None to write none
    Raises InputError where no bound is known, or an error is out of reach.
    """
    table = scene.design or DesignTable()
    wanted = candidates(scene, magnifications(table.magnifications))
    compared = table.bits or (None,)
    step = _Steps(progress, len(compared) * (2 + (folder is not None) * (len(design_report.SHARES) + len(wanted))) + 3)
    spaces = {bits: design_space(_with_bits(scene, bits), wanted) for bits in step(compared)}
    found, wishes, missed = dict[int | None, BestCamera](), dict[int | None, tuple[str, str]](), Rows()
    for bits, space in step(spaces.items()):
        if table.error is None:
            found[bits] = space.best(space.budget)
            continue
        try:
            least, found[bits] = space.cheapest(table.error)
            wishes[bits] = design_report.wish_row(table.error, least, found[bits])
        except InputError:
            if bits == max(spaces, key=lambda each: each or 0):
                raise
            missed.append((f"{bits} bits", f"an error of {table.error:g} is out of reach"))
    chosen = min(found, key=lambda bits: _rank(found[bits], bits, table.error is not None))
    best = found[chosen]
    made, with_edges = list[Scene | None](), list[float | str]()
    for each in step(best.whole):
        try:
            made.append(None)
            made[-1] = camera = best.space.camera(each.counts)
            with_edges.append(predict_scene(camera, rays=scene.camera.tolerance is not None, picture=False).mse)
        except InputError as error:
            with_edges.append(str(error).removeprefix(f"{scene.source}: "))
    lines = [wishes[chosen]] if chosen in wishes else []
    lines += design_report.rows(best, with_edges)
    lines += missed + [design_report.bits_row(bits, each) for bits, each in found.items() if bits is not None]
    if folder is not None:
        points = [
            point for bits, each in found.items() for point in step(design_report.front(each.space, bits, each.budget))
        ]
        make_folder(folder)
        files = _write_cameras(folder, best, made, chosen)
        design_report.write_front(folder / "front.csv", points, [_file(folder, point, files) for point in points])
        design_report.draw_front(folder / "front.png", points, best, figures)
    progress(1.0)
    return {"bits": chosen, **design_report.describe(best, with_edges)}, lines


def _write_cameras(
    folder: Path, best: BestCamera, cameras: Iterable[Scene | None], bits: int | None
) -> dict[tuple[int | None, str], str]:
    """Write the scene files of the best cameras, and return their names by bits and lens types."""
    files = dict[tuple[int | None, str], str]()
    for number, (each, camera) in enumerate(zip(best.whole, cameras, strict=True), 1):
        if camera is not None:
            files[bits, words_of(each.counts, best.space)] = f"camera{number}.toml"
            write(folder / f"camera{number}.toml", camera)
    return files


@dataclass
class _Steps:
    """Yields the items of several lists, and tells `progress` after each, of about `count` in all."""

    progress: Progress
    count: int
    done: int = 0

    def __call__(self, items: Iterable[Item]) -> Iterator[Item]:
        for item in items:
            yield item
            self.done += 1
            self.progress(min(self.done / self.count, 1.0))


def steer_windows(
    scene: Scene, weighted: str, folder: Path | None, figures: FigureFiles
) -> tuple[dict[str, Any], Rows]:
    """Place the windows of [design], and return what they bring in JSON's types and as rows of a table.

    weighted : folder of a run, whose error map are the weights;  folder : of the scene and a figure, None to write none
    Raises InputError.
    """
    region = re.fullmatch(r"(\d{1,6}),(\d{1,6}),(\d{1,6}),(\d{1,6})", weighted.replace(" ", ""))
    if region is not None:
        row, column, rows, columns = (int(each) for each in region.groups())
        weights = steering.weights_of(scene, ((row, column), (rows, columns)))
    else:
        if not Path(weighted).is_dir():
            raise InputError(f"--steer {shortened(weighted)}: expected the folder of a run, or ROW,COLUMN,ROWS,COLUMNS")
        weights = read_estimate(Path(weighted) / ESTIMATE).channels["variance"].astype(np.float64)
    steered = steering.steer(scene, weights)
    if folder is not None:
        make_folder(folder)
        write(folder / "steered.toml", steered.scene)
        steering.draw(folder / "steered.png", steered, weights, figures)
    return steering.describe(steered), steering.rows(steered)


def _rank(best: BestCamera, bits: int | None, wished: bool) -> tuple[float, float]:
    """Return what is least for the best number of bits: the value or, for a wished error, the bits that are read."""
    if not best.whole:
        return np.inf, best.mixture.found.value
    first = best.whole[0]
    return (best.space.cost(first) * (bits or 1) if wished else first.found.value), float(bits or 0)


def _with_bits(scene: Scene, bits: int | None) -> Scene:
    """Return the scene with so many bits over the same range of light."""
    if bits is None:
        return scene
    if scene.sensor is None:
        return with_tables(scene, noise=(scene.noise or NoiseTable()).model_copy(update={"bits": bits}))
    sensor, finer = scene.sensor, 2.0 ** (bits - scene.sensor.bits)
    full = None if sensor.saturation is None else max(round(sensor.saturation * finer), 1)
    changed = {"bits": bits, "gain": sensor.gain * finer, "black_level": sensor.black_level * finer, "saturation": full}
    return with_tables(scene, sensor=sensor.model_copy(update=changed))


def _file(folder: Path, point: FrontPoint, files: dict[tuple[int | None, str], str]) -> str:
    """Return the scene file of the camera of a point, "" without one; it is written unless another point has it."""
    if point.camera is None:
        return ""
    space = point.best.space
    key = point.bits, words_of(point.camera.counts, space)
    if key not in files:
        try:
            camera = space.camera(point.camera.counts)
        except InputError:
            return ""
        files[key] = f"front{len(files) + 1}.toml"
        write(folder / files[key], camera)
    return files[key]
