"""Families of hostile Mitsuba files, made from a number: their XML, and the meshes that they name.

Each family yields a world that has to be refused, whatever the number is.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

from ..fuzz.families.worlds import PLY, serialized_mesh


def scene(content: str, version: str = "3.0.0") -> str:
    return f'<scene version="{version}">{content}<emitter type="constant"/></scene>'


def mesh(name: str) -> str:
    kind = name.rpartition(".")[2]
    return scene(f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>')


def meshes(rng: random.Random, folder: Path) -> str:
    """Indices beyond the vertices, and files that are cut off or damaged; Mitsuba reads negative indices as 0."""
    beyond = str(rng.choice([4, 5, 4 + rng.randrange(10**6), 2**31 - 1])).encode()
    good = serialized_mesh()
    name, content = rng.choice(
        [
            ("m.ply", PLY.replace(b"3 0 1 2", b"3 0 %s 1" % beyond)),
            *(("m.serialized", bad) for bad in (good[:20], b"", good[:10] + b"\xff" * 9 + good[19:])),
        ]
    )
    (folder / name).write_bytes(content)
    return mesh(name)


def laughs(rng: random.Random, folder: Path) -> str:
    """A million laughs: of entities, of variables, of included files."""
    family = rng.randrange(3)
    if family == 0:
        entities = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "ha"}">' for i in range(9))
        return f"<!DOCTYPE scene [{entities}]>" + scene('<string name="x" value="&a8;"/>')
    if family == 1:
        defaults = "".join(f'<default name="a{i}" value="{f"$a{i - 1}" * 10 if i else "ha"}"/>' for i in range(9))
        return scene(defaults + '<string name="x" value="$a8"/>')
    for i in range(8):
        content = f'<include filename="{i + 1}.xml"/>' * 10 if i < 7 else '<shape type="sphere"/>' * 10
        (folder / f"{i}.xml").write_text(f'<scene version="3.0.0">{content}</scene>', encoding="utf-8")
    return scene('<include filename="0.xml"/>')


def cycles(rng: random.Random, folder: Path) -> str:
    length = rng.choice([1, 2, 20])
    for i in range(length):
        content = f'<scene version="3.0.0"><include filename="{(i + 1) % length}.xml"/></scene>'
        (folder / f"{i}.xml").write_text(content, encoding="utf-8")
    return scene('<include filename="0.xml"/>')


def _shape(kind: str) -> str:
    return scene(f'<shape type="{kind}"/>')


def plugins(rng: random.Random, folder: Path) -> str:
    kind = rng.choice(
        ["evil", "../evil", "../x/evil", f"{folder}/evil", "./sphere", "sphere.so", "plugins/sphere", "", "scene"]
    )
    kind = rng.choice(
        [kind, "".join(chr(rng.randrange(0x21, 0x2FF)) for _ in range(9)).translate({34: None, 38: None, 60: None})]
    )
    if rng.random() < 0.3:
        (folder / "part.xml").write_text(_shape("$kind"), encoding="utf-8")
        return scene(f'<default name="kind" value="{kind or "x"}"/><include filename="part.xml"/>')
    tag = rng.choice(["shape", "bsdf", "emitter", "integrator", "sampler", "texture"])
    return scene(f'<shape type="sphere"><{tag} type="{kind or "x"}"/></shape>')


def outside(rng: random.Random, folder: Path) -> str:
    beyond = folder.parent / f"{folder.name}-beyond"
    beyond.mkdir(exist_ok=True)
    (beyond / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", encoding="utf-8")
    (beyond / "part.xml").write_text(scene(""), encoding="utf-8")
    name = rng.choice([str(beyond), f"../{beyond.name}", f"./x/../../{beyond.name}", "link"])
    (folder / "x").mkdir(exist_ok=True)
    if name == "link":
        (folder / "link").symlink_to(beyond)
    if rng.random() < 0.3:
        return scene(f'<include filename="{name}/part.xml"/>')
    if rng.random() < 0.3:
        return scene(f'<path value="{name}"/>') + ""
    return scene(
        f'<default name="at" value="{name}"/><shape type="obj"><string name="filename" value="$at/m.obj"/></shape>'
    )


FAMILIES: dict[str, Callable[[random.Random, Path], str]] = {
    make.__name__: make
    for make in (
        meshes,
        laughs,
        cycles,
        plugins,
        outside,
    )
}


def hostile_world(number: int, folder: Path) -> Path:
    """Write a hostile world of the family and the details that a number gives, and return its path."""
    rng = random.Random(number)
    make = list(FAMILIES.values())[number % len(FAMILIES)]
    path = folder / "world.xml"
    path.write_text(make(rng, folder), encoding="utf-8")
    return path
