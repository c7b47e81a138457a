"""Names of files that are not names of folders, not UTF-8, too long, or act on a terminal."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from random import Random

from ..family import SCENE, CommandCase, CommandFamily

STEMS = (
    ".", "..", "...", " ", "  .", "-", "--help", "-o", "a b", "a\tb", "a\nb", "\r", "\x1b[31mred\x1b[0m",
    "\x1b]0;x\x07", "\u202egnp", "\u200b", "é", "e\u0301", "😀", "日本語", "\udcff\udcfe", "\udcc3(", "x" * 250,
    "é" * 124, "x" * 195, "x" * 201, "~", "$HOME", "$(touch pwned)", "`touch pwned`", ";touch pwned", "%s%n", "{0}",
    "[red]", "*", "?", "con", "nul", "<script>", "\"'&", "=cmd", "@x", "run", "index", "new", "sweep", ".jobs",
    ".hidden", "a.part.b", "C:x", "a:b", "a\\b",
)  # fmt: skip
SCENE_COMMANDS = (
    *(
        ("show", "{}"),
        ("predict", "{}", "--no-rays"),
        ("render", "{}", "-o", "new"),
        ("run", "{}", "-o", "new", "--dry-run"),
    ),
    *(("calibrate", "{}", "-o", "new.npz"), ("export", "{}", "-o", "new.xml"), ("render", "{}", SCENE, "-o", "new")),
)
OUTPUT_COMMANDS = (
    *(
        ("render", SCENE, "-o", "{}"),
        ("calibrate", SCENE, "-o", "{}.npz"),
        ("export", SCENE, "-o", "{}.xml"),
        ("init", "{}.toml"),
    ),
    *(
        ("show", SCENE, "--figure", "{}.png"),
        ("export", "sound.npz", "-o", "{}.npz"),
        ("export", "sound.npz", "-o", "{}"),
    ),
    ("reconstruct", "sound.exr", "sound.npz", "-o", "{}.exr"),
)
INPUTS = {
    "{}.exr": ("sound.exr", ("reconstruct", "{}.exr", "sound.npz", "-o", "new.exr")),
    "{}.npz": ("sound.npz", ("check", "sound.exr", "{}.npz")),
    "{}.npy": ("mosaic.npy", ("import", SCENE, "{}.npy", "-o", "new.exr", "--origin", "0,0")),
    "{}.csv": ("spectrum.csv", ("show", SCENE, "--set", "light.spectrum={}.csv")),
    "{}.dat": ("lenses/planoconvex.dat", ("show", SCENE, "--set", "camera.lens.I.surfaces={}.dat")),
}


def random_stem(rng: Random) -> str:
    """Return a name, or one made of characters of several."""
    if rng.random() < 0.7:
        return rng.choice(STEMS)
    parts = "".join(rng.choice(STEMS)[:3] for _ in range(rng.randint(1, 4)))
    return parts.replace("/", "").replace("\0", "") or "."


def scene_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command on a scene of such a name."""
    name = f"{random_stem(rng)}.toml"
    command = rng.choice(SCENE_COMMANDS)
    _copied(folder, SCENE, name)
    outputs = ("new",) if len(command) > 3 else ()
    return CommandCase(_words(command, name), outputs=outputs)


def input_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command on a stack, a model, a frame, a curve or a lens of such a name."""
    stem, pattern = random_stem(rng), rng.choice(sorted(INPUTS))
    original, command = INPUTS[pattern]
    _copied(folder, original, pattern.replace("{}", stem))
    return CommandCase(_words(command, stem))


def output_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command that writes to such a name."""
    del folder
    stem = random_stem(rng)
    written = stem.encode("unicode_escape", "surrogateescape").decode()
    names = (written, os.fsdecode(os.fsencode(stem)).encode("unicode_escape", "backslashreplace").decode())
    return CommandCase(_words(rng.choice(OUTPUT_COMMANDS), stem), outputs=names)


def _words(command: tuple[str, ...], name: str) -> tuple[str, ...]:
    words = [word.replace("{}", name) for word in command]
    if any(word.startswith("-") for word in words[1:2]):
        words[1] = f"./{words[1]}"
    return tuple(words)


def _copied(folder: Path, original: str, name: str) -> None:
    try:
        shutil.copyfile(folder / original, folder / name)
    except OSError:
        return  # a name that the file system does not take: the file is missing


NAMES = (
    CommandFamily("names of scenes", scene_case, ()),
    CommandFamily("names of inputs", input_case, ()),
    CommandFamily("names of outputs", output_case, ()),
)
