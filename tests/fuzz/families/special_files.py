"""FIFOs, devices, sockets, folders, links and files of 10 GB in the place of every input and every output.

Devices are nodes in the campaign's folder: a fault of the program must not replace those of the machine.
"""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from random import Random

from ..family import PARTIAL, RUN, SCENE, CommandCase, CommandFamily

SLOW = ("paper", "bench", "stability")
LARGE = 10 << 30  # bytes of a sparse file
Commands = tuple[tuple[str, ...], ...]


def showing(key: str, *names: str) -> dict[str, Commands]:
    """Return commands that read files which a scene names."""
    return {name: (("show", SCENE, "--set", f"{key}={name}"),) for name in names}


INPUTS: dict[str, Commands] = {  # the file that is replaced, and commands that read it
    "in.toml": (("show", "in.toml"), ("run", "in.toml", "-o", "new"), ("predict", "in.toml", "--no-rays")),
    "in.exr": (
        *(("report", "in.exr"), ("check", "in.exr", "sound.npz")),
        ("reconstruct", "in.exr", "sound.npz", "-o", "new.exr"),
    ),
    "in.npz": (("reconstruct", "sound.exr", "in.npz", "-o", "new.exr"), ("export", "in.npz", "-o", "new.npz")),
    "in.npy": (
        *(("import", SCENE, "mosaic.npy", option, "in.npy", "-o", "new.exr") for option in ("--dark", "--flat")),
        *(("import", SCENE, "in.npy", "-o", "new.exr"), ("show", SCENE, "--set", "target.image=in.npy")),
        ("calibrate", SCENE, "--points", "in.npy", "-o", "new.npz"),
    ),
    "places.csv": (("calibrate", SCENE, "--points", "mosaic.npy", "--places", "places.csv", "-o", "new.npz"),),
    **{f"paper.{suffix}": (("paper", "--image", f"paper.{suffix}", "-o", "new"),) for suffix in ("png", "jpg", "tif")},
    "in.xml": (("show", SCENE, "--set", "world.file=in.xml", "--set", "target.image="),),
    **showing("light.spectrum", "in.csv"),
    **showing("target.image", "in.png", "in.jpg", "in.tif"),
    **showing("camera.lens.I.surfaces", "in.dat", "in.zmx", "lenses/doublet.toml"),
}
AGAIN = ("run", SCENE, "-o", "out")
RUN_FILES = (
    *("run.json", "report.html", "bench.json", "scene.toml"),
    *("stack.exr", "model.npz", "truth.exr", "estimate.exr"),
)
FOUND: dict[str, Commands] = {  # what a command finds in its folder of results
    **{f"{RUN}/{name}": (("report", RUN), ("report", "out"), AGAIN) for name in RUN_FILES},
    "out/sweep.json": (("report", "out"),),
    "out/index.html": (("report", "out"), AGAIN),
    PARTIAL: (("render", SCENE, "-o", "out", "--force"),),
}
RENDER = ("render", SCENE, "-o", "new")
OUTPUTS: dict[str, Commands] = {
    "new.exr": (
        ("reconstruct", "sound.exr", "sound.npz", "-o", "new.exr"),
        ("import", SCENE, "mosaic.npy", "-o", "new.exr", "--origin", "0,0"),
    ),
    "new.npz": (("calibrate", SCENE, "-o", "new.npz"), ("export", "sound.npz", "-o", "new.npz")),
    "new.xml": (("export", SCENE, "-o", "new.xml"),),
    "new.toml": (("init", "new.toml"),),
    "new.png": (("show", SCENE, "--figure", "new.png"),),
    "new": (
        *(RENDER, ("run", SCENE, "-o", "new"), ("reconstruct", "sound.exr", "sound.npz", "-o", "new")),
        *(("paper", "-o", "new"), ("bench", SCENE, "-o", "new"), ("stability", "-o", "new")),
    ),
    "new/tiny": (RENDER,),
    "new/tiny/stack.exr": (RENDER,),
}


def device(path: Path, number: int) -> None:
    """Make a node of a device like /dev/zero, or where that is not allowed a FIFO."""
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, number))
    except PermissionError:
        os.mkfifo(path)


def socket_file(path: Path) -> None:
    """Make a socket that nothing listens to."""
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as made:  # names of sockets are short
        made.bind(path.name)


def link(path: Path, make: Callable[[Path], None]) -> None:
    """Make a link to what is made beside it."""
    path.symlink_to(f"{path.name}.other")
    make(path.with_name(f"{path.name}.other"))


def large(path: Path) -> None:
    """Make a file of 10 GB that takes no room."""
    path.touch()
    os.truncate(path, LARGE)


Maker = Callable[[Path], None]
FOLDER, DANGLING, EMPTY = "folder", "link to nothing", "empty file"
NOT_FILES: dict[str, Maker] = {
    "FIFO": os.mkfifo,
    "/dev/zero": lambda path: device(path, 5),
    "/dev/null": lambda path: device(path, 3),
    "socket": socket_file,
    FOLDER: Path.mkdir,
    "links in a circle": lambda path: link(path, lambda other: other.symlink_to(path.name)),
    DANGLING: lambda path: path.symlink_to("nowhere/at/all"),
    "link to a FIFO": lambda path: link(path, os.mkfifo),
}
BAD_FILES: dict[str, Maker] = {
    **NOT_FILES,
    EMPTY: Path.touch,
    "10 GB": large,
}


def replaced(
    rng: Random, folder: Path, places: dict[str, Commands], makers: dict[str, Maker]
) -> tuple[str, str, tuple[str, ...]]:
    """Put something else in the place of a file; return the file's name, what was put there, and a command."""
    name, kind = rng.choice(sorted(places)), rng.choice(sorted(makers))
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        path = path / "x"
    path.unlink(missing_ok=True)
    makers[kind](path)
    return name, kind, rng.choice(places[name])


def input_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of an input, which must be refused."""
    return CommandCase(replaced(rng, folder, INPUTS, BAD_FILES)[2], refused=True)


def found_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of something in its folder of results."""
    name, _, words = replaced(rng, folder, FOUND, BAD_FILES)
    return CommandCase(words, outputs=("out",), finished=("out",), kept=name)


def output_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of an output, which must stay."""
    name, kind, words = replaced(rng, folder, OUTPUTS, NOT_FILES)
    harmless = kind == FOLDER and (name in ("new", "new/tiny") or words[0] == "reconstruct")
    return CommandCase(
        RENDER if harmless and words[0] in SLOW else words,
        refused=False if harmless else None if kind == DANGLING else True,
    )


SPECIAL_FILES = (
    CommandFamily("special files as inputs", input_case),
    CommandFamily("special files among results", found_case),
    CommandFamily("special files as outputs", output_case),
)
