"""Extreme values of every option of every command, as the command line declares them."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from pathlib import Path
from random import Random
from typing import Any

from .. import mutations
from ..family import RUN, SCENE, CommandCase, CommandFamily, escaped

HARMLESS: dict[str, tuple[str, ...]] = {
    "show": (SCENE,),
    "predict": (SCENE, "--no-rays"),
    "design": (SCENE, "--set", "design.magnifications=1/2,1/3"),
    "run": (SCENE, "-o", "out"),
    "render": (SCENE, "-o", "out"),
    "calibrate": (SCENE, "-o", "new.npz"),
    "reconstruct": ("sound.exr", "sound.npz", "-o", "new.exr"),
    "report": (RUN,),
    "figure": (RUN, "-o", "new.svg"),
    "check": ("sound.exr", "sound.npz"),
    "import": (SCENE, "mosaic.npy", "-o", "new.exr", "--origin", "0,0"),
    "export": (SCENE, "-o", "new.xml"),
    "init": ("new.toml",),
    "schema": (),
}
SLOW = {"bench": (SCENE, "-o", "new"), "paper": ("-o", "new"), "stability": ("-o", "new"), "doctor": ()}
WEIGHTS = {"run": 0.3, "render": 0.3, "calibrate": 0.5, "export": 0.5, "check": 0.5}  # of slow ones
NOT_VALUES = ("nan", "inf", "-inf", "-1", "1e400", "x", "1,5", "", "0x10", "1e", "٣", "9" * 5000)  # for `--within`
NUMBERS = (
    *("0", "-1", "1", "2", "-0.0", "1e308", "1e400", "-1e400", "inf", "-inf", "nan", "5e-324", "1e-400", "0x10", "1_0"),
    *("9223372036854775807", "9223372036854775808", "18446744073709551616", "9" * 400, "9" * 5000, "1" + "0" * 100),
    *("٣", "½", "+1", " 1", "1 ", "1e", "", "--", "-", "x", "1,1", "1;1"),
)
TEXTS = (
    "", " ", ",", ",,,,", "a,", "=", "x" * 300, "x" * 100000, "\x1b[31mred", "\x9b2J", "\u202eabc", "é", "\udcff",
    "😀", "%s", "0,0", "-1,-1", "1,1,1,1", "0,0,999,999", "99999999999999999999,0", "1e9,1", "0,0,-1,-1", "nan,nan",
    "1/2,1/3,...,1/1000000000", "1/0", "1/2,...,1/3", "...", "1/" + "9" * 5000, "0/1", "1/1e9", "1/2", "0/0", "1/0",
    "9/1", "/1", "auto", "1/99999999999999999999", "2/1" + "0" * 5000, "svg,pdf,exe", "npy,npy", "tiff64", "1 s",
    "-1 s", "0 s", "1e999 s", "1e30 years", "1 parsec", "I", "I,I", "II", "x", "tcp://", "tcp://x y:1",
    "file:///etc/passwd", "http://", "tcp://localhost:99999999",
)  # fmt: skip
FILES = (
    "", " ", ".", "..", "/", "new/x/y", "\udcff\udcfe", "x" * 256, "x/" * 3000, "\x1b[31m", "-", "--", "new\n", SCENE,
    "out",
)  # fmt: skip
SETS = ("", "=", "a", "a=b", "noise.variance", "noise.variance=", "camera.lens.I=1", "render.samples=1e400", "target=1")
SWEEPS = (
    *("", "=", "a", "noise.variance=", "noise.variance=1", "noise.variance=1,", "noise.variance=1,1", "x.y=1,2"),
    *("title=\x1b[31m,b", "title=../x,..", "title=" + "x" * 300 + ",b", "title=/,.", "title=a/b,c", "title=\udcff,b"),
    *("noise.variance=" + ",".join(map(str, range(100))), "render.samples=1,2,...,1e9", "title=.,.."),
)
NOT_A_SCENE = (
    "nope.toml", "sound.exr", "out", "", "\udcff.toml", "x" * 300, "/", "..toml", "photo:camera", "\x1b[31m.toml",
)  # fmt: skip


@cache
def commands() -> dict[str, Any]:
    """Return the commands of the command line by name."""
    from typer.main import get_command

    from ommatid.cli.app import app

    group: Any = get_command(app)
    return dict(group.commands)


def option_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command with extreme values of one to three of its options or arguments."""
    del folder
    names = sorted(HARMLESS)
    name = rng.choices(names, [WEIGHTS.get(each, 1.0) for each in names])[0]
    words = [name, *HARMLESS[name]]
    if len(words) > 1 and rng.random() < 0.1:
        words[1] = rng.choice([each for each in NOT_A_SCENE if (name, each) != ("report", "sound.exr")])  # it has one
    options = [each for each in commands()[name].params if each.param_type_name == "option" and each.name != "help"]
    for _ in range(rng.choice((1, 1, 2, 3))):
        option = rng.choice(options)
        words.append(rng.choice(option.opts + option.secondary_opts))
        if not option.is_flag:
            words.append(_value(rng, option))
    named = _outputs(["-o", *words[1:2], *words]) if name == "init" else _outputs(words)
    return CommandCase(tuple(words), outputs=named)


def _outputs(words: list[str]) -> tuple[str, ...]:
    """Return the beginnings of the names of what a command may write: what follows its options that name files."""
    named = [after.strip("./") for word, after in pairwise(words) if word in ("-o", "--output", "--figure")]
    return ("new", "out", *map(escaped, named))


def _kind(option: Any) -> str:
    """Return the name of an option's type, which versions of the parser keep in different places."""
    kind = getattr(option, "type", None)
    return str(option.type_descriptor.annotation.__name__ if kind is None else kind.name).lower()


def _value(rng: Random, option: Any) -> str:
    kind = _kind(option)
    if "--set" in option.opts:
        key = rng.choice(("noise.variance", "render.samples", "target.shape", "title", "camera.lens.I.array", "seed"))
        return rng.choice((*SETS, f"{key}={rng.choice(mutations.VALUES)}")).replace("\0", "")
    if "--sweep" in option.opts:
        return rng.choice(SWEEPS)
    if kind.startswith(("int", "float")):
        return rng.choice(NUMBERS)
    if kind.startswith(("path", "posixpath", "file", "directory")):
        return rng.choice(FILES)
    return rng.choice((*TEXTS, *NUMBERS[:8]))


def slow_case(rng: Random, folder: Path) -> CommandCase:
    """Return a command that takes minutes, with an option that must be refused at once."""
    del folder
    name = rng.choice(sorted(SLOW))
    wrong: list[tuple[str, ...]] = [("--" + rng.choice(("x", "é", "\x1b[31m", "x" * 3000)),), ("too", "many", "words")]
    if name == "bench":
        wrong += [("--within", rng.choice(NOT_VALUES)), ("--lens", "nope"), ("--set", "a=b")] * 2
    if name == "paper":
        image, seed = rng.choice(("nope.png", "photo:nope", "out")), rng.choice(("-1", "x", "1.5", "nan"))
        wrong += [("--seed", seed), ("--image", image)] * 2
    if name != "doctor":
        wrong += [("-o", f"{SCENE}/x"), ("--format", rng.choice(("exe", "npy")))]
    return CommandCase((name, *SLOW[name], *rng.choice(wrong)), refused=True)


OPTIONS = (
    CommandFamily("options", option_case, tuple((name, *words) for name, words in HARMLESS.items()), share=2.0),
    CommandFamily("options of slow commands", slow_case, share=0.3),
)
