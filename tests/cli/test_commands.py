"""The commands: their output, the files of a run, and the reuse of finished stages."""

from __future__ import annotations

import json
import platform
import shutil
import signal
import subprocess
import sys
import tomllib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.cli.failures import exit_code_of, report
from ommatid.pipeline.camera_files import calibrate_file
from ommatid.pipeline.stages import export_scene
from ommatid.reconstruct.measured_error import best_single_sub_image
from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import no_progress
from ommatid.scenes import stack
from ommatid.scenes.formats import exr
from ommatid.scenes.tables import gallery
from tests.modules import tracked

from ..conftest import TINY, Command, Ended, shell
from ..runs import FILES, MADE, document, numbers, without

GALLERY = Path(__file__).parents[2] / "scenes"
COMMANDS = ("run", "render", "calibrate", "reconstruct", "predict", "show", "export", "init", "schema", "doctor")


def channels(path: Path) -> dict[str, Any]:
    return exr.read(path)[0].channels


def assert_same_light(one: Path, other: Path) -> None:
    first, second = stack.read(one), stack.read(other)
    np.testing.assert_array_equal(first.values, second.values)
    np.testing.assert_array_equal(first.variance, second.variance)


# --- output


def test_help_lists_every_command_and_loads_nothing_heavy(tmp_path: Path) -> None:
    heavy = ("numpy", "scipy", "pydantic", "pint", "skimage", "matplotlib", "OpenEXR", "mitsuba", "drjit")
    ended = shell("-h", cwd=tmp_path, before=without(*heavy))
    assert ended.code == 0
    listed = {line.split()[0] for line in ended.out.partition("Commands:")[2].splitlines() if line.strip()}
    assert set(COMMANDS) <= listed


@pytest.mark.parametrize(
    ("scene", "options", "expected"),
    [
        ("tile19", (), {"mse": 2.79777e-4, "rank": 361, "null_space": 0, "measurements": 706, "unknowns": 361}),
        ("tile19", ("--lens", "I,I"), {"mse": 2057.4237, "rank": 225, "null_space": 136, "measurements": 450}),
        ("tile19", ("--lens", "I,II"), {"mse": 484.100, "rank": 329, "null_space": 32, "measurements": 450}),
        pytest.param("tile35", (), {"mse": 1.54401e-4, "unknowns": 1225}, marks=pytest.mark.slow),
        pytest.param("tile41", (), {"mse": 1.24737e-3, "unknowns": 1681}, marks=pytest.mark.slow),
    ],
)
def test_predict_gives_the_values_of_the_reference(
    scene: str, options: tuple[str, ...], expected: dict[str, float], ommatid: Command
) -> None:
    ended = ommatid(
        "predict", GALLERY / f"{scene}.toml", "--no-rays", "--set", "noise.variance=1e-6", *options, "--json"
    )
    (predicted,) = document(ended)
    assert predicted.pop("scene") == str(GALLERY / f"{scene}.toml")
    keys = ["measurements", "unknowns", "rank", "null_space", "condition", "mse", "trimmed_mse", "trim"]
    assert list(predicted)[:8] == keys
    others = {"degrees_of_freedom", "resolution", "method", "prior_variance", "assumes", "recovers_nothing"}
    others |= {"budget", "interval", "mse_for_picture"}
    assert others == set(predicted) - set(keys)
    assert {key: predicted[key] for key in expected} == pytest.approx(expected, rel=1e-5)
    assert predicted["rank"] + predicted["null_space"] == predicted["unknowns"]


def arguments(command: str, finished: Path) -> list[str | Path]:
    files: dict[str, list[str | Path]] = {
        "run": ["tiny.toml", "-o", "out"],
        "render": ["tiny.toml", "-o", "out"],
        "calibrate": ["tiny.toml", "-o", "model.npz"],
        "reconstruct": [finished / "stack.exr", finished / "model.npz", "-o", "estimate.exr"],
        "predict": ["tiny.toml"],
        "show": ["tiny.toml"],
        "export": ["tiny.toml", "-o", "camera.xml"],
        "init": ["new.toml"],
    }
    return [command, *files.get(command, [])]


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_json_is_the_only_output_on_stdout_of_a_new_process(command: str, here: Path, finished: Path) -> None:
    """Libraries may print when they are loaded and unloaded."""
    ended = shell(*arguments(command, finished), "--json", cwd=here)
    assert isinstance(document(ended), list if command in ("run", "render", "predict") else dict)
    assert "Traceback" not in ended.err


def test_results_are_printed_for_reading_or_as_one_json_document(here: Path, finished: Path, ommatid: Command) -> None:
    assert here.is_dir()
    for command in ("run", "predict", "show", "reconstruct"):
        ended = ommatid(*arguments(command, finished))
        assert ended.code == 0
        assert {"run": "tiny", "reconstruct": "estimate.exr"}.get(command, "Tiny") in ended.out
        assert ("grey levels" if command != "show" else "measurements") in ended.out
        described = document(ommatid(*arguments(command, finished), "--json"))
        assert isinstance(described, list if command in ("run", "predict") else dict)


def test_show_lists_skipped_effects_and_unseen_pixels(here: Path, ommatid: Command) -> None:
    assert here.is_dir()
    shown = document(ommatid("show", "tiny.toml", "--json", "--set", "noise="))
    assert "sensor noise and quantisation" in [skip["what"] for skip in shown["skipped"]]
    # Three windows of nine pixels, one pixel apart, span 11 of 12 rows and columns: 23 pixels are left.
    assert shown["pixels_seen_by_fewer_types"] == {"0": 23}
    assert (shown["measurements"], shown["unknowns"]) == (81, 144)


def test_lens_keeps_types_and_takes_one_named_twice_twice(ommatid: Command) -> None:
    shown = document(ommatid("show", GALLERY / "tile19.toml", "--lens", "III,I,III", "--json"))
    assert [kind["name"] for kind in shown["lens_types"]] == ["III", "I", "III-2"]


# --- imports


@pytest.mark.parametrize("command", ["predict", pytest.param("reconstruct", marks=pytest.mark.slow)])
def test_works_where_mitsuba_is_not_installed(command: str, here: Path, finished: Path) -> None:
    closed = ["--no-rays"] if command == "predict" else []
    ended = shell(*arguments(command, finished), *closed, cwd=here, before=without("mitsuba", "drjit"))
    assert ended.code == 0, ended.err


# --- the files of a run


def test_run_json_keeps_the_contract(finished: Path) -> None:
    run = json.loads((finished / "run.json").read_text(encoding="utf-8"))
    assert set(run["stages"]) == {"render", "calibrate", "reconstruct", "files", "page"}
    assert all(stage["seconds"] >= 0 for stage in run["stages"].values())
    error = run["error"]
    assert {"mse", "trimmed_mse", "predicted_mse", "psnr", "ssim", "budget"} <= set(error)
    assert set(error["budget"]) == {"null_space", "noise", "quantisation", "rendering", "calibration", "detail"}
    assert sum(error["budget"].values()) == pytest.approx(error["predicted_mse"], rel=1e-9)
    assert min(error["budget"].values()) >= 0
    assert {"method", "condition", "digits", "bound", "variance_bound", "why", "tried"} <= set(run["solver"])
    assert run["diagnostics"]["degrees_of_freedom"] <= run["unknowns"]
    assert set(run["model"]) == {"rms_difference_from_ideal", "max_z", "p_value", "spurious_information"}
    assert all({"what", "why"} <= set(skip) <= {"what", "why", "bound"} for skip in run["skipped"])
    assert [skip["what"] for skip in run["skipped"] if "bound" in skip] == ["aperture and diffraction"]
    assert {"ommatid", "python", "mitsuba", "drjit", "numpy", "scipy"} <= set(run["versions"])
    assert run["seeds"]


def test_run_json_agrees_with_the_images(finished: Path) -> None:
    error = json.loads((finished / "run.json").read_text(encoding="utf-8"))["error"]
    maps = {name: pixels.astype(np.float64) for name, pixels in channels(finished / "estimate.exr").items()}
    measured = float(np.mean((maps["estimate"] - maps["truth"]) ** 2))
    single = 1e-5  # float32 keeps seven digits, of values that are some times larger than their differences
    assert error["mse"] == pytest.approx(measured, rel=single)
    assert error["psnr"] == pytest.approx(10 * np.log10(255**2 / measured), rel=single)
    assert error["predicted_mse"] == pytest.approx(maps["variance"].mean(), rel=single)
    np.testing.assert_array_equal(maps["truth"], channels(finished / "truth.exr")["Y"])


def test_run_json_says_what_one_sub_image_alone_yields_and_who_computed_when(finished: Path) -> None:
    run = json.loads((finished / "run.json").read_text(encoding="utf-8"))
    error, [baseline] = run["error"], run["baselines"]
    recorded, truth = stack.read(finished / "stack.exr"), channels(finished / "truth.exr")["Y"].astype(np.float64)
    best = best_single_sub_image(recorded, truth)
    assert best is not None
    numbers = {name: baseline[name] for name in ("mse", "psnr", "ssim")}
    assert numbers == pytest.approx({"mse": best.mse, "psnr": best.psnr, "ssim": best.ssim})
    assert (baseline["method"], baseline["sub_imager"]) == ("single", best.name)
    assert error["gain"] == pytest.approx(10 * np.log10(baseline["mse"] / error["mse"]))
    assert run["command"] == ["ommatid", "run", "tiny.toml", "-o", "out"]
    assert run["host"] == platform.node()
    age = datetime.now(UTC) - datetime.fromisoformat(run["date"])
    assert timedelta(0) <= age < timedelta(days=1)


def test_the_scene_in_the_folder_reproduces_the_stack(here: Path, finished: Path, ommatid: Command) -> None:
    for name in ("scene.toml", "truth.exr"):
        shutil.copy(finished / name, here / name)
    assert ommatid("render", "scene.toml", "-o", "again").code == 0
    assert_same_light(here / "again" / "scene" / "stack.exr", finished / "stack.exr")


def test_reconstruct_from_files_gives_the_numbers_of_the_run(here: Path, finished: Path, ommatid: Command) -> None:
    run = json.loads((finished / "run.json").read_text(encoding="utf-8"))
    ended = ommatid("reconstruct", finished / "stack.exr", finished / "model.npz", "-o", "again.exr", "--json")
    assert numbers(document(ended)) == numbers(run)
    before, after = channels(finished / "estimate.exr"), channels(here / "again.exr")
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name], after[name])
    assert (here / "again.png").read_bytes() == (finished / "estimate.png").read_bytes()


# --- reuse of finished stages


def stamps(folder: Path) -> dict[str, int]:
    return {name: (folder / name).stat().st_mtime_ns for name in MADE}


def done(ended: Ended) -> dict[str, bool]:
    """Return which stages were done rather than up to date, from stderr."""
    assert ended.code == 0, ended.err
    lines = dict(line.split(": ", 1) for line in ended.err.splitlines())
    assert set(lines) == {"render", "calibrate", "reconstruct", "report"}
    assert all(line.startswith(("done", "up to date")) for line in lines.values())
    return {stage: line.startswith("done") for stage, line in lines.items()}


NOTHING = {"render": False, "calibrate": False, "reconstruct": False, "report": False}
REPEATED = {"reconstruct", "report"}  # the page shows the reconstruction


def test_a_repeated_run_repeats_no_stage(kept: Path, ommatid: Command) -> None:
    before = stamps(kept)
    ended = ommatid("run", "tiny.toml", "-o", "out", "--json")
    assert done(ended) == NOTHING
    assert stamps(kept) == before
    assert {path.name for path in kept.iterdir()} == FILES
    [described] = document(ended)
    assert numbers(described) == numbers(json.loads((kept / "run.json").read_text(encoding="utf-8")))


def test_a_finished_run_is_compared_with_other_methods_and_with_another_run(
    kept: Path, finished: Path, here: Path, ommatid: Command
) -> None:
    before = stamps(kept)
    ended = ommatid("run", "tiny.toml", "-o", "out", "--baselines", "--json")
    assert ended.code == 0, ended.err
    [described] = document(ended)
    assert {"single", "rearranged", "shift_and_add"} <= {each["method"] for each in described["baselines"]}
    assert json.loads((kept / "run.json").read_text(encoding="utf-8"))["baselines"] == described["baselines"]
    assert {name for name, at in stamps(kept).items() if at != before[name]} == {"run.json", "report.html"}
    ended = ommatid("report", kept, finished, "-o", "both", "--json")
    assert ended.code == 0, ended.err
    assert document(ended) == {"pages": [str(Path("both", "comparison.html"))]}
    assert "the same error" in (here / "both" / "comparison.html").read_text(encoding="utf-8")
    for wrong, words in ((("-o", "both", "--baselines"), "got --baselines"), ((), "got no -o")):
        ended = ommatid("report", kept, finished, *wrong)
        assert (ended.code, words in ended.err) == (2, True)


def test_another_expected_noise_redoes_the_reconstruction_alone(
    kept: Path, finished: Path, here: Path, ommatid: Command
) -> None:
    options = ("--set", "estimator.noise_variance=25")
    model = stamps(kept)["model.npz"]
    ended = ommatid("run", "tiny.toml", "-o", "out", *options)
    assert done(ended) == {**NOTHING, **dict.fromkeys(REPEATED, True)}
    assert stamps(kept)["model.npz"] == model
    assert_same_light(kept / "stack.exr", finished / "stack.exr")
    estimate = channels(kept / "estimate.exr")["estimate"]
    assert (estimate != channels(finished / "estimate.exr")["estimate"]).any()
    # The files of the run give the same estimate, and so does the old stack with the same option.
    for source, more in ((kept, ()), (finished, options)):
        assert ommatid("reconstruct", source / "stack.exr", source / "model.npz", "-o", "again.exr", *more).code == 0
        np.testing.assert_array_equal(channels(here / "again.exr")["estimate"], estimate)


@pytest.mark.parametrize(
    ("setting", "redone"),
    [
        ("render.seed=1", {"render", "calibrate"} | REPEATED),
        pytest.param("render.samples=32", {"render"} | REPEATED, marks=pytest.mark.slow),
        pytest.param("noise.variance=1", {"render"} | REPEATED, marks=pytest.mark.slow),
        ("calibration.samples=32", {"calibrate"} | REPEATED),
        ("prior.mean=100", REPEATED),
        pytest.param("target.origin=[90,200]", {"render"} | REPEATED, marks=pytest.mark.slow),
    ],
)
def test_only_outdated_stages_are_repeated(setting: str, redone: set[str], kept: Path, ommatid: Command) -> None:
    assert kept.is_dir()
    ended = ommatid("run", "tiny.toml", "-o", "out", "--set", setting)
    assert {stage for stage, again in done(ended).items() if again} == redone


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("stack.exr", "render"),
        pytest.param("model.npz", "calibrate", marks=pytest.mark.slow),
        ("run.json", ""),  # which is in estimate.exr, too
        pytest.param("estimate.exr", "reconstruct", marks=pytest.mark.slow),
    ],
)
def test_a_damaged_file_is_replaced(name: str, stage: str, kept: Path, finished: Path, ommatid: Command) -> None:
    whole = (kept / name).read_bytes()
    (kept / name).write_bytes(whole[: len(whole) // 2])
    # The repeated stage took another time, which is part of run.json, so the reconstruction is repeated too.
    again = dict.fromkeys((stage, *REPEATED), True) if stage else {}
    assert done(ommatid("run", "tiny.toml", "-o", "out")) == {**NOTHING, **again}
    assert_same_light(kept / "stack.exr", finished / "stack.exr")
    described = [json.loads((folder / "run.json").read_text(encoding="utf-8")) for folder in (kept, finished)]
    assert numbers(described[0]) == numbers(described[1])


def test_a_missing_or_truncated_report_is_written_again_unchanged(kept: Path, ommatid: Command) -> None:
    report = kept / "report.html"
    whole = report.read_bytes()
    for left in (0, 100_000):
        report.write_bytes(whole[:left])
        assert done(ommatid("run", "tiny.toml", "-o", "out")) == {**NOTHING, "report": True}
        assert report.read_bytes() == whole


# --- batches


def test_one_bad_scene_does_not_stop_the_others(here: Path, ommatid: Command) -> None:
    (here / "bad.toml").write_text(TINY.replace('"1/3"', "2"), encoding="utf-8")
    (here / "last.toml").write_text(TINY, encoding="utf-8")
    ended = ommatid("run", "tiny.toml", "bad.toml", "last.toml", "-o", "out", "--json")
    assert ended.code == 2
    first, bad, last = json.loads(ended.out)
    assert bad["scene"] == "bad.toml"
    assert bad["exit_code"] == 2
    assert "magnification" in bad["error"]
    assert [line for line in ended.err.splitlines() if line.startswith("ommatid: ")] == [f"ommatid: {bad['error']}"]
    assert numbers(first) == numbers(last)
    assert {path.name for path in (here / "out").iterdir()} == {"tiny", "last", "index.html"}
    for stem in ("tiny", "last"):
        assert {path.name for path in (here / "out" / stem).iterdir()} == FILES


# --- init and schema


def test_init_writes_a_scene_to_start_from_and_never_overwrites(here: Path, ommatid: Command) -> None:
    assert ommatid("init", "new.toml").code == 0
    assert document(ommatid("show", "new.toml", "--json"))["lens_types"]
    (here / "new.toml").write_text("mine", encoding="utf-8")
    ended = ommatid("init", "new.toml")
    assert ended.code == 2
    assert "exists already" in ended.err
    assert (here / "new.toml").read_text(encoding="utf-8") == "mine"


def test_the_schema_knows_every_key_of_the_gallery(ommatid: Command) -> None:
    schema = document(ommatid("schema"))
    tables = [schema, *schema["$defs"].values()]
    known = {key for table in tables for key in table["properties"]}
    for path in tracked("ommatid/scenes/*.toml"):
        data = tomllib.loads(path.read_text(encoding="utf-8"))
        assert data.keys() <= schema["properties"].keys(), path.name
        assert {key for table in data.values() if isinstance(table, dict) for key in table} <= known, path.name
    assert all(table["additionalProperties"] is False for table in tables)


# --- protection of files


def test_the_scene_that_is_read_is_never_replaced(here: Path, ommatid: Command) -> None:
    (here / "scene").mkdir()
    source = here / "scene" / "scene.toml"
    source.write_text("# own\n" + (here / "tiny.toml").read_text(encoding="utf-8"), encoding="utf-8")
    before = source.read_bytes()
    for command in ("run", "render"):
        ended = ommatid(command, "scene/scene.toml", "-o", ".")
        assert ended.code == 2
        assert "would replace" in ended.err
        assert source.read_bytes() == before
    assert [path.name for path in source.parent.iterdir()] == ["scene.toml"]


def test_reconstruct_never_replaces_what_it_reads(kept: Path, ommatid: Command) -> None:
    before = stamps(kept)
    for name in ("stack.exr", "model.npz", "truth.exr"):
        ended = ommatid("reconstruct", kept / "stack.exr", kept / "model.npz", "-o", kept / name)
        assert ended.code == 2
    assert stamps(kept) == before


@pytest.mark.slow
def test_ctrl_c_yields_one_sentence_and_keeps_finished_files(here: Path) -> None:
    """A run interrupted during calibration leaves a complete stack and no part of a model."""
    command = [sys.executable, "-m", "ommatid", "run", "tiny.toml", "-o", "out"]
    more = ["--set", "calibration.samples=100000"]
    with subprocess.Popen(
        [*command, *more],
        cwd=here,
        stderr=subprocess.PIPE,
        text=True,
        # Background jobs of a shell ignore SIGINT, and child processes inherit this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as started:
        assert started.stderr is not None
        assert "render: done" in started.stderr.readline()
        started.send_signal(signal.SIGINT)
        err = started.stderr.read()
    assert started.returncode == 1
    assert err.strip() == "ommatid: stopped; finished files stay, the next run carries on from them"
    assert {path.name for path in (here / "out" / "tiny").iterdir()} == {"scene.toml", "truth.exr", "stack.exr"}


def test_an_import_that_ctrl_c_stops_is_ctrl_c(capsys: pytest.CaptureFixture[str]) -> None:
    """Libraries then raise an ImportError, which would be the failure of one scene or frame of many."""

    def command() -> None:
        try:
            raise ImportError("initialization failed") from KeyboardInterrupt()
        except ImportError as error:
            report(error)

    assert exit_code_of(command) == 1
    assert capsys.readouterr().err.startswith("ommatid: stopped;")


def test_too_large_a_reconstruction_is_refused_before_anything_is_rendered(here: Path, ommatid: Command) -> None:
    sets = ["target.origin=", "target.shape=[512, 512]", "camera.lens.I.pixels=fit", "camera.lens_pitch=9 mm"]
    sets.append("estimator.memory=20 MB")
    ended = ommatid("run", "tiny.toml", "-o", "out", *(word for one in sets for word in ("--set", one)))
    assert ended.code == 2
    assert "GB" in ended.err
    assert not (here / "out").exists()


def test_a_gallery_scene_is_not_replaced_by_a_result(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = tmp_path / "tile19.toml"
    scene.write_bytes((gallery.GALLERY / scene.name).read_bytes())
    monkeypatch.setattr(gallery, "GALLERY", tmp_path)
    with pytest.raises(InputError, match="would replace the file that is read"):
        export_scene(Path("tile19"), scene)
    with pytest.raises(InputError, match="expected the name of a model"):
        calibrate_file(Path("tile19"), scene, (), (), None, no_progress)
