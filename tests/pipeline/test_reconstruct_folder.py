"""`reconstruct` into a folder and `report`: results from files alone have what a run has, recorded frames, too."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ommatid as interface
from ommatid.scenes import stack as stack_file
from ommatid.scenes.formats import exr

from ..conftest import Command
from ..runs import document, numbers

RESULTS = {"stack.exr", "model.npz", "estimate.exr", "estimate.png", "overview.png", "run.json", "report.html"}


def stored(folder: Path) -> Any:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def frames(finished: Path, here: Path) -> Path:
    """A stack recorded with the camera of the finished run: an imported one, whose truth is not known."""
    folder = here / "frames"
    folder.mkdir()
    for number, image in enumerate(stack_file.read(finished / "stack.exr").images()):
        np.save(folder / f"{number}.npy", image)
    return folder


def test_a_folder_has_the_files_and_numbers_of_the_run(finished: Path, here: Path, ommatid: Command) -> None:
    files = finished / "stack.exr", finished / "model.npz"
    ended = ommatid("reconstruct", *files, "-o", "again", "--format", "npy")
    assert ended.code == 0, ended.err
    assert ended.out.splitlines()[-1].split() == ["page", "again/report.html"]
    assert names(here / "again") == RESULTS | {"truth.exr", "estimate.npy"}
    run, again = (numbers(stored(folder)) for folder in (finished, here / "again"))
    assert again == run
    assert stored(here / "again")["command"][:2] == ["ommatid", "reconstruct"]
    assert interface.read_result("again").mse == interface.read_result(finished).mse
    once_more = ommatid("reconstruct", *files, "-o", "again", "-q")
    assert (once_more.err, len(once_more.out.splitlines())) == ("", 1)
    assert "up to date" in ommatid("reconstruct", *files, "-o", "again").err
    assert ": done" in ommatid("reconstruct", *files, "-o", "again", "--set", "prior.mean=100").err
    into_itself = ommatid("reconstruct", *files, "-o", finished)
    assert into_itself.code == 2
    assert "would replace" in into_itself.err


def test_recorded_frames_get_a_page_a_run_json_and_an_overview(frames: Path, finished: Path, ommatid: Command) -> None:
    assert ommatid("import", "tiny.toml", frames, "-o", "recorded.exr").code == 0
    ended = ommatid("reconstruct", "recorded.exr", finished / "model.npz", "-o", "recorded")
    assert ended.code == 0, ended.err
    assert names(Path("recorded")) == RESULTS
    run, recorded = stored(finished), stored(Path("recorded"))
    assert recorded["error"]["predicted_mse"] > recorded["error"]["expected_given_estimate"] > 0
    assert not {"mse", "gain"} & set(recorded["error"])
    assert recorded["unknowns"] == run["unknowns"]
    assert "the truth is not known" in ended.out.splitlines()[1]


def test_report_writes_the_page_of_a_run_of_a_batch_and_of_a_stack(kept: Path, here: Path, ommatid: Command) -> None:
    before, page = stored(kept), (kept / "report.html").read_text(encoding="utf-8")
    (kept / "report.html").unlink()
    assert document(ommatid("report", kept, "--json")) == {"pages": [str(kept / "report.html")]}
    assert (kept / "report.html").read_text(encoding="utf-8") == page
    (kept / "report.html").unlink()
    assert document(ommatid("report", "out", "--json"))["index"] == "out/index.html"
    assert (kept / "report.html").is_file()
    assert stored(kept) == before
    shutil.copy(kept / "stack.exr", "alone.exr")
    ended = ommatid("report", "alone.exr")
    assert (ended.code, ended.out.split()) == (0, ["alone/report.html"])
    assert ended.err.startswith("warning: alone.exr: there is no model.npz beside it, so H as designed is taken")
    assert names(here / "alone") == RESULTS
    assert stored(here / "alone")["stages"]["calibrate"]["method"] == "ideal"
    (here / "empty").mkdir()
    nothing = ommatid("report", "empty")
    assert nothing.code == 2
    assert "expected a stack, or a folder" in nothing.err


def test_the_estimate_alone_and_other_names(finished: Path, here: Path, ommatid: Command) -> None:
    files = finished / "stack.exr", finished / "model.npz"
    ended = ommatid("reconstruct", *files, "-o", "alone.exr", "--region", "2,2,3,3", "-v")
    assert ended.code == 0, ended.err
    assert "mean of 3 x 3 pixels" in ended.out
    shown = ommatid("reconstruct", *files, "-o", "alone.exr", "--region", "2,2,3,3").out.splitlines()
    assert shown[6].startswith("  region   mean of 3 x 3 pixels at 2, 2 is ")
    assert {"alone.exr", "alone.png"} == names(here) - {"tiny.toml"}
    estimate = exr.read(finished / "estimate.exr")[0].channels["estimate"]
    np.testing.assert_array_equal(exr.read(Path("alone.exr"))[0].channels["estimate"], estimate)
    refused = ommatid("reconstruct", *files, "-o", "alone.tiff")
    assert refused.code == 2
    assert "expected the name of an OpenEXR file" in refused.err
