"""Families of hostile Mitsuba files, made from a number: their XML, and the meshes that they name.

Each family yields a world that has to be refused, whatever the number is.
"""

from __future__ import annotations

import random
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

PLY_TYPES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}


def scene(content: str, version: str = "3.0.0") -> str:
    return f'<scene version="{version}">{content}<emitter type="constant"/></scene>'


def mesh(name: str) -> str:
    kind = name.rpartition(".")[2]
    return scene(f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>')


def ply(vertices: int, faces: list[tuple[int, ...]], order: str, index: str = "int", count: str = "uchar") -> bytes:
    """Return a PLY file; the counts of its header are those of its content."""
    name = {"=": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}[order]
    header = (
        f"ply\nformat {name} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    header += f"element face {len(faces)}\nproperty list {count} {index} vertex_index\nend_header\n"
    points = [(float(i), float(i * i), 1.0) for i in range(vertices)]
    if order == "=":
        rows = [" ".join(map(str, row)) for row in (*points, *((len(face), *face) for face in faces))]
        return (header + "\n".join(rows) + "\n").encode()
    content = b"".join(struct.pack(f"{order}3f", *point) for point in points)
    for face in faces:
        content += struct.pack(f"{order}{PLY_TYPES[count]}{len(face)}{PLY_TYPES[index]}", len(face), *face)
    return header.encode() + content


def serialized(vertices: int, faces: list[tuple[int, int, int]], says: int | None = None) -> bytes:
    content = struct.pack("<I", 0x1000) + b"name\0" + struct.pack("<QQ", says or vertices, len(faces))
    content += b"".join(struct.pack("<3f", i, i * i, 1) for i in range(vertices))
    content += b"".join(struct.pack("<3I", *face) for face in faces)
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(content) + struct.pack("<QI", 0, 1)


def _index(rng: random.Random, vertices: int) -> int:
    return rng.choice([vertices, vertices + 1, vertices + rng.randrange(10**6), 2**31 - 1])


def indices_of_ply(rng: random.Random, folder: Path) -> str:
    """Indices beyond the vertices; Mitsuba reads negative ones as 0."""
    vertices, order = rng.randrange(3, 9), rng.choice("=<>")
    faces = [(0, 1, 2)] * rng.randrange(4)
    faces.insert(rng.randrange(len(faces) + 1), (0, _index(rng, vertices), 1))
    (folder / "m.ply").write_bytes(ply(vertices, faces, order))
    return mesh("m.ply")


def serialized_mesh(rng: random.Random, folder: Path) -> str:
    good = serialized(4, [(0, 1, 2)])
    bad = [serialized(4, [(0, 1, _index(rng, 4))]), serialized(4, [(0, 1, 2)], says=rng.choice([5, 10**9, 2**40]))]
    bad += [good[:20], b"", good[:10] + b"\xff" * 9 + good[19:]]
    (folder / "m.serialized").write_bytes(rng.choice(bad))
    return mesh("m.serialized")


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
        indices_of_ply,
        serialized_mesh,
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
