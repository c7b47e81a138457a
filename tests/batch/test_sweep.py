"""A scene multiplied over values of its keys: reading, folders, and the table and plot of what became of it."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.analysis.predict import predict_scene
from ommatid.analysis.prediction_table import json_of
from ommatid.batch import sweep_figure
from ommatid.batch.sweep import SweepAxis, members, sweep_axes
from ommatid.batch.sweep_row import read_rows, summary
from ommatid.batch.sweep_table import write_sweep
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import read
from ommatid.scenes.tables.overrides import value_of

from ..conftest import TINY, Command

NOISES = ("1e-4", "1e-2", "1")
# Values with commas inside brackets and quotation marks, which do not end them.
VALUES = st.recursive(
    st.sampled_from(["1e-6", "1/3", "0.1 mm", '"a,b"', "'c]'", "auto"]),
    lambda inner: st.lists(inner, min_size=1, max_size=3).map(lambda parts: f"[{','.join(parts)}]"),
    max_leaves=6,
)


@given(st.lists(VALUES, min_size=1, max_size=5, unique=True))
def test_values_that_are_joined_by_commas_are_read_apart(values: list[str]) -> None:
    assert sweep_axes([f"noise.variance={','.join(values)}"]) == (SweepAxis("noise.variance", tuple(values)),)


@given(st.lists(st.text(min_size=1, max_size=60), min_size=1, max_size=6, unique=True))
def test_folders_are_safe_and_never_shared(values: list[str]) -> None:
    found = members([Path("a.toml"), Path("b.toml")], (SweepAxis("target.image", tuple(values)),), Path("out"))
    folders = [member.folder for member in found]
    assert len(set(folders)) == 2 * len(values)
    assert {folder.parent for folder in folders} == {Path("out")}
    assert all(folder.name.isascii() and folder.name.isprintable() for folder in folders)
    assert [member.values["target.image"] for member in found] == 2 * values


def test_folders_tell_their_values() -> None:
    keys = ["noise.variance=1e-6,1e-4", "camera.lens.I.magnification=1/2,1/3", "camera.lens.II.pixels=[2, 2],[3,3]"]
    swept = sweep_axes(keys)
    names = [member.folder.name for member in members([Path("tile19.toml")], swept, Path())]
    assert len(names) == 8
    assert names[0] == "tile19+noise.variance=1e-6+camera.lens.I.magnification=1-2+camera.lens.II.pixels=2,2"
    assert names[-1] == "tile19+noise.variance=1e-4+camera.lens.I.magnification=1-3+camera.lens.II.pixels=3,3"


def test_no_sweep_leaves_a_batch_as_it_was() -> None:
    [one] = members([Path("x/tile19.toml")], (), Path("out"))
    assert (one.folder, one.changes, one.values) == (Path("out/tile19"), (), {})
    with pytest.raises(InputError, match="two scenes of the batch are called 'tile19'"):
        members([Path("x/tile19.toml"), Path("tile19.toml")], (), Path("out"))


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["noise.variance"], "expected KEY=VALUE,VALUE,..."),
        (["noise.variance="], "without an empty value"),
        (["noise.variance=1,,2"], "without an empty value"),
        (["=1,2"], "expected KEY=VALUE"),
        (["noise.variance=1,1"], "got '1' twice"),
        (["noise.variance=1", "noise.variance=2"], "got 'noise.variance' twice"),
        (["noise.varience=1,2"], "unknown key 'noise.varience'; the nearest known key is 'noise.variance'"),
        (["noice.variance=1,2"], "unknown key 'noice'"),
        (["camera.lens.II.pixels=[2,2]"], "no lens type is called 'II'; there are 'I'"),
        (["camera.lens.I.pixles=[2,2]"], "unknown key 'camera.lens.I.pixles'"),
        (["noise.variance.x=1"], "noise.variance.x"),
    ],
)
@pytest.mark.parametrize("command", ["run", "render", "predict"])
def test_what_cannot_be_swept_is_refused_before_any_work(
    command: str, options: list[str], sentence: str, here: Path, ommatid: Command
) -> None:
    swept = [part for option in options for part in ("--sweep", option)]
    ended = ommatid(command, "tiny.toml", "-o", "out", *swept)
    assert (ended.code, ended.out) == (2, "")
    [line] = ended.err.splitlines()
    assert line.startswith("ommatid: --sweep ")
    assert sentence in line
    assert not (here / "out").exists()


def test_a_combination_that_is_no_scene_fails_for_itself(here: Path, ommatid: Command) -> None:
    swept = ("--sweep", "noise.variance=1e-2,-1", "--sweep", "camera.lens.I.magnification=1/3,1/20")
    ended = ommatid("run", "tiny.toml", "-o", "out", *swept, "--workers", "1", "--json")
    assert ended.code == 2
    documents = json.loads(ended.out)
    assert [one.get("exit_code", 0) for one in documents] == [0, 2, 2, 2]
    rows = table(here / "out" / "sweep.csv")
    assert [bool(row["failed"]) for row in rows] == [False, True, True, True]
    assert "noise.variance" in rows[2]["failed"]
    assert rows[1]["failed"] == documents[1]["error"]
    assert [float(row["mse"] or "nan") == documents[0]["error"]["mse"] for row in rows] == [True, False, False, False]
    assert (here / "out" / "sweep.png").is_file()


@pytest.mark.parametrize("value", ["nan", "-inf", "2024-01-01", "[{a=2024-01-01}]"])
def test_a_value_that_json_does_not_know_fails_for_itself(here: Path, ommatid: Command, value: str) -> None:
    ended = ommatid("predict", "tiny.toml", "--sweep", f"noise.variance={value},1", "-o", "out", "--json")
    assert ended.code == 2
    assert [one.get("exit_code", 0) for one in json.loads(ended.out)] == [2, 0]
    told = json.loads((here / "out" / "sweep.json").read_text(encoding="utf-8"))
    assert [row["values"]["noise.variance"] for row in told] == [value, 1]
    assert len(ended.err.splitlines()) == 1


def table(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_the_table_of_a_sweep_is_what_each_run_says(here: Path, ommatid: Command) -> None:
    (here / "other.toml").write_text(TINY.replace("[render]", "[render]\nseed = 7"), encoding="utf-8")
    swept = ("--sweep", "noise.variance=1e-2,100", "--sweep", "prior.variance=5461.25")
    ended = ommatid("run", "tiny.toml", "other.toml", "-o", "out", *swept, "--workers", "1", "--json")
    assert ended.code == 0, ended.err
    documents, rows = json.loads(ended.out), table(here / "out" / "sweep.csv")
    told = json.loads((here / "out" / "sweep.json").read_text(encoding="utf-8"))
    assert len(documents) == len(rows) == len(told) == 4
    assert [Path(row["scene"]).stem for row in rows] == ["tiny"] * 2 + ["other"] * 2
    for document, row, one in zip(documents, rows, told, strict=True):
        run = json.loads((here / row["folder"] / "run.json").read_text(encoding="utf-8"))
        described = read(here / row["folder"] / "scene.toml")
        assert described.noise is not None
        assert described.noise.variance == float(row["noise.variance"]) == one["values"]["noise.variance"]
        assert described.prior.variance == float(row["prior.variance"]) == one["values"]["prior.variance"]
        for name in ("mse", "predicted_mse", "psnr"):
            assert float(row[name]) == one[name] == run["error"][name] == document["error"][name]
        given_truth = run["error"]["expected_given_truth"]
        assert float(row["expected_low"]) == given_truth["low"]
        parts = [float(value) for name, value in row.items() if name.startswith("budget.")]
        assert sum(parts) == pytest.approx(float(row["predicted_mse"]), rel=1e-9)
        assert float(row["seconds.render"]) == run["stages"]["render"]["seconds"]
        assert (row["measurements"], row["unknowns"]) == ("81", "144")
    assert len({row["mse"] for row in rows}) == 4, "every combination is another scene"


def test_predictions_of_a_sweep_are_those_of_each_scene(here: Path, ommatid: Command) -> None:
    swept = ("--sweep", f"noise.variance={','.join(NOISES)}")
    ended = ommatid("predict", "tiny.toml", *swept, "-o", "out", "--json")
    assert ended.code == 0, ended.err
    assert {path.name for path in (here / "out").iterdir()} == {"sweep.csv", "sweep.json", "sweep.png"}
    rows = table(here / "out" / "sweep.csv")
    for noise, document, row in zip(NOISES, json.loads(ended.out), rows, strict=True):
        expected = json_of(predict_scene(read(here / "tiny.toml", [f"noise.variance={noise}"])))
        assert {name: document[name] for name in expected} == expected
        assert document["values"] == {"noise.variance": noise}
        assert float(row["predicted_mse"]) == expected["mse"]
        assert "mse" not in row, "nothing was measured"
    assert ommatid("predict", "tiny.toml", *swept).out.count("predicted mse") == len(NOISES)
    assert sorted(path.name for path in here.iterdir()) == ["out", "tiny.toml"]


def test_a_sweep_of_renderings_has_a_table_and_no_plot(here: Path, ommatid: Command) -> None:
    ended = ommatid("render", "tiny.toml", "-o", "out", "--sweep", "render.samples=16,64", "--workers", "1", "--json")
    assert ended.code == 0, ended.err
    assert {path.name for path in (here / "out").iterdir()} == {
        "tiny+render.samples=16",
        "tiny+render.samples=64",
        "sweep.csv",
        "sweep.json",
    }
    assert [row["render.samples"] for row in table(here / "out" / "sweep.csv")] == ["16", "64"]


@pytest.mark.parametrize(
    ("values", "places", "unit", "logarithmic", "categories"),
    [
        (["1e-6", "1e-4", "1e-2"], [1e-6, 1e-4, 1e-2], "squared units of f", True, False),
        (["1", "2", "4"], [1, 2, 4], "squared units of f", False, False),
        (["0.1 mm", "0.2 mm"], [0.1, 0.2], "mm", False, False),
        (["0.1 mm", "200 um"], [0, 1], "", False, True),
        (["1/2", "1/3", "1/5"], [0, 1, 2], "", False, True),
        (["-1", "0", "100"], [-1, 0, 100], "squared units of f", False, False),
    ],
)
def test_values_that_are_numbers_of_one_unit_have_a_scale(
    values: list[str], places: list[float], unit: str, logarithmic: bool, categories: bool
) -> None:
    found = sweep_figure.scale("noise.variance", values)
    assert [found.positions[value] for value in values] == pytest.approx(places)
    assert (found.unit, found.logarithmic, found.categories) == (unit, logarithmic, categories)


def documents(swept: dict[str, list[str]]) -> list[dict[str, Any]]:
    """What runs might say of every combination, without running them."""
    found: list[dict[str, Any]] = []
    options = [f"{key}={','.join(values)}" for key, values in swept.items()]
    for place, member in enumerate(members([Path("a.toml")], sweep_axes(options), Path("out"))):
        given_truth = {"mse": 2.0 + place, "low": 1.0 + place, "high": 3.0 + place}
        error = {"mse": 2.5 + place, "predicted_mse": 2.0 + place, "psnr": None, "ssim": None, "budget": {}}
        document = {"error": {**error, "expected_given_truth": given_truth}, "stages": {}}
        found.append({"scene": "a.toml", "folder": str(member.folder), "values": member.values, **document})
    return found


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_point_of_a_sweep_is_drawn(count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the table: what stands in the plot's points and lines, whatever the number of keys."""
    keys: dict[str, list[str]] = {
        "noise.variance": list(NOISES),
        "prior.variance": ["1", "2"],
        "render.seed": ["1", "2"],
    }
    rows = [summary(document) for document in documents(dict(list(keys.items())[:count]))]
    drawn: list[Any] = []
    monkeypatch.setattr(sweep_figure, "_label_axes", lambda *given: drawn.append(given[0]))
    write_sweep(tmp_path, rows)
    assert [row.flat() | {"values": 0} for row in read_rows(tmp_path / "sweep.json")] == [
        row.flat() | {"values": 0} for row in rows
    ]
    [panel] = drawn
    for name, is_line in (("mse", False), ("predicted_mse", True)):
        lines = [line for line in panel.lines if (line.get_marker() == "None") == is_line]
        heights = sorted(float(y) for line in lines for y in line.get_ydata())
        assert heights == sorted(getattr(row, name) for row in rows)
    styles = {(str(line.get_color()), line.get_linestyle()) for line in panel.lines if line.get_marker() == "None"}
    assert len(styles) == len(rows) / len(NOISES), "a line for each combination of the other keys, and no two alike"


@pytest.mark.parametrize(("text", "value"), [("1e-6", 1e-6), ("[2,2]", [2, 2]), ("1/3", "1/3"), ("auto", "auto")])
def test_values_are_read_like_those_of_set(text: str, value: Any) -> None:
    assert value_of(text) == value
