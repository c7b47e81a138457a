"""FIFOs, devices, sockets, folders, links and files of 10 GB in the place of every input and every output.

Devices are nodes in the campaign's folder: a fault of the program must not replace those of the machine.
"""

from __future__ import annotations

import os
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from random import Random

from ..family import RUN, SCENE, CommandCase, CommandFamily

SLOW = ("paper", "bench", "stability")
LARGE = 10 << 30  # bytes of a sparse file
INPUTS = {  # the file that is replaced, and commands that read it
    "in.toml": (("show", "in.toml"), ("run", "in.toml", "-o", "new"), ("predict", "in.toml", "--no-rays")),
    "in.exr": (
        ("reconstruct", "in.exr", "sound.npz", "-o", "new.exr"),
        ("check", "in.exr", "sound.npz"),
        ("report", "in.exr"),
    ),
    "in.npz": (("reconstruct", "sound.exr", "in.npz", "-o", "new.exr"), ("export", "in.npz", "-o", "new.npz")),
    "in.npy": (
        *(
            ("import", SCENE, "in.npy", "-o", "new.exr"),
            ("import", SCENE, "mosaic.npy", "--dark", "in.npy", "-o", "new.exr"),
        ),
        *(
            ("import", SCENE, "mosaic.npy", "--flat", "in.npy", "-o", "new.exr"),
            ("calibrate", SCENE, "--points", "in.npy", "-o", "new.npz"),
        ),
        ("show", SCENE, "--set", "target.image=in.npy"),
    ),
    "in.csv": (
        ("show", SCENE, "--set", "light.spectrum=in.csv"),
        ("calibrate", SCENE, "--points", "mosaic.npy", "--places", "in.csv", "-o", "new.npz"),
    ),
    **{
        f"in.{suffix}": (
            ("show", SCENE, "--set", f"target.image=in.{suffix}"),
            ("paper", "--image", f"in.{suffix}", "-o", "new"),
        )
        for suffix in ("png", "jpg", "tif")
    },
    **{f"in.{suffix}": (("show", SCENE, "--set", f"camera.lens.I.surfaces=in.{suffix}"),) for suffix in ("dat", "zmx")},
    "lenses/doublet.toml": (("show", SCENE, "--set", "camera.lens.I.surfaces=lenses/doublet.toml"),),
    "in.xml": (("show", SCENE, "--set", "world.file=in.xml", "--set", "target.image="),),
}
FOUND = {  # what a command finds in its folder of results
    **{
        f"{RUN}/{name}": (("report", RUN), ("report", "out"), ("run", SCENE, "-o", "out"))
        for name in (
            *("run.json", "report.html", "bench.json", "scene.toml"),
            *("stack.exr", "model.npz", "truth.exr", "estimate.exr"),
        )
    },
    "out/sweep.json": (("report", "out"),),
    "out/index.html": (("report", "out"), ("run", SCENE, "-o", "out")),
    f"{RUN}/.stack.exr.partial.npz": (("render", SCENE, "-o", "out", "--force"),),
}
OUTPUTS = {
    "new.exr": (
        ("reconstruct", "sound.exr", "sound.npz", "-o", "new.exr"),
        ("import", SCENE, "mosaic.npy", "-o", "new.exr", "--origin", "0,0"),
    ),
    "new.npz": (("calibrate", SCENE, "-o", "new.npz"), ("export", "sound.npz", "-o", "new.npz")),
    "new.xml": (("export", SCENE, "-o", "new.xml"),),
    "new.toml": (("init", "new.toml"),),
    "new.png": (("show", SCENE, "--figure", "new.png"),),
    "new": (
        ("render", SCENE, "-o", "new"),
        ("run", SCENE, "-o", "new"),
        ("paper", "-o", "new"),
        ("bench", SCENE, "-o", "new"),
        ("stability", "-o", "new"),
        ("reconstruct", "sound.exr", "sound.npz", "-o", "new"),
    ),
    "new/tiny": (("render", SCENE, "-o", "new"),),
    "new/tiny/stack.exr": (("render", SCENE, "-o", "new"),),
}


def fifo(path: Path) -> None:
    """Make a FIFO without a writer."""
    os.mkfifo(path)


def device(path: Path, number: int = 5) -> None:
    """Make a node of /dev/zero, or where that is not allowed a FIFO."""
    try:
        os.mknod(path, 0o666 | stat.S_IFCHR, os.makedev(1, number))
    except PermissionError:
        os.mkfifo(path)


def null_device(path: Path) -> None:
    """Make a node of /dev/null, or where that is not allowed a FIFO."""
    device(path, 3)


def socket_file(path: Path) -> None:
    """Make a socket that nothing listens to."""
    here = Path.cwd()
    os.chdir(path.parent)  # names of sockets are short
    try:
        with socket.socket(socket.AF_UNIX) as made:
            made.bind(path.name)
    finally:
        os.chdir(here)


def folder_there(path: Path) -> None:
    """Make an empty folder."""
    path.mkdir()


def link_loop(path: Path) -> None:
    """Make two links that name one another."""
    path.symlink_to(f"{path.name}.other")
    path.with_name(f"{path.name}.other").symlink_to(path.name)


def dangling(path: Path) -> None:
    """Make a link to a file in a folder that does not exist."""
    path.symlink_to("nowhere/at/all")


def link_to_fifo(path: Path) -> None:
    """Make a link to a FIFO."""
    fifo(path.with_name(f"{path.name}.fifo"))
    path.symlink_to(f"{path.name}.fifo")


def large(path: Path) -> None:
    """Make a file of 10 GB that takes no room."""
    with path.open("wb") as stream:
        stream.truncate(LARGE)


def empty(path: Path) -> None:
    """Make an empty file."""
    path.touch()


NOT_FILES = (fifo, device, null_device, socket_file, folder_there, link_loop, dangling, link_to_fifo)
Maker = Callable[[Path], None]


def _case(
    rng: Random, folder: Path, places: dict[str, tuple[tuple[str, ...], ...]], makers: tuple[Maker, ...]
) -> tuple[str, Maker, tuple[str, ...]]:
    name = rng.choice(sorted(places))
    make = rng.choice(makers)
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.is_dir():
        path = path / "x"
    path.unlink(missing_ok=True)
    make(path)
    return name, make, rng.choice(places[name])


def input_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of an input, which must be refused."""
    _, _, words = _case(rng, folder, INPUTS, (*NOT_FILES, large, empty))
    return CommandCase(words, refused=True)


def found_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of something in its folder of results."""
    name, _, words = _case(rng, folder, FOUND, (*NOT_FILES, large, empty))
    return CommandCase(words, outputs=("out",), finished=("out",), kept=name)


def output_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with such a file in the place of an output, which must stay."""
    name, make, words = _case(rng, folder, OUTPUTS, NOT_FILES)
    harmless = make is folder_there and (name in ("new", "new/tiny") or words[0] == "reconstruct")
    if harmless and words[0] in SLOW:
        words = ("render", SCENE, "-o", "new")
    return CommandCase(words, refused=False if harmless else None if make is dangling else True)


SPECIAL_FILES = (
    CommandFamily("special files as inputs", input_case, ()),
    CommandFamily("special files among results", found_case, ()),
    CommandFamily("special files as outputs", output_case, ()),
)
