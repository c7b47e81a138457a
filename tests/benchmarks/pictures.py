"""Which pictures have correct error bars: `python -m tests.benchmarks pictures`.

Eleven kinds of picture, made by formulas, through six cameras with three noises, 8 and 12 bits, recorded by H itself
and the scene's sensor. The file of results has one line per run, so that a second start runs what is missing.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage
from skimage import data

from ommatid.pipeline.stages import checked_setup
from ommatid.reconstruct.output import result_files
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.study import FAILED, study
from ommatid.scenes.scene import Scene, parse
from ommatid.simulate.ideal import ideal_model
from ommatid.simulate.render import exposed

from .rows import markdown, say_failed

NOISES, BITS = (0.01, 1.0, 100.0), (8, 12)
APART = 1.5  # ratio of the measured to the stated error, or its inverse, from which a green verdict is counted
LARGE = 60  # pixels from which sub-images need a wide lens pitch
MOST_SCORE = 50.0  # deviations, beyond which a score counts as this
REGIONS = ("pixel", "5 x 5", "quarter", "whole")
COLUMNS = ("runs", "inside", "above, not red", "red", "amber", "green, 1.5 above", "green, 1.5 below", *REGIONS)
PAPER = (("1/3", 3), ("1/5", 5), ("1/4", 4))
CAMERAS: dict[str, tuple[tuple[str, int], ...]] = {
    "paper": PAPER,
    "one type": PAPER[:1],
    "odd": (("2/7", 4), ("3/8", 3), ("1/4", 4)),
    "aperture": PAPER,
    "500 lux": PAPER,
    "5 lux": PAPER,
}


class Run(NamedTuple):
    """One run: the names of its picture and camera, and its numbers."""

    picture: str
    camera: str
    noise: float
    bits: int
    size: int
    seed: int


def _photo(rng: np.random.Generator, size: int) -> FloatArray:
    row, column = rng.integers(0, 512 - size, 2)
    return np.asarray(data.camera(), dtype=np.float64)[row : row + size, column : column + size]


def _stars(rng: np.random.Generator, size: int) -> FloatArray:
    image = np.full((size, size), 4.0)
    image[tuple(rng.integers(0, size, (2, max(25 * size * size // 1225, 1))))] = 250.0
    return image


def _text(rng: np.random.Generator, size: int) -> FloatArray:
    return np.where(ndimage.gaussian_filter(rng.normal(size=(size, size)), (0.7, 1.5)) > 0.35, 10.0, 240.0)


def _checker(_: np.random.Generator, size: int) -> FloatArray:
    row, column = np.indices((size, size))
    return np.where((column // 3 + row // 3) % 2, 30.0, 220.0)


def _blobs(rng: np.random.Generator, size: int) -> FloatArray:
    return 30 + 300 * ndimage.gaussian_filter(rng.normal(size=(size, size)), 4)


def _sky(rng: np.random.Generator, size: int) -> FloatArray:
    row = np.arange(size)[:, None]
    return np.where(row < 0.6 * size, 215.0, 50.0) + 3 * rng.normal(size=(size, size))


PICTURES: dict[str, Callable[[np.random.Generator, int], FloatArray]] = {
    "natural": _photo,
    "bright": lambda rng, size: 0.5 * _photo(rng, size) + 127,
    "dark": lambda rng, size: 0.15 * _photo(rng, size),
    "text": _text,
    "checker": _checker,
    "stars": _stars,
    "ramp": lambda _, size: np.broadcast_to(20 + 200 * np.arange(size) / size, (size, size)),
    "flat": lambda rng, size: np.full((size, size), rng.uniform(20, 220)),
    "blobs": _blobs,
    "noise": lambda rng, size: 127 + 60 * rng.normal(size=(size, size)),
    "sky": _sky,
}


def picture(run: Run, size: int) -> FloatArray:
    """Return the picture of a run: (size, size)."""
    rng = np.random.default_rng([run.seed, [*PICTURES].index(run.picture)])
    return np.clip(PICTURES[run.picture](rng, size), 0.0, 255.0)


def described(run: Run, path: Path) -> Scene:
    """Return the scene of a run; path : of its picture."""
    glass, counts = run.camera == "aperture" or "lux" in run.camera, "lux" in run.camera
    optics = {"aperture": "0.4 mm"} if glass else {}
    lenses = [
        {"name": name, "magnification": magnification, "array": [side, side], "pixels": "fit", **optics}
        for name, (magnification, side) in zip(("I", "II", "III"), CAMERAS[run.camera], strict=False)
    ]
    pitch = "50 mm" if run.size > LARGE else "1 mm"
    camera: dict[str, Any] = {"pixel_pitch": "6 um", "lens_pitch": pitch, "lens": lenses}
    target = {"image": str(path), "shape": [run.size, run.size], "pixel_pitch": "1 mm", "distance": "1 m"}
    tables: dict[str, Any] = {
        "target": target | {"detail": detail_of(run)},
        "camera": camera | ({"wavelength": "550 nm"} if glass else {}),
        "render": {"samples": 256, "seed": run.seed},
        "calibration": {"method": "ideal"},
    }
    if counts:
        tables["sensor"] = {
            "illuminance": run.camera,
            "exposure": "4 ms",
            "quantum_efficiency": 0.6,
            "full_well": 10000,
            "dark_current": 20,
            "read_noise": 2.5 * run.noise**0.5,
            "dsnu": 1,
            "prnu": 0.01,
            "gain": 0.4 * 2.0 ** (run.bits - 12),
            "black_level": 2 ** (run.bits - 6),
            "bits": run.bits,
        }
    else:
        tables["noise"] = {"variance": run.noise, "bits": run.bits}
    return parse(tables, Path("pictures.toml"))


def detail_of(run: Run) -> int:
    """Return by how much the world of a run is finer than f."""
    return 2 if run.camera == "aperture" else 1


def measured(run: Run, folder: Path) -> dict[str, Any]:
    """Record and reconstruct the picture of a run, and return its errors, its verdict, and the scores of regions."""
    world, path = picture(run, run.size * detail_of(run)), folder / "picture.npy"
    np.save(path, world.astype(np.float32))
    setup = checked_setup(described(run, path))
    model = ideal_model(setup.calibrated.scene, setup.calibrated.camera)
    light = model.forward(setup.calibrated.image.astype(np.float64).ravel())
    stack = exposed(setup, light, np.zeros(light.size), {"seed": run.seed, "first_seed": run.seed})
    found, report = result_files.reconstruct(stack, model, world.ravel(), (Path("stack"), Path("model")))
    truth = world.reshape(run.size, detail_of(run), run.size, detail_of(run)).mean(axis=(1, 3))
    half, interval, error = run.size // 2, report.error.expected_given_truth, report.error
    regions = ((half, 1), (half - 2, 5), (0, half), (0, run.size))
    scores: list[float] = []
    for first, side in regions:
        mean, deviation = found.region((first, first), (side, side))
        scores.append((mean - float(truth[first : first + side, first : first + side].mean())) / deviation)
    return {
        "stated": error.predicted_mse,
        "mse": error.mse,
        "interval": None if interval is None else [interval.low, interval.high],
        "level": report.verdict.level,
        "scores": scores,
    }


def row(found: Sequence[dict[str, Any]]) -> list[str]:
    """Return a row of the table: counts, and the root mean squares of scores."""
    known = [each for each in found if each["interval"] is not None]
    ratio = np.sqrt([each["mse"] / each["stated"] for each in found])
    green = np.array([each["level"] == "green" for each in found])
    scores = np.clip([each["scores"] for each in found], -MOST_SCORE, MOST_SCORE)
    counts = (
        sum(each["interval"][0] <= each["mse"] <= each["interval"][1] for each in known),
        sum(each["mse"] > each["interval"][1] and each["level"] != "red" for each in known),
        *(sum(each["level"] == level for each in found) for level in ("red", "amber")),
        int(np.sum(green & (ratio > APART))),
        int(np.sum(green & (ratio < 1 / APART))),
    )
    return [str(len(found)), *map(str, counts), *(f"{each:.2f}" for each in np.sqrt(np.mean(scores**2, axis=0)))]


def table(every: Iterable[dict[str, Any]]) -> str:
    """Return the table of results in Markdown, by camera and by picture."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for each in every:
        for name in ("all", each["camera"], each["picture"]):
            groups[name].append(each)
    names = [name for name in ("all", *CAMERAS, *PICTURES) if name in groups]
    return markdown(["pictures", *COLUMNS], ([name, *row(groups[name])] for name in names))


def runs(size: int, seeds: int, cameras: Sequence[str]) -> Iterator[Run]:
    """Yield the runs of a size, seed by seed."""
    for seed, camera, noise, bits, name in product(range(seeds), cameras, NOISES, BITS, PICTURES):
        yield Run(name, camera, noise, bits, size, seed)


def command(arguments: Sequence[str]) -> None:
    """Run the benchmark with the options of its command line."""
    parser = ArgumentParser("python -m tests.benchmarks pictures", description="Which pictures have correct errors.")
    parser.add_argument("-o", "--out", type=Path, default=Path("pictures.jsonl"), help="file of the results")
    parser.add_argument("--size", type=int, default=19, help="rows and columns of f; default: 19")
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="runs of every cell; default: 5")
    parser.add_argument("--cameras", default=",".join(CAMERAS), metavar="NAME,...", help="default: all")
    options = parser.parse_args(arguments)
    listed = [run._asdict() for run in runs(options.size, options.seeds, options.cameras.split(","))]
    with TemporaryDirectory(prefix="ommatid-") as folder:
        found = study(options.out, listed, lambda cell: measured(Run(**cell), Path(folder)), say_failed, Exception)
    print(table(row for row in found if FAILED not in row))
