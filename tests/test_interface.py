"""The Python interface does what the commands do, and loads nothing before it is used."""

from __future__ import annotations

import base64
import io
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.sparse.linalg import lsqr

import ommatid
from ommatid.reconstruct.output.result_files import write_estimate
from ommatid.scenes.formats import exr

from .conftest import Command

MADE = ("stack.exr", "model.npz", "estimate.exr", "run.json", "report.html")
FEW = ("render.samples=16", "calibration.samples=16", "render.variant=scalar_rgb", "noise.variance=1e-2")


@pytest.fixture(
    scope="module", params=["none", pytest.param("auto", marks=pytest.mark.slow)], ids=["entries", "few numbers"]
)
def changes(request: pytest.FixtureRequest) -> list[str]:
    """Changes of the scene; the fit of H by few numbers takes most of the time."""
    return [*FEW, f"calibration.fit={request.param}"]


@pytest.fixture(scope="module")
def scene(changes: list[str]) -> ommatid.Scene:
    return ommatid.read_scene("tile19", set=changes)


@pytest.fixture(scope="module")
def stack(scene: ommatid.Scene) -> ommatid.Stack:
    return ommatid.render(scene)


@pytest.fixture(scope="module")
def model(scene: ommatid.Scene) -> ommatid.Model:
    return ommatid.calibrate(scene)


@pytest.fixture(scope="module")
def result(scene: ommatid.Scene, stack: ommatid.Stack, model: ommatid.Model) -> ommatid.Result:
    return ommatid.reconstruct(stack, model, ommatid.target_image(scene))


def loaded(script: str, cwd: Path) -> set[str]:
    """Modules that are loaded after a script, in a new process."""
    script = f"{script}\nimport sys\nprint(*sys.modules)"
    ended = subprocess.run([sys.executable, "-c", script], cwd=cwd, check=True, capture_output=True, text=True)
    return set(ended.stdout.split())


# --- the module itself


def test_importing_it_loads_nothing_heavy(tmp_path: Path) -> None:
    heavy = {"numpy", "scipy", "pydantic", "pint", "typer", "mitsuba", "drjit", "matplotlib", "skimage", "xarray"}
    assert loaded("import ommatid\ndir(ommatid), ommatid.reconstruct", tmp_path) & heavy == set()
    assert "numpy" in loaded("import ommatid\nommatid.read_scene", tmp_path), "the check sees what is loaded"


@pytest.mark.slow
def test_it_loads_mitsuba_only_to_render(tmp_path: Path) -> None:
    script = "import ommatid\nommatid.predict(ommatid.read_scene('single'), rays=False)"
    assert loaded(script, tmp_path) & {"mitsuba", "drjit", "bokeh", "matplotlib"} == set()


def test_its_names_are_there() -> None:
    assert set(ommatid.__all__) <= set(dir(ommatid))
    assert all(getattr(ommatid, name).__doc__ for name in ommatid.__all__)
    with pytest.raises(AttributeError, match="no attribute 'renderer'"):
        getattr(ommatid, "renderer")  # noqa: B009
    with pytest.raises(ImportError, match="renderer"):
        exec("from ommatid import renderer")


def test_reconstruct_is_a_function_and_stays_a_package() -> None:
    from ommatid.reconstruct import restore

    assert callable(ommatid.reconstruct)
    assert getattr(ommatid.reconstruct, "restore") is restore  # noqa: B009


# --- what it yields


def test_it_yields_the_numbers_of_the_commands(
    changes: list[str],
    stack: ommatid.Stack,
    model: ommatid.Model,
    result: ommatid.Result,
    tmp_path: Path,
    ommatid_command: Command,
) -> None:
    """Bit for bit: the files of `ommatid run`, read again, and the estimate as that stores it."""
    options = [word for change in changes for word in ("--set", change)]
    assert ommatid_command("run", "tile19", "-o", tmp_path, *options).code == 0
    folder = tmp_path / "tile19"
    there = ommatid.read_stack(folder / "stack.exr"), ommatid.read_model(folder / "model.npz")
    np.testing.assert_array_equal(there[0].values, stack.values)
    np.testing.assert_array_equal(there[0].variance, stack.variance)
    np.testing.assert_array_equal(there[1].matrix.toarray(), model.matrix.toarray())
    np.testing.assert_array_equal(there[1].variance, model.variance)
    np.testing.assert_array_equal(there[1].batches, model.batches)
    assert result.reconstruction is not None
    write_estimate(tmp_path / "again.exr", result.reconstruction, {})
    before, after = (exr.read(path)[0].channels for path in (folder / "estimate.exr", tmp_path / "again.exr"))
    assert before.keys() == after.keys()
    for name in before:
        np.testing.assert_array_equal(before[name], after[name])
    finished = ommatid.read_result(folder)
    assert finished.summary.error == result.summary.error
    np.testing.assert_array_equal(finished.image, result.image.astype(np.float32))
    np.testing.assert_array_equal(finished.truth, result.truth)


@pytest.mark.slow
def test_a_prepared_model_gives_the_same_results(
    changes: list[str], scene: ommatid.Scene, stack: ommatid.Stack, model: ommatid.Model, result: ommatid.Result
) -> None:
    reconstructor = ommatid.prepare(model, scene)
    for _ in range(2):
        again = reconstructor(stack, ommatid.target_image(scene))
        np.testing.assert_array_equal(again.image, result.image)
        np.testing.assert_array_equal(again.deviation, result.deviation)
        np.testing.assert_array_equal(again.truth, result.truth)
        assert (again.summary.error, again.summary.verdict) == (result.summary.error, result.summary.verdict)
        assert again.reconstruction is not None
    other = ommatid.prepare(model, ommatid.read_scene("tile19", set=[*changes, "prior.variance=1000"]))(stack)
    changed = stack.scene.model_copy(update={"prior": scene.prior.model_copy(update={"variance": 1000.0})})
    alone = ommatid.reconstruct(replace(stack, scene=changed), model)
    np.testing.assert_array_equal(other.image, alone.image)
    assert np.abs(other.deviation / result.deviation - 1).max() > 0.01
    np.testing.assert_array_equal(ommatid.prepare(model)(stack).image, result.image)


def test_a_model_of_another_camera_is_not_prepared(model: ommatid.Model, stack: ommatid.Stack) -> None:
    with pytest.raises(ommatid.InputError, match=r"tile35.*do not belong together"):
        ommatid.prepare(model, "tile35")
    with pytest.raises(ommatid.InputError, match="expected a Model"):
        ommatid.prepare("model.npz")  # pyright: ignore[reportArgumentType]
    moved = replace(stack, camera=replace(stack.camera, distance=2 * stack.camera.distance))
    with pytest.raises(ommatid.InputError, match=r"the stack and the model do not belong together: target\.distance"):
        ommatid.prepare(model)(moved)
    with pytest.raises(ommatid.InputError, match="expected a Stack"):
        ommatid.prepare(model)("stack.exr")  # pyright: ignore[reportArgumentType]


@pytest.mark.slow
def test_a_run_is_not_repeated(tmp_path: Path) -> None:
    scene = ommatid.read_scene("single", set=[*FEW, "calibration.method=ideal"])
    first = ommatid.run(scene, tmp_path / "out")
    written = {name: (tmp_path / "out" / name).stat().st_mtime_ns for name in MADE}
    second = ommatid.run(scene, tmp_path / "out")
    assert {name: (tmp_path / "out" / name).stat().st_mtime_ns for name in MADE} == written
    np.testing.assert_array_equal(first.image, second.image)


def test_maps_have_the_shape_of_the_target(result: ommatid.Result) -> None:
    assert result.image.shape == result.deviation.shape == (19, 19)
    assert result.truth is not None
    assert result.expected_mse == pytest.approx(float(np.mean(result.deviation**2)), rel=1e-12)
    assert result.mse == pytest.approx(float(np.mean((result.image - result.truth) ** 2)), rel=1e-12)


def test_without_the_truth_nothing_is_measured(
    stack: ommatid.Stack, model: ommatid.Model, result: ommatid.Result
) -> None:
    alone = ommatid.reconstruct(stack, model)
    np.testing.assert_array_equal(alone.image, result.image)
    assert (alone.truth, alone.mse) == (None, None)
    assert "<figcaption>truth" not in alone._repr_html_()  # pyright: ignore[reportPrivateUsage]


@pytest.mark.slow
def test_samples_are_chosen_for_the_stack_where_there_is_one() -> None:
    chosen = ommatid.read_scene("single", set=["calibration.samples=auto", "noise.variance=100", *FEW[:1], *FEW[2:3]])
    recorded = ommatid.render(chosen)
    records = [ommatid.calibrate(chosen, known).record["fingerprint"] for known in (recorded, None)]
    assert records[0] != records[1]


# --- H as an operator


@pytest.mark.parametrize("method", ["ideal", "frame"])
def test_the_operator_is_h_and_its_adjoint(method: str) -> None:
    changes = {"ideal": ["calibration.method=ideal"], "frame": ["calibration.method=ideal", "estimator.method=frame"]}
    model = ommatid.calibrate(ommatid.read_scene("tile19", set=changes[method]))
    operator, random = model.as_linear_operator(), np.random.default_rng(0)
    f, g = random.normal(size=(model.unknowns, 2)), random.normal(size=model.measurements)
    assert operator.shape == (model.measurements, model.unknowns)
    assert g @ operator.matvec(f[:, 0]) == pytest.approx(operator.rmatvec(g) @ f[:, 0], rel=1e-12)
    np.testing.assert_allclose(operator.matmat(f)[:, 1], operator.matvec(f[:, 1]), rtol=1e-12)


def test_the_operator_serves_solvers_of_scipy(scene: ommatid.Scene) -> None:
    """LSQR stops at a residual of a |H| |f| + b |g|; the least singular value then bounds the error."""
    model = ommatid.calibrate(ommatid.read_scene("tile19", set="calibration.method=ideal"))
    truth = ommatid.target_image(scene).ravel()
    exact, stop = model.forward(truth), 1e-10
    solved, *_, norm, _, _, length, _ = lsqr(model.as_linear_operator(), exact, atol=stop, btol=stop, iter_lim=5000)
    least = np.linalg.svd(model.matrix.toarray(), compute_uv=False)[-1]
    assert np.linalg.norm(solved - truth) < stop * (norm * length + np.linalg.norm(exact)) / least


# --- xarray


def test_maps_become_a_labelled_dataset(result: ommatid.Result, model: ommatid.Model) -> None:
    pytest.importorskip("xarray")
    maps = result.to_xarray()
    assert maps["image"].dims == ("row", "column")
    np.testing.assert_array_equal(maps["deviation"], result.deviation)
    assert set(maps.data_vars) == {"image", "deviation", "truth"}
    for axis, step in (("row", -1), ("column", 1)):  # heights fall from row to row
        places = maps[axis].to_numpy()
        np.testing.assert_allclose(np.diff(places), step * model.camera.target_pitch)
        assert places.sum() == pytest.approx(0, abs=1e-9)
        assert maps[axis].attrs["units"] == "mm"


def test_without_xarray_it_says_what_to_install(result: ommatid.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(ImportError, match=r"to_xarray needs xarray.*pip install 'ommatid\[notebook\]'"):
        result.to_xarray()


# --- what notebooks show


def pictures(html: str) -> list[Any]:
    """The images of a page, each as an array."""
    found = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in found]


def test_everything_shows_itself(
    scene: ommatid.Scene, stack: ommatid.Stack, model: ommatid.Model, result: ommatid.Result
) -> None:
    shown: list[Any] = [scene, stack, model, result]
    for thing, shapes in zip(shown, ([(19, 19)], [(5, 5), (3, 3), (4, 4)], [(19, 19)], [(19, 19)] * 4), strict=True):
        html = thing._repr_html_()
        assert [picture.shape for picture in pictures(html)] == shapes
        assert "19 x 19 tile" in html
        assert "<table>" in html
    np.testing.assert_array_equal(pictures(shown[0]._repr_html_())[0], ommatid.target_image(scene))


# --- errors


def test_what_is_wrong_is_said() -> None:
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: ommatid.read_scene("tile9"), "did you mean 'tile19'"),
        (lambda: ommatid.read_scene("tile19", set=["noise.varience=1"]), "'noise.variance'"),
        (lambda: ommatid.read_scene("tile19", lens=["X"]), "no lens type is called 'X'"),
        (lambda: ommatid.read_stack("none.exr"), "no such file"),
        (lambda: ommatid.read_model("none.npz"), "no such file"),
        (lambda: ommatid.read_result("none"), "none"),
    ]
    for call, words in wrong:
        with pytest.raises(ommatid.InputError, match=words):
            call()


def test_what_does_not_belong_together_is_said(stack: ommatid.Stack) -> None:
    other = ommatid.calibrate(ommatid.read_scene("tile35", set=["calibration.method=ideal"]))
    with pytest.raises(ommatid.InputError, match="the stack and the model do not belong together"):
        ommatid.reconstruct(stack, other)
    with pytest.raises(ommatid.InputError, match="expected a stack of this scene's camera"):
        ommatid.calibrate(ommatid.read_scene("tile35"), stack)
    wrong: Any = stack
    path: Any = "stack.exr"
    with pytest.raises(ommatid.InputError, match="stack: expected a Stack, got 'stack"):
        ommatid.reconstruct(path, wrong)
    with pytest.raises(ommatid.InputError, match="model: expected a Model, got"):
        ommatid.reconstruct(stack, wrong)


def test_a_truth_that_is_none_is_said(stack: ommatid.Stack, model: ommatid.Model) -> None:
    wrong: list[tuple[Any, str]] = [
        (np.zeros((3, 3)), "expected 19 x 19 pixels"),
        (np.zeros((1, 361)), "expected 19 x 19 pixels"),
        (np.full((19, 19), np.nan), "expected finite values"),
        ("truth.exr", "expected an array of numbers"),
    ]
    for truth, words in wrong:
        with pytest.raises(ommatid.InputError, match=f"truth: {words}"):
            ommatid.reconstruct(stack, model, truth)


@pytest.fixture(name="ommatid_command")
def _command(ommatid: Command) -> Command:
    """The command line, under a name that the module does not have."""
    return ommatid
