"""Limits of numbers, names, nesting and memory in files and options, refused in one sentence."""

from __future__ import annotations

import json
import struct
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError, shortened, shortened_repr
from ommatid.runtime.memory import check_memory, free_memory
from ommatid.scenes import camera, model_file, scene, stack
from ommatid.scenes.formats import exr, lens_file, npz, picture_file
from ommatid.scenes.hardware import frames
from ommatid.scenes.optics.blur import blur_of

from ..conftest import TINY, Command, shell
from ..examples import scene as example

GIBI = 2**30


def read(path: Path, *changes: str) -> Any:
    """Return the tiny scene with some changes, and its camera."""
    file = path / "tiny.toml"
    file.write_text(TINY, encoding="utf-8")
    described = scene.read(file, changes)
    return described, camera.derive(described)


@pytest.mark.parametrize(
    "text",
    [
        *("9**9**9 m", "9**9**9**9 m", "(9**9)**(9**9) m", "1 m**9**9**9", "9⁹⁹⁹⁹⁹⁹⁹⁹ m", "1e999999999 m", "1e400 m"),
        *("9 squared squared squared squared squared squared m", "1" * 100000 + " m", "1 " + "a" * 100000),
        *("1 " + "m*" * 5000 + "m", "(" * 5000 + "1 m", "1e16 mm", "1e-16 mm", "nan m", "m"),
    ],
    ids=lambda text: text[:20],
)
def test_a_length_is_a_number_and_a_unit(text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"target.distance: expected a length") as refused:
        read(tmp_path, f"target.distance='{text}'")
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    ("text", "length"),
    [
        ("6 um", 6e-3),
        ("1e-3 m", 1.0),
        ("1/2 mm", 0.5),
        ("1_000 µm", 1.0),
        ("2mm", 2.0),
        ("3*mm", 3.0),
        ("1 m**2/m", 1e3),
    ],
)
def test_lengths_are_still_written_in_many_ways(text: str, length: float, tmp_path: Path) -> None:
    described, _ = read(tmp_path, f"target.distance='{text}'")
    assert described.target.distance == pytest.approx(length, rel=1e-12)


@pytest.mark.parametrize("text", ["500 lm/m**2", "500 lm / m^2", "500 lm/m²", "0.5 klux"])
def test_illuminances_are_still_written_in_many_ways(text: str, tmp_path: Path) -> None:
    sensor = f'{{illuminance = "{text}", exposure = "1 ms"}}'
    changes = (f"sensor={sensor}", "noise=", "camera.lens.I.aperture='0.1 mm'")
    assert read(tmp_path, *changes)[0].sensor.illuminance == pytest.approx(500, rel=1e-12)


@pytest.mark.parametrize("text", ["1e-9999999999", "1e99999999", "1/" + "9" * 4000, "0." + "3" * 10**6, "9" * 5000])
@pytest.mark.parametrize("key", ["magnification", "step"])
def test_a_ratio_is_one_of_few_digits(key: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"camera.lens.I.{key}: expected a ratio") as refused:
        read(tmp_path, f"camera.lens.I.{key}='{text}'")
    assert len(str(refused.value)) < 400


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ("9" * 5000, "thousands of digits"),
        ("0x" + "f" * 5000, "64 bits"),
        ("9" * 30, "64 bits"),
        ("[" * 100000, "brackets go deeper"),
        ("[" * 2000 + "]" * 2000, "go deeper"),
        ("[" * 100 + "]" * 100, "go deeper"),
        ("{a." + "a." * 500 + "a = 1}", "go deeper"),
    ],
    ids=["digits", "bits", "digits of 64 bits", "open", "closed", "deep", "dotted"],
)
def test_excessive_numbers_and_nesting_are_refused(value: str, words: str, tmp_path: Path) -> None:
    file = tmp_path / "x.toml"
    file.write_text(f"title = {value}\n{TINY.partition('[target]')[2]}", encoding="utf-8")
    with pytest.raises(InputError, match=words):
        scene.read(file)
    with pytest.raises(InputError, match="title"):  # on the command line what is no TOML is text
        read(tmp_path, f"title.x={value}")
    with pytest.raises(InputError, match="not valid TOML"):
        lens_file.read_lens(file)


def test_a_key_of_too_many_tables_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="deeper than 16 tables"):
        read(tmp_path, "a." * 5000 + "b=1")


@pytest.mark.parametrize("key", ["target.image", "world.file", "camera.lens.I.surfaces"])
@pytest.mark.parametrize("name", [r"a\u0000b", "b" * 300, "c/" * 3000, " "], ids=["NUL", "long", "deep", "none"])
def test_impossible_file_names_are_refused(key: str, name: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=f"{key}.*expected the name of a file"):
        read(tmp_path, f'{key}="{name}"')


def test_messages_stay_short(tmp_path: Path) -> None:
    assert len(shortened_repr({"a" * 1000: ["b" * 1000] * 1000})) < 700
    assert shortened("a") == "a"
    assert len(shortened("a" * 1000)) < 100
    long = "x" * 9000
    changes = (f"{long}=1", "title=[" + "1," * 9000 + "]", f"prior.kind={long}", f"render.samples={long}", long)
    for change in changes:
        with pytest.raises(InputError) as refused:
            read(tmp_path, change)
        assert len(str(refused.value)) < 600
    named = [f"--set camera.lens.{'x' * 999}.step=1"]
    data = {"camera": {"lens": [{"name": "n" * 999 + str(number)} for number in range(99)]}}
    with pytest.raises(InputError, match="89 more") as refused:
        scene.with_changes(data, tmp_path, [named[0].removeprefix("--set ")], ())
    assert len(str(refused.value)) < 2500


def test_a_lens_radius_close_to_zero_is_refused(tmp_path: Path) -> None:
    (tmp_path / "lens.dat").write_text("1e-40 1 1.5 2\n-10 0 1 2\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"line 1: radius: expected a radius of curvature"):
        lens_file.read_lens(tmp_path / "lens.dat")


def test_a_blur_that_cannot_be_computed_is_refused() -> None:
    lens = example().camera.lens[0]
    for update in ({"aperture": 1e4, "focus": 1.0}, {"aperture": 1e-3}):
        table = example().camera.model_copy(update={"lens": (lens.model_copy(update=update),)})
        derived = camera.derive(example().model_copy(update={"camera": table}))
        with pytest.raises(InputError, match=r"its blur reaches|expected a cone of light of f/0\.5"):
            blur_of(derived, derived.types[0])


# Files


def write_circular_tiff(path: Path) -> None:
    """Write two pages, the second of which names the first as the next."""
    import tifffile

    page = np.zeros((20, 20), np.uint16)
    tifffile.imwrite(path, np.stack([page, page]), photometric="minisblack", metadata=None)
    data = bytearray(path.read_bytes())
    with tifffile.TiffFile(path) as file:
        first, second = (int(page.offset) for page in file.pages)
    entries = int.from_bytes(data[second : second + 2], "little")
    offset = second + 2 + 12 * entries
    data[offset : offset + 4] = first.to_bytes(4, "little")
    path.write_bytes(data)


def test_a_tiff_with_a_circular_list_of_pages_is_read_once(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    write_circular_tiff(path)
    assert len(frames.pictures_of(path, "images")) == 2
    with pytest.raises(InputError, match="expected one picture, got 2 pages"):
        picture_file.decode(path, "here")


def test_many_pages_need_the_memory_of_their_own_number_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import tifffile

    tifffile.imwrite(tmp_path / "a.tif", np.zeros((40, 1000, 1000), np.uint16), photometric="minisblack")
    monkeypatch.setattr(
        "ommatid.runtime.memory.free_memory", lambda: 110 * 10**6
    )  # two bytes a number; one page as floats
    assert len(frames.pictures_of(tmp_path / "a.tif", "images")) == 40
    monkeypatch.setattr("ommatid.runtime.memory.free_memory", lambda: 100 * 10**6)
    with pytest.raises(InputError, match=r"a.tif: to read it needs 0.104 GB of memory, 0.1 GB are free"):
        frames.pictures_of(tmp_path / "a.tif", "images")


def npy_of(shape: str, kind: str = "<f8") -> bytes:
    """Return an NPY file whose header states a shape, with eight numbers."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + bytes(64)


@pytest.mark.parametrize("shape", ["(100000, 100000)", "(9223372036854775807, 9)", "(-1, 2)", "x", "[" * 900])
def test_an_array_smaller_than_its_header_states_is_refused(shape: str, tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(npy_of(shape))
    with pytest.raises(InputError, match="could not be read as a picture"):
        picture_file.decode(tmp_path / "a.npy", "here")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", npy_of(shape))
    with pytest.raises(ValueError, match=r"."):
        npz.read(tmp_path / "a.npz")
    with pytest.raises(InputError, match="a model that ommatid wrote"):
        model_file.read(tmp_path / "a.npz")


def test_headers_of_old_versions_are_read_without_a_warning(tmp_path: Path) -> None:
    (tmp_path / "a.npy").write_bytes(npy_of("(2L, 4L)"))  # as Python 2 wrote them
    assert picture_file.decode(tmp_path / "a.npy", "here").shape == (2, 4)
    (tmp_path / "a.npy").write_bytes(npy_of("(8,)", "|a8"))  # NumPy 2.5 reads it no more, and says so by itself
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            assert npz.array(tmp_path / "a.npy").shape == (8,)
        except ValueError:
            assert np.lib.NumpyVersion(np.__version__) >= "2.5.0"


def png_of(rows: int, columns: int) -> bytes:
    """Return a PNG file whose header states a size, with almost no pixels."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


def test_a_picture_beyond_the_memory_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(png_of(10**6, 10**6))
    with pytest.raises(InputError, match=r"here: .*a.png: to read it needs 2.4e\+04 GB of memory, .* GB are free"):
        picture_file.decode(tmp_path / "a.png", "here")


def test_a_large_picture_is_read_without_a_warning(tmp_path: Path) -> None:
    from PIL import Image

    limit = Image.MAX_IMAGE_PIXELS
    pixels = np.zeros((9500, 9500), np.uint8)  # from 89 million pixels on Pillow warns
    pixels[3, 5] = 7
    Image.fromarray(pixels).save(tmp_path / "a.png", compress_level=1)
    decoded = picture_file.decode(tmp_path / "a.png", "here")
    assert (decoded.shape, int(decoded[3, 5]), int(decoded.sum())) == ((9500, 9500), 7, 7)
    assert limit == Image.MAX_IMAGE_PIXELS


def test_an_exr_picture_beyond_the_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exr.write(tmp_path / "a.exr", [exr.Part("one", {"Y": np.zeros((4000, 4000), np.float32)}, {})])
    monkeypatch.setattr("ommatid.runtime.memory.free_memory", lambda: 10**8)
    with pytest.raises(InputError, match=r"a.exr: to read it needs 0.128 GB of memory, 0.1 GB are free"):
        exr.read(tmp_path / "a.exr")


def with_record(path: Path, change: Any) -> None:
    """Change the record of a stack, with valid checksums."""
    parts = exr.read(path)
    parts[0].record["record"] = change(parts[0].record["record"])
    exr.write(path, parts)


@pytest.mark.parametrize(
    "change",
    [lambda _: 3, lambda _: ["x"], lambda old: {**old, "versions": "1"}, lambda old: {**old, "seconds": float("nan")}],
    ids=["number", "list", "versions", "NaN"],
)
def test_an_invalid_record_is_refused(change: Any, kept: Path) -> None:
    with_record(kept / "stack.exr", lambda old: old)
    assert stack.read(kept / "stack.exr").record["passes"] == 16
    with_record(kept / "stack.exr", change)
    with pytest.raises(InputError, match=r"stack.exr: .*; make it again"):
        stack.read(kept / "stack.exr")


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [("data", 0, np.nan), ("data", 0, 1e300), ("variance", 0, -1.0), ("indptr", 3, 10**6), ("indices", 0, 10**6)],
)
def test_an_invalid_matrix_is_refused(name: str, index: int, value: float, kept: Path) -> None:
    path = kept / "model.npz"
    with np.load(path) as file:
        arrays: dict[str, Any] = {key: file[key] for key in ("shape", "variance", "batches", *model_file.ENTRIES)}
        description = json.loads(str(file["ommatid"][()]))["description"]
    arrays[name][index] = value
    seal = model_file._seal(arrays, description)  # pyright: ignore[reportPrivateUsage]
    record = json.dumps({"description": description, "sha256": seal})
    np.savez_compressed(path, format=np.array(b"csr"), ommatid=record, **arrays)
    with pytest.raises(InputError, match="holds no usable observation matrix"):
        model_file.read(path)


# Memory


def test_free_memory_respects_the_limit_of_the_process(tmp_path: Path) -> None:
    before = f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({4 * GIBI}, {4 * GIBI}))"
    before += "\nfrom ommatid.runtime.memory import free_memory"
    script = f"{before}\nassert 0 < free_memory() < {4 * GIBI}\nraise SystemExit"
    assert shell(cwd=tmp_path, before=script).err == ""
    assert free_memory() > 0


def test_small_requests_are_never_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.runtime.memory.free_memory", lambda: 0)
    check_memory(10**6, "it", "do nothing")
    with pytest.raises(InputError, match="it needs 1 GB of memory, 0 GB are free; do nothing"):
        check_memory(10**9, "it", "do nothing")


LARGE = ("target.shape=[1000000,1000000]", "estimator.memory='1000 TB'")
WIDE = (
    *("target.shape=[60000,60000]", "target.origin=", "world.file=world.xml", "target.image="),
    *("camera.lens_pitch='1 m'", "camera.lens.I.pixels='fit'", "camera.lens.I.array=[1,1]"),
)
MANY = (
    "target.shape=[3000,3000]",
    "camera.lens.I.pixels='fit'",
    "camera.lens.I.magnification=1/100",
    "camera.lens_pitch='1 m'",
)
TAKE = {
    "show": ("show", "tiny.toml"),
    "predict": ("predict", "tiny.toml"),
    "run": ("run", "tiny.toml", "-o", "new"),
    "render": ("render", "tiny.toml", "-o", "new"),
    "calibrate": ("calibrate", "tiny.toml", "-o", "new.npz"),
    "export": ("export", "tiny.toml", "-o", "new.xml"),
}


CASES = [
    *((TAKE[command], LARGE) for command in TAKE),
    (TAKE["show"], WIDE),
    (TAKE["render"], WIDE),
    (TAKE["calibrate"], (*MANY, "camera.lens.I.array=[40,40]", "target.origin=[0,0]")),
    (TAKE["show"], ("target.image=huge.png", "target.shape=", "target.origin=")),
    (TAKE["run"], ("target.image=huge.png",)),
]
SCRIPT = f"""
import contextlib, io, json, resource, sys
from ommatid.cli import app
resource.setrlimit(resource.RLIMIT_AS, ({6 * GIBI}, {6 * GIBI}))
for command in json.load(open("commands.json")):
    sys.argv, out, err = ["ommatid", *command], io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            app.main()
        except SystemExit as ended:
            code = ended.code
    print(json.dumps([code, out.getvalue(), err.getvalue()]))
raise SystemExit
"""


def test_requests_beyond_the_memory_are_refused_before_allocation(here: Path) -> None:
    (here / "huge.png").write_bytes(png_of(100000, 100000))
    (here / "world.xml").write_text('<scene version="3.0.0"><emitter type="constant"/></scene>', encoding="utf-8")
    commands = [[*command, *(word for change in changes for word in ("--set", change))] for command, changes in CASES]
    (here / "commands.json").write_text(json.dumps(commands), encoding="utf-8")
    before = sorted(here.rglob("*"))
    ended = shell(cwd=here, before=SCRIPT)  # in one process, since imports take longer than all that is refused
    answers = [json.loads(line) for line in ended.out.splitlines()]
    assert len(answers) == len(commands), ended.err
    for command, (code, out, err) in zip(commands, answers, strict=True):
        [line] = err.splitlines()
        assert (code, out) == (2, ""), (command, line)
        assert line.startswith("ommatid: ")
        assert "GB" in line or "leaves the picture" in line, line
    assert sorted(here.rglob("*")) == before


def test_the_smallest_noise_is_refused(here: Path, ommatid: Command) -> None:
    """The square of its inverse exceeds the range of float64."""
    assert (here / "tiny.toml").is_file()
    ended = ommatid("predict", "tiny.toml", "--no-rays", "--set", "noise.variance=5e-324")
    assert ended.code == 2
    assert "no form of the estimator reaches" in ended.err
