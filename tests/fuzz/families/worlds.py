"""Worlds: XML that reaches outside, nests, repeats or overflows, and meshes that lie about themselves."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from random import Random

import numpy as np

from ..damage import Engine, damaged, words_exchanged
from ..family import SCENE, CommandCase, CommandFamily, FileType, gallery_files

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
NAMES = ("", "x" * 10000, "\x85", "\u202e", "a.b", "ommatid_target", "é", "\x7f[31m", "x\ny")
TAGS = ("shape", "emitter", "bsdf", "integrator", "sensor", "film", "texture", "medium", "volume", "x")
# Elements by what "@" in them stands for.
ELEMENTS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (PLUGINS, tuple(f'<{tag} type="@"/>' for tag in TAGS)),
    (
        OUTSIDE,
        (
            *('<include filename="@"/>', '<path value="@"/>'),
            *(
                f'<shape type="{kind}"><string name="filename" value="@"/></shape>'
                for kind in ("ply", "obj", "serialized")
            ),
            '<emitter type="envmap"><string name="filename" value="@"/></emitter>',
            '<shape type="cube"><bsdf type="diffuse"><texture type="bitmap" name="reflectance">'
            '<string name="filename" value="@"/></texture></bsdf></shape>',
            '<shape type="cube"><bsdf type="diffuse"><spectrum name="reflectance" filename="@"/></bsdf></shape>',
            '<default name="f" value="@"/><shape type="ply"><string name="filename" value="$f"/></shape>',
            '<default name="t" value="@"/><shape type="$t"/>',
        ),
    ),
    (
        NUMBERS,
        (
            f'<shape type="sphere"><float name="radius" value="@"/>{WHERE}</shape>',
            '<emitter type="point"><rgb name="intensity" value="@"/></emitter>',
            '<shape type="cube"><transform name="to_world"><scale value="@"/></transform></shape>',
            '<shape type="cube"><transform name="to_world"><translate z="@"/></transform></shape>',
            '<integrator type="path"><integer name="max_depth" value="@"/></integrator>',
            f'<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="@"/></emitter>{WHERE}</shape>',
        ),
    ),
    (NAMES, ('<shape type="cube" id="@"/>', '<ref id="@"/>', '<float name="@" value="1"/>', '<x y="@"/>')),
)
MANY = (BLOCK, "<ref id='x'/>", "<default name='a' value='b'/>", '<include filename="worlds/corridor.xml"/>')
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
    inside = f"{LIGHT}{BLOCK}{_element(rng)}"
    entities, used = rng.choices((("", ""), (LAUGHS, "&j;"), (EXTERNAL, "&e;")), (30, 1, 1))[0]
    if used:
        inside += f"<default name='x' value='{used}'/>"
    encoding = rng.choices(("utf-8", "utf-16", "utf-32", "utf-8-sig"), (72, 1, 1, 1))[0]
    return f"{entities}{HEAD}{inside}</scene>".encode(encoding, errors="surrogatepass")


def _element(rng: Random) -> str:
    choice = rng.random()
    if choice < 0.1:
        depth, tag = rng.choice((30, 300, 3000, 30000)), rng.choice(("shape", "bsdf", "transform", "scene"))
        return f'<{tag} type="cube">' * depth + f"</{tag}>" * depth
    if choice < 0.2:
        return rng.choice(MANY) * rng.choice((2, 50, 2000))
    values, patterns = rng.choices(ELEMENTS, (2, 2, 2, 1))[0]
    value = rng.choice(values).replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return rng.choice(patterns).replace("@", value)


POINTS = np.array([(-50, -50, 1000), (50, -50, 1000), (50, 50, 1000), (-50, 50, 1000)])
FACES = np.array([(0, 1, 2), (0, 2, 3)])
INDICES = ("4", "-1", "1000", str(2**31 - 1), str(-(2**31)), str(2**32 - 1))
COUNTS = ("0", "-1", "3", "5", str(10**6), str(4 * 10**9), str(2**63), str(10**30))


def _lines(start: str, rows: np.ndarray, end: str = "") -> str:
    return "".join(f"{start}{' '.join(f'{value}{end}' for value in row)} \n" for row in rows)


OBJ = f"{_lines('v ', POINTS)}vt 0 0 \nvt 1 0 \nvn 0 0 -1 \n{_lines('f ', FACES + 1, '/1/1')}".encode()
PLY_HEAD = """ply
format @ 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
"""
PLY = (PLY_HEAD.replace("@", "ascii") + _lines("", POINTS) + _lines("3 ", FACES)).encode()


def _binary_ply(order: str, name: str) -> bytes:
    faces = b"".join(b"\3" + face.astype(f"{order}i4").tobytes() for face in FACES)
    return PLY_HEAD.replace("@", name).encode() + POINTS.astype(f"{order}f4").tobytes() + faces


PLYS = [PLY, _binary_ply("<", "binary_little_endian"), _binary_ply(">", "binary_big_endian")]
EXTREME = ("nan", "inf", "1e38", "1e300", "1e400", "x", "0", "\n", "\x00", "9" * 5000)
ply = words_exchanged(
    b" |\n", *INDICES, *COUNTS, *EXTREME, "9.9", "double", "uchar", "list uchar float", "vertex_index", "80"
)
obj = words_exchanged(b" ", *INDICES, *EXTREME, "1/1/1", "1//9", "-9//1", "v", "f")


def serialized(rng: Random, original: bytes) -> bytes:
    """Return a file of Mitsuba's own meshes whose counts, indices and compressed contents may disagree."""
    if rng.random() < 0.3:
        return damaged(rng, original)
    counts, faces = [len(POINTS), len(FACES)], FACES.copy()
    if rng.random() < 0.3:
        faces[rng.randrange(2), rng.randrange(3)] = int(rng.choice(INDICES))
    if rng.random() < 0.3:
        counts[rng.randrange(2)] = int(rng.choice(COUNTS)) % 2**64
    flags, name = rng.choice((0x1000, 0x1000, 0x2000, 0xFFFF, 0)), rng.choice((b"x", b"", b"x" * 100, b"\x1b[31m"))
    version, offsets = rng.choice((4, 4, 4, 3, 99)), rng.choice(((0,), (0,), (0,), (0, 2**62), (2**31,), ()))
    body = struct.pack("<I", flags) + name + struct.pack("<BQQ", 0, *counts)
    body += POINTS.astype("<f4").tobytes() + faces.astype("<u4").tobytes() + bytes(10**8 * (rng.random() < 0.05))
    end = struct.pack(f"<{len(offsets)}QI", *offsets, len(offsets))
    return struct.pack("<HH", 0x041C, version) + zlib.compress(body) + end


def serialized_mesh() -> bytes:
    """Return a valid file of one mesh."""
    body = struct.pack("<I", 0x1000) + b"x\0" + struct.pack("<QQ", len(POINTS), len(FACES))
    body += POINTS.astype("<f4").tobytes() + FACES.astype("<u4").tobytes()
    return struct.pack("<HH", 0x041C, 4) + zlib.compress(body) + struct.pack("<QI", 0, 1)


def read_world(path: Path) -> object:
    """Read a world with all its checks, and build it."""
    from ommatid.scenes import scene
    from ommatid.simulate.renderer import world

    described = scene.read(path.with_name(SCENE), [f"world.file={path.name}"])
    files = world.files(described)
    built = world.stage(described, "scalar_rgb", None)
    return path.read_bytes(), len(files), len(built.scene.shapes()), built.scene.bbox()


def read_mesh(path: Path) -> object:
    """Read a world of one mesh."""
    shape = f'<shape type="{path.suffix[1:]}"><string name="filename" value="{path.name}"/></shape>'
    world = path.with_name("mesh.xml")
    world.write_text(f"{HEAD}{LIGHT}{shape}</scene>", encoding="utf-8")
    try:
        return read_world(world)
    finally:
        world.unlink()


def of_mesh(name: str, suffix: str, originals: list[bytes], damage: Engine) -> FileType:
    """Return a type of meshes."""
    share = 1.0 if suffix == "ply" else 0.5
    return FileType(f"world, {name}", f"mesh.{suffix}", lambda _: originals, damage, read_mesh, (), share=share)


def rendered(rng: Random, folder: Path) -> CommandCase:
    """Return the rendering of a world with one hostile element."""
    (folder / "w.xml").write_bytes(elements(rng, PLAIN.encode()))
    return CommandCase(("render", SCENE, "-o", "new", "--set", "world.file=w.xml", "--set", "world.white=1"))


WORLDS = (
    FileType("world, XML", "world.xml", gallery_files("worlds/*.xml"), damaged, read_world, ()),
    FileType("world, elements", "w.xml", lambda _: [PLAIN.encode()], elements, read_world, ()),
    of_mesh("PLY", "ply", PLYS, ply),
    of_mesh("serialized", "serialized", [serialized_mesh()], serialized),
    of_mesh("OBJ", "obj", [OBJ], obj),
    CommandFamily("world, rendered", rendered, share=0.2),
)
