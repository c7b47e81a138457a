"""The files of a result: all are those of a run, none of an earlier one stays, and no other file is touched."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import ommatid as interface
from ommatid.batch.remote import RunObserver, carry_out, packed, unpack
from ommatid.batch.sweep_row import read_rows
from ommatid.reconstruct.output import result_files, run_json
from ommatid.runtime.errors import InputError
from ommatid.scenes import stack as stack_file
from ommatid.scenes.formats import exr
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup

from ..conftest import TINY, Command
from ..runs import document, numbers

RUN = ("run", "tiny.toml", "-o", "out", "-q")
CHANGED = ("--set", "prior.mean=100")
FORMATS = {"estimate.npy", "estimate.tiff"}
RESULTS = {"stack.exr", "model.npz", "estimate.exr", "estimate.png", "overview.png", "run.json", "report.html"}


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def content(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def write_old(folder: Path) -> None:
    for name in FORMATS:
        (folder / name).write_text("of an earlier run", encoding="utf-8")


# --- a new result


def test_a_new_result_removes_the_formats_of_the_old_one(kept: Path, ommatid: Command) -> None:
    write_old(kept)
    assert ommatid(*RUN).code == 0
    assert names(kept) >= FORMATS, "the result is up to date, and so are they"
    write_old(kept)
    assert ommatid(*RUN, *CHANGED).code == 0
    assert not names(kept) & FORMATS


def test_a_reconstruction_removes_what_an_earlier_run_left_in_its_folder(
    kept: Path, finished: Path, ommatid: Command
) -> None:
    command = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", kept, "-q"
    write_old(kept)
    assert ommatid(*command, *CHANGED).code == 0
    assert not names(kept) & (FORMATS | {"scene.toml"})
    (kept / "scene.toml").write_text(TINY, encoding="utf-8")
    assert ommatid(*command).code == 0
    assert (kept / "scene.toml").read_text(encoding="utf-8") == TINY, "a scene that no run wrote stays"


def test_a_new_estimate_alone_removes_its_old_formats(finished: Path, here: Path, ommatid: Command) -> None:
    command = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", "a.exr", "-q"
    assert ommatid(*command, "--format", "npy,tiff16").code == 0
    assert ommatid(*command, *CHANGED).code == 0
    assert names(here) == {"tiny.toml", "a.exr", "a.png"}
    np.save("a.npy", np.zeros((2, 2)))
    tifffile.imwrite("a.tiff", np.zeros((2, 2)))
    before = content(here)
    assert ommatid(*command, *CHANGED).code == 0
    others = [str(here / name) for name in ("a.npy", "a.tiff")]
    assert [content(here)[name] for name in others] == [before[name] for name in others], "they show something else"


def test_one_of_many_frames_removes_its_old_formats(finished: Path, here: Path, ommatid: Command) -> None:
    stacks = [shutil.copy(finished / "stack.exr", here / f"{name}.exr") for name in "ab"]
    command = "reconstruct", *stacks, finished / "model.npz", "-o", "film", "-q"
    assert ommatid(*command, "--format", "npy,tiff16").code == 0
    assert ommatid(*command, *CHANGED).code == 0
    assert names(here / "film") == {"a.exr", "a.png", "b.exr", "b.png", "film.gif", "index.html"}


def _removes_the_stack(setup: Setup, folder: Path, observer: RunObserver) -> dict[str, str]:
    del setup, observer
    (folder / "stack.exr").unlink()
    return {}


def test_what_a_worker_removes_is_removed_here(kept: Path, here: Path) -> None:
    before = names(kept)
    unpack(carry_out(_removes_the_stack, packed(Setup.from_scene(read(here / "tiny.toml")), kept)), kept)
    assert names(kept) == before - {"stack.exr"}


def test_links_in_a_folder_are_not_sent_to_other_machines(kept: Path, here: Path) -> None:
    (here / "private.json").write_text("{}", encoding="utf-8")
    (kept / "linked.json").symlink_to(here / "private.json")
    assert packed(Setup.from_scene(read(here / "tiny.toml")), kept).files.keys() == names(kept) - {"linked.json"}


# --- a command that is refused


def sets(*changes: str) -> tuple[str, ...]:
    return tuple(word for change in changes for word in ("--set", change))


def test_a_picture_in_the_folder_of_the_results_is_refused(kept: Path, ommatid: Command) -> None:
    np.save(kept / "estimate.npy", exr.read(kept / "estimate.exr")[0].channels["estimate"])
    before = content(kept)
    for words, name in (
        ("run", "truth.exr"),
        ("run --force", "estimate.png"),
        ("run --within 1s", "estimate.npy"),
        ("render", "estimate.png"),
        ("render --force", "truth.exr"),
    ):
        changes = sets(f"target.image={kept / name}", "target.origin=")
        ended = ommatid(*words.split(), "tiny.toml", "-o", "out", *changes)
        assert ended.code == 2
        assert f"{name}: would replace" in ended.err
        assert content(kept) == before


def test_a_run_that_is_refused_removes_nothing(kept: Path, ommatid: Command) -> None:
    before = content(kept)
    for change in ('study.models=["transport"]', 'study.models=["fitted"]', "estimator.memory=1 kB"):
        for more in ((), ("--within", "1 s")):
            assert ommatid("run", "tiny.toml", "-o", "out", "--force", *sets(change), *more).code == 2
            assert content(kept) == before


def test_a_scene_among_its_results_keeps_them(kept: Path, ommatid: Command) -> None:
    folder = kept.rename(kept.with_name("scene"))
    before = content(folder)
    ended = ommatid("run", folder / "scene.toml", "-o", "out", "--force")
    assert ended.code == 2
    assert "scene.toml: would replace" in ended.err
    assert content(folder) == before


def test_a_reconstruction_that_is_refused_removes_nothing(kept: Path, finished: Path, ommatid: Command) -> None:
    before = content(kept)
    ended = ommatid("reconstruct", kept / "stack.exr", kept / "model.npz", "-o", kept, "--force")
    assert ended.code == 2
    assert "would replace" in ended.err
    assert content(kept) == before
    again = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", kept
    assert "reconstruct: up to date" in ommatid(*again).err
    assert "reconstruct: done" in ommatid(*again, "--force").err


# --- files that hold something else


def test_an_estimate_replaces_no_file_that_shows_something_else(finished: Path, here: Path, ommatid: Command) -> None:
    command = "reconstruct", finished / "stack.exr", finished / "model.npz", "-o", "mosaic.exr", "-q"
    (here / "mosaic.png").write_bytes(b"mine")
    before = content(here)
    ended = ommatid(*command)
    assert (ended.code, content(here)) == (2, before)
    assert "mosaic.png: would be replaced" in ended.err
    (here / "mosaic.png").unlink()
    assert ommatid(*command, "--format", "npy,tiff16").code == 0
    assert ommatid(*command, "--format", "npy,tiff32").code == 0, "its own files are replaced"
    for name, write in (("mosaic.tiff", tifffile.imwrite), ("mosaic.npy", np.save)):
        write(name, np.zeros((12, 12), np.float32))
        before = content(here)
        ended = ommatid(*command, *CHANGED, "--format", "npy,tiff16")
        assert (ended.code, content(here)) == (2, before)
        assert f"{name}: would be replaced" in ended.err
        (here / name).unlink()


# --- H as designed instead of the camera's


def test_every_report_says_that_h_as_designed_was_taken(
    kept: Path, finished: Path, here: Path, ommatid: Command
) -> None:
    (here / "rp").mkdir()
    shutil.copy(finished / "stack.exr", here / "rp")
    asked = read(here / "tiny.toml").calibration.method
    assert ommatid("report", "rp/stack.exr").err.startswith("warning: rp/stack.exr: there is no model.npz beside it")
    note = f"H as designed was taken, although the scene asks for calibration.method '{asked}'"
    for path in ("rp/stack.exr", "rp", "."):
        assert f"warning: rp/stack.exr: {note}" in ommatid("report", path).err
    shutil.copy(here / "rp" / "stack.exr", "alone.exr")
    shutil.copy(here / "rp" / "model.npz", here)
    assert f"warning: alone/stack.exr: {note}" in ommatid("report", "alone.exr").err
    for folder in ("rp", "alone"):
        assert json.loads((here / folder / "run.json").read_text(encoding="utf-8"))["verdict"]["notes"][-1] == note
        assert "although the scene asks for" in (here / folder / "report.html").read_text(encoding="utf-8")
    assert ommatid("report", kept).err == ""


def test_packed_files_do_not_depend_on_the_clock(kept: Path) -> None:
    for number, path in enumerate(sorted(kept.iterdir(), reverse=True)):
        os.utime(path, (1e9 + number, 1e9 + number))
    scene = read(Path("tiny.toml"))
    sent = list(packed(Setup.from_scene(scene), kept).files)
    assert sent == [*sorted(set(sent) - {"run.json"}), "run.json"]


# --- documents of results


def test_a_document_with_a_key_twice_is_refused(finished: Path, tmp_path: Path) -> None:
    report = (finished / "run.json").read_text(encoding="utf-8")
    row = '{"scene": "a.toml", "folder": "a", "values": {}, "psnr": 1.0}'
    (tmp_path / "sweep.json").write_text(f"[{row}]", encoding="utf-8")
    (tmp_path / "run.json").write_text(report, encoding="utf-8")
    assert (run_json.read(tmp_path), len(read_rows(tmp_path / "sweep.json"))) == (run_json.read(finished), 1)
    (tmp_path / "sweep.json").write_text(f"[{row[:-1]}, {row[1:]}]", encoding="utf-8")
    (tmp_path / "run.json").write_text('{"fingerprint": "x",' + report.lstrip()[1:], encoding="utf-8")
    for read_again in (lambda: read_rows(tmp_path / "sweep.json"), lambda: run_json.read(tmp_path)):
        with pytest.raises(InputError, match=r"expected each key of a table once, got '\w+' twice"):
            read_again()


CHANGES: tuple[tuple[str, dict[str, object]], ...] = (
    ("error", {"predicted_mse": 0.0}),
    ("study", {"model": "of another program"}),
)


@pytest.mark.parametrize(("table", "change"), CHANGES)
def test_contradictions_in_a_report_are_refused(
    table: str, change: dict[str, object], kept: Path, ommatid: Command
) -> None:
    content = json.loads((kept / "run.json").read_text(encoding="utf-8"))
    case = {"mse": 1.0, "predicted": 1.0, "expected": 1.0, "low": 0.5, "high": 2.0, "seconds": 1.0}
    content[table] = [{**case, **change}] if table == "study" else {**content[table], **change}
    (kept / "run.json").write_text(json.dumps(content), encoding="utf-8")
    result = ommatid("report", kept)
    assert result.code == 2
    assert f"run.json: expected the results of a run, got a file whose {table}" in result.err


@pytest.mark.parametrize(("channel", "value"), [("estimate", np.nan), ("variance", np.inf), ("variance", -1.0)])
def test_an_estimate_of_no_numbers_is_refused_and_made_again(
    channel: str, value: float, kept: Path, ommatid: Command
) -> None:
    (part,) = exr.read(kept / "estimate.exr")
    values = part.channels[channel].copy()
    values[2, 1] = value
    exr.write(kept / "estimate.exr", [exr.Part(part.name, {**part.channels, channel: values}, part.record)])
    (kept / "report.html").unlink()
    result = ommatid("report", kept)
    assert result.code == 2
    assert "estimate.exr: expected a finite estimate" in result.err
    assert ommatid(*RUN).code == 0
    np.testing.assert_array_equal(exr.read(kept / "estimate.exr")[0].channels[channel], part.channels[channel])


@pytest.mark.parametrize("name", ["estimate.png", "overview.png"])
def test_a_picture_that_was_cut_short_is_made_again(name: str, kept: Path, ommatid: Command) -> None:
    whole = (kept / name).read_bytes()
    (kept / name).write_bytes(whole[:200])
    assert ommatid(*RUN).code == 0
    assert (kept / name).read_bytes() == whole


# --- results of two runs


def test_a_first_result_removes_no_file_of_another_program(here: Path, ommatid: Command) -> None:
    (here / "out" / "tiny").mkdir(parents=True)
    for name in ("estimate.npy", "estimate.tiff", "depth.png"):
        (here / "out" / "tiny" / name).write_text("of another program", encoding="utf-8")
    assert ommatid(*RUN).code == 0
    for name in ("estimate.npy", "estimate.tiff", "depth.png"):
        assert (here / "out" / "tiny" / name).read_text(encoding="utf-8") == "of another program"


def test_a_run_that_is_killed_between_its_files_leaves_nothing_of_two_results(
    kept: Path, ommatid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = {name: (kept / name).read_bytes() for name in ("estimate.png", "overview.png")}

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(result_files, "write_estimate", killed)
        assert ommatid(*RUN, *CHANGED).code == 1
    assert (kept / "estimate.png").read_bytes() != whole["estimate.png"]
    assert not (kept / "estimate.exr").exists()
    assert ommatid(*RUN).code == 0
    assert {name: (kept / name).read_bytes() for name in whole} == whole


def test_a_page_of_results_of_two_runs_is_refused(kept: Path, ommatid: Command) -> None:
    assert ommatid("render", "tiny.toml", "-o", "out", "--set", "render.seed=5").code == 0
    result = ommatid("report", kept)
    assert (result.code, "run.json is of another stack or model" in result.err) == (2, True)


def test_a_page_beside_a_damaged_result_is_not_up_to_date(kept: Path, ommatid: Command) -> None:
    message = "damaged or of another result than run.json"
    for name, words in (("estimate.exr", "the file is cut short"), ("overview.png", message)):
        whole = (kept / name).read_bytes()
        (kept / name).write_bytes(whole[:-20])
        result = ommatid("report", kept)
        assert (result.code, words in result.err) == (2, True)
        (kept / name).write_bytes(whole)


def test_an_error_without_a_cause_is_no_report(kept: Path, ommatid: Command) -> None:
    document = json.loads((kept / "run.json").read_text(encoding="utf-8"))
    document["verdict"], document["error"]["budget"] = {"trusted": True, "reasons": []}, {}
    (kept / "run.json").write_text(json.dumps(document), encoding="utf-8")
    result = ommatid("report", kept)
    assert (result.code, "run.json: expected the results of a run" in result.err) == (2, True)


def test_baselines_outlive_run_json(kept: Path, ommatid: Command) -> None:
    assert ommatid("report", kept, "--baselines").code == 0
    (kept / "run.json").unlink()
    assert ommatid("report", kept).code == 0
    assert len(run_json.read(kept).baselines) > 1


def test_a_truth_that_is_known_later_counts(finished: Path, here: Path, ommatid: Command) -> None:
    (here / "recorded").mkdir()
    for name in ("stack.exr", "model.npz"):
        shutil.copy(finished / name, here / "recorded")
    command = "reconstruct", "recorded/stack.exr", "recorded/model.npz", "-o", "result", "-q"
    assert ommatid(*command).code == 0
    assert run_json.read(here / "result").error.mse is None
    shutil.copy(finished / "truth.exr", here / "recorded")
    assert ommatid(*command).code == 0
    assert run_json.read(here / "result").error.mse == run_json.read(finished).error.mse


def test_the_page_of_a_run_keeps_what_the_run_said(kept: Path, ommatid: Command) -> None:
    document = json.loads((kept / "run.json").read_text(encoding="utf-8"))
    document["spent"] = {"within": 9.0, "chosen": {"render.samples": 16}}
    (kept / "run.json").write_text(json.dumps(document), encoding="utf-8")
    assert ommatid("report", kept / "stack.exr").code == 0
    spent = run_json.read(kept).spent
    assert (spent.within, spent.chosen) == (9.0, {"render.samples": 16})


# --- results from files alone, of recorded frames, too


def stored(folder: Path) -> Any:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


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
