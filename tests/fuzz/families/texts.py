"""Texts of scenes that act on a terminal, a page or a table, and commands that print them."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

from ..family import SCENE, CommandCase, CommandFamily

PARTS = (
    *(
        "\x1b[31m",
        "\x1b]8;;http://x\x07",
        "\x1b]52;c;eA==\x07",
        "\x9b2J",
        "\x00",
        "\x07",
        "\x08" * 9,
        "\x7f",
        "\x85",
        "\r",
        "\n",
        "\t",
    ),
    *(
        "\u202e",
        "\u2066",
        "\u200b",
        "\u2028",
        "\ufeff",
        "e" + "\u0301" * 50,
        "日本",
        "😀",
        "\U000e0041",
        "\ufffe",
        "\ue000",
    ),
    *(
        "$x^2$",
        "$\\frac{1}$",
        "$",
        "[red]",
        "[/]",
        "{{7*7}}",
        "{% x %}",
        "<script>alert(1)</script>",
        "]]>",
        "&amp;",
        "=1+1",
    ),
    *("%s%n", "\\", "'", '"', "x" * 300, "x" * 70000, "../x", "/", "a,b", "#", " "),
)
COMMANDS = (
    *(
        ("show", "t.toml"),
        ("show", "t.toml", "--json"),
        ("show", "t.toml", "--figure", "new.png"),
        ("predict", "t.toml", "--no-rays"),
    ),
    *(
        ("design", "t.toml", "--candidates", "1/2"),
        ("run", "t.toml", "-o", "new", "--dry-run"),
        ("run", "t.toml", "-o", "new"),
    ),
    *(
        ("run", "t.toml", "-o", "new", "-v"),
        ("predict", "t.toml", "--no-rays", "--lens", "nope"),
        ("export", "t.toml", "-o", "new.xml"),
    ),
    *(("calibrate", "t.toml", "-o", "new.npz"), ("predict", "t.toml", "--no-rays", "--sweep", "noise.variance=1,2")),
)
WEIGHTS = (5, 2, 0.5, 5, 2, 3, 0.3, 0.3, 5, 0.5, 0.5, 1)


def text(rng: Random) -> str:
    """Return a text with one to three hostile parts."""
    return "".join(rng.choice(("a", "", "Title ")) + rng.choice(PARTS) for _ in range(rng.choice((1, 1, 2, 3))))


def case(rng: Random, folder: Path) -> CommandCase:
    """Return a command on a scene with such texts in a title, a name, a key, or in place of a value."""
    scene = (folder / SCENE).read_text(encoding="utf-8")
    where = rng.choice(("title", "title", "lens", "key", "value", "image", "table", "kind"))
    hostile = json.dumps(text(rng), ensure_ascii=True)
    if "\\ud" in hostile:  # JSON's pairs of surrogates are not TOML's
        hostile = json.dumps(text(rng).encode("ascii", "replace").decode())
    changes = {
        "title": ('title = "Tiny"', f"title = {hostile}"),
        "lens": ('name = "I"', f"name = {hostile}"),
        "key": ("[noise]", f"[noise]\n{hostile} = 1"),
        "value": ("variance = 1e-2", f"variance = {hostile}"),
        "image": ('"photo:camera"', hostile),
        "table": ("[noise]", f"[{hostile}]"),
        "kind": ('fit = "none"', f"fit = {hostile}"),
    }
    (folder / "t.toml").write_text(scene.replace(*changes[where]), encoding="utf-8")
    return CommandCase(rng.choices(COMMANDS, WEIGHTS)[0])


HARMLESS = tuple(
    tuple(SCENE if word == "t.toml" else word for word in words) for words in COMMANDS if "nope" not in words
)
TEXTS = (CommandFamily("texts of scenes", case, HARMLESS),)
