"""Worlds: XML that reaches outside, nests, repeats or overflows, and meshes that lie about themselves."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from random import Random

import numpy as np

from ..damage import damaged
from ..family import SCENE, CommandCase, CommandFamily, FileType, fingerprint

HEAD = '<scene version="3.0.0">'
LIGHT = '<emitter type="constant"><rgb name="radiance" value="1"/></emitter>'
WHERE = '<transform name="to_world"><translate z="1000"/></transform>'
BLOCK = f'<shape type="cube">{WHERE}<bsdf type="diffuse"/></shape>'
PLAIN = f"{HEAD}{LIGHT}{BLOCK}</scene>"
OUTSIDE = (
    "/etc/passwd", "../../etc/passwd", "/dev/zero", "/dev/stdin", "/proc/self/mem", "~/x", "file:///etc/passwd", "",
    ".", "nope.png", "x\x1b[31m.png", "é" * 300, "a" * 5000, "world.xml", "mesh.ply", "tiny.toml", "sound.exr",
    "lenses",
)  # fmt: skip
PLUGINS = (
    "../x/evil", "./evil", "/elsewhere/evil", "evil", "plugins/evil", "evil.so", "", "CUBE", "cube\0", "sphere ",
    "ommatid_camera", "path", "aov", "moment", "ptracer", "prb", "stokes", "volpath", "depth", "direct",
    "perspective", "hdrfilm", "merge",
)  # fmt: skip
NUMBERS = (
    "nan", "inf", "-inf", "1e400", "-1", "0", "1e308", "1e-320", "x", "", "1 2 3", "9" * 5000, "-0.0", "0x10", "1e38",
)  # fmt: skip
LAUGHS = (
    "<!DOCTYPE x [<!ENTITY a 'aaaaaaaaaa'>"
    + "".join(f"<!ENTITY {chr(98 + index)} '{('&' + chr(97 + index) + ';') * 10}'>" for index in range(9))
    + "]>"
)
EXTERNAL = "<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/passwd'>]>"


def elements(rng: Random, original: bytes) -> bytes:
    """Return a world with one hostile element, or with damaged bytes."""
    if rng.random() < 0.15:
        return damaged(rng, original)
    inside = LIGHT + BLOCK + rng.choice(ELEMENTS)(rng)
    choice = rng.random()
    if choice < 0.03:
        return f"{LAUGHS}{HEAD}{inside}<default name='x' value='&j;'/></scene>".encode()
    if choice < 0.06:
        return f"{EXTERNAL}{HEAD}{inside}<default name='x' value='&e;'/></scene>".encode()
    if choice < 0.1:
        return f"{HEAD}{inside}</scene>".encode(rng.choice(("utf-16", "utf-32", "utf-8-sig")))
    return f"{HEAD}{inside}</scene>".encode(errors="surrogatepass")


def _plugin(rng: Random) -> str:
    tag = rng.choice(("shape", "emitter", "bsdf", "integrator", "sensor", "film", "texture", "medium", "volume", "x"))
    return f'<{tag} type="{_escaped(rng.choice(PLUGINS))}"/>'


def _file(rng: Random) -> str:
    name = _escaped(rng.choice(OUTSIDE))
    return rng.choice(
        (
            f'<include filename="{name}"/>',
            f'<path value="{name}"/>',
            f'<shape type="ply"><string name="filename" value="{name}"/></shape>',
            f'<shape type="obj"><string name="filename" value="{name}"/></shape>',
            f'<shape type="serialized"><string name="filename" value="{name}"/></shape>',
            f'<emitter type="envmap"><string name="filename" value="{name}"/></emitter>',
            f'<shape type="cube"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
            f'<string name="filename" value="{name}"/></texture></bsdf></shape>',
            f'<shape type="cube"><bsdf type="diffuse"><spectrum name="reflectance" filename="{name}"/></bsdf></shape>',
            f'<default name="f" value="{name}"/><shape type="ply"><string name="filename" value="$f"/></shape>',
            f'<default name="t" value="{name}"/><shape type="$t"/>',
        )
    )


def _nested(rng: Random) -> str:
    depth, tag = rng.choice((30, 300, 3000, 30000)), rng.choice(("shape", "bsdf", "transform", "scene"))
    return f'<{tag} type="cube">' * depth + f"</{tag}>" * depth


def _many(rng: Random) -> str:
    return rng.choice(
        (BLOCK, "<ref id='x'/>", "<default name='a' value='b'/>", '<include filename="worlds/corridor.xml"/>')
    ) * rng.choice((2, 50, 2000))


def _number(rng: Random) -> str:
    value = rng.choice(NUMBERS)
    radiance = f'<rgb name="radiance" value="{value}"/>'
    return rng.choice(
        (
            f'<shape type="sphere"><float name="radius" value="{value}"/>{WHERE}</shape>',
            f'<emitter type="point"><rgb name="intensity" value="{value}"/></emitter>',
            f'<shape type="cube"><transform name="to_world"><scale value="{value}"/></transform></shape>',
            f'<shape type="cube"><transform name="to_world"><translate z="{value}"/></transform></shape>',
            f'<integrator type="path"><integer name="max_depth" value="{value}"/></integrator>',
            f'<shape type="rectangle"><emitter type="area">{radiance}</emitter>{WHERE}</shape>',
        )
    )


def _name(rng: Random) -> str:
    name = _escaped(rng.choice(("", "x" * 10000, "\x85", "\u202e", "a.b", "ommatid_target", "é", "\x7f[31m", "x\ny")))
    return rng.choice(
        (
            f'<shape type="cube" id="{name}"/>',
            f'<ref id="{name}"/>',
            f'<float name="{name}" value="1"/>',
            f'<{"x"} {"y"}="{name}"/>',
        )
    )


def _escaped(text: str) -> str:
    return text.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")


ELEMENTS = (_plugin, _plugin, _file, _file, _nested, _many, _number, _number, _name)
POINTS = ((-50, -50, 1000), (50, -50, 1000), (50, 50, 1000), (-50, 50, 1000))
FACES = ((0, 1, 2), (0, 2, 3))
INDICES = (4, -1, 1000, 2**31 - 1, -(2**31), 2**32 - 1)
COUNTS = (0, -1, 3, 5, 10**6, 4 * 10**9, 2**63, 10**30)


def ply(rng: Random, original: bytes) -> bytes:
    """Return a PLY file whose header and contents may disagree."""
    if rng.random() < 0.3:
        return damaged(rng, original)
    points = [list(map(float, point)) for point in POINTS]
    faces = [list(face) for face in FACES]
    counts = [str(len(points)), str(len(faces))]
    kind = rng.choice(("ascii", "binary_little_endian", "binary_big_endian"))
    change = rng.randrange(6)
    if change == 0:
        faces[rng.randrange(2)][rng.randrange(3)] = rng.choice(INDICES)
    elif change == 1:
        counts[rng.randrange(2)] = str(rng.choice(COUNTS))
    elif change == 2:
        points[rng.randrange(4)][rng.randrange(3)] = rng.choice((np.nan, np.inf, 1e38, 1e300))
    elif change == 3:
        faces[0] = faces[0][: rng.choice((0, 1, 2))] if rng.random() < 0.5 else faces[0] * rng.choice((2, 80))
    version, types, names = "1.0", ["float"] * 3, rng.choice(("vertex_index", "vertex_indices"))
    if change == 4:
        version, names = rng.choice(("1.0", "9.9", "x")), rng.choice((names, "x", "vertex_index x"))
        types[rng.randrange(3)] = rng.choice(("float", "double", "uchar", "x", "list uchar float"))
    properties = "".join(f"property {kind_of} {axis}\n" for kind_of, axis in zip(types, "xyz", strict=True))
    header = (
        f"ply\nformat {kind} {version}\nelement vertex {counts[0]}\n{properties}"
        f"element face {counts[1]}\nproperty list uchar int {names}\nend_header\n"
    )
    return header.encode() + _ply_body(kind, points, faces)


def _ply_body(kind: str, points: list[list[float]], faces: list[list[int]]) -> bytes:
    if kind == "ascii":
        lines = [" ".join(map(str, point)) for point in points]
        lines += [" ".join(map(str, (len(face), *face))) for face in faces]
        return "\n".join(lines).encode() + b"\n"
    order = "<" if "little" in kind else ">"
    with np.errstate(over="ignore"):
        body = np.array(points).astype(f"{order}f4").tobytes()
    for face in faces:
        body += struct.pack(f"{order}B", len(face) % 256)
        body += b"".join(struct.pack(f"{order}I", index % 2**32) for index in face)
    return body


def obj(rng: Random, original: bytes) -> bytes:
    """Return an OBJ file with indices that name nothing, or damaged bytes."""
    if rng.random() < 0.4:
        return damaged(rng, original)
    words = original.decode().split(" ")
    extreme = (
        *map(str, INDICES),
        "nan",
        "inf",
        "1/1/1",
        "1//9",
        "-9//1",
        "0",
        "x",
        "1e400",
        "9" * 5000,
        "\n",
        "v",
        "f",
        "\x00",
    )
    for _ in range(rng.choice((1, 1, 2))):
        words[rng.randrange(len(words))] = rng.choice(extreme)
    return " ".join(words).encode()


OBJ = b"".join(
    (
        *(b"v %d %d %d\n" % point for point in POINTS),
        b"vt 0 0 \nvt 1 0 \nvn 0 0 -1 \n",
        *(b"f %d/1/1 %d/2/1 %d/1/1 \n" % tuple(index + 1 for index in face) for face in FACES),
    )
)
PLY = (
    b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    b"element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    + _ply_body("ascii", [list(map(float, point)) for point in POINTS], [list(face) for face in FACES])
)


def serialized(rng: Random, original: bytes) -> bytes:
    """Return a file of Mitsuba's own meshes whose counts, indices and compressed contents may disagree."""
    if rng.random() < 0.3:
        return damaged(rng, original)
    points, faces = np.array(POINTS, "<f4"), np.array(FACES, "<u4")
    counts = [len(points), len(faces)]
    change = rng.randrange(5)
    if change == 4:
        return serialized_mesh()
    if change == 0:
        faces[rng.randrange(2), rng.randrange(3)] = rng.choice(INDICES) % 2**32
    elif change == 1:
        counts[rng.randrange(2)] = rng.choice(COUNTS) % 2**64
    name, flags = rng.choice((b"", b"x" * 100, b"\x1b[31m")), rng.choice((0x1000, 0x1000, 0x2000, 0xFFFF, 0))
    body = struct.pack("<I", flags) + name + b"\0" + struct.pack("<QQ", *counts) + points.tobytes() + faces.tobytes()
    body += bytes(rng.choice((0, 0, 0, 10**8)) if change == 2 and rng.random() < 0.2 else 0)
    header = struct.pack("<HH", rng.choice((0x041C, 0x041C, 0x041C, 0)), rng.choice((4, 4, 3, 99)))
    content = header + zlib.compress(body)
    offsets = rng.choice(([0], [0], [0, 2**62], [2**31], []))
    return (
        content + struct.pack(f"<{len(offsets)}Q", *offsets) + struct.pack("<I", rng.choice((len(offsets), 1, 2**31)))
    )


def serialized_mesh() -> bytes:
    """Return a valid file of one mesh."""
    body = struct.pack("<I", 0x1000) + b"x\0" + struct.pack("<QQ", len(POINTS), len(FACES))
    body += np.array(POINTS, "<f4").tobytes() + np.array(FACES, "<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<Q", 0) + struct.pack("<I", 1)


def read_world(path: Path) -> str:
    """Read a world with all its checks, and build it."""
    from ommatid.scenes import scene
    from ommatid.simulate.renderer import world

    described = scene.read(path.with_name(SCENE), [f"world.file={path.name}"])
    files = world.files(described)
    built = world.stage(described, "scalar_rgb", None)
    return fingerprint(len(files), len(built.scene.shapes()), built.scene.bbox())


def read_mesh(path: Path) -> str:
    """Read a world of one mesh."""
    kind = path.suffix[1:]
    shape = f'<shape type="{kind}"><string name="filename" value="{path.name}"/></shape>'
    world = path.with_name("mesh.xml")
    world.write_text(f"{HEAD}{LIGHT}{shape}</scene>", encoding="utf-8")
    try:
        return read_world(world)
    finally:
        world.unlink()


WORLDS = (
    FileType("world, elements", "w.xml", lambda _: [PLAIN.encode()], elements, read_world, ()),
    FileType("world, PLY", "mesh.ply", lambda _: [PLY], ply, read_mesh, ()),
    FileType(
        "world, serialized", "mesh.serialized", lambda _: [serialized_mesh()], serialized, read_mesh, (), share=0.5
    ),
    FileType("world, OBJ", "mesh.obj", lambda _: [OBJ], obj, read_mesh, (), share=0.5),
)


def rendered(rng: Random, folder: Path) -> CommandCase:
    """Return the rendering of a world with one hostile element."""
    (folder / "w.xml").write_bytes(elements(rng, PLAIN.encode()))
    return CommandCase(("render", SCENE, "-o", "new", "--set", "world.file=w.xml", "--set", "world.white=1"))


RENDERED = (CommandFamily("world, rendered", rendered, share=0.2),)
