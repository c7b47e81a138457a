"""Worlds are checked without Mitsuba: hostile ones are refused in one sentence, others become the text it parses."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ommatid.interface import read_scene
from ommatid.runtime.errors import InputError
from ommatid.simulate.renderer.worlds.checked_world import check_world_files
from ommatid.simulate.renderer.worlds.trial import try_world

from ..conftest import TINY, Command
from ..examples import GALLERY
from ..fuzz.families.worlds import PLY, serialized_mesh

WHERE = "test.toml: world.file"
OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\nf 1 2 3\n"
MESH, LAUGHS = serialized_mesh(), range(9)
BEYOND = "beyond"  # a folder beside the world's


def scene(content: str) -> str:
    return f'<scene version="3.0.0">{content}<emitter type="constant"/></scene>'


def mesh(name: str) -> str:
    kind = name.rpartition(".")[2]
    return scene(f'<shape type="{kind}"><string name="filename" value="{name}"/></shape>')


def including(*names: str) -> str:
    return scene("".join(f'<include filename="{name}"/>' for name in names))


def cycle(length: int) -> dict[str, str | bytes]:
    files = {f"{i}.xml": including(f"{(i + 1) % length}.xml") for i in range(length)}
    return {"world.xml": including("0.xml"), **files}


ENTITIES = "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10 if i else "ha"}">' for i in LAUGHS)
DEFAULTS = "".join(f'<default name="a{i}" value="{f"$a{i - 1}" * 10 if i else "ha"}"/>' for i in LAUGHS)
OUTSIDE = ("/tmp", f"../{BEYOND}", f"./x/../../{BEYOND}", "link")
PLUGINS = ("evil", "../evil", "../x/evil", "./sphere", "sphere.so", "plugins/sphere", "", "scene", "ȀƐ!", "[\x7f")
# Files of worlds that have to be refused: world.xml, and what it names.
HOSTILE: list[dict[str, str | bytes]] = [
    # indices beyond the vertices, and files that are cut off or damaged; Mitsuba reads negative indices as 0
    *(
        {"world.xml": mesh("m.ply"), "m.ply": PLY.replace(b"3 0 1 2", b"3 0 %d 1" % i)}
        for i in (4, 5, 10**6, 2**31 - 1)
    ),
    *(
        {"world.xml": mesh("m.serialized"), "m.serialized": bad}
        for bad in (MESH[:20], b"", MESH[:10] + b"\xff" * 9 + MESH[19:])
    ),
    # a million laughs: of entities, of variables, of included files
    {"world.xml": f'<!DOCTYPE scene [{ENTITIES}]>{scene("""<string name="x" value="&a8;"/>""")}'},
    {"world.xml": scene(f'{DEFAULTS}<string name="x" value="$a8"/>')},
    {
        "world.xml": including("0.xml"),
        **{f"{i}.xml": including(*[f"{i + 1}.xml"] * 10) for i in LAUGHS},
        "9.xml": scene(""),
    },
    *map(cycle, (1, 2, 20)),
    *(
        {"world.xml": scene(f'<shape type="sphere"><{tag} type="{kind}"/></shape>')}
        for tag in ("shape", "bsdf", "emitter", "integrator", "sampler", "texture")
        for kind in PLUGINS
    ),
    *(
        {
            "world.xml": scene(f'<default name="kind" value="{kind}"/><include filename="part.xml"/>'),
            "part.xml": scene('<shape type="$kind"/>'),
        }
        for kind in PLUGINS
    ),
    *(
        {"world.xml": scene(content)}
        for name in OUTSIDE
        for content in (
            f'<include filename="{name}/part.xml"/>',
            f'<path value="{name}"/>',
            f'<default name="at" value="{name}"/><shape type="obj"><string name="filename" value="$at/m.obj"/></shape>',
        )
    ),
]


def test_hostile_worlds_are_refused_in_one_short_sentence(tmp_path: Path) -> None:
    """Files by their XML, before Mitsuba starts; meshes in the process that reads them first."""
    for place in (tmp_path / BEYOND, tmp_path / "in" / "x"):
        place.mkdir(parents=True)
    (tmp_path / BEYOND / "m.obj").write_text(OBJ, encoding="utf-8")
    (tmp_path / BEYOND / "part.xml").write_text(scene(""), encoding="utf-8")
    folder = tmp_path / "in"
    (folder / "link").symlink_to(tmp_path / BEYOND)
    for files in HOSTILE:
        for name, content in files.items():
            (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        path = folder / "world.xml"
        with pytest.raises(InputError) as refused:
            try_world(check_world_files(path, WHERE), "scalar_rgb", f"{WHERE}: {path}")
        sentence = str(refused.value)
        assert sentence.startswith(f"{WHERE}: "), files
        assert sentence.isprintable(), files
        assert len(sentence) <= 300 + 2 * len(str(folder)), files


def test_sound_meshes_are_read(tmp_path: Path) -> None:
    for name, content in (("m.ply", PLY), ("m.obj", OBJ.encode()), ("m.serialized", serialized_mesh())):
        (tmp_path / name).write_bytes(content)
        path = tmp_path / "world.xml"
        path.write_text(mesh(name), encoding="utf-8")
        checked = check_world_files(path, WHERE)
        assert checked.files == [path, tmp_path / name]
        assert f'value="{tmp_path / name}"' in checked.text
        try_world(checked, "scalar_rgb", WHERE)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (OBJ + "f 1 2 9\n", "reference to invalid vertex 9"),
        (OBJ.replace("1 0 0", "nan 0 0"), "invalid vertex position data"),
        ("v 0 0 0\n", "m.obj: expected faces of existing vertices"),
    ],
)
def test_a_changed_mesh_is_tried_again_and_refused_with_its_reason(tmp_path: Path, content: str, reason: str) -> None:
    (tmp_path / "m.obj").write_text(OBJ, encoding="utf-8")
    path = tmp_path / "world.xml"
    path.write_text(mesh("m.obj"), encoding="utf-8")
    try_world(check_world_files(path, WHERE), "scalar_rgb", WHERE)
    (tmp_path / "m.obj").write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=reason):
        try_world(check_world_files(path, WHERE), "scalar_rgb", WHERE)


def test_includes_and_variables_become_one_text_with_its_places(tmp_path: Path) -> None:
    part = '<shape version="3.0.0"\n type="$kind" id="a">\n<float name="radius" value="$$half\\$"/></shape>'
    (tmp_path / "part.xml").write_text(part.replace("$$half", "${half}".replace("{half}", "r")), encoding="utf-8")
    content = (
        '<default name="kind" value="sphere"/>\n<default name="r" value="2"/>\n<include filename="part.xml" name="b"/>'
    )
    path = tmp_path / "world.xml"
    path.write_text(scene(content), encoding="utf-8")
    checked = check_world_files(path, WHERE)
    assert checked.text.splitlines()[1:4] == [
        '<shape type="sphere" id="a" name="b">',
        '<float name="radius" value="2\\$"/>',
        "</shape>",
    ]
    assert checked.place(3) == "part.xml (line 3)"
    assert checked.files == [path, tmp_path / "part.xml"]


def test_the_option_opens_files_outside(tmp_path: Path) -> None:
    inside = tmp_path / "in"
    inside.mkdir()
    (tmp_path / "m.obj").write_text(OBJ, encoding="utf-8")
    path = inside / "world.xml"
    path.write_text(mesh("../m.obj"), encoding="utf-8")
    with pytest.raises(InputError, match=r"in the folder of the world's file, got '../m.obj' .* --allow-outside"):
        check_world_files(path, WHERE)
    assert check_world_files(path, WHERE, allow_outside=True).files[1].resolve() == tmp_path / "m.obj"


@pytest.mark.parametrize("content", ['<include filename="f"/>', mesh("f.ply"), '<spectrum name="a" filename="f"/>'])
def test_fifos_are_refused_without_waiting(tmp_path: Path, content: str) -> None:
    for name in ("f", "f.ply"):
        os.mkfifo(tmp_path / name)
    path = tmp_path / "world.xml"
    path.write_text(content if "scene" in content else scene(content), encoding="utf-8")
    with pytest.raises(InputError, match="expected a regular file, got a FIFO"):
        check_world_files(path, WHERE)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InputError, match="expected a regular file, got a FIFO"):
        check_world_files(path, WHERE)


@pytest.mark.parametrize("path", sorted((GALLERY / "worlds").glob("*.xml")), ids=lambda path: path.stem)
def test_the_worlds_of_the_gallery_are_sound(path: Path) -> None:
    assert check_world_files(path, WHERE).files == [path]


def test_the_option_reaches_every_command_that_reads_a_world(here: Path, ommatid: Command) -> None:
    (here / "in").mkdir()
    (here / "m.obj").write_text("v -500 -500 1000\nv 500 -500 1000\nv 0 500 1000\nf 1 3 2\n", encoding="utf-8")
    (here / "in" / "world.xml").write_text(mesh("../m.obj"), encoding="utf-8")
    table = TINY.replace('image = "photo:camera"\norigin = [100, 230]\n', "")
    (here / "in" / "tiny.toml").write_text(f'{table}\n[world]\nfile = "world.xml"\n', encoding="utf-8")
    for command in ("show", "render", "run", "calibrate"):
        arguments = ["in/tiny.toml", *({"calibrate": ["-o", "m.npz"], "show": []}.get(command, ["-o", "out"]))]
        refused = ommatid(command, *arguments)
        assert (refused.code, refused.out) == (2, "")
        assert "got '../m.obj' outside it; move it there, or add --allow-outside" in refused.err
        assert sorted(path.name for path in here.iterdir()) == ["in", "m.obj", "tiny.toml"], "nothing is left behind"
    shown = ommatid("show", "in/tiny.toml", "--allow-outside", "--json")
    assert shown.code == 0, shown.err
    rendered = ommatid("render", "in/tiny.toml", "-o", "out", "--allow-outside")
    assert rendered.code == 0, rendered.err


def test_the_python_interface_has_the_option(tmp_path: Path) -> None:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY, encoding="utf-8")
    assert not read_scene(path).allows_outside
    assert read_scene(path, set="noise.variance=1e-3", allow_outside=True).allows_outside
