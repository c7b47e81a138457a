"""Scenes that are run with both checkouts, each as commands of `ommatid` in a folder of its own.

Gallery scenes are read by each checkout from its own gallery. All other scenes are texts of this module, so that both
read the same. Numbers of samples are fixed where the automatic ones would take minutes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

Words = tuple[str, ...]


@dataclass(frozen=True)
class Case:
    """One run: commands, the files that they read, and the folder in which they leave their results."""

    name: str
    commands: tuple[Words, ...]
    result: str  # folder of run.json, stack.exr, model.npz and estimate.exr
    files: dict[str, str] = field(default_factory=dict[str, str])  # name and text
    recorded: bool = False  # whether the folder `frames` holds recorded frames

    def write(self, folder: Path) -> None:
        """Write the files that the commands read."""
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        if self.recorded:
            record(folder / "frames")


def samples(render: int, calibration: int) -> dict[str, object]:
    """Settings of a fixed number of rays per sensor pixel."""
    return {"render.samples": render, "calibration.samples": calibration}


GALLERY: dict[str, dict[str, object]] = {
    "tile19": {},
    "tile35": samples(64, 64),
    "tile41": samples(64, 64),
    "single": samples(64, 64),
    "corridor": samples(64, 64),
    "still_life": samples(64, 64),
    "misaligned": {},
    "distorted": samples(256, 256),
    "sensor": samples(256, 256),
    "doublet": samples(256, 256),
    "planoconvex": samples(256, 256),
    "photo": samples(64, 64),
}  # and starter, the thirteenth, which `init` writes

THREE = (("1/3", (3, 3)), ("1/5", (5, 5)), ("1/4", (4, 4)))


def scene(
    shape: tuple[int, int],
    tables: str,
    lenses: tuple[tuple[str, tuple[int, int]], ...] = THREE,
    *,
    aperture: str = "",
    target: str = 'image = "photo:camera"\norigin = [16, 24]',
    camera: str = 'pixel_pitch = "6 um"\nlens_pitch = "2 mm"',
    optics: str = "",
) -> str:
    """Text of a scene file with these magnifications and arrays.

    tables : those that follow the lens types;  optics : further keys and tables of every lens type
    """
    types = "".join(
        f'\n[[camera.lens]]\nname = "{"I" * number}"\nmagnification = "{magnification}"\narray = {list(array)}\n'
        'pixels = "fit"\n' + (f'aperture = "{aperture}"\n' if aperture else "") + optics
        for number, (magnification, array) in enumerate(lenses, 1)
    )
    return (
        f'[target]\n{target}\nshape = {list(shape)}\npixel_pitch = "1 mm"\ndistance = "1 m"\n\n'
        f"[camera]\n{camera}\n{types}\n{tables}"
    )


NOISE = "[noise]\nvariance = 1e-2\n"
NEIGHBOURS = '[prior]\nkind = "exponential"\ncorrelation_length = "12.5 mm"\n'
DESIGNED = '[calibration]\nmethod = "ideal"\n'
FEW_RAYS = '[render]\nsamples = 256\n[calibration]\nmethod = "transport"\nsamples = 256\n'
SENSOR = """
[sensor]
illuminance = "500 lux"
exposure = "4 ms"
quantum_efficiency = 0.6
dark_current = 20
read_noise = 2.5
dsnu = 1
prnu = 0.01
gain = 0.4
black_level = 64
"""
FINER = 'image = "photo:camera"\norigin = [88, 216]\ndetail = 2'

VARIANTS = {
    "one-type": scene((19, 19), NOISE, THREE[:1]),
    "two-types": scene((19, 23), NOISE, THREE[:2]),
    "five-by-two": scene((27, 29), NOISE, (("2/7", (5, 2)), ("3/8", (5, 2)))),
    "sensor59": scene((59, 59), SENSOR + NEIGHBOURS + FEW_RAYS, THREE[:2], aperture="0.4 mm"),
    "detail35": scene((35, 35), NOISE + NEIGHBOURS + FEW_RAYS, aperture="0.4 mm", target=FINER),
    "frame119": scene((119, 119), NOISE),
    "frame239": scene((239, 239), NOISE + NEIGHBOURS + DESIGNED),
    "frame479": scene((479, 479), NOISE + DESIGNED),
}


def run(name: str, scene_name: str, settings: dict[str, object], files: dict[str, str], *first: Words) -> Case:
    """A case of `ommatid run`; first : commands before it."""
    words = (word for key, value in settings.items() for word in ("--set", f"{key}={value}"))
    return Case(name, (*first, ("run", scene_name, "-o", "out", "--quiet", *words)), f"out/{name}", files)


def recorded() -> Case:
    """Frames of a camera: imported as a stack, and reconstructed with the H of the design."""
    commands = (
        ("import", "recorded.toml", "frames", "-o", "stack.exr"),
        ("calibrate", "recorded.toml", "-o", "model.npz"),
        ("reconstruct", "stack.exr", "model.npz", "-o", "out", "--quiet"),
    )
    text = scene((19, 19), NOISE + DESIGNED)
    return Case("recorded", commands, "out", {"recorded.toml": text}, recorded=True)


def record(folder: Path) -> None:
    """Write the frames that the three lens types record of an image of 19 x 19 pixels, with noise and a dead pixel.

    A sensor pixel of magnification 1/m reads the mean of m x m pixels of the target. The views of an array together
    stand in the middle of the target, each a pixel beside the other.
    """
    rng = np.random.default_rng(28)
    rows, columns = np.mgrid[:19, :19]
    image = 127.5 + 60 * np.sin(rows / 3 + columns / 7) + rng.normal(0, 20, (19, 19))
    folder.mkdir()
    number = 0
    for size, array in ((3, 3), (5, 5), (4, 4)):
        pixels = (19 - array + 1) // size
        start = (19 - (pixels * size + array - 1)) // 2
        for row, column in np.ndindex(array, array):
            corner = start + row, start + column
            view = image[corner[0] : corner[0] + pixels * size, corner[1] : corner[1] + pixels * size]
            frame = view.reshape(pixels, size, pixels, size).mean(axis=(1, 3)) + rng.normal(0, 0.1, (pixels, pixels))
            if number == 7:
                frame[0, 1] = np.nan  # a dead pixel
            np.save(folder / f"{number:03}.npy", frame)
            number += 1


def all_cases() -> dict[str, Case]:
    """Every case by name, those that take long at the end."""
    cases = [run(name, name, settings, {}) for name, settings in GALLERY.items()]
    cases.append(run("starter", "starter.toml", samples(64, 64), {}, ("init", "starter.toml")))
    cases += [run(name, f"{name}.toml", {}, {f"{name}.toml": text}) for name, text in VARIANTS.items()]
    cases.append(recorded())
    return {case.name: case for case in cases}
