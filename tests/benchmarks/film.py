"""Many frames of one camera against one model, beside the bare solves of the same frames in alternation."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
from rich.table import Table

import ommatid
from ommatid.batch.frames import FrameOptions, reconstruct_frames
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.progress import no_progress
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.scenes.model import Model
from ommatid.scenes.scene import parse
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from .whole import MEAN, NOISE, Whole, compile_all, whole_scene

SIZE = 1019
COUNT = 100
FILES = 10  # frames that are read and written
SMALL = 239  # of frames whose noise differs from pixel to pixel, whose first error bars take minutes at 1019 x 1019
UNCERTAIN = 3e-3 * NOISE  # rendering variance of frames whose noise is not the same, as 17 passes estimate it
TARGET = 1.5  # times the bare solves


@dataclass(frozen=True)
class FilmRow:
    """Seconds of every frame, the first with the preparation, and of its bare solve; reused : frames with old bars."""

    name: str
    seconds: FloatArray
    solves: FloatArray
    reused: int
    difference: float

    @property
    def ratio(self) -> float:
        """Time of all frames over that of their solves."""
        return float(self.seconds.sum() / self.solves.sum())

    @property
    def later(self) -> float:
        """Median ratio of the frames after the first."""
        return float(np.median(self.seconds[1:] / self.solves[1:]))


class _Film:
    """Frames of a camera, whose solver is prepared."""

    def __init__(self, size: int) -> None:
        scene = whole_scene(size).plain() | {"noise": {"variance": NOISE}, "calibration": {"method": "ideal"}}
        self.scene = parse(scene, Path("film.toml"))
        self.camera, self.size = derive(self.scene), size
        self.model: Model = ideal_model(self.scene, self.camera)
        self._solver = Whole.drawn(size).frame()
        self.solve(Whole.drawn(size))

    def stack(self, whole: Whole, seed: int, rendering: float) -> Stack:
        """Return the stack of a frame, with estimates of a rendering variance."""
        shape, record = whole.readings.shape, {"seed": seed, "first_seed": seed, "passes": 17, "versions": {}}
        variance = rendering * np.random.default_rng(seed).chisquare(16, shape) / 16 if rendering else np.zeros(shape)
        return Stack(self.scene, self.camera, whole.readings, variance, record)

    def solve(self, whole: Whole) -> tuple[FloatArray, float]:
        """Return the estimate without error bars, and its seconds."""
        start = perf_counter()
        image = self._solver.solve(self._solver.right_hand_side(whole.residual)).image
        return image + MEAN, perf_counter() - start


def film_rows(size: int = SIZE, count: int = COUNT, files: int = FILES) -> Iterator[FilmRow]:
    """Yield the time of frames from memory, of even noise and of noise that differs a little, and from files."""
    compile_all()
    film = _Film(size)
    yield _from_memory(film, f"{size} x {size} from Python", count, 0.0)
    yield _from_files(film, files)
    yield _from_memory(_Film(SMALL), f"{SMALL} x {SMALL}, noise that differs", files, UNCERTAIN)


def _from_memory(film: _Film, name: str, count: int, rendering: float) -> FilmRow:
    reconstructor = ommatid.prepare(film.model, film.scene)
    times, reused, worst = np.empty((2, count)), 0, 0.0
    for number in range(count):
        whole = Whole.drawn(film.size, number)
        stack = film.stack(whole, number, rendering)
        image, times[1, number] = film.solve(whole)
        start = perf_counter()
        result = reconstructor(stack)
        times[0, number] = perf_counter() - start
        reused += result.summary.diagnostics.noise_difference is not None
        worst = max(worst, float(np.max(np.abs(result.image.ravel() - image) / result.deviation.ravel())))
    return FilmRow(name, times[0], times[1], reused, worst)


def _from_files(film: _Film, count: int) -> FilmRow:
    times, reused, worst = np.empty((2, count)), 0, 0.0
    with TemporaryDirectory(prefix="ommatid-") as scratch:
        folder = Path(scratch)
        stacks, model = [folder / f"{number}.exr" for number in range(count)], folder / "model.npz"
        model_file.write(model, replace(film.model, scene=film.scene))
        for number, path in enumerate(stacks):
            stack_file.write(path, film.stack(Whole.drawn(film.size, number), number, 0.0))
        start = perf_counter()
        works = reconstruct_frames(stacks, folder / "out", FrameOptions(model), None, no_progress)
        before = perf_counter() - start  # headers and fingerprints
        for number, (_, work) in enumerate(works):
            image, times[1, number] = film.solve(Whole.drawn(film.size, number))
            start = perf_counter()
            report, _ = work()
            times[0, number] = perf_counter() - start + before / count
            reused += report.diagnostics.noise_difference is not None
            estimate = _written(folder / "out" / f"{number}.exr")
            worst = max(worst, float(np.max(np.abs(estimate[0] - image) / estimate[1])))
    return FilmRow(f"{film.size} x {film.size} with files", times[0], times[1], reused, worst)


def _written(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return the estimate of a file and its standard deviation, (N,) each."""
    channels = exr.read(path)[0].channels
    return channels["estimate"].ravel().astype(float), np.sqrt(channels["variance"].ravel())


def film_table() -> Table:
    """Return the time of many frames over that of their bare solves."""
    table = Table(title="Frames against one model, over the bare solves of the same frames")
    for name in ("frames", "number", "first", "median", "bare solve", "later frames / solves", "all / solves"):
        table.add_column(name, justify="left" if name == "frames" else "right")
    for name in ("target", "error bars reused", "largest difference from the bare solve"):
        table.add_column(name, justify="right")
    for row in film_rows():
        table.add_row(
            row.name,
            str(row.seconds.size),
            f"{row.seconds[0]:.1f} s",
            f"{np.median(row.seconds):.2f} s",
            f"{np.median(row.solves):.2f} s",
            f"{row.later:.2f}",
            f"{row.ratio:.2f}",
            f"{TARGET:g}",
            str(row.reused),
            f"{row.difference:.2g} posterior standard deviations",
        )
    table.caption = "A bare solve is H^T Rv^-1 (g - H f0) and conjugate gradients with a preconditioner that is ready."
    return table
