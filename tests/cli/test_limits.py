"""Limits of numbers, names, nesting and memory in files and options, refused in one sentence."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import check_memory, free_memory
from ommatid.scenes import camera, model_file, scene
from ommatid.scenes.formats import npz, picture_file
from ommatid.scenes.optics.field import light_reach

from ..conftest import TINY, Command, shell
from ..examples import scene as example
from ..scenes import picture_bytes as made

GIBI = 2**30


def read(path: Path, *changes: str) -> Any:
    """Return the tiny scene with some changes, and its camera."""
    file = path / "tiny.toml"
    file.write_text(TINY, encoding="utf-8")
    described = scene.read(file, changes)
    return described, camera.derive(described)


def test_lengths_and_ratios_are_numbers_of_few_digits(tmp_path: Path) -> None:
    """Powers of powers and thousands of digits once took minutes; tests/fuzz tries many more."""
    lengths = (
        "9**9**9 m",
        "9⁹⁹⁹⁹⁹⁹⁹⁹ m",
        "1e999999999 m",
        "1" * 100000 + " m",
        "(" * 5000 + "1 m",
        "1e16 mm",
        "nan m",
        "m",
    )
    ratios = ("1e-9999999999", "1/" + "9" * 4000, "0." + "3" * 10**6)
    for key, texts, expected in (
        ("target.distance", lengths, "a length"),
        ("camera.lens.I.magnification", ratios, "a ratio"),
        ("camera.lens.I.step", ratios, "a ratio"),
    ):
        for text in texts:
            with pytest.raises(InputError, match=f"{key}: expected {expected}") as refused:
                read(tmp_path, f"{key}='{text}'")
            assert len(str(refused.value)) < 400


def test_quantities_are_still_written_in_many_ways(tmp_path: Path) -> None:
    lengths = {"6 um": 6e-3, "1e-3 m": 1.0, "1/2 mm": 0.5, "1_000 µm": 1.0, "2mm": 2.0, "3*mm": 3.0, "1 m**2/m": 1e3}
    for text, length in lengths.items():
        described, _ = read(tmp_path, f"target.distance='{text}'")
        assert described.target.distance == pytest.approx(length, rel=1e-12)
    for text in ("500 lm/m**2", "500 lm / m^2", "500 lm/m²", "0.5 klux"):
        sensor = f'{{illuminance = "{text}", exposure = "1 ms"}}'
        changes = (f"sensor={sensor}", "noise=", "camera.lens.I.aperture='0.1 mm'")
        assert read(tmp_path, *changes)[0].sensor.illuminance == pytest.approx(500, rel=1e-12)


def test_a_key_of_too_many_tables_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="deeper than 16 tables"):
        read(tmp_path, "a." * 5000 + "b=1")


def test_impossible_file_names_are_refused(tmp_path: Path) -> None:
    for key in ("target.image", "world.file", "camera.lens.I.surfaces"):
        for name in (r"a\u0000b", "b" * 300, "c/" * 3000, " "):
            with pytest.raises(InputError, match=f"{key}.*expected the name of a file"):
                read(tmp_path, f'{key}="{name}"')


def test_a_blur_that_cannot_be_computed_is_refused() -> None:
    lens = example().camera.lens[0]
    for update in ({"aperture": 1e4, "focus": 1.0}, {"aperture": 1e-3}):
        table = example().camera.model_copy(update={"lens": (lens.model_copy(update=update),)})
        derived = camera.derive(example().model_copy(update={"camera": table}))
        with pytest.raises(InputError, match=r"its blur reaches|expected a cone of light of f/0\.5"):
            light_reach(derived, derived.types[0])


# Files


def npy_of(shape: str, kind: str = "<f8") -> bytes:
    """Return an NPY file whose header states a shape, with eight numbers."""
    text = f"{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + bytes(64)


def test_an_array_smaller_than_its_header_states_is_refused(tmp_path: Path) -> None:
    shape = "(100000, 100000)"
    (tmp_path / "a.npy").write_bytes(npy_of(shape))
    with pytest.raises(InputError, match="could not be read as a picture"):
        picture_file.read_picture(tmp_path / "a.npy", "here")
    with zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("x.npy", npy_of(shape))
    with pytest.raises(ValueError, match=r"."):
        npz.read(tmp_path / "a.npz")
    with pytest.raises(InputError, match="a model that ommatid wrote"):
        model_file.read(tmp_path / "a.npz")


# Memory


def test_free_memory_respects_the_limit_of_the_process(tmp_path: Path) -> None:
    before = f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({4 * GIBI}, {4 * GIBI}))"
    before += "\nfrom ommatid.runtime.machine import free_memory"
    script = f"{before}\nassert 0 < free_memory() < {4 * GIBI}\nraise SystemExit"
    assert shell(cwd=tmp_path, before=script).err == ""
    assert free_memory() > 0


def test_small_requests_are_never_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ommatid.runtime.machine.free_memory", lambda: 0)
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


def test_a_request_beyond_the_memory_is_refused(here: Path, ommatid: Command) -> None:
    (here / "huge.png").write_bytes(made.png_of(made.header(100000, 100000), made.chunk(b"IDAT", bytes(99))))
    for command, changes in CASES[-3:-1]:
        ended = ommatid(*command, *(word for change in changes for word in ("--set", change)))
        assert (ended.code, ended.out, len(ended.err.splitlines())) == (2, "", 1)
        assert "GB" in ended.err
    assert not (here / "new").exists()


@pytest.mark.slow
def test_requests_beyond_the_memory_are_refused_before_allocation(here: Path) -> None:
    (here / "huge.png").write_bytes(made.png_of(made.header(100000, 100000), made.chunk(b"IDAT", bytes(99))))
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
