"""Every combination of camera, size, prior, detail, noise and number of lens types.

`python -m tests.benchmarks cells` prints what `run --dry-run` says of these 4,860 cells, in some minutes: the table of
docs/frames.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from itertools import combinations, product
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import mock

import numpy as np
from skimage import data

from ommatid.batch.batch import Member
from ommatid.batch.plan import plan
from ommatid.pipeline.stages import open_member
from ommatid.runtime.errors import InputError

from ..reference.cases import DESIGNED, NEIGHBOURS, NOISE, SENSOR, THREE, scene
from .chain import PITCH
from .rows import markdown

Cell = dict[str, str | int]
FREE = 16_000_000_000  # bytes of memory, half of which the estimator may take
GLASS = Path(__file__).parents[2] / "scenes" / "lenses" / "doublet.toml"
FACTORS: dict[str, tuple[str | int, ...]] = {
    "camera": (
        *("pinholes", "thin lenses", "glass", "distorted", "misaligned", "rotated", "steered windows", "odd arrays"),
        "entries",
    ),
    "size": (19, 119, 479, 1019),
    "prior": ("independent", "exponential", "fit"),
    "detail": (1, 2, 3),
    "noise": ("even", "sensor", "quantised", "saturated", "dead pixels"),  # dead ones are those of a stack
    "types": (1, 2, 3),
}
ODD = (("2/7", (5, 2)), ("3/8", (5, 2)), ("5/12", (3, 4)))
OPTICS = {
    "glass": 'surfaces = "doublet.toml"\n',
    "distorted": "distortion = [0.02, 0]\n",
    "rotated": '[[camera.lens.sub_imager]]\nat = [1, 1]\nrotation = "0.5 deg"\n',
    "steered windows": '[[camera.lens.sub_imager]]\nat = [1, 1]\nwindow = ["1/2", "1/2"]\n',
}
RAYS = '[calibration]\nmethod = "transport"\nsamples = 256\n'
CALIBRATIONS = {
    "glass": RAYS,
    "misaligned": f'{RAYS}[camera.tolerance]\nposition = "41 nm"\n',
    "entries": f'{RAYS}fit = "none"\n',
}
PRIORS = {"independent": '[prior]\nkind = "independent"\n', "exponential": NEIGHBOURS, "fit": '[prior]\nkind = "fit"\n'}
NOISES = {"sensor": SENSOR, "quantised": f"{NOISE}bits = 8\n", "saturated": f"{NOISE}saturation = 200\n"}


def write(cell: Cell, folder: Path) -> Path:
    """Write the scene of a cell, and the files that it names."""
    camera, size = str(cell["camera"]), int(cell["size"])
    side = size * int(cell["detail"])
    if not (folder / f"{side}.npy").exists():
        seen = np.pad(data.camera(), (0, side), mode="symmetric")
        np.save(folder / f"{side}.npy", seen[304 : 304 + side, 288 : 288 + side])  # of which 4 % exceed 200
        (folder / GLASS.name).write_bytes(GLASS.read_bytes())
    width, blurred = (3 if camera == "glass" else 1), camera in ("thin lenses", "glass")
    pitch = f'pixel_pitch = "{6 * width} um"\nlens_pitch = "{max(1.0, PITCH * size) * width:g} mm"\n'
    tables = PRIORS[str(cell["prior"])], NOISES.get(str(cell["noise"]), NOISE), CALIBRATIONS.get(camera, DESIGNED)
    opened = camera == "thin lenses" or (cell["noise"] == "sensor" and not blurred)  # else a sensor counts no light
    text = scene(
        (size, size),
        "[render]\nsamples = 64\n" + "".join(tables),
        (ODD if camera == "odd arrays" else THREE)[: int(cell["types"])],
        aperture="0.4 mm" if opened else "",
        target=f'image = "{side}.npy"\ndetail = {cell["detail"]}',
        camera=pitch if blurred else f'{pitch}wavelength = "none"\n',
        optics=OPTICS.get(camera, ""),
    )
    path = folder / "cell.toml"
    path.write_text(text, encoding="utf-8")
    return path


def covering(factors: Mapping[str, tuple[str | int, ...]]) -> list[Cell]:
    """Return few cells that hold every pair of levels of two factors, chosen greedily."""
    places = [(name, level) for name, levels in factors.items() for level in levels]
    left = dict.fromkeys((one, other) for one, other in combinations(places, 2) if one[0] != other[0])
    found: list[Cell] = []
    while left:
        cell: Cell = dict(next(iter(left)))
        for name, levels in factors.items():
            held = list(cell.items())
            gains = [
                sum((one, (name, level)) in left or ((name, level), one) in left for one in held) for level in levels
            ]
            turned = [*range(len(found) % len(levels), len(levels)), *range(len(found) % len(levels))]
            cell.setdefault(name, levels[max(turned, key=gains.__getitem__)])  # of equals another one each time
        for pair in combinations([(name, cell[name]) for name in factors], 2):
            left.pop(pair, None)
        found.append(cell)
    return found


def answer(cell: Cell, folder: Path) -> str:
    """Return what `run --dry-run` says: the method of the estimator, or the reason of a refusal."""
    member = Member(write(cell, folder), folder / "out")
    names = "ommatid.runtime.machine.free_memory", "ommatid.reconstruct.method_choice.free_memory"
    with mock.patch(names[0], return_value=FREE), mock.patch(names[1], return_value=FREE):
        try:
            described = plan(member, open_member(member))
        except InputError as error:
            return "refused for memory" if " GB" in str(error) else str(error)
    return str(described["plan"]["reconstruct"]["method"])


def table(answers: Iterable[tuple[Cell, str]]) -> str:
    """Return a table of Markdown: the number of cells by their answer, of each camera and size."""
    known = list(answers)
    heads = [said for said, _ in Counter(said for _, said in known).most_common()]
    lines: list[list[str]] = []
    for name in ("camera", "size"):
        for level in FACTORS[name]:
            counted = Counter(said for cell, said in known if cell[name] == level)
            words = f"{level} x {level}" if name == "size" else str(level)
            lines.append([words, *(str(counted[said]) for said in heads)])
    return markdown(["cells", *heads], lines)


def command(words: list[str]) -> None:
    """Print the table; `words` are none."""
    del words
    with TemporaryDirectory(prefix="ommatid-cells-") as folder:
        levels = (dict(zip(FACTORS, each, strict=True)) for each in product(*FACTORS.values()))
        print(table((cell, answer(cell, Path(folder))) for cell in levels))
