"""The page of two runs, and the pictures of other methods."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ommatid.analysis import baselines
from ommatid.analysis.baselines import BASELINES, known_baselines
from ommatid.batch.remote import SILENT
from ommatid.page import comparison
from ommatid.page.comparison import difference_words, scene_differences, write_comparison
from ommatid.page.data import Run, read_run
from ommatid.page.sections import page
from ommatid.pipeline.stages import StageResults, finish
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.run_json import IntervalReport, RunReport, VerdictReport
from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file, stack

from .runs import letter_run
from .test_page import maps_of, parsed


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run of a letter F, with all of its files."""
    made = letter_run(tmp_path_factory.mktemp("letter"))
    stack.write(made.folder / "stack.exr", made.stack)
    model_file.write(made.folder / "model.npz", made.model)
    return made


def with_error(run: Run, mse: float, half_width: float | None, *, trusted: bool = True) -> Run:
    """A run with another measured error and the half width of its expected interval."""
    given = None
    if half_width is not None:
        given = IntervalReport(mse=mse, low=mse - half_width, high=mse + half_width)
    error = run.report.error.model_copy(update={"mse": mse, "expected_given_truth": given})
    verdict = VerdictReport(trusted=trusted, reasons=() if trusted else ("no",))
    return replace(run, report=run.report.with_changes(error=error, verdict=verdict))


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [  # sqrt(3^2 + 4^2) = 5
        ((10.0, 3.0), (16.0, 4.0), "A has the smaller error: 3.16 against 4 grey levels RMS."),
        ((10.0, 3.0), (16.0, 4.0), "The difference of the mean squared errors, 6, is larger than its uncertainty, 5"),
        ((14.0, 4.0), (10.0, 3.0), "4, is not larger than its uncertainty, 5 (99 %): it may be chance."),
        ((14.0, 4.0), (10.0, 3.0), "B has the smaller error"),
        ((14.0, None), (10.0, 3.0), "Its uncertainty is not known"),
        ((9.0, 1.0), (9.0, 1.0), "Both have the same error, 3 grey levels RMS"),
    ],
)
def test_the_smaller_error_and_its_uncertainty(
    first: tuple[float, float | None], second: tuple[float, float | None], words: str, run: Run
) -> None:
    assert words in difference_words(with_error(run, *first), with_error(run, *second))[0]


def test_what_makes_runs_hard_to_compare_is_said(run: Run) -> None:
    assert run.truth is not None
    other = replace(with_error(run, 1.0, 0.1, trusted=False), truth=run.truth + 1)
    words = " ".join(difference_words(run, other))
    assert "The targets differ" in words
    assert "B is not to be trusted" in words
    assert len(difference_words(run, run)) == 1


def test_keys_of_scenes_that_differ(run: Run) -> None:
    scene = run.stack.scene
    assert scene.noise is not None
    lens = scene.camera.lens[1].model_copy(update={"name": "other"})
    changed = scene.model_copy(
        update={
            "noise": scene.noise.model_copy(update={"variance": 0.5}),
            "camera": scene.camera.model_copy(update={"lens": (scene.camera.lens[0], lens)}),
        }
    )
    rows = {row[0]: row[1:] for row in scene_differences(scene, changed).rows}
    assert rows["noise.variance"] == ("0.01", "0.5")
    assert rows["camera.lens.B.name"] == ("B", "")
    assert rows["camera.lens.other.name"] == ("", "other")
    assert not any(key.startswith("camera.lens.A") for key in rows)
    assert scene_differences(scene, scene).rows == []


def test_a_page_shows_two_runs(run: Run, tmp_path: Path) -> None:
    path = write_comparison(run.folder, run.folder, tmp_path / "both")
    text = path.read_text(encoding="utf-8")
    reader = parsed(text)
    assert (reader.open, reader.mismatched) == ([], [])
    assert "None: the scenes are equal." in text
    for name in ("A", "B"):
        np.testing.assert_array_equal(maps_of(text)[f"estimate-{name}"], run.estimate)
    assert write_comparison(run.folder, run.folder, tmp_path / "both") == path, "its own page is replaced"
    path.write_text("<html>another program</html>", encoding="utf-8")
    with pytest.raises(InputError, match="another program"):
        write_comparison(run.folder, run.folder, tmp_path / "both")
    with pytest.raises(InputError, match="expected the folder of a run"):
        write_comparison(run.folder, tmp_path, tmp_path / "both")
    assert path.name == comparison.COMPARISON


def compared(run: Run) -> RunReport:
    """The content of run.json of a finished run, compared with other methods."""
    results = StageResults(run_json.read(run.folder), run.stack, run.model)
    return finish(results, run.folder, SILENT, baselines=True)


def test_baselines_are_in_run_json_and_on_the_page(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(baselines, "find_spec", lambda _: None)  # total variation has its own tests
    report = compared(run)
    assert [each.method for each in report.baselines] == ["single", "rearranged", "shift_and_add"]
    assert run_json.read(run.folder).baselines == report.baselines
    text = page(read_run(run.folder), None, "0")
    known = known_baselines(run.folder, report.fingerprint)
    assert known is not None
    np.testing.assert_array_equal(maps_of(text)["shift_and_add"], known.images["shift_and_add"])
    assert "Pixel rearrangement" in text
    assert known_baselines(run.folder, "another") is None
    written = (run.folder / BASELINES).stat().st_mtime_ns
    assert compared(run) == report
    assert (run.folder / BASELINES).stat().st_mtime_ns == written


def test_baselines_need_the_truth(tmp_path: Path) -> None:
    run = letter_run(tmp_path, truth=False)
    with pytest.raises(InputError, match="--baselines compares with the truth, which is not known here"):
        compared(run)
