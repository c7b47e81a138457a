"""Whatever is wrong with the input: one sentence that helps, the right exit code, and no file left behind."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ommatid.scenes import stack

from ..conftest import TINY, Command, Ended, shell

RUN = ("run", "tiny.toml", "-o", "new")
RECONSTRUCT = ("reconstruct", "out/tiny/stack.exr", "out/tiny/model.npz", "-o", "new.exr")


def nothing(folder: Path) -> None:
    """The files are fine; it is the command that is not."""
    del folder


@dataclass(frozen=True)
class Case:
    """A command that has to be refused, words that its one sentence has to contain, and what was done to the files."""

    name: str
    arguments: tuple[str, ...]
    words: tuple[str, ...]
    prepare: Callable[[Path], None] = nothing


def told(setting: str, *words: str) -> Case:
    """A run of the tiny scene with one key changed on the command line."""
    return Case(setting, (*RUN, "--set", setting), words)


def text(old: str, new: str, *words: str) -> Case:
    """A run of the tiny scene with another text in its file."""
    assert old in TINY

    def prepare(folder: Path) -> None:
        (folder / "tiny.toml").write_text(TINY.replace(old, new, 1), encoding="utf-8")

    return Case(f"in the file: {words[0]}", RUN, ("tiny.toml", *words), prepare)


def picture(name: str, fill: Callable[[Path], None], *words: str) -> Case:
    """A run with a whole picture of one's own as its target."""
    settings = ("--set", f"target.image={name}", "--set", "target.origin=")
    return Case(f"picture {name}", (*RUN, *settings), words, lambda folder: fill(folder / name))


def note(path: Path) -> None:
    path.write_text("This is a note and no picture at all.\nIt has two lines.\n", encoding="utf-8")


def save(array: object) -> Callable[[Path], None]:
    return lambda path: np.save(path, np.asarray(array))


def with_nan(path: Path) -> None:
    target = np.full((12, 12), 100.0)
    target[5, 7] = np.nan
    np.save(path, target)


def cut(name: str, part: float) -> Callable[[Path], None]:
    """Keep the first part of a file, as a copy that was interrupted does."""

    def prepare(folder: Path) -> None:
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: int(part * len(whole))])

    return prepare


def flip(name: str, place: int) -> Callable[[Path], None]:
    """Flip a bit of one byte, counted from the end."""

    def prepare(folder: Path) -> None:
        altered = bytearray((folder / name).read_bytes())
        altered[-place] ^= 4
        (folder / name).write_bytes(altered)

    return prepare


class _Trap:
    """Pickled, it writes a file when somebody loads it."""

    def __reduce__(self) -> tuple[Callable[..., None], tuple[Path, bytes]]:
        return Path.write_bytes, (Path("sprung"), b"")  # type: ignore[return-value]


def pickled(folder: Path) -> None:
    trap = np.array([_Trap()], dtype=object)
    names = ("indices", "indptr", "data", "shape", "variance", "batches", "ommatid")
    np.savez(folder / "out/tiny/model.npz", **dict.fromkeys(names, trap))  # type: ignore[arg-type]


def other_arrays(folder: Path) -> None:
    np.savez(folder / "out/tiny/model.npz", x=np.eye(3))


def one_array(folder: Path) -> None:
    with (folder / "out/tiny/model.npz").open("wb") as stream:
        np.save(stream, np.eye(3))


def latin(folder: Path) -> None:
    (folder / "tiny.toml").write_bytes(TINY.replace("Tiny", "Für Käfer").encode("latin-1"))


def gone(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


SECOND_LENS = """[[camera.lens]]
name = "I"
magnification = "1/2"
array = [2, 2]
pixels = [3, 3]

[noise]"""

KEYS = [
    text("[render]", "[render]\nsede = 1", "'render.sede'", "'render.seed'"),
    text('distance = "1 m"', 'distnace = "1 m"', "unknown key 'target.distnace'", "'target.distance'"),
    text("[noise]", "[nois]", "unknown key 'nois'", "'noise'"),
    text("[noise]", '[noise]\n"read noise" = 1', "unknown key 'noise.read noise'"),
    text("array = [3, 3]", "arrays = [3, 3]", "unknown key 'camera.lens.I.arrays'", "'camera.lens.array'"),
    text('distance = "1 m"', "", "'target.distance' is missing"),
    text("[noise]", SECOND_LENS, "camera", "'I' twice"),
    text("samples = 16", "samples = 8", "render.samples", "16", "got 8"),
    text("variance = 1e-2", "variance = ", "not valid TOML"),
    text("[target]", "[target", "TOML"),
]

VALUES = [
    told("target.distance=1", "target.distance", "length with its unit", "bare number 1"),
    told("target.distance='1'", "target.distance", "length with its unit"),
    told("target.distance=1 s", "target.distance", "length with its unit", "'1 s'"),
    told("target.distance=1 parsnip", "target.distance", "'1 parsnip'"),
    told("target.distance=0 m", "target.distance", "above zero"),
    told("target.distance=-1 m", "target.distance", "above zero"),
    told("camera.pixel_pitch=true", "camera.pixel_pitch", "length with its unit"),
    told("camera.lens.I.magnification=2", "camera.lens.I.magnification", "at most 1", "got 2"),
    told("camera.lens.I.magnification=0", "camera.lens.I.magnification", "above 0", "got 0"),
    told("camera.lens.I.magnification='-1/3'", "camera.lens.I.magnification", "above 0"),
    told("camera.lens.I.magnification='abc'", "camera.lens.I.magnification", "ratio", "'abc'"),
    told("camera.lens.I.magnification='1/0'", "camera.lens.I.magnification", "ratio", "'1/0'"),
    told("camera.lens.I.array=[13,3]", "camera.lens.I.array", "13 x 3", "12 x 12"),
    told("camera.lens.I.array=[3,true]", "camera.lens.I.array", "integer"),
    told("camera.lens.I.array=[0,3]", "camera.lens.I.array", "got 0"),
    told("camera.lens.I.array=[3]", "camera.lens.I.array"),
    told("camera.lens.I.pixels=[4,3]", "camera.lens.I.pixels", "4 x 3", "at most 3 x 3"),
    told("camera.lens.I.pixels='fill'", "camera.lens.I.pixels", '"fit"'),
    told("camera.lens.I.step=-1", "camera.lens.I.step", "0 or more"),
    told("camera.lens.I.name='I.b'", "name", "'I.b'"),
    told("camera.lens.I.name=[1]", "name"),
    told("camera.lens=[]", "camera.lens"),
    told("camera.lens_pitch=10 um", "camera.lens_pitch", "I.00.00", "overlap"),
    told("noise.bits=true", "noise.bits", "integer", "True"),
    told("noise.bits=0", "noise.bits", "got 0"),
    told("noise.variance=-1", "noise.variance", "got -1"),
    told("noise.variance=nan", "noise.variance", "finite"),
    told("prior.variance=0", "prior.variance", "got 0"),
    told("render.seed=true", "render.seed", "integer", "True"),
    told("render.seed=1.5", "render.seed", "integer", "1.5"),
    told("render.samples=8", "render.samples", "16", "got 8"),
    told("render.variant='fast'", "render.variant", "'scalar_rgb'", "'fast'"),
    told("target.image=5", "target.image", "string", "got 5"),
    told("target.shape=[0,12]", "target.shape", "got 0"),
    told("target=", "'target' is missing"),
]

PICTURES = [
    told("target.image=none.png", "target.image", "none.png", "no picture"),
    told("target.image='photo:nobody'", "target.image", "'photo:nobody'", "camera"),
    told("target.image=tiny.toml", "target.image", "tiny.toml", "PNG"),
    told("target.origin=[505,0]", "target.origin", "[505, 0]", "512 x 512"),
    told("target.origin=[-1,0]", "target.origin", "got -1"),
    told("target.origin=", "target.shape", "12 x 12", "512 x 512", "target.origin"),
    Case(
        "an empty crop",
        (*RUN, "--set", "target.origin=[512,0]", "--set", "target.shape="),
        ("target.origin", "0 x 512", "empty"),
    ),
    picture("note.tif", note, "note.tif could not be read as a picture"),
    picture("note.npy", note, "note.npy could not be read as a picture"),
    picture("note.exr", note, "note.exr", "OpenEXR"),
    picture("nan.npy", with_nan, "nan.npy", "NaN"),
    picture("infinite.npy", save(np.full((12, 12), np.inf)), "infinite.npy", "infinite"),
    picture("small.npy", save(np.ones((11, 12))), "target.shape", "12 x 12", "11 x 12"),
    picture("complex.npy", save(np.ones((12, 12), complex)), "complex128"),
    picture("cube.npy", save(np.ones((12, 12, 7))), "(12, 12, 7)"),
    picture("empty.npy", save(np.ones((0, 12))), "(0, 12)"),
    picture("object.npy", save(np.array([[_Trap()]], dtype=object)), "could not be read as a picture"),
    Case(
        "a picture cut short",
        (*RUN, "--set", "target.image=out/tiny/overview.png"),
        ("overview.png", "could not be read as a picture"),
        cut("out/tiny/overview.png", 0.5),
    ),
]

FILES = [
    Case("a missing scene", ("run", "none.toml", "-o", "new"), ("none.toml", "ommatid init")),
    Case("a folder for a scene", ("run", "out", "-o", "new"), ("out", "scene file")),
    Case("a scene that is not UTF-8", RUN, ("tiny.toml", "utf-8"), latin),
    *[
        Case(f"a stack cut at {part}", RECONSTRUCT, ("out/tiny/stack.exr",), cut("out/tiny/stack.exr", part))
        for part in (0, 0.01, 0.1, 0.3, 0.6, 0.9, 0.97, 0.999)
    ],
    *[
        Case(
            f"a stack altered {place} bytes from its end",
            RECONSTRUCT,
            ("stack.exr",),
            flip("out/tiny/stack.exr", place),
        )
        for place in (1, 20, 40, 75)  # the pixels of the last sub-image, compressed
    ],
    *[
        Case(f"a model cut at {part}", RECONSTRUCT, ("out/tiny/model.npz",), cut("out/tiny/model.npz", part))
        for part in (0, 0.01, 0.3, 0.6, 0.9, 0.999)
    ],
    *[
        Case(
            f"a model altered {place} bytes from its end",
            RECONSTRUCT,
            ("model.npz",),
            flip("out/tiny/model.npz", place),
        )
        for place in (1200, 2000, 4000)
    ],
    Case("a model with pickled objects", RECONSTRUCT, ("out/tiny/model.npz", "pickled"), pickled),
    Case("another kind of .npz", RECONSTRUCT, ("out/tiny/model.npz", "a model that ommatid wrote"), other_arrays),
    Case("an array that is no archive", RECONSTRUCT, ("out/tiny/model.npz", "a model that ommatid wrote"), one_array),
    Case("a missing stack", RECONSTRUCT, ("out/tiny/stack.exr", "no such file"), gone("out/tiny/stack.exr")),
    Case("a missing model", RECONSTRUCT, ("out/tiny/model.npz", "no such file"), gone("out/tiny/model.npz")),
    Case(
        "a model for a stack",
        ("reconstruct", "out/tiny/model.npz", "out/tiny/model.npz", "-o", "new.exr"),
        ("out/tiny/model.npz", "OpenEXR"),
    ),
    Case(
        "a stack for a model",
        ("reconstruct", "out/tiny/stack.exr", "out/tiny/stack.exr", "-o", "new.exr"),
        ("out/tiny/stack.exr", "a model that ommatid wrote"),
    ),
    Case(
        "an estimate for a stack",
        ("reconstruct", "out/tiny/estimate.exr", "out/tiny/model.npz", "-o", "new.exr"),
        ("out/tiny/estimate.exr", "stack of sub-images"),
    ),
]

OPTIONS = [
    Case("--set without =", (*RUN, "--set", "noise.variance"), ("--set noise.variance", "KEY=VALUE")),
    Case("--set without a key", (*RUN, "--set", "=1"), ("--set =1", "KEY=VALUE")),
    told("camera.lens.X.step=1", "no lens type is called 'X'", "'I'"),
    told("title.x=1", "title"),
    told("noise.varaince=1", "unknown key 'noise.varaince'", "'noise.variance'"),
    Case("--lens with an unknown name", (*RUN, "--lens", "I,X"), ("--lens I,X", "no lens type is called 'X'", "'I'")),
    Case("--lens for a stack without it", (*RECONSTRUCT, "--lens", "X"), ("--lens X", "I")),
    *[
        Case(f"{setting} when all is recorded", (*RECONSTRUCT, "--set", setting), ("--set", f"[{table}]", "prior"))
        for setting, table in (
            ("render.seed=1", "render"),
            ("target.distance=2 m", "target"),
            ("target.shape=[3,3]", "target"),
            ("calibration.samples=32", "calibration"),
        )
    ],
    Case("an unknown option", (*RUN, "--fast"), ("--fast",)),
    Case("an unknown command", ("launch", "tiny.toml"), ("launch",)),
    Case("no command", (), ("command",)),
    Case("no scene", ("run",), ("SCENE",)),
    Case("no output", ("calibrate", "tiny.toml"), ("--output",)),
    Case("a file for the folder", ("run", "tiny.toml", "-o", "tiny.toml"), ("tiny.toml", "folder")),
    Case("a folder for the estimate", (*RECONSTRUCT[:-1], "out"), ("out", "folder")),
    Case("a folder for the model", ("calibrate", "tiny.toml", "-o", "out"), ("out", "folder")),
    Case("a picture for the estimate", (*RECONSTRUCT[:-1], "new.png"), ("new.png", "new.exr")),
    Case("no folder for the model", ("calibrate", "tiny.toml", "-o", "no/new.npz"), ("no/new.npz", "does not exist")),
    Case("no folder for the estimate", (*RECONSTRUCT[:-1], "no/new.exr"), ("no/new.exr", "does not exist")),
    Case("no folder for the export", ("export", "tiny.toml", "-o", "no/new.xml"), ("no/new", "does not exist")),
    Case("no folder for a new scene", ("init", "no/new.toml"), ("no/new.toml", "does not exist")),
    Case("another ending for the export", ("export", "tiny.toml", "-o", "new.obj"), ("new.obj", ".xml")),
]


def contents(folder: Path) -> dict[str, bytes]:
    """Every file below a folder, hidden ones too, and every folder."""
    found = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in found}


def assert_refused(ended: Ended, *words: str, code: int = 2) -> None:
    assert ended.code == code, ended.err
    assert ended.out == ""
    [line] = ended.err.splitlines()
    assert line.startswith("ommatid: ")
    assert "unexpected" not in line
    for word in words:
        assert word in line


@pytest.mark.parametrize("case", [*KEYS, *VALUES, *PICTURES, *FILES, *OPTIONS], ids=lambda case: case.name)
def test_one_sentence_and_nothing_left_behind(case: Case, here: Path, kept: Path, ommatid: Command) -> None:
    assert kept.is_dir()
    case.prepare(here)
    before = contents(here)
    assert_refused(ommatid(*case.arguments), *case.words)
    assert contents(here) == before


def test_the_trap_in_the_pickles_works(here: Path, kept: Path) -> None:
    pickled(here)
    with np.load(kept / "model.npz", allow_pickle=True) as trapped:
        assert trapped["data"].size == 1
    assert (here / "sprung").exists()


@pytest.mark.parametrize("name", ["note.png", "note.jpg"])
def test_a_text_called_a_picture(name: str, here: Path) -> None:
    # The decoders that try their luck leave the file open: a process of its own, where nobody minds.
    note(here / name)
    before = contents(here)
    ended = shell(*RUN, "--set", f"target.image={name}", cwd=here)
    assert_refused(ended, "target.image", f"{name} could not be read as a picture")
    assert contents(here) == before


@pytest.mark.parametrize(
    ("setting", "key"),
    [
        ("camera.lens.I.array=[2,2]", "camera.lens.I"),
        ("camera.lens.I.magnification='1/2'", "camera.lens.I"),
        ("camera.lens.I.name=J", "camera.lens.I"),
        ("camera.pixel_pitch=5 um", "camera.pixel_pitch"),
        ("camera.lens_pitch=1 mm", "camera.lens_pitch"),
        ("target.shape=[12,13]", "target.shape"),
        ("target.pixel_pitch=2 mm", "target.pixel_pitch"),
        ("target.distance=2 m", "target.distance"),
    ],
)
def test_a_stack_and_a_model_that_do_not_belong_together(
    setting: str, key: str, here: Path, kept: Path, ommatid: Command
) -> None:
    options = ("--set", "calibration.method=ideal", "--set", setting)
    assert ommatid("calibrate", "tiny.toml", "-o", "other.npz", *options).code == 0
    before = contents(here)
    ended = ommatid("reconstruct", kept / "stack.exr", "other.npz", "-o", "new.exr")
    assert_refused(ended, "stack.exr", "other.npz", "do not belong together", f"{key} is ")
    assert contents(here) == before


def test_one_model_serves_stacks_of_other_pictures_noise_and_seeds(here: Path, kept: Path, ommatid: Command) -> None:
    other = ("target.origin=[10,20]", "noise.bits=8", "render.seed=5", "prior.mean=100", "title=Other")
    settings = [word for setting in other for word in ("--set", setting)]
    assert ommatid("render", "tiny.toml", "-o", "new", *settings).code == 0
    assert ommatid("reconstruct", "new/tiny/stack.exr", kept / "model.npz", "-o", here / "new.exr").code == 0


def full_after(size: int) -> str:
    """Python that lets no file of its process grow beyond a size, as a disk without room does."""
    return f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))"


def test_a_full_disk_for_the_stack_leaves_the_old_one(here: Path, kept: Path) -> None:
    old = contents(kept)
    room = max(len(old["scene.toml"]), len(old["truth.exr"])) + 100  # they come first, and find their place
    assert room < len(old["stack.exr"])
    arguments = ("render", "tiny.toml", "-o", "out", "--set", "render.seed=1")
    ended = shell(*arguments, cwd=here, before=full_after(room))
    assert_refused(ended, "out/tiny/stack.exr", "could not be written", code=1)
    new = contents(kept)
    assert new.keys() == old.keys()
    assert new["stack.exr"] == old["stack.exr"]
    assert stack.read(kept / "stack.exr").scene.render.seed == 0


@pytest.mark.parametrize(
    ("arguments", "file", "room"),
    [
        (("calibrate", "tiny.toml", "-o", "new.npz"), "new.npz", 2000),
        (("calibrate", "tiny.toml", "-o", "new.npz"), "new.npz", 0),
        (RECONSTRUCT, "new.exr", 1000),
        (RECONSTRUCT, "new.exr", 0),
        (("init", "new.toml"), "new.toml", 1000),
    ],
)
def test_a_full_disk_leaves_no_file(arguments: tuple[str, ...], file: str, room: int, here: Path, kept: Path) -> None:
    assert kept.is_dir()
    before = contents(here)
    ended = shell(*arguments, cwd=here, before=full_after(room))
    assert_refused(ended, file, "could not be written", "free some space", code=1)
    assert contents(here) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("options", [(), ("--json",)], ids=["table", "json"])
def test_a_full_disk_for_what_is_printed(options: tuple[str, ...], here: Path) -> None:
    before = "import os; os.dup2(os.open('/dev/full', os.O_WRONLY), 1)"
    assert_refused(shell("show", "tiny.toml", *options, cwd=here, before=before), "No space left", code=1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_may_not_be_written_to(here: Path, ommatid: Command) -> None:
    (here / "locked").mkdir(mode=0o500)
    assert_refused(ommatid("run", "tiny.toml", "-o", "locked"), "locked", "could not be created", code=1)
