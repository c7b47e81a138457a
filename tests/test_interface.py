"""The Python interface does what the commands do, and loads nothing before it is used."""

from __future__ import annotations

import base64
import io
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike
from PIL import Image
from scipy.sparse.linalg import lsqr

import ommatid
from ommatid.reconstruct.output.result_files import write_estimate
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.formats import exr
from ommatid.scenes.tables.sensor import NoiseTable

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
    assert dir(ommatid) == sorted(ommatid.__all__)
    assert all(getattr(ommatid, name).__doc__ for name in ommatid.__all__)
    with pytest.raises(AttributeError, match="no attribute 'renderer'"):
        getattr(ommatid, "renderer")  # noqa: B009
    with pytest.raises(ImportError, match="renderer"):
        exec("from ommatid import renderer")


def test_reconstruct_is_a_function_and_stays_a_package() -> None:
    from ommatid.reconstruct import restore

    assert callable(ommatid.reconstruct)
    assert getattr(ommatid.reconstruct, "restore") is restore  # noqa: B009


def test_scenes_are_changed_by_texts_and_by_values() -> None:
    texts = ["noise.variance=0.01", "noise.bits=8", "camera.lens.II.pixels=[2,2]", "title=dots 1/2", "prior.level="]
    values = {"noise.variance": np.float64(0.01), "noise.bits": np.int64(8), "camera.lens.II.pixels": np.array([2, 2])}
    values |= {"title": "dots 1/2", "prior.level": None}
    assert ommatid.read_scene("tile19", set=values).plain() == ommatid.read_scene("tile19", set=texts).plain()
    fraction: dict[str, object] = {
        "camera.lens.I.magnification": Fraction(1, 3),
        "noise": {"bits": 8, "variance": None},
    }
    third = ommatid.read_scene("tile19", set=fraction)
    assert (third.camera.lens[0].magnification, third.noise) == (Fraction(1, 3), NoiseTable(bits=8))
    with pytest.raises(ommatid.InputError, match=r"tile19.toml with set noise.bits=99: noise.bits: expected"):
        ommatid.read_scene("tile19", set={"noise.bits": 99, "noise.variance": 1})


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


# --- arrays in place of files


def observed(model: ommatid.Model, image: ArrayLike, seed: int, changes: dict[str, object]) -> ommatid.Stack:
    """The stack of one image, by the sensor of tile19 with changes."""
    stack = ommatid.observe(model, image, seed, ommatid.read_scene("tile19", set={"noise": {}, **changes}))
    assert isinstance(stack, ommatid.Stack)
    return stack


@pytest.fixture(scope="module")
def ideal() -> ommatid.Model:
    return ommatid.calibrate(ommatid.read_scene("tile19", set={"calibration.method": "ideal"}))


@pytest.fixture(scope="module")
def physical() -> ommatid.Model:
    changes = {"calibration.method": "ideal", "sensor.prnu": 0.0, "sensor.dsnu": 0.0}
    return ommatid.calibrate(ommatid.read_scene("sensor", set=changes, lens="I"))


@pytest.fixture(scope="module")
def ramp() -> FloatArray:
    return np.linspace(20, 180, 361).reshape(19, 19)


def test_sub_images_become_the_stack_that_they_are_of(ideal: ommatid.Model) -> None:
    """Every value names its place: the lens type, the lens and the pixel, as the camera lists its measurements."""
    camera = ideal.camera
    arrays = {lens.name: np.arange(lens.measurements).reshape(*lens.array, *lens.pixels) for lens in camera.types}
    stack = ommatid.stack("tile19", {name: arrays[name].tolist() for name in reversed(arrays)})
    for sub, image in zip(camera.sub_imagers, stack.images(), strict=True):
        np.testing.assert_array_equal(image, arrays[sub.type.name][sub.k, sub.l])
    for name, array in stack.arrays().items():
        np.testing.assert_array_equal(array, arrays[name])


def test_a_given_stack_is_reconstructed_with_its_dead_pixels(ideal: ommatid.Model, ramp: FloatArray) -> None:
    arrays = observed(ideal, ramp, 0, {"noise.variance": 1.0}).arrays()
    arrays["II"][0, 1, 2, 2] = np.nan
    result = ommatid.reconstruct(ommatid.stack(ommatid.read_scene("tile19", set="noise.variance=1"), arrays), ideal)
    assert result.summary.diagnostics.pixels_dead == 1
    assert float(np.mean((result.image - ramp) ** 2)) < 2 * result.expected_mse


def test_the_noise_of_given_images_is_that_of_the_scene(ideal: ommatid.Model, ramp: FloatArray) -> None:
    """Variance by chi-squared of M deviations to 5 standard errors; rounding to half a level, uniform; saturation."""
    light, count = ideal.matrix @ ramp.ravel(), ideal.measurements
    stack = observed(ideal, ramp, 1, {"noise.variance": 4.0})
    noisy = stack.values - light
    assert np.mean(noisy**2) == pytest.approx(4, abs=5 * 4 * (2 / count) ** 0.5)
    assert abs(np.mean(noisy)) < 5 * 2 / count**0.5
    np.testing.assert_array_equal(stack.variance, 4.0)
    rounded = observed(ideal, ramp, 1, {"noise.bits": 8})
    np.testing.assert_array_equal(rounded.values, np.rint(light))
    np.testing.assert_allclose(rounded.variance, 1 / 12)
    clipped = observed(ideal, ramp, 1, {"noise.variance": 4.0, "noise.saturation": 150.1})
    np.testing.assert_array_equal(clipped.values, np.minimum(light + noisy, 150.1))
    saturated = ommatid.reconstruct(clipped, ideal).summary.diagnostics.pixels_saturated
    assert saturated == np.sum(light + noisy >= 150.1) > 0
    np.testing.assert_allclose(observed(ideal, ramp, 1, {}).values, light, rtol=1e-12)


def test_a_sensor_counts_the_electrons_of_given_images(physical: ommatid.Model) -> None:
    """Photon transfer (EMVA 1288): between two lights, variance grows by the gain times the growth of the mean, DN."""
    moments, count = list[tuple[float, float]](), 20
    for level in (50.0, 150.0):
        stacks = ommatid.observe(physical, np.full((count, *physical.camera.shape), level), 2)
        assert isinstance(stacks, list)
        readings = np.array([stack.recording.digital for stack in stacks if stack.recording is not None])
        moments.append((float(readings.mean()), float(readings.var(axis=0, ddof=1).mean())))
    (dim, quiet), (bright, noisy) = moments
    error = (2 / ((count - 1) * physical.measurements)) ** 0.5 * (quiet + noisy)  # standard errors of both, at most
    assert physical.scene.sensor is not None
    assert 3 * error < noisy - quiet == pytest.approx(physical.scene.sensor.gain * (bright - dim), abs=5 * error)


def test_each_of_many_images_has_its_own_noise(ideal: ommatid.Model, ramp: FloatArray) -> None:
    many = ommatid.observe(ideal, np.stack([ramp, ramp, 2 * ramp]), 3)
    few, alone = ommatid.observe(ideal, [[ramp, ramp]], 3), ommatid.observe(ideal, ramp.tolist(), 3)
    assert isinstance(many, list)
    assert isinstance(few, list)
    assert isinstance(alone, ommatid.Stack)
    np.testing.assert_array_equal([stack.values for stack in few], [stack.values for stack in many[:2]])
    np.testing.assert_array_equal(alone.values, many[0].values)
    first, second = (stack.values - ideal.forward(ramp) for stack in many[:2])
    assert abs(np.corrcoef(first, second)[0, 1]) < 5 / ideal.measurements**0.5
    reconstructor = ommatid.prepare(ideal)
    for stack in many:
        np.testing.assert_array_equal(reconstructor(stack).image, ommatid.reconstruct(stack, ideal).image)


@pytest.mark.slow
def test_given_images_are_observed_as_they_are_rendered() -> None:
    """Chi-squared of the differences of a rendered and an observed stack, and both errors in one interval."""
    changes = {"render.samples": 4096, "noise.variance": 1.0, "calibration.method": "ideal"}
    scene = ommatid.read_scene("tile19", set=changes)
    model, truth, rendered = ommatid.calibrate(scene), ommatid.target_image(scene), ommatid.render(scene)
    stack = ommatid.observe(model, truth, 4)
    assert isinstance(stack, ommatid.Stack)
    squares = (rendered.values - stack.values) ** 2 / (rendered.variance + stack.variance)
    assert np.sum(squares) == pytest.approx(squares.size, abs=5 * (2 * squares.size) ** 0.5)
    by_rays, by_matrix = (ommatid.reconstruct(each, model, truth) for each in (rendered, stack))
    given = by_rays.summary.error.expected_given_truth
    assert given is not None
    assert given.low < by_matrix.summary.error.mse < given.high  # type: ignore[operator]


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


def test_everything_has_one_line(
    scene: ommatid.Scene, stack: ommatid.Stack, model: ommatid.Model, result: ommatid.Result
) -> None:
    things: list[object] = [scene, stack, model, result, result.summary, result.reconstruction, model.camera]
    things += [ommatid.prepare(model), ommatid.predict(scene, rays=False), ommatid.check(stack, model)]
    for thing in things:
        assert re.fullmatch(r"<[A-Z].{10,140}>", repr(thing)), repr(thing)
        assert type(thing).__name__ in repr(thing) == str(thing)
    assert "19 x 19 pixels" in repr(result)


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


def test_what_is_wrong_is_said(
    stack: ommatid.Stack,
    model: ommatid.Model,
    ideal: ommatid.Model,
    physical: ommatid.Model,
    ramp: FloatArray,
) -> None:
    good: dict[str, Any] = observed(ideal, ramp, 0, {}).arrays()
    infinite, other = np.full((3, 3, 5, 5), np.inf), ommatid.read_scene("tile35")
    distant = replace(stack, camera=replace(stack.camera, distance=2 * stack.camera.distance))
    of_other = ommatid.calibrate(ommatid.read_scene("tile35", set=["calibration.method=ideal"]))
    dark, of_one = np.full(physical.camera.shape, -80.0), r"arrays\['I'\]: expected"
    shape = r"images: expected \[..., 19, 19\], the grid of H, got"
    apart, pixels = "do not belong together", "truth: expected 19 x 19 pixels"
    others: tuple[Any, ...] = stack, "a.exr", [*good.values()], 0.5
    any_stack, any_path, no_mapping, no_seed = others
    wrong: list[tuple[Callable[[], object], str]] = [
        (lambda: ommatid.read_scene("tile9"), "did you mean 'tile19'"),
        (lambda: ommatid.read_scene("tile19", set=["noise.varience=1"]), "'noise.variance'"),
        (lambda: ommatid.read_scene("tile19", set={"noise.varience": 1}), "'noise.variance'"),
        (lambda: ommatid.read_scene("tile19", set={"noise.variance": object()}), "set: noise.variance: expected a num"),
        (lambda: ommatid.read_scene("tile19", set={"noise.bits": 2**70}), "set: noise.bits: expected a number"),
        (lambda: ommatid.read_scene("tile19", set={"noise.bits": [1 + 1j]}), "set: noise.bits: expected a number"),
        (lambda: ommatid.read_scene("tile19", lens=["X"]), "no lens type is called 'X'"),
        (lambda: ommatid.read_stack("none.exr"), "no such file"),
        (lambda: ommatid.read_model("none.npz"), "no such file"),
        (lambda: ommatid.read_result("none"), "none"),
        (lambda: ommatid.prepare(model, "tile35"), rf"{apart}: .*\[35, 35\] in \S*tile35\.toml and"),
        (lambda: ommatid.prepare(any_path), "expected a Model"),
        (lambda: ommatid.prepare(model)(distant), rf"the stack and the model {apart}: target\.distance"),
        (lambda: ommatid.prepare(model)(any_path), "expected a Stack"),
        (lambda: ommatid.reconstruct(stack, of_other), f"the stack and the model {apart}"),
        (lambda: ommatid.calibrate(other, stack), "expected a stack of this scene's camera"),
        (lambda: ommatid.reconstruct(any_path, any_stack), "stack: expected a Stack, got 'a"),
        (lambda: ommatid.reconstruct(stack, any_stack), "model: expected a Model, got"),
        (lambda: ommatid.stack("tile19", {"I": good["I"]}), "the lens types 'I', 'II', 'III', got 'I'"),
        (lambda: ommatid.stack("tile19", no_mapping), "a dictionary by lens type"),
        (lambda: ommatid.stack("tile19", good | {"I": good["I"][0]}), rf"{of_one} \[3, 3, 5, 5\].* got \[3, 5, 5\]"),
        (lambda: ommatid.stack("tile19", good | {"I": infinite}), rf"{of_one} numbers up to 1e\+24"),
        (lambda: ommatid.stack("tile19", good | {"I": "a.png"}), f"{of_one} an array of real numbers"),
        (lambda: ommatid.stack("sensor", good), r"a \[sensor\] needs dark and flat frames"),
        (lambda: ommatid.observe(ideal, ramp[:-1], 0), rf"{shape} \[18, 19\]; set target.shape of the scene"),
        (lambda: ommatid.observe(ideal, ramp[0], 0), rf"{shape} \[19\]"),
        (lambda: ommatid.observe(ideal, np.full((19, 19), np.nan), 0), "images: expected finite values"),
        (lambda: ommatid.observe(ideal, [[1.0], [1.0, 2.0]], 0), "images: expected an array of numbers"),
        (lambda: ommatid.observe(ideal, ramp, -1), "seed: expected a whole number of 0 or more, got -1"),
        (lambda: ommatid.observe(ideal, ramp, no_seed), "seed: expected a whole number"),
        (lambda: ommatid.observe(ideal, ramp, 0, other), apart),
        (lambda: ommatid.observe(physical, dark, 0), "counts electrons.* got -80"),
        (lambda: ommatid.reconstruct(stack, model, np.zeros((3, 3))), pixels),
        (lambda: ommatid.reconstruct(stack, model, np.zeros((1, 361))), pixels),
        (lambda: ommatid.reconstruct(stack, model, np.full((19, 19), np.nan)), "truth: expected finite values"),
        (lambda: ommatid.reconstruct(stack, model, any_path), "truth: expected an array of real numbers"),
    ]
    for call, words in wrong:
        with pytest.raises(ommatid.InputError, match=words):
            call()


@pytest.fixture(name="ommatid_command")
def _command(ommatid: Command) -> Command:
    """The command line, under a name that the module does not have."""
    return ommatid
