"""Invalid input yields one sentence, exit code 2, and no new file: what people do, one case of each kind.

Damaged files and extreme values are those of tests/fuzz.
"""

from __future__ import annotations

import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ommatid.cli.failures import WITHDRAWN, WITHDRAWN_COMMANDS
from ommatid.scenes import stack

from ..conftest import TINY, Command, Ended, shell

RUN = ("run", "tiny.toml", "-o", "new")
RECONSTRUCT = ("reconstruct", "out/tiny/stack.exr", "out/tiny/model.npz", "-o", "new.exr")


def unchanged(folder: Path) -> None:
    """Leave the files as they are, where the command itself is wrong."""
    del folder


@dataclass(frozen=True)
class Case:
    """A command that must be refused, words of its error message, and the preparation of the files."""

    name: str
    arguments: tuple[str, ...]
    words: tuple[str, ...]
    prepare: Callable[[Path], None] = unchanged


def setting(change: str, *words: str) -> Case:
    """Run the tiny scene with one key changed on the command line."""
    return Case(change, (*RUN, "--set", change), words)


def edited(old: str, new: str, *words: str) -> Case:
    """Run the tiny scene with a part of its file replaced."""
    assert old in TINY

    def prepare(folder: Path) -> None:
        (folder / "tiny.toml").write_text(TINY.replace(old, new, 1), encoding="utf-8")

    return Case(f"in the file: {words[0]}", RUN, ("tiny.toml", *words), prepare)


def picture(name: str, fill: Callable[[Path], None], *words: str) -> Case:
    """Run with the picture that `fill` writes as the whole target."""
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


class _WritesFile:
    """Writes a file when it is unpickled."""

    def __reduce__(self) -> tuple[Callable[..., None], tuple[Path, bytes]]:
        return Path.write_bytes, (Path("unpickled"), b"")  # type: ignore[return-value]


def pickled(folder: Path) -> None:
    array = np.array([_WritesFile()], dtype=object)
    names = ("indices", "indptr", "data", "shape", "variance", "batches", "ommatid")
    np.savez(folder / "out/tiny/model.npz", **dict.fromkeys(names, array))  # type: ignore[arg-type]


def latin_1(folder: Path) -> None:
    (folder / "tiny.toml").write_bytes(TINY.replace("Tiny", "Für Käfer").encode("latin-1"))


def removed(name: str) -> Callable[[Path], None]:
    return lambda folder: (folder / name).unlink()


SECOND_LENS = """[[camera.lens]]
name = "I"
magnification = "1/2"
array = [2, 2]
pixels = [3, 3]

[noise]"""

KEYS = [
    edited("[render]", "[render]\nsede = 1", "'render.sede'", "'render.seed'"),
    edited('distance = "1 m"', 'distnace = "1 m"', "unknown key 'target.distnace'", "'target.distance'"),
    edited("[noise]", "[nois]", "unknown key 'nois'", "'noise'"),
    edited("[noise]", SECOND_LENS, "camera", "'I' twice"),
    edited("variance = 1e-2", "variance = ", "not valid TOML"),
    edited('"6 um"', "6 um", "line 15, pixel_pitch = 6 um: ", "texts and quantities take quotation marks"),
]

VALUES = [
    setting("target.distance=1", "target.distance", "length with its unit", "bare number 1"),
    setting("camera.lens.I.magnification=2", "camera.lens.I.magnification", "at most 1", "got 2"),
    setting("camera.lens.I.array=[13,3]", "camera.lens.I.array", "13 x 3", "12 x 12"),
    setting("camera.lens.I.pixels=[4,3]", "camera.lens.I.pixels", "4 x 3", "at most 3 x 3"),
    setting("camera.lens_pitch=10 um", "camera.lens_pitch", "I.00.00", "overlap"),
    setting("noise.variance=nan", "noise.variance", "finite"),
    setting("target=", "'target' is missing"),
]

PICTURES = [
    setting("target.image='photo:unknown'", "target.image", "'photo:unknown'", "camera"),
    setting("target.image=tiny.toml", "target.image", "tiny.toml", "PNG"),
    setting("target.origin=", "target.shape", "12 x 12", "512 x 512", "target.origin"),
    Case(
        "an empty crop",
        (*RUN, "--set", "target.origin=[512,0]", "--set", "target.shape="),
        ("target.origin", "0 x 512", "empty"),
    ),
    picture("note.tif", note, "note.tif could not be read as a picture"),
    picture("nan.npy", with_nan, "nan.npy", "NaN"),
    picture("small.npy", save(np.ones((11, 12))), "target.shape", "12 x 12", "11 x 12"),
    picture("object.npy", save(np.array([[_WritesFile()]], dtype=object)), "could not be read as a picture"),
]

FILES = [
    Case("a missing scene", ("run", "none.toml", "-o", "new"), ("none.toml", "ommatid init")),
    Case("a folder for a scene", ("run", "out", "-o", "new"), ("out", "scene file")),
    Case("a scene that is not UTF-8", RUN, ("tiny.toml", "UTF-8"), latin_1),
    Case("a model with pickled objects", RECONSTRUCT, ("out/tiny/model.npz", "pickled"), pickled),
    Case("a missing stack", RECONSTRUCT, ("out/tiny/stack.exr", "no such file"), removed("out/tiny/stack.exr")),
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
    setting("camera.lens.X.step=1", "no lens type is called 'X'", "'I'"),
    setting("noise.varaince=1", "unknown key 'noise.varaince'", "'noise.variance'"),
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
    Case("no scene", ("run", "--strict"), ("SCENE",)),
    Case("no output", ("calibrate", "tiny.toml"), ("--output",)),
    Case("a file for the folder", ("run", "tiny.toml", "-o", "tiny.toml"), ("tiny.toml", "folder")),
    Case("a picture for the estimate", (*RECONSTRUCT[:-1], "new.png"), ("new.png", "new.exr")),
    Case("no folder for the model", ("calibrate", "tiny.toml", "-o", "no/new.npz"), ("no/new.npz", "does not exist")),
    Case("no folder for a new scene", ("init", "no/new.toml"), ("no/new.toml", "does not exist")),
]


# What newcomers type: a command, and words of the sentence that leads to the cure.
WRONG = {
    # shapes, numbers and tables
    "show tiny.toml --set target.shape=19": "target.shape: expected [rows, columns], two whole numbers of at least 1",
    "show tiny.toml --set target.shape=[19]": "such as [19, 19], got [19]",
    "show tiny.toml --set target.shape=19x19": "got '19x19'",
    "show tiny.toml --set target.origin=96": "target.origin: expected [row, column]",
    "show tiny.toml --set camera.lens.I.array=3": "camera.lens.I.array: expected [rows, columns]",
    "show tiny.toml --set camera.lens.I.pixels=5": 'or "fit", got 5',
    "show tiny.toml --set camera.lens=3": "expected a table [[camera.lens]] for each lens type",
    "show tiny.toml --set noise=0.01": "noise: expected a table, whose keys are variance, bits, saturation",
    "show tiny.toml --set noise.variance=1,5": "expected a number, got '1,5'; decimals take a point",
    "show tiny.toml --set noise.variance=-1": "tiny.toml with --set noise.variance=-1: noise.variance: expected",
    "show tiny.toml --set camera.lens.*.pixels=[9,9]": "with --set camera.lens.*.pixels=[9,9]: camera.lens.I.pixels",
    "show tiny.toml --set noise.bits=8 --set noise.sigma=1": "tiny.toml with --set noise.sigma=1: unknown key",
    "show tiny.toml --set render.seed=1 --set target.image=a.png": "with --set target.image=a.png: target.image: ",
    "show tiny.toml --set noise.bits=8.5": "expected a whole number, got 8.5",
    "show tiny.toml --set noise.bits=64": "expected a number of at most 24",
    "show tiny.toml --set camera.walls=yes": "expected true or false, got 'yes'",
    "show tiny.toml --set camera.lens.I.magnification=0.333": 'got 0.333: write "1/3" if that is meant, or "333/1000"',
    "show tiny.toml --set camera.lens.I.magnification=1:3": 'expected a ratio such as "1/3"',
    # units
    "show tiny.toml --set camera.pixel_pitch=6": 'such as "6 um" or "6 mm", got the bare number 6',
    "show tiny.toml --set camera.wavelength=550": 'such as "550 nm" or "550 mm"',
    "show tiny.toml --set camera.pixel_pitch='6 pixels'": "expected a length with its unit",
    "show tiny.toml --set camera.tolerance.rotation=1": "expected an angle with its unit",
    # names of keys
    "show tiny.toml --set camera.lens.I.magnifcation=1/3": "the nearest known key is 'camera.lens.magnification'",
    "show tiny.toml --set camera.lens.I.focal=2mm": "the nearest known key is 'camera.lens.focal_length'",
    "show tiny.toml --set noise.sigma=1": "the keys there are variance, bits, saturation",
    "show tiny.toml --set prior.kind=gaussian": "expected 'independent', 'exponential', 'power' or 'fit'",
    "show tiny.toml --set noise.variance:1": "expected KEY=VALUE",
    # options and commands
    "run tiny.toml --samples 100": "it is a key of the scene, as in --set render.samples=VALUE",
    "run tiny.toml -set noise.variance=1": "long ones begin with two dashes, as in --set",
    "run --dry-run": "Missing argument 'SCENE...'; `ommatid run -h` says what it is",
    "run tiny.toml --workers two": "expected a number, as in 4",
    "run tiny.toml --workers 0": "expected a number of at least 1",
    "run tiny.toml --within 30": 'expected a time with its unit, such as "2 min"',
    "run tiny.toml --sweep noise.variance=1e-4..1e-2": "dots stand between commas, as in noise.bits=8,...,12",
    "run tiny.toml --format jpg": "expected names of npy, tiff16, tiff32 (the estimate), svg, pdf (figures), got 'jpg'",
    "predict tiny.toml --format npy": "no estimate is written here",
    "tile19": "expected a command before the scene, as in: ommatid run tile19",
    "rnu tiny.toml": "Did you mean 'run'?",
    "simulate tiny.toml": "`ommatid -h` lists the commands",
    # files
    "show tiny": "did you mean 'tiny.toml'?",
    "show tile19.tml": "did you mean 'tile19'?",
    "show out": "expected a scene file, got a folder",
    "show out/tiny/stack.exr": "expected a scene file, a text in UTF-8",
    "reconstruct out/tiny/model.npz out/tiny/stack.exr -o x": "got a model; name the model last",
    "reconstruct out/tiny/stack.exr -o x": "name its model, model.npz, after it",
    "reconstruct out/tiny/stack.exr out/tiny -o x": "got a folder; name its model.npz, or: ommatid report out/tiny",
    "reconstruct photo.png out/tiny/model.npz -o x": "ommatid import SCENE photo.png -o stack.exr",
    "import photo.png tiny.toml -o x.exr": "photo.png: no such scene file",
    "import tiny.toml photo.png -o x.png": "expected the name of a stack, ending in .exr, such as x.exr",
    "calibrate tiny.toml -o model.toml": "expected the name of a model, ending in .npz, such as model.npz",
    "report tiny.toml": "expected a folder of results, or a stack, which ends in .exr",
    "design tiny.toml --steer 1,2": "expected the folder of a run, or ROW,COLUMN,ROWS,COLUMNS",
}


@pytest.mark.usefixtures("kept")
def test_what_newcomers_type_is_answered_by_a_sentence_that_leads_to_the_cure(here: Path, ommatid: Command) -> None:
    before = contents(here)
    for command, words in WRONG.items():
        assert_refused(ommatid(*shlex.split(command)), words)
    assert contents(here) == before


def contents(folder: Path) -> dict[str, bytes]:
    """Return every file and folder below a folder, hidden ones included, with its bytes."""
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else b"" for path in paths}


def assert_refused(ended: Ended, *words: str, code: int = 2) -> None:
    assert ended.code == code, ended.err
    assert ended.out == ""
    [line] = ended.err.splitlines()
    assert line.startswith("ommatid: ")
    assert "unexpected" not in line
    for word in words:
        assert word in line


def test_invalid_input_yields_one_sentence_and_no_file(here: Path, kept: Path, ommatid: Command) -> None:
    assert kept.is_dir()
    sound = {path: path.read_bytes() for path in here.rglob("*") if path.is_file()}
    for case in (*KEYS, *VALUES, *PICTURES, *FILES, *OPTIONS):
        case.prepare(here)
        before = contents(here)
        assert_refused(ommatid(*case.arguments), *case.words)
        assert contents(here) == before, case.name
        for path, content in sound.items():
            path.write_bytes(content)


def test_a_withdrawn_option_names_what_replaces_it(here: Path, ommatid: Command) -> None:
    """One test for all options that are no longer."""
    assert {"--tls-ca", "--tls-cert", "--tls-key"} <= WITHDRAWN.keys()
    for option, replacement in WITHDRAWN.items():
        for given in ((option, "x"), (f"{option}=x",)):
            assert_refused(ommatid(*RUN, *given), f"{option}: this option is withdrawn; {replacement}")
    for command, replacement in WITHDRAWN_COMMANDS.items():
        assert_refused(ommatid(command, "model.npz"), f"{command}: this command is withdrawn; {replacement}")
    assert [path.name for path in here.iterdir()] == ["tiny.toml"]


def test_a_stack_and_a_model_of_different_cameras_are_refused(here: Path, kept: Path, ommatid: Command) -> None:
    for changed, key in (
        ("camera.lens.I.array=[2,2]", "camera.lens.I"),
        ("camera.lens.I.name=J", "camera.lens.I"),
        ("camera.pixel_pitch=5 um", "camera.pixel_pitch"),
        ("target.shape=[12,13]", "target.shape"),
        ("target.distance=2 m", "target.distance"),
    ):
        options = ("--set", "calibration.method=ideal", "--set", changed)
        assert ommatid("calibrate", "tiny.toml", "-o", "other.npz", *options).code == 0
        before = contents(here)
        ended = ommatid("reconstruct", kept / "stack.exr", "other.npz", "-o", "new.exr")
        assert_refused(ended, "stack.exr", "other.npz", "do not belong together", f"{key} is ")
        assert contents(here) == before


def test_a_model_fits_stacks_of_other_pictures_noise_and_seeds(here: Path, kept: Path, ommatid: Command) -> None:
    other = ("target.origin=[10,20]", "noise.bits=8", "render.seed=5", "prior.mean=100", "title=Other")
    settings = [word for setting in other for word in ("--set", setting)]
    assert ommatid("render", "tiny.toml", "-o", "new", *settings).code == 0
    assert ommatid("reconstruct", "new/tiny/stack.exr", kept / "model.npz", "-o", here / "new.exr").code == 0


def full_after(size: int) -> str:
    """Return Python code that limits the size of files, as a full disk does."""
    return f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))"


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_stack(here: Path, kept: Path) -> None:
    old = contents(kept)
    room = max(len(old["scene.toml"]), len(old["truth.exr"])) + 100  # written first, and small enough
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
        pytest.param(("calibrate", "tiny.toml", "-o", "new.npz"), "new.npz", 100, marks=pytest.mark.slow),
        pytest.param(RECONSTRUCT, "new.exr", 1000, marks=pytest.mark.slow),
        (("init", "new.toml"), "new.toml", 1000),
    ],
)
def test_a_full_disk_leaves_no_file(arguments: tuple[str, ...], file: str, room: int, here: Path, kept: Path) -> None:
    assert kept.is_dir()
    before = contents(here)
    ended = shell(*arguments, cwd=here, before=full_after(room))
    assert_refused(ended, file, "could not be written", "free some space", code=1)
    assert contents(here) == before


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_estimate(here: Path, kept: Path, ommatid: Command) -> None:
    assert kept.is_dir()
    assert ommatid(*RECONSTRUCT).code == 0
    before = contents(here)
    ended = shell(*RECONSTRUCT, "--set", "prior.variance=100", cwd=here, before=full_after(1000))
    assert_refused(ended, "new.exr", "could not be written", code=1)
    assert contents(here) == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_output_that_cannot_be_printed_is_an_error(here: Path) -> None:
    before = "import os; os.dup2(os.open('/dev/full', os.O_WRONLY), 1)"
    assert_refused(shell("show", "tiny.toml", "--json", cwd=here, before=before), "No space left", code=1)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_write_permission_is_refused(here: Path, ommatid: Command) -> None:
    (here / "locked").mkdir(mode=0o500)
    assert_refused(ommatid("run", "tiny.toml", "-o", "locked"), "locked", "could not be created", code=1)
