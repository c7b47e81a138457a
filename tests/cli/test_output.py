"""What is printed, the options of the command line that every tool has, and the verdict in documents and exit codes."""

from __future__ import annotations

import json
import shutil
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image

from ommatid.cli import output
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.estimate_formats import write_formats
from ommatid.reconstruct.output.verdict_words import error_words
from ommatid.scenes.formats import exr, picture
from ommatid.scenes.scene import read

from ..conftest import Command
from ..runs import document

RUN = ("run", "tiny.toml", "-o", "out")
QUICK = ("--set", "calibration.method=ideal")


def stored(folder: Path) -> Any:
    return json.loads((folder / "run.json").read_text(encoding="utf-8"))


# --- a result


def test_six_lines_are_printed_of_a_scene(kept: Path, ommatid: Command) -> None:
    lines = ommatid(*RUN).out.splitlines()
    run = stored(kept)
    error, [baseline] = run["error"], run["baselines"]
    assert len(lines) == 6
    assert lines[0] == f"tiny: not to be trusted: {'; '.join(run['verdict']['reasons'])}"
    assert [line.split()[0] for line in lines[1:]] == ["error", "quality", "limit", "time", "page"]
    given = error["expected_given_truth"]
    assert f"RMS error {sqrt(error['mse']):.3g} grey levels (expected {sqrt(given['mse']):.3g})" in lines[1]
    assert f"MSE {error['mse']:.4g} (expected {given['mse']:.4g}, 99 %: {given['low']:.4g} to" in lines[1]
    assert f"PSNR {error['psnr']:.1f} dB (single sub-image: {baseline['psnr']:.1f} dB)" in lines[2]
    assert f"SSIM {error['ssim']:.4f} (single sub-image: {baseline['ssim']:.4f})" in lines[2]
    assert f"gain {error['gain']:.1f} dB (over the best sub-image, {baseline['sub_imager']})" in lines[2]
    assert f" {sum(stage['seconds'] for stage in run['stages'].values()):.1f} s (render " in lines[4]
    assert lines[5].split()[1] == "out/tiny/report.html"


@pytest.mark.usefixtures("kept")
def test_quiet_prints_the_verdict_alone_and_verbose_the_table(ommatid: Command) -> None:
    summary, quiet, verbose = (ommatid(*RUN, *options) for options in ((), ("-q",), ("-v",)))
    assert quiet.out.splitlines() == summary.out.splitlines()[:1]
    assert (quiet.err, summary.err.count("up to date")) == ("", 4)
    first = next(line for line in verbose.out.splitlines() if "│" in line)
    assert first.startswith("│ verdict")
    assert "predicted MSE (Eq. 5)" in verbose.out
    both = ommatid(*RUN, "-q", "-v")
    assert both.code == 2
    assert "-v and -q" in both.err


def test_the_error_of_a_grey_level_is_a_grey_level() -> None:
    assert error_words(4.0) == "4 (2 grey levels RMS)"
    assert error_words(1.28553, 6) == "1.28553 (1.13 grey levels RMS)"


# --- help, version, completion


def test_commands_and_scenes_of_the_gallery_are_completed(ommatid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("_OMMATID_COMPLETE", "complete_bash")
    for words, number, expected in (
        ("ommatid re", "1", "render\nreconstruct"),
        ("ommatid run still", "2", "still_life"),
    ):
        monkeypatch.setenv("COMP_WORDS", words)
        monkeypatch.setenv("COMP_CWORD", number)
        assert expected in ommatid().out


# --- the plan, and everything again


def test_a_dry_run_writes_nothing_and_tells_what_is_up_to_date(kept: Path, ommatid: Command) -> None:
    def states(*options: str) -> dict[str, str]:
        (plan,) = document(ommatid(*RUN, "--dry-run", "--json", *options))
        assert (plan["measurements"], plan["unknowns"]) == (81, 144)
        return {name: stage["state"] for name, stage in plan["plan"].items()}

    made, current = "to be made", "up to date"
    assert states() == {"render": current, "calibrate": current, "reconstruct": current}
    assert states("--set", "prior.mean=100") == {"render": current, "calibrate": current, "reconstruct": made}
    assert states("--set", "calibration.samples=17") == {"render": current, "calibrate": made, "reconstruct": made}
    assert states("--set", "noise.variance=2e-2") == {"render": made, "calibrate": made, "reconstruct": made}
    assert states("--force") == {"render": made, "calibrate": made, "reconstruct": made}
    shutil.rmtree(kept.parent)
    assert ommatid(*RUN, "--dry-run").out.count(made) == 3
    assert not kept.parent.exists()


def test_force_makes_everything_again(kept: Path, ommatid: Command) -> None:
    before, values = stored(kept), exr.read(kept / "estimate.exr")[0].channels["estimate"]
    forced = ommatid(*RUN, "--force")
    assert (forced.code, forced.err.count(": done")) == (0, 4)
    after = stored(kept)
    assert after["command"] == ["ommatid", *RUN, "--force"]
    assert after["date"] >= before["date"]
    np.testing.assert_array_equal(exr.read(kept / "estimate.exr")[0].channels["estimate"], values)
    assert ommatid(*RUN).err.count("up to date") == 4
    assert stored(kept) == after, "a run that is up to date keeps its command and its date"


# --- formats


@pytest.mark.usefixtures("kept")
def test_the_estimate_is_written_in_other_formats(kept: Path, ommatid: Command) -> None:
    assert ommatid(*RUN, "--format", "npy,tiff16").code == 0
    estimate = exr.read(kept / "estimate.exr")[0].channels["estimate"]
    np.testing.assert_array_equal(np.load(kept / "estimate.npy"), estimate)
    with tifffile.TiffFile(kept / "estimate.tiff") as file:
        assert "value = pixel / 257" in file.pages[0].tags["ImageDescription"].value
        assert file.pages[0].dtype == np.uint16
    scene = read(Path("tiny.toml"), ["target.image=out/tiny/estimate.tiff", "target.origin="])
    np.testing.assert_allclose(picture.load(scene), np.clip(estimate, 0, 255), atol=0.5 / 257 + 1e-4)
    write_formats(kept / "estimate.exr", ("tiff32",))
    np.testing.assert_array_equal(tifffile.imread(kept / "estimate.tiff"), estimate)


@pytest.mark.parametrize(("names", "words"), [("gif", "npy, tiff16, tiff32"), ("tiff16,tiff32", "one file")])
def test_unknown_formats_are_refused(names: str, words: str, here: Path, ommatid: Command) -> None:
    ended = ommatid(*RUN, "--format", names)
    assert (ended.code, (here / "out").exists()) == (2, False)
    assert words in ended.err


# --- what is read


def save(name: str, pixels: Any) -> None:
    Image.fromarray(pixels).save(name)


@pytest.mark.parametrize(
    ("name", "pixels", "words"),
    [
        ("colour.png", np.full((12, 12, 3), 9, np.uint8), "is a colour picture"),
        ("deep.png", np.full((12, 12), 9, np.uint16), "scaled from 65535 to the range from 0 to 255"),
        ("grey.png", np.full((12, 12), 9, np.uint8), ""),
    ],
)
def test_what_is_lost_of_a_picture_is_said_in_one_warning(
    name: str, pixels: Any, words: str, here: Path, ommatid: Command
) -> None:
    assert here.is_dir()
    save(name, pixels)
    changes = "--set", f"target.image={name}", "--set", "target.origin="
    for command in (("predict", "tiny.toml", "--no-rays"), (*RUN, "--dry-run")):
        ended = ommatid(*command, *changes)
        assert ended.code == 0, ended.err
        assert [words in line for line in ended.err.splitlines()] == ([True] if words else [])
        assert all(line.startswith("warning: ") for line in ended.err.splitlines())


def test_files_named_by_set_are_relative_to_the_current_folder(here: Path, ommatid: Command) -> None:
    folder = here / "scenes"
    folder.mkdir()
    shutil.move("tiny.toml", folder / "tiny.toml")
    save("here.png", np.full((12, 12), 200, np.uint8))
    scene = "scenes/tiny.toml"
    read_here = read(Path(scene), ["target.image=here.png", "target.origin="])
    assert read_here.target.image == str(here / "here.png")
    assert (picture.load(read_here) == 200).all()
    ended = ommatid("show", scene, "--set", "target.image=missing.png", "--set", "target.shape=")
    assert str(here / "missing.png") in ended.err
    curves = read(Path(scene), ["light.spectrum=D65"]), read(Path(scene), ["light.spectrum=450-650 nm"])
    assert [curve.light.spectrum for curve in curves if curve.light] == ["D65", "450-650 nm"]
    Path("led.csv").write_text("wavelength,power\n450,1\n550,2\n650,1\n", encoding="utf-8")
    lit = read(Path(scene), ["light.spectrum=led.csv"]).light
    assert lit is not None
    assert not isinstance(lit.spectrum, str)


# --- how much is printed, and progress


def test_several_scenes_are_compared_and_swept_by_dots_and_for_every_lens_type(
    ommatid: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = ommatid("predict", "tile19", "single", "--no-rays")
    rows = {cells[0]: cells[1:] for cells in (line.strip("│ ").split("│") for line in both.out.splitlines())}
    rows = {name.strip(): [cell.strip() for cell in cells] for name, cells in rows.items()}
    alone = [document(ommatid("predict", name, "--no-rays", "--json"))[0] for name in ("tile19", "single")]
    assert rows["scene"] == ["tile19", "single"]
    assert rows["squared error (Eq. 5)"] == [f"{each['mse']:.6g}" for each in alone]
    assert rows["measurements"] == [str(each["measurements"]) for each in alone]
    sweep = ("predict", "tile19", "--no-rays", "--sweep", "noise.bits=8,...,10", "-q")
    assert [line.partition(":")[0] for line in ommatid(*sweep).out.splitlines()] == [
        f"tile19, noise.bits = {bits}" for bits in (8, 9, 10)
    ]
    assert len(ommatid("predict", "tile19", "--no-rays", "-q").out.splitlines()) == 1
    small = ("predict", "tile19", "--no-rays", "--set", "camera.lens.*.pixels=[2,2]", "--json")
    assert document(ommatid(*small))[0]["measurements"] == 50 * 4
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a terminal
    shown, quiet = ommatid(*sweep[:-1]), ommatid(*sweep)
    assert "3 scenes" in shown.err
    assert "3 scenes" not in shown.out
    assert quiet.err == ""


def test_show_is_one_short_table_and_all_with_v(ommatid: Command) -> None:
    short, long, line = (ommatid("show", "sensor", *options).out for options in ((), ("-v",), ("-q",)))
    assert len(short.splitlines()) <= 24
    assert "left out: light through neighbouring lenses, interreflection" in short
    assert "What will run" in long
    assert line.splitlines() == short.splitlines()[:2]
    assert "expected one of them" in ommatid("show", "sensor", "-v", "-q").err


# --- the verdict: the tiny scene's is against trust, since one lens type has a noisy H


def test_strict_exits_with_3_where_results_are_not_to_be_trusted(kept: Path, ommatid: Command) -> None:
    plain, strict = (ommatid("run", "tiny.toml", "-o", "out", *options) for options in ((), ("--strict",)))
    assert (plain.code, strict.code) == (0, 3)
    assert plain.out == strict.out, "the results are written and printed all the same"
    assert plain.out.startswith("tiny: not to be trusted: ")
    assert not run_json.read(kept).verdict.trusted
    files = kept / "stack.exr", kept / "model.npz", "-o", "again.exr"
    assert ommatid("reconstruct", *files).code == 0
    assert ommatid("reconstruct", *files, "--strict").code == 3
    assert Path("again.exr").is_file()


@pytest.mark.usefixtures("kept")
def test_a_trusted_scene_passes_and_the_worst_exit_code_of_a_batch_counts(ommatid: Command) -> None:
    exact = Path("tiny.toml").read_text(encoding="utf-8").replace("[calibration]", '[calibration]\nmethod = "ideal"')
    Path("exact.toml").write_text(exact, encoding="utf-8")
    alone = ommatid("run", "exact.toml", "-o", "out", "--strict", "--json")
    assert document(alone)[0]["verdict"]["trusted"] is True
    both = ommatid("run", "exact.toml", "tiny.toml", "-o", "out", "--strict", "--json", "--workers", "1")
    assert both.code == 3
    assert [run["verdict"]["trusted"] for run in json.loads(both.out)] == [True, False]
    index = Path("out/index.html").read_text(encoding="utf-8")
    assert index.index(">trusted with a doubt</td>") < index.index(">not to be trusted</td>")
    assert "; not to be trusted: Tiny" in index


def test_results_without_a_verdict_get_one(kept: Path, ommatid: Command) -> None:
    path = kept / "run.json"
    before = json.loads(path.read_text(encoding="utf-8"))
    verdict = before.pop("verdict")
    path.write_text(json.dumps(before), encoding="utf-8")
    refused = ommatid("report", kept)
    assert (refused.code, "run.json: expected the results of a run" in refused.err) == (2, True)
    ended = ommatid("run", "tiny.toml", "-o", "out", "--strict")
    assert ended.code == 3
    assert json.loads(path.read_text(encoding="utf-8"))["verdict"] == verdict


def test_the_time_left_is_known_after_two_steps_of_minutes() -> None:
    shown, now = output.Bars()._shown, [0.0]  # pyright: ignore[reportPrivateUsage]
    shown.get_time = lambda: now[0]
    task = shown.add_task("scenes", total=1.0)
    for step in (1, 2):
        now[0] = 300.0 * step
        shown.update(task, completed=step / 4)
    assert shown.tasks[0].time_remaining == pytest.approx(600)
