"""Names of files that are not names of folders, not UTF-8, too long, or act on a terminal."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from random import Random

from ..family import SCENE, CommandCase, CommandFamily, escaped

STEMS = (
    ".", "..", "...", " ", "  .", "-", "--help", "-o", "a b", "a\tb", "a\nb", "\r", "\x1b[31mred\x1b[0m",
    "\x1b]0;x\x07", "\u202egnp", "\u200b", "é", "e\u0301", "😀", "日本語", "\udcff\udcfe", "\udcc3(", "x" * 250,
    "é" * 124, "x" * 195, "x" * 201, "~", "$HOME", "$(touch pwned)", "`touch pwned`", ";touch pwned", "%s%n", "{0}",
    "[red]", "*", "?", "con", "nul", "<script>", "\"'&", "=cmd", "@x", "run", "index", "new", "sweep", ".jobs",
    ".hidden", "a.part.b", "C:x", "a:b", "a\\b",
)  # fmt: skip
# The name of a file, the sound one of which it is a copy, and commands that read or write it.
Row = tuple[str, str, tuple[tuple[str, ...], ...]]
SCENES: tuple[Row, ...] = (
    ("{}.toml", SCENE, (("show", "{}"), ("predict", "{}", "--no-rays"), ("render", "{}", "-o", "new"))),
    ("{}.toml", SCENE, (("run", "{}", "-o", "new", "--dry-run"), ("render", "{}", SCENE, "-o", "new"))),
    ("{}.toml", SCENE, (("calibrate", "{}", "-o", "new.npz"), ("export", "{}", "-o", "new.xml"))),
)
INPUTS: tuple[Row, ...] = (
    ("{}.exr", "sound.exr", (("reconstruct", "{}", "sound.npz", "-o", "new.exr"),)),
    ("{}.npz", "sound.npz", (("check", "sound.exr", "{}"),)),
    ("{}.npy", "mosaic.npy", (("import", SCENE, "{}", "-o", "new.exr", "--origin", "0,0"),)),
    ("{}.csv", "spectrum.csv", (("show", SCENE, "--set", "light.spectrum={}"),)),
    ("{}.dat", "lenses/planoconvex.dat", (("show", SCENE, "--set", "camera.lens.I.surfaces={}"),)),
)
OUTPUTS: tuple[Row, ...] = (
    ("{}", "", (("render", SCENE, "-o", "{}"), ("export", "sound.npz", "-o", "{}"))),
    ("{}.npz", "", (("calibrate", SCENE, "-o", "{}"), ("export", "sound.npz", "-o", "{}"))),
    ("{}.xml", "", (("export", SCENE, "-o", "{}"),)),
    ("{}.toml", "", (("init", "{}"),)),
    ("{}.png", "", (("show", SCENE, "--figure", "{}"),)),
    ("{}.exr", "", (("reconstruct", "sound.exr", "sound.npz", "-o", "{}"),)),
)


def stem(rng: Random) -> str:
    """Return a name, or one made of characters of several."""
    if rng.random() < 0.7:
        return rng.choice(STEMS)
    parts = "".join(rng.choice(STEMS)[:3] for _ in range(rng.randint(1, 4)))
    return parts.replace("/", "").replace("\0", "") or "."


def named(kind: str, rows: tuple[Row, ...]) -> CommandFamily:
    """Return the family of commands on a file of such a name."""

    def case(rng: Random, folder: Path) -> CommandCase:
        pattern, original, commands = rng.choice(rows)
        start = stem(rng)
        name = pattern.replace("{}", start)
        if original:
            with suppress(OSError):  # of a name that the file system does not take: the file is missing
                shutil.copyfile(folder / original, folder / name)
        words = [word.replace("{}", name) for word in rng.choice(commands)]
        if words[1].startswith("-"):
            words[1] = f"./{words[1]}"
        outputs = ("new",) if any(word.startswith("new") for word in words) else ()
        return CommandCase(tuple(words), outputs=outputs if original else (escaped(start),))

    return CommandFamily(f"names of {kind}", case)


NAMES = (named("scenes", SCENES), named("inputs", INPUTS), named("outputs", OUTPUTS))
