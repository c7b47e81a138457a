"""Several stacks and one model: the files and the numbers are those of each stack by itself."""

from __future__ import annotations

import errno
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.camera import derive
from ommatid.scenes.formats import exr
from ommatid.simulate.ideal import ideal_model

from ..conftest import Command
from ..frames import P0, recorded, wide

COUNT = 4
TIMES = ("stages", "spent", "file", "stack", "fingerprint", "command", "date", "host")


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of model.npz and of stacks f0.exr to f3.exr."""
    folder = tmp_path_factory.mktemp("film")
    write_film(folder, (16, 15), COUNT)
    return folder


def write_film(folder: Path, shape: tuple[int, int], count: int) -> None:
    scene = wide(shape, noise={"variance": 1.0}, estimator={"method": "frame"}, calibration={"method": "ideal"})
    model_file.write(folder / "model.npz", ideal_model(scene, derive(scene)))
    for number in range(count):
        image = 127.5 + np.random.default_rng(number).normal(0, P0**0.5, shape[0] * shape[1])
        stack_file.write(folder / f"f{number}.exr", recorded(scene, image, 1.0, number))


def stacks(film: Path) -> list[Path]:
    return sorted(film.glob("f?.exr"))


def channels(path: Path) -> dict[str, Any]:
    return exr.read(path)[0].channels


def without_times(document: dict[str, Any]) -> dict[str, Any]:
    diagnostics = {key: value for key, value in document["diagnostics"].items() if key != "noise_difference"}
    return {**{key: value for key, value in document.items() if key not in TIMES}, "diagnostics": diagnostics}


def test_the_results_are_those_of_single_runs(film: Path, tmp_path: Path, ommatid: Command) -> None:
    model, options = film / "model.npz", ("--region", "2,3,4,5", "--set", "prior.variance=5000")
    ended = ommatid("reconstruct", *stacks(film), model, "-o", tmp_path / "out", *options, "--json")
    assert ended.code == 0, ended.err
    documents = json.loads(ended.out)
    assert [document["stack"] for document in documents] == [str(stack) for stack in stacks(film)]
    for stack, document in [*zip(stacks(film), documents, strict=True)][:: COUNT - 1]:
        single = ommatid("reconstruct", stack, model, "-o", tmp_path / "one.exr", *options, "--json")
        assert without_times(document) == without_times(json.loads(single.out))
        assert_same(Path(document["file"]), tmp_path / "one.exr")
    assert [document["diagnostics"].get("noise_difference") for document in documents] == [None, 0.0, 0.0, 0.0]


@pytest.mark.slow
def test_processes_share_the_frames(film: Path, tmp_path: Path, ommatid: Command) -> None:
    """The files are those of one process, bit for bit; a frame that is damaged is named, and stops no other."""
    files = stacks(film)
    damaged = tmp_path / "damaged.exr"  # its header is whole: the damage shows when the frame is read
    damaged.write_bytes(files[1].read_bytes()[:-200] + bytes(200))
    here = ommatid("reconstruct", *files, film / "model.npz", "-o", tmp_path / "here", "--json")
    options = ("-o", tmp_path / "out", "--workers", "2", "--json")
    ended = ommatid("reconstruct", *files[:2], damaged, *files[2:], film / "model.npz", *options)
    assert ended.code == 2
    documents = json.loads(ended.out)
    assert str(damaged) in documents.pop(2)["error"]
    assert [without_times(one) for one in documents] == [without_times(one) for one in json.loads(here.out)]
    assert [one["diagnostics"].get("noise_difference") for one in documents] == [None, 0.0, 0.0, 0.0]
    for stack in files:
        assert_same(tmp_path / "out" / stack.name, tmp_path / "here" / stack.name)
    assert len(list((tmp_path / "out").iterdir())) == 2 * COUNT + 2, "film.gif and index.html"


def assert_same(path: Path, other: Path) -> None:
    """The same estimate, variances and picture."""
    here, alone = channels(path), channels(other)
    assert here.keys() == alone.keys()
    for name in here:
        np.testing.assert_array_equal(here[name], alone[name])
    assert path.with_suffix(".png").read_bytes() == other.with_suffix(".png").read_bytes()


def test_a_disk_that_is_full_for_what_processes_share_is_one_sentence(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ommatid: Command
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    ended = ommatid("reconstruct", *stacks(film), film / "model.npz", "-o", tmp_path / "out", "--workers", "2", "-q")
    assert ended.code == 1
    assert f"{tmp_path / 'out'}: could not be written (No space left on device); free some space" in ended.err
    assert not list((tmp_path / "out").glob(".*"))


def test_a_run_that_was_interrupted_does_what_is_missing(film: Path, tmp_path: Path, ommatid: Command) -> None:
    for path in film.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    command = ("reconstruct", *stacks(tmp_path), tmp_path / "model.npz", "-o", tmp_path / "out", "--json")
    first = json.loads(ommatid(*command).out)
    (tmp_path / "out" / "f1.exr").unlink()
    damaged = tmp_path / "out" / "f2.exr"
    damaged.write_bytes(damaged.read_bytes()[:-9])
    (tmp_path / "f3.exr").write_bytes((film / "f0.exr").read_bytes())
    kept = (tmp_path / "out" / "f0.exr").stat().st_mtime_ns
    again = ommatid(*command)
    assert [line.split(",")[0].split(": ")[1] for line in again.err.splitlines()[:-1]] == ["up to date", *["done"] * 3]
    assert (tmp_path / "out" / "f0.exr").stat().st_mtime_ns == kept
    second = json.loads(again.out)
    assert second[0] == first[0]
    assert [without_times(document) for document in second[:3]] == [without_times(document) for document in first[:3]]
    assert without_times(second[3]) == without_times(first[0])
    record = exr.read(tmp_path / "out" / "f3.exr")[0].record
    report = RunReport.model_validate(record["report"])
    assert report.plain() == {key: value for key, value in second[3].items() if key not in ("file", "stack")}


def test_other_options_make_every_frame_again(film: Path, tmp_path: Path, ommatid: Command) -> None:
    command = ("reconstruct", *stacks(film)[:2], film / "model.npz", "-o", tmp_path / "out")
    for more in ((), ("--set", "prior.variance=5000"), ("--region", "0,0,4,4"), ("--lens", "A,B")):
        ended = ommatid(*command, *more)
        assert ended.code == 0
        assert "up to date" not in ended.err


def test_a_frame_of_another_camera_is_refused_before_anything_is_written(
    film: Path, tmp_path: Path, ommatid: Command
) -> None:
    write_film(tmp_path, (16, 16), 1)
    other = (tmp_path / "f0.exr").rename(tmp_path / "other.exr")
    files = (*stacks(film), other, film / "model.npz")
    ended = ommatid("reconstruct", *files, "-o", tmp_path / "out")
    assert ended.code == 2
    assert f"{other} and {film / 'model.npz'} do not belong together" in ended.err
    assert not (tmp_path / "out").exists()


def test_what_cannot_be(film: Path, tmp_path: Path, ommatid: Command) -> None:
    several = (film / "f0.exr", film / "f1.exr", film / "model.npz")
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((film / "model.npz", "-o", tmp_path / "out"), "expected stacks and then their model, got one file"),
        ((*several, "-o", film), "f0.exr: would replace a file that is read; choose another folder"),
        ((*several, "-o", tmp_path / "file"), "expected a folder for the estimates of 2 stacks, got a file"),
        ((*several, "-o", tmp_path / "out", "--scheduler", "tcp://h:1"), "take --workers instead"),
        ((*several, "-o", tmp_path / "out", "--set", "noise.variance=1"), "[noise] is already recorded"),
        ((*several, "-o", tmp_path / "out", "--region", "0,0,99,9"), "a region of 99 x 9 pixels"),
        ((*several[:2], film / "none.npz", "-o", tmp_path / "out"), "none.npz"),
        ((several[0], several[2], several[1], "-o", tmp_path / "out"), "name the model last"),
    ):
        ended = ommatid("reconstruct", *arguments)
        assert ended.code == 2
        assert message in ended.err
        assert len(ended.err.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_one_stack_in_a_folder_has_all_results_and_strict_counts(film: Path, tmp_path: Path, ommatid: Command) -> None:
    command = ("reconstruct", film / "f0.exr", film / "model.npz", "-o", tmp_path)
    assert ommatid(*command).code == 0
    assert {"estimate.exr", "overview.png", "run.json", "report.html"} < {path.name for path in tmp_path.iterdir()}
    wrong = (*command, "--strict", "--set", "prior.variance=1")
    assert ommatid(*wrong).code == 3
