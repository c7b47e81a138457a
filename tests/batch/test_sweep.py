"""Sweeps: options, folders, the table and figure of the results."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.prediction_table import json_of
from ommatid.batch import sweep_table
from ommatid.batch.sweep import SweepAxis, job_numbers, members, sweep_axes
from ommatid.batch.sweep_row import SweepRow, read_rows, summary
from ommatid.batch.sweep_table import lines, write_sweep
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read

from ..conftest import TINY, Command
from ..kept_figures import KeptFigures
from ..runs import document

NOISES = ("1e-4", "1e-2", "1")
# Values with commas inside brackets and quotation marks, which do not end them.
VALUES = st.recursive(
    st.sampled_from(["1e-6", "1/3", "0.1 mm", '"a,b"', "'c]'", "auto"]),
    lambda inner: st.lists(inner, min_size=1, max_size=3).map(lambda parts: f"[{','.join(parts)}]"),
    max_leaves=6,
)


@given(st.lists(VALUES, min_size=1, max_size=5, unique=True))
def test_values_joined_by_commas_are_separated_again(values: list[str]) -> None:
    assert sweep_axes([f"noise.variance={','.join(values)}"]) == (SweepAxis("noise.variance", tuple(values)),)


@given(st.lists(st.text(min_size=1, max_size=60), min_size=1, max_size=6, unique=True))
def test_folder_names_are_safe_and_unique(values: list[str]) -> None:
    batch = members([Path("a.toml"), Path("b.toml")], (SweepAxis("target.image", tuple(values)),), Path("out"))
    folders = [member.folder for member in batch]
    assert len(set(folders)) == 2 * len(values)
    assert {folder.parent for folder in folders} == {Path("out")}
    assert all(folder.name.isascii() and folder.name.isprintable() for folder in folders)
    assert [member.values["target.image"] for member in batch] == 2 * values


def test_folder_names_contain_the_values() -> None:
    keys = ["noise.variance=1e-6,1e-4", "camera.lens.I.magnification=1/2,1/3", "camera.lens.II.pixels=[2, 2],[3,3]"]
    names = [member.folder.name for member in members([Path("tile19.toml")], sweep_axes(keys), Path())]
    assert len(names) == 8
    assert names[0] == "tile19+noise.variance=1e-6+camera.lens.I.magnification=1-2+camera.lens.II.pixels=2,2"
    assert names[-1] == "tile19+noise.variance=1e-4+camera.lens.I.magnification=1-3+camera.lens.II.pixels=3,3"


def test_a_batch_without_a_sweep_has_a_folder_per_scene() -> None:
    [member] = members([Path("x/tile19.toml")], (), Path("out"))
    assert (member.folder, member.changes, member.values) == (Path("out/tile19"), (), {})
    with pytest.raises(InputError, match="two scenes of the batch are called 'tile19'"):
        members([Path("x/tile19.toml"), Path("tile19.toml")], (), Path("out"))


def test_wrong_sweeps_are_refused_before_any_work(here: Path, ommatid: Command) -> None:
    for options, message in (
        (["noise.variance"], "expected KEY=VALUE,VALUE,..."),
        (["noise.variance="], "without an empty value"),
        (["noise.variance=1,1"], "got '1' twice"),
        (["noise.variance=1", "noise.variance=2"], "--sweep noise.variance=2: expected every key once, got it twice"),
        (["noise.varience=1,2"], "unknown key 'noise.varience'; the nearest known key is 'noise.variance'"),
        (["camera.lens.II.pixels=[2,2]"], "no lens type is called 'II'; there are 'I'"),
    ):
        words = (part for option in options for part in ("--sweep", option))
        ended = ommatid("predict", "tiny.toml", "-o", "out", *words)
        assert (ended.code, ended.out) == (2, "")
        [line] = ended.err.splitlines()
        assert line.startswith("ommatid: --sweep ")
        assert message in line
    for command in ("run", "render"):
        ended = ommatid(command, "tiny.toml", "-o", "out", "--sweep", "noice.variance=1,2")
        assert "unknown key 'noice'" in ended.err
    assert not (here / "out").exists()


# --- shares of jobs


def test_the_number_of_a_job_is_written_or_that_of_the_array() -> None:
    for text, environment, expected in (
        ("2/3", {}, (2, 3)),
        ("2/3", {"SLURM_ARRAY_TASK_ID": "1"}, (2, 3)),  # what is written counts
        ("/8", {"SLURM_ARRAY_TASK_ID": "3"}, (3, 8)),
        ("/8", {"PBS_ARRAY_INDEX": "8"}, (8, 8)),
    ):
        assert job_numbers(text, environment) == expected
    for text, environment, message in (
        ("0/3", {}, "expected a job from 1 to 3, got '0'"),
        ("4/3", {}, "expected a job from 1 to 3, got '4'"),
        ("three", {}, "expected I/N, such as 2/8"),
        ("1/200000", {}, "with N up to 100000"),
        ("auto", {"SLURM_ARRAY_TASK_ID": "1"}, "`auto` is withdrawn"),
        ("/3", {}, "neither SLURM_ARRAY_TASK_ID nor PBS_ARRAY_INDEX is set"),
        (
            "/3",
            {"SLURM_ARRAY_TASK_ID": "0"},
            "got '0', which is SLURM_ARRAY_TASK_ID; submit the jobs as an array from 1",
        ),
        ("/3", {"PBS_ARRAY_INDEX": "x"}, "got 'x', which is PBS_ARRAY_INDEX"),
    ):
        with pytest.raises(InputError, match=re.escape(message)):
            job_numbers(text, environment)


def test_jobs_do_every_scene_once_and_the_command_without_them_writes_the_table(here: Path, ommatid: Command) -> None:
    """Four scenes of which two fail, in three jobs; the seventh of nine jobs has none."""
    sweep = ("--sweep", "render.seed=1,2", "--sweep", "camera.lens.I.magnification=1/3,2")
    render = ("render", "tiny.toml", *sweep, "-o", "out", "--json")
    scenes: list[str] = []
    for job, code in ((3, 0), (1, 2), (2, 2)):
        ended = ommatid(*render, "--job", f"{job}/3")
        documents = json.loads(ended.out)
        scenes += [str(document["values"]) for document in documents]
        assert (ended.code, len(documents)) == (code, 2 if job == 1 else 1)
        assert ended.err.endswith(
            f"job {job} of 3: {len(documents)} of 4 scenes; once all jobs have ended, the same command without --job"
            " writes the table\n"
        )
    assert len(set(scenes)) == 4
    assert not [*(here / "out").glob("sweep.*")]
    assert json.loads(ommatid(*render, "--job", "7/9").out) == []
    whole = ommatid(*render)
    assert whole.err.count("up to date, nothing to do") == 2
    assert [row.failed is not None for row in read_rows(here / "out" / "sweep.json")] == [False, True, False, True]
    assert ommatid("run", "tiny.toml", "--job", "1/2", "--scheduler", "tcp://localhost:1").err.startswith(
        "ommatid: --job and --scheduler: expected one of them"
    )


# --- the table


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_combinations_with_errors_fail_independently(here: Path, ommatid: Command) -> None:
    swept = ("--sweep", "noise.variance=1e-2,-1", "--sweep", "camera.lens.I.magnification=1/3,1/20")
    ended = ommatid("run", "tiny.toml", "-o", "out", *swept, "--workers", "1", "--json")
    assert ended.code == 2
    documents = json.loads(ended.out)
    assert [document.get("exit_code", 0) for document in documents] == [0, 2, 2, 2]
    rows = table(here / "out" / "sweep.csv")
    assert [bool(row["failed"]) for row in rows] == [False, True, True, True]
    assert "noise.variance" in rows[2]["failed"]
    assert rows[1]["failed"] == documents[1]["error"]
    assert [row["mse"] for row in rows] == [str(documents[0]["error"]["mse"]), "", "", ""]
    assert (here / "out" / "sweep.png").is_file()


@pytest.mark.parametrize("value", ["nan", "-inf", "2024-01-01", "[{a=2024-01-01}]"])
def test_values_that_json_does_not_have_are_written_as_text(here: Path, ommatid: Command, value: str) -> None:
    ended = ommatid("predict", "tiny.toml", "--sweep", f"noise.variance={value},1", "-o", "out", "--json")
    assert ended.code == 2
    assert [document.get("exit_code", 0) for document in json.loads(ended.out)] == [2, 0]
    rows = read_rows(here / "out" / "sweep.json")
    assert [row.values["noise.variance"] for row in rows] == [value, 1]
    assert len(ended.err.splitlines()) == 1


def test_the_table_holds_the_numbers_of_each_run(here: Path, ommatid: Command) -> None:
    (here / "other.toml").write_text(TINY.replace("[render]", "[render]\nseed = 7"), encoding="utf-8")
    swept = ("--sweep", "noise.variance=1e-2,100", "--sweep", "prior.variance=5461.25")
    documents = document(ommatid("run", "tiny.toml", "other.toml", "-o", "out", *swept, "--workers", "1", "--json"))
    lines, rows = table(here / "out" / "sweep.csv"), read_rows(here / "out" / "sweep.json")
    assert len(documents) == len(lines) == len(rows) == 4
    assert [Path(row.scene).stem for row in rows] == ["tiny"] * 2 + ["other"] * 2
    for shown, line, row in zip(documents, lines, rows, strict=True):
        run = json.loads((here / line["folder"] / "run.json").read_text(encoding="utf-8"))
        scene = read(here / line["folder"] / "scene.toml")
        assert scene.noise is not None
        assert scene.noise.variance == float(line["noise.variance"]) == row.values["noise.variance"]
        assert scene.prior.variance == float(line["prior.variance"]) == row.values["prior.variance"]
        for name in ("mse", "predicted_mse", "psnr"):
            assert float(line[name]) == getattr(row, name) == run["error"][name] == shown["error"][name]
        assert float(line["expected_low"]) == row.expected_low == run["error"]["expected_given_truth"]["low"]
        others = row.model_extra or {}
        assert float(line["seconds.render"]) == others["seconds.render"] == run["stages"]["render"]["seconds"]
        budget = {name: value for name, value in others.items() if name.startswith("budget.")}
        assert budget == {name: float(value) for name, value in line.items() if name.startswith("budget.")}
        assert sum(budget.values()) == pytest.approx(run["error"]["predicted_mse"], rel=1e-9)
        assert (line["measurements"], line["unknowns"]) == ("81", "144")
    assert len({row.mse for row in rows}) == 4, "every combination is another scene"


def test_predictions_of_a_sweep_are_those_of_each_scene(here: Path, ommatid: Command) -> None:
    swept = ("--sweep", f"noise.variance={','.join(NOISES)}")
    documents = document(ommatid("predict", "tiny.toml", *swept, "-o", "out", "--json"))
    assert {path.name for path in (here / "out").iterdir()} == {"sweep.csv", "sweep.json", "sweep.png"}
    for noise, shown, line in zip(NOISES, documents, table(here / "out" / "sweep.csv"), strict=True):
        expected = json_of(predict_scene(read(here / "tiny.toml", [f"noise.variance={noise}"])))
        assert {name: shown[name] for name in expected} == expected
        assert shown["values"] == {"noise.variance": noise}
        assert float(line["predicted_mse"]) == expected["mse"]
        assert float(line["predicted_rms"]) ** 2 == pytest.approx(expected["mse"])
        assert "mse" not in line, "nothing was measured"
    assert ommatid("predict", "tiny.toml", *swept).out.count("predicted mse") == len(NOISES)
    assert sorted(path.name for path in here.iterdir()) == ["out", "tiny.toml"]


# --- the figure


def test_every_curve_has_a_colour_and_the_error_both_scales(rows_of_tolerance: list[SweepRow], tmp_path: Path) -> None:
    figure = drawn(rows_of_tolerance, tmp_path)
    [panel] = figure.axes
    assert (panel.get_xscale(), panel.get_yscale()) == ("log", "log")
    assert panel.get_xlabel() == "camera.tolerance.position (nm)"
    assert [label.get_text() for label in panel.get_xticklabels()] == ["1", "10", "100", "1000"]
    [right] = panel.child_axes
    figure.canvas.draw()
    assert np.square(right.get_ylim()) == pytest.approx(panel.get_ylim())
    for axes in (panel, right):
        assert "grey levels" in axes.get_ylabel()
        assert len(inside(axes.yaxis)) > 1
    legend = " ".join(text.get_text() for text in figure.legends[0].get_texts())
    assert "ideal (H as designed, not calibrated)" in legend
    assert "transport (calibrated by rays)" in legend


def inside(axis: Any) -> list[float]:
    low, high = sorted(axis.get_view_interval())
    return [tick for tick in axis.get_ticklocs() if low <= tick <= high]


def test_measured_points_are_at_their_values(rows_of_tolerance: list[SweepRow], tmp_path: Path) -> None:
    """Points on the finished figure, in pixels, map back to lengths in nm and to measured errors."""
    panel = drawn(rows_of_tolerance, tmp_path).axes[0]
    points: list[Any] = []
    for line in panel.lines:
        if line.get_marker() == "o":
            place = line.get_transform().transform(line.get_xydata())
            points += panel.transData.inverted().transform(place).tolist()
    lengths = {value: 10.0**power for power, value in enumerate(POSITIONS)}
    expected = [[lengths[row.values["camera.tolerance.position"]], row.mse] for row in rows_of_tolerance]
    assert np.sort(points, axis=0) == pytest.approx(np.sort(np.array(expected, dtype=float), axis=0), rel=1e-9)


def test_a_sweep_says_where_the_error_is_twice_the_smallest(rows_of_tolerance: list[SweepRow]) -> None:
    """Between decades the logarithm is interpolated, which is exact for the power that these errors follow."""
    axis, found = sweep_table.crossings(rows_of_tolerance)
    assert [crossing.values["calibration.method"] for crossing in found] == ["ideal", "transport"]
    assert [crossing.position for crossing in found] == pytest.approx([200**0.5, 20000**0.5], rel=1e-9)
    assert axis.limit(found[1].position, found[1].good) == "up to 140 nm"
    printed = [value for name, value in lines(rows_of_tolerance) if "twice the smallest" in name]
    assert printed[0] == "camera.tolerance.position up to 14 nm, calibration.method = ideal"
    named = [
        row.model_copy(update={"values": {"render.sampler": name}}) for name, row in zip("abc", NAMED, strict=True)
    ]
    assert sweep_table.crossings(named)[1] == []
    falling = [row.model_copy(update={"values": {"noise.bits": bits}}) for bits, row in zip("642", NAMED, strict=True)]
    assert sweep_table.crossings(falling)[1] == [], "one value alone is below twice the smallest error"
    needed = [*falling, NAMED[0].model_copy(update={"values": {"noise.bits": "8"}})]
    [bits] = sweep_table.crossings(needed)[1]
    assert bits.position == pytest.approx(4), "the error of 4 bits is twice that of 6 and 8"


def printed_limits(key: str, errors: dict[str, float]) -> list[str]:
    rows = [
        SweepRow(scene="a.toml", values={key: value}, predicted_mse=error, null_space=0)
        for value, error in errors.items()
    ]
    return [value for name, value in lines(rows) if "twice the smallest" in name]


def test_the_value_that_is_named_holds_twice_the_smallest_error() -> None:
    """12 bits have 2.53 times the smallest error."""
    errors = {"10": 1.515, "11": 0.4238, "12": 0.1507, "13": 0.08236, "14": 0.06528, "18": 0.05961}
    assert printed_limits("noise.bits", errors) == ["noise.bits from 13 bits"]
    valley = {"1": 9.0, "2": 1.0, "3": 1.1, "4": 9.0}
    assert printed_limits("x", valley) == ["x from 2", "x up to 3"]


def test_nothing_is_twice_an_error_of_zero() -> None:
    assert printed_limits("noise.variance", {"0": 0.0, "1e-6": 2.8e-4, "1.5e-6": 4.2e-4, "1e-5": 2.8e-3}) == []


def test_a_run_that_is_not_to_be_trusted_has_a_hollow_point_and_no_prediction(
    rows_of_tolerance: list[SweepRow], tmp_path: Path
) -> None:
    """The curve without calibration predicts too little from 100 nm on; what is measured there counts."""
    doubted = [
        row.model_copy(update={"trusted": False, "predicted_mse": 0.1, "expected_low": 0.05, "expected_high": 0.2})
        if (row.mse or 0) > 1 and row.values["calibration.method"] == "ideal"
        else row.model_copy(update={"trusted": True})
        for row in rows_of_tolerance
    ]
    figure = drawn(doubted, tmp_path)
    hollow = [line for line in figure.axes[0].lines if line.get_markerfacecolor() == "white"]
    heights = np.concatenate([line.get_ydata() for line in hollow])
    assert sorted(heights[np.isfinite(heights)]) == sorted(row.mse or 0 for row in doubted if row.trusted is False)
    lines_drawn = [line for line in figure.axes[0].lines if line.get_marker() == "None" and len(line.get_xdata()) == 4]
    assert [int(np.isfinite(line.get_ydata()).sum()) for line in lines_drawn] == [2, 4]
    assert "measured, not to be trusted" in [text.get_text() for text in figure.legends[0].get_texts()]
    ideal, _ = sweep_table.crossings(doubted)[1]
    measured = 11  # at 100 nm; 0.1 is predicted at 10 nm, and 0.2 is between them
    assert ideal.position == pytest.approx(10 ** (1 + np.log(2) / np.log(measured / 0.1)))


POSITIONS = ("1 nm", "10 nm", "100 nm", "1 um")
NAMED = [SweepRow(scene="a.toml", values={}, predicted_mse=float(error)) for error in (1, 2, 4)]


@pytest.fixture
def rows_of_tolerance() -> list[SweepRow]:
    """Errors of the square of the tolerance, uncalibrated, and a tenth of the length's effect, calibrated."""
    return [
        SweepRow(
            scene="a.toml",
            values={"camera.tolerance.position": length, "calibration.method": method},
            predicted_mse=max(0.1, (10.0**power / scale) ** 2 / 10),
            mse=1.1 * max(0.1, (10.0**power / scale) ** 2 / 10),
        )
        for power, length in enumerate(POSITIONS)
        for method, scale in (("ideal", 10.0), ("transport", 100.0))
    ]


def drawn(rows: list[SweepRow], folder: Path) -> Any:
    figures = KeptFigures()
    sweep_table.write_figure(folder / "sweep.png", rows, figures)
    return figures.kept["sweep"]


def documents_of(swept: dict[str, list[str]]) -> list[dict[str, Any]]:
    """Descriptions of every combination, as of runs."""
    documents: list[dict[str, Any]] = []
    options = [f"{key}={','.join(values)}" for key, values in swept.items()]
    for index, member in enumerate(members([Path("a.toml")], sweep_axes(options), Path("out"))):
        given_truth = {"mse": 2.0 + index, "low": 1.0 + index, "high": 3.0 + index}
        error = {"mse": 2.5 + index, "predicted_mse": 2.0 + index, "psnr": None, "ssim": None, "budget": {"null": 1.0}}
        description = {"error": {**error, "expected_given_truth": given_truth}, "stages": {}}
        documents.append({"scene": "a.toml", "folder": str(member.folder), "values": member.values, **description})
    return documents


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_row_of_a_sweep_is_drawn_and_read_again(count: int, tmp_path: Path) -> None:
    keys: dict[str, list[str]] = {
        "noise.variance": list(NOISES),
        "prior.variance": ["1", "2"],
        "render.seed": ["1", "2"],
    }
    rows = [summary(description) for description in documents_of(dict(list(keys.items())[:count]))]
    write_sweep(tmp_path, rows)
    [panel] = drawn(rows, tmp_path).axes
    curves = [line for line in panel.lines if len(line.get_xdata()) == len(NOISES)]
    for name, is_line in (("mse", False), ("predicted_mse", True)):
        of_kind = [line for line in curves if (line.get_marker() == "None") == is_line]
        heights = sorted(float(y) for line in of_kind for y in line.get_ydata())
        assert heights == sorted(getattr(row, name) for row in rows)
    styles = {(str(line.get_color()), line.get_linestyle()) for line in curves if line.get_marker() == "None"}
    assert len(styles) == len(rows) / len(NOISES), "every combination of the other keys has a line of its own"
    typed = [{key: float(text) for key, text in row.values.items()} for row in rows]
    expected = [row.model_copy(update={"values": values}) for row, values in zip(rows, typed, strict=True)]
    assert read_rows(tmp_path / "sweep.json") == expected
