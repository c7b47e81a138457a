"""A whole frame beside the dense estimate: image, error bars, shares of the error, sums; the choice of the method."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.analysis.predict import predict_scene
from ommatid.reconstruct.assumptions import assumptions_for
from ommatid.reconstruct.frame.frame_method import FrameMethod
from ommatid.reconstruct.frame.readings import leaves_null_space
from ommatid.reconstruct.method_choice import METHODS, choose_method
from ommatid.reconstruct.methods.method import Execution, Prepared
from ommatid.reconstruct.prior import coloured, reflecting_root, spectrum_of
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, views_as_designed
from ommatid.scenes.fitted.kernel_shapes import KernelShapes
from ommatid.scenes.fitted.kernels import KernelFootprints
from ommatid.scenes.model import Model, fitted_model
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix, ideal_model
from ommatid.simulate.render import exposed

from ..examples import Lenses, not_none, slow, with_keys
from ..frames import FITTED, P0, blurred, drawn, frame_camera, observed, recorded, wide, with_apertures

ROOT = Path(__file__).parents[2]
SHAPE = (52, 47)
SMALL = (38, 35)  # strips along the edges cover it entirely
NOISE = {"variance": 1e-2, "bits": 10}
ROUNDING = (256 / 2**10) ** 2 / 12  # variance of the steps of 10 bits
VARIANCE = 1e-2 + ROUNDING
SIMULATIONS = 200
ONE: Lenses = (("1/3", [3, 3], "fit"),)
TWO: Lenses = FITTED[:2]
EVEN: Lenses = (*ONE, ("1/2", [2, 2], "fit"), ("1/4", [4, 4], "fit"))
ODD: Lenses = (*ONE, ("1/4", [3, 5], "fit"))
FRACTION: Lenses = (*ONE, ("2/7", [4, 4], "fit"))
UNFITTED = (("1/3", [2, 3], "fit"),)
ODD_RATIOS = (("2/7", [4, 4], "fit"), ("3/8", [3, 3], "fit"), ("1/4", [4, 4], "fit"))
ODD_ARRAYS = (("1/3", [2, 4], "fit"), ("1/5", [5, 3], "fit"), ("1/4", [4, 4], "fit"))


def restored_by(method: str, stack: Stack, model: Model, truth: FloatArray | None) -> Reconstruction:
    """Reconstruct by a method; the frame to 1e-6 posterior standard deviations."""
    scene = with_keys(stack.scene, estimator={"method": method, "accuracy": 1e-6})
    return restore(replace(stack, scene=scene), model, truth)


def both(stack: Stack, model: Model, truth: FloatArray | None) -> tuple[Reconstruction, Reconstruction]:
    """The dense estimate and that of the whole frame."""
    dense, frame = (restored_by(method, stack, model, truth) for method in ("auto", "frame"))
    assert frame.solver.method == "frame"
    return dense, frame


def difference(frame: Reconstruction, dense: Reconstruction) -> FloatArray:
    """Difference of the estimates in posterior standard deviations, as an image."""
    return ((frame.estimate - dense.estimate) / np.sqrt(dense.expected.variance)).reshape(dense.shape)


CASES = {
    "exact H": ({"noise": NOISE}, 0.0),
    "exact H, other expected noise": ({"noise": NOISE, "estimator": {"noise_variance": 0.5}}, 0.0),
    "exact H, much expected noise": ({"noise": NOISE, "estimator": {"noise_variance": 1.0}}, 0.0),
    "uncertain H": ({"noise": NOISE}, 0.003),
    "uncertain H, other expected noise": ({"noise": NOISE, "estimator": {"noise_variance": 0.1}}, 0.003),
}


def test_without_a_truth_the_expectation_is_that_of_an_image_like_the_estimate() -> None:
    """As for this image as the truth, by another solution of the dense problem."""
    scene = wide(SMALL, FITTED, **CASES["exact H, other expected noise"][0])
    model, stack = ideal_model(scene, derive(scene)), recorded(scene, drawn(SMALL, 0), VARIANCE)
    dense, frame = both(stack, model, None)
    known = restored_by("auto", stack, model, dense.estimate)
    assert known.interval is not None
    assert dense.given_estimate() == pytest.approx(known.interval.mse, rel=1e-8)
    assert frame.given_estimate() == pytest.approx(known.interval.mse, rel=1e-2)  # its map of the noise
    assert known.interval.mse < dense.expected.mse


@pytest.mark.parametrize(
    ("case", "shape"),
    [*((case, SMALL) for case in ("exact H", "exact H, other expected noise")), *(slow(case, SHAPE) for case in CASES)],
)
def test_it_is_the_dense_estimate_with_the_same_error_bars(case: str, shape: tuple[int, int]) -> None:
    """The variance map has its stated accuracy of 1e-3; much expected noise correlates distant pixels (1e-2).

    Shares come from single random images of covariance C_n, whose mean square has a relative standard error of
    sqrt(2) |C_n| / trace(C_n), at most 0.085 here; four of them are allowed.
    """
    tables, uncertainty = CASES[case]
    scene, truth = wide(shape, FITTED, **tables), drawn(shape, 0)
    model, true = blurred(scene, uncertainty) if uncertainty else (ideal_model(scene, derive(scene)), None)
    dense, frame = both(recorded(scene, truth, VARIANCE, matrix=true), model, truth)
    assert np.abs(difference(frame, dense)).max() < 1e-4
    stated = 1e-2 if case in ("exact H, other expected noise", "exact H, much expected noise") else 1e-3
    np.testing.assert_allclose(frame.expected.variance, dense.expected.variance, rtol=stated)
    np.testing.assert_allclose(frame.expected.resolved, dense.expected.resolved, atol=2e-3)
    assert frame.solver.variance_bound < stated
    assert not_none(frame.residual).chi_squared == pytest.approx(not_none(dense.residual).chi_squared, rel=1e-4)
    assert sum(frame.budget().values()) == pytest.approx(frame.expected.mse)
    assert frame.budget()["null_space"] == pytest.approx(dense.budget()["null_space"], rel=1e-3)
    for name, part in dense.budget().items():
        assert frame.budget()[name] == pytest.approx(part, rel=4 * 0.085), name
    assert frame.interval is not None
    assert dense.interval is not None
    width = dense.interval.high - dense.interval.low
    assert frame.interval.mse == pytest.approx(dense.interval.mse, rel=stated), "its noise is that of the map"
    assert abs(frame.interval.mse - dense.interval.mse) < width
    assert 0.7 * width < frame.interval.high - frame.interval.low < 1.6 * width
    assert frame.region((8, 9), (6, 20)) == pytest.approx(dense.region((8, 9), (6, 20)), rel=1e-4)


def test_from_a_solution_for_nearly_the_same_noise_fewer_steps_are_left() -> None:
    """As accurate as from none: the image, its level, and what the estimate lacks of a constant image."""
    scene = wide(SHAPE, noise={"variance": 1.0}, prior={"kind": "exponential", "correlation_length": "8 mm"})
    stack, model = recorded(scene, drawn(SHAPE, 2), 1.0), ideal_model(scene, derive(scene))
    choice = choose_method(scene, stack.camera, exact=True)
    assert choice.method == "frame"
    task = assumptions_for(stack, model, choice, Execution()).method.task
    noisier = replace(task, expected_noise=1.02 * task.expected_noise)
    near, cold = FrameMethod(task, Execution()), FrameMethod(noisier, Execution())
    warm = FrameMethod(noisier, Execution(nearby=near.nearby))
    assert warm.solution.steps < cold.solution.steps
    assert max(warm.solution.bound, cold.solution.bound) <= task.settings.accuracy
    assert np.abs(warm.image - cold.image).max() < 0.02
    np.testing.assert_allclose(not_none(warm.response), not_none(cold.response), atol=1e-3)
    assert np.abs(near.image - cold.image).max() > 0.03, "another solution"


@pytest.mark.parametrize(
    ("lenses", "detail", "shape"),
    [
        (ODD_RATIOS, 1, (30, 29)),
        slow(ODD_RATIOS, 1, (46, 29)),
        slow(ODD_ARRAYS, 1, (50, 52)),
        slow(ODD_RATIOS, 2, (50, 30)),
    ],
    ids=["few ratios", "ratios", "arrays", "finer world"],
)
def test_other_arrays_have_the_error_bars_of_windows(lenses: Any, detail: int, shape: tuple[int, int]) -> None:
    """The estimate and Eq. 5 by the inverse of the readings' covariance, one matrix for the whole image."""
    prior = {"kind": "power", "variance": 2000.0, "level": "known"}
    scene = wide(shape, lenses, noise={"variance": 1.0}, prior=prior, target={"detail": detail})
    camera = derive(scene)
    fine = camera.world
    spectrum = spectrum_of(scene.prior, fine.shape, camera.target_pitch / detail)
    world = 127.5 + coloured(spectrum, np.random.default_rng(4).normal(size=fine.shape)).ravel()
    model = ideal_model(scene, fine)
    stack = replace(recorded(scene, np.zeros(camera.unknowns), 1.0), values=model.forward(world))
    values = stack.values + np.random.default_rng(5).normal(size=stack.values.size)
    frame = restored_by("frame", replace(stack, values=values), model, world)
    assert frame.solver.method == "frame"
    matrix = model.to_sparse().toarray()
    root = reflecting_root(np.broadcast_to(spectrum, fine.shape))
    average = np.kron(*(np.kron(np.eye(size), np.full(detail, 1 / detail)) for size in shape))
    seen, of_f = matrix @ root, average @ root
    gain = np.linalg.solve(seen @ seen.T + np.eye(len(seen)), seen @ of_f.T).T
    variance = np.square(of_f).sum(axis=1) - np.einsum("ij,ij->i", gain, of_f @ seen.T)
    image = 127.5 + gain @ (values - matrix @ np.full(fine.unknowns, 127.5))
    assert np.abs((frame.estimate - image) / np.sqrt(variance)).max() < 1e-3
    np.testing.assert_allclose(frame.expected.variance, variance, rtol=0.03)
    assert frame.solver.variance_bound < 0.03


def test_sums_and_intervals_are_those_of_the_dense_problem_where_error_bars_are_small() -> None:
    """At the accuracy of the scene, 0.01 deviations: a sum is solved for relative to its own variance."""
    scene = wide(SMALL, noise={"variance": 1e-6}, prior={"variance": 1e-4, "level": "known"})
    truth = 127.5 + 1e-2 / P0**0.5 * (drawn(SMALL, 6) - 127.5)
    stack = recorded(scene, truth, 1e-6)
    model = ideal_model(scene, stack.camera)
    framed = with_keys(scene, estimator={"method": "frame"})
    dense, frame = (restore(replace(stack, scene=each), model, truth) for each in (scene, framed))
    assert frame.solver.method == "frame" != dense.solver.method
    assert dense.expected.mse < 1e-2
    for region in (((3, 4), (1, 1)), ((9, 8), (5, 5)), ((0, 0), SMALL)):
        assert frame.region(*region)[1] == pytest.approx(dense.region(*region)[1], rel=0.01)
    assert not_none(frame.interval).variance == pytest.approx(
        not_none(dense.interval).variance, rel=0.35
    )  # of one random image


@dataclass(frozen=True)
class Compared:
    """A recording whose frame is compared with the dense problem, and relative errors of its bars and interval."""

    scene: Scene
    noise: float
    seed: int = 1
    bars: float = 1e-3
    interval: float = 1e-3
    image: float = 1e-4  # in posterior standard deviations
    dead: int = 0  # every so many sensor pixels


def correlated(kind: str, shape: tuple[int, int], length: str | None = None) -> Compared:
    prior = {"kind": kind, "variance": 2000.0} | ({} if length is None else {"correlation_length": length})
    return Compared(wide(shape, noise={"variance": 1.0}, prior=prior), 1.0, 3, image=1e-3, interval=0.03)


def apertures(shape: tuple[int, int], noise: float) -> Compared:
    """Kernels wider than the frame."""
    scene = with_apertures(wide(shape, noise=NOISE | {"variance": noise}))
    return Compared(scene, noise + ROUNDING, bars=1e-6)


def null_space(shape: tuple[int, int], lenses: Lenses, dead: int = 0) -> Compared:
    """Bars are differences of inverses, at a step of 1e-4."""
    return Compared(wide(shape, lenses, noise={"variance": 1e-2}), 1e-2, 0, bars=2e-4, image=1e-3, dead=dead)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(lambda: correlated("exponential", (24, 21), "25 mm"), id="exponential"),
        slow(lambda: correlated("exponential", (35, 35), "25 mm"), id="exponential, large"),
        pytest.param(lambda: correlated("power", (24, 21)), id="power"),
        pytest.param(lambda: apertures((19, 17), 1.0), id="apertures"),
        slow(lambda: apertures((33, 31), 1e-2), id="apertures, large"),
        pytest.param(lambda: null_space((24, 31), ONE, 23), id="one type"),
        pytest.param(lambda: null_space((31, 24), TWO), id="two types"),
        pytest.param(lambda: null_space((25, 25), ODD, 23), id="other array"),
        pytest.param(lambda: null_space((27, 25), FRACTION), id="fraction"),
        slow(
            # Errors of a null space reach from edge to edge; small frames of two lengths give their variances to 4 %.
            lambda: Compared(with_apertures(wide((64, 62), TWO, noise=NOISE)), VARIANCE, bars=0.04, interval=0.1),
            id="two blurred types",
        ),
        slow(
            lambda: Compared(wide(SHAPE, noise={"variance": 1e-2, "saturation": 180.0}), 1e-2, 2, 2e-3, 0.01, dead=97),
            id="dead and saturated",
        ),
    ],
)
def test_image_bars_and_interval_are_those_of_the_dense_problem(case: Callable[[], Compared]) -> None:
    compared = case()
    scene, truth = compared.scene, drawn(derive(compared.scene).shape, compared.seed)
    stack, level = recorded(scene, truth, compared.noise), not_none(scene.noise).saturation
    values = np.minimum(stack.values, np.inf if level is None else level)
    if compared.dead:
        values[:: compared.dead] = np.nan
    dense, frame = both(replace(stack, values=values), ideal_model(scene, stack.camera), truth)
    assert (frame.usable.dead > 0, frame.usable.saturated > 0) == (compared.dead > 0, level is not None)
    assert (frame.usable.dead, frame.usable.saturated) == (dense.usable.dead, dense.usable.saturated)
    assert np.abs(difference(frame, dense)).max() < compared.image
    np.testing.assert_allclose(frame.expected.variance, dense.expected.variance, rtol=compared.bars)
    assert frame.solver.variance_bound < compared.bars
    assert not_none(frame.interval).mse == pytest.approx(not_none(dense.interval).mse, rel=compared.interval)
    assert frame.verdict.level != "red"


def varying_blur(shape: tuple[int, int], noise: float) -> tuple[Scene, Model]:
    """Thin lenses which diffract, and a calibrated H whose blur varies by a part of a percent over the field."""
    described = with_apertures(wide(shape, noise=NOISE | {"variance": noise}))
    camera = derive(described)
    kernels: dict[str, KernelFootprints] = {}
    for part in observed(camera).parts:
        assert isinstance(part, KernelFootprints)
        mean = part.mean_kernel
        sharper = 0.02 * (4 * mean - sum(np.roll(mean, step, axis) for step in (1, -1) for axis in (0, 1)))
        coefficients = np.array([[1.0, 0, 0, 0, 0, 0], [0, 0.4, -0.3, 0.5, 0.3, -0.5]])  # Legendre's over the field
        shapes = KernelShapes.dense(np.stack([mean, sharper]))
        no_errors = np.zeros((0, 0, 6))
        changed = replace(part, degree=2, shapes=shapes, coefficients=coefficients, error_coefficients=no_errors)
        assert 1e-4 < changed.variation < 0.01
        kernels[part.places.lens_type.name] = changed
    views = {
        lens.name: views_as_designed([sub for sub in camera.sub_imagers if sub.type == lens]) for lens in camera.types
    }
    fitted = FittedMatrix(camera, views, kernels)
    return described, fitted_model(described, camera, fitted, None, {"method": "transport", "versions": {}})


@pytest.mark.parametrize(("shape", "noise"), [((19, 17), 1.0), slow((33, 31), 1e-2)])
def test_kernels_that_hardly_vary_count_in_error_bars(shape: tuple[int, int], noise: float) -> None:
    """Interval, regions and expected residual of blur that varies by less than 1 %: by the dense covariance.

    Where the mean kernel passes little, its variation passes as much.
    """
    described, model = varying_blur(shape, noise)
    truth = drawn(shape, 1)
    stack = recorded(described, truth, noise + ROUNDING, matrix=model.as_linear_operator())
    choice = replace(choose_method(described, stack.camera, exact=True), method="frame")
    found = assumptions_for(stack, model, choice, Execution()).result(truth)
    dense = restored_by("auto", stack, model, truth)
    assert found.interval is not None
    assert dense.result.interval is not None
    assert found.interval.mse == pytest.approx(dense.result.interval.mse, rel=0.01)
    assert found.interval.high - found.interval.low == pytest.approx(
        dense.result.interval.high - dense.result.interval.low, rel=0.1
    )
    for weights in (np.full(truth.size, 1 / truth.size), np.eye(truth.size)[truth.size // 2]):
        assert found.variance_of_sum(weights) == pytest.approx(dense.result.variance_of_sum(weights), rel=0.01)


def test_large_cameras_of_lenses_are_applied_without_entries() -> None:
    """More than 4000 pixels behind lenses that diffract: no entries, the frame alone, other methods refused."""
    scene = with_apertures(wide((59, 71), FITTED, noise=NOISE, calibration={"method": "ideal"}))
    camera = derive(scene)
    model = ideal_model(scene, camera)
    assert model.stored is None
    assert camera.is_applied
    assert choose_method(scene, camera, camera.is_applied).method == "frame"
    tiles = with_keys(scene, estimator={"method": "tiles"})
    with pytest.raises(InputError, match="blurred lenses have too many for 4189 pixels; set it to 'auto' or 'frame'"):
        choose_method(tiles, camera, camera.is_applied)
    truth = drawn(camera.shape, 2)
    done = restore(recorded(scene, truth, VARIANCE, matrix=ideal_matrix(camera)), model, truth)
    assert done.verdict.trusted
    assert not_none(done.interval).low < float(np.mean((done.estimate - truth) ** 2)) < not_none(done.interval).high


@pytest.mark.parametrize(
    ("detail", "shape", "types"),
    [(1, (25, 23), 3), (2, (25, 23), 3), (2, (25, 23), 1), slow(1, (62, 57), 3), slow(2, (62, 57), 3)],
)
def test_the_prediction_of_a_frame_is_that_of_its_estimate(detail: int, shape: tuple[int, int], types: int) -> None:
    """By transfer functions with edges, against exact maps, solutions and random images: to 2 %."""
    prior = {"kind": "exponential", "variance": 2000.0, "correlation_length": "4 mm"}
    scene = with_apertures(
        wide(shape, FITTED[:types], prior=prior, noise={"variance": 1e-2}, target={"detail": detail})
    )
    setup = Setup.from_scene(scene)
    prediction, truth = predict_scene(scene, rays=False, picture=types == 3), setup.calibrated.image.ravel()
    model = ideal_model(scene, setup.calibrated.camera)
    done = restore(exposed(setup, model.forward(truth), np.zeros(model.measurements), {}), model, truth)
    assert "transfer functions" in " ".join(prediction.assumes)
    assert prediction.mse == pytest.approx(done.expected.mse, rel=0.02)
    assert prediction.trimmed_mse == pytest.approx(done.trimmed_mse, rel=0.02)
    assert prediction.degrees_of_freedom == pytest.approx(done.expected.degrees_of_freedom, rel=1e-3)
    if types == 3:  # one type hides much, and then a picture's error and parts by single draws are their own
        assert prediction.interval == pytest.approx(
            (not_none(done.interval).low, not_none(done.interval).high), rel=0.05
        )
        for cause in ("null_space", "noise", "detail"):
            assert not_none(prediction.budget)[cause] == pytest.approx(done.budget()[cause], rel=0.1)
    assert (prediction.rank, prediction.null_space, prediction.condition) == (None, None, None)


def test_a_frame_of_which_its_lenses_see_a_quarter_is_predicted() -> None:
    """Of fixed sub-images, as those of the tile, no reading reaches the edges; the rest keeps the prior's variance."""
    scene = read(GALLERY / "tile35.toml", ("target.shape=[70,70]", "noise.variance=1e-6"))
    assert predict_scene(scene, rays=False).mse == pytest.approx(0.75 * scene.prior.variance, rel=1e-3)


@pytest.mark.slow
def test_peak_memory_is_below_the_stated_one() -> None:
    """The peak of a frame in its own process, against the figure that is compared with `estimator.memory`.

    From /proc, because getrusage includes the peak of the parent process.
    """
    if not Path("/proc/self/status").is_file():
        pytest.skip("needs /proc")
    script = (
        "from tests.reconstruct.test_frame_method import *\n"
        "shape = (420, 400); scene = wide(shape, noise=NOISE); truth = drawn(shape, 0)\n"
        "camera = derive(scene); stack = recorded(scene, truth, VARIANCE)\n"
        "allowed = choose_method(scene, camera, exact=True).memory\n"
        "restore(stack, ideal_model(scene, camera), truth)\n"
        "status = Path('/proc/self/status').read_text().split()\n"
        "print(allowed, 1024 * int(status[status.index('VmHWM:') + 1]))"
    )
    ended = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    stated, peak = map(int, ended.stdout.split())
    stored = 2 * 12 * 50 * 420 * 400  # H from which the data were made, and that of the model
    assert peak <= stated + stored


def test_a_measurement_without_noise_is_refused() -> None:
    scene = wide(SHAPE, noise={"variance": 0.0}, estimator={"method": "frame"})
    stack = recorded(scene, drawn(SHAPE), 0.0)
    with pytest.raises(InputError, match="needs noise in every measurement"):
        restore(stack, ideal_model(scene, stack.camera))


@pytest.mark.parametrize(
    ("shape", "lenses", "tables", "method"),
    [
        ((59, 59), FITTED, {"noise": NOISE}, "dense"),
        ((239, 239), FITTED, {"noise": NOISE}, "frame"),
        ((239, 239), FITTED, {"noise": NOISE, "estimator": {"accuracy": 0.5}}, "tiles"),
        ((239, 239), FITTED, {}, "tiles"),
        ((239, 239), UNFITTED, {"noise": NOISE}, "frame"),
        ((479, 479), UNFITTED, {"noise": NOISE}, "tiles"),
        ((239, 239), FITTED, {"noise": NOISE, "estimator": {"method": "tiles"}}, "tiles"),
        ((59, 59), FITTED, {"noise": NOISE, "estimator": {"method": "frame"}}, "frame"),
        ((63, 63), FITTED, {"noise": NOISE, "estimator": {"memory": "850 MB"}}, "tiles"),
        *(((99, 99), lenses, {"noise": NOISE}, "frame") for lenses in (TWO, ODD)),
        ((499, 499), TWO, {"noise": NOISE}, "tiles"),
        ((499, 499), FITTED, {"noise": NOISE}, "frame"),
    ],
)
def test_which_method_is_chosen(shape: tuple[int, int], lenses: Any, tables: dict[str, Any], method: str) -> None:
    scene = wide(shape, lenses, **tables)
    choice = choose_method(scene, derive(scene), exact=True)
    assert choice.method == method
    assert choice.method in METHODS
    assert choice.memory <= 850e6 or scene.estimator.memory is None


@pytest.mark.parametrize(("lenses", "leaves"), [(ONE, True), (TWO, True), (ODD, True), (EVEN, True), (FITTED, False)])
def test_a_null_space_of_every_frame(lenses: Lenses, leaves: bool) -> None:
    """By the rank of H of a small frame."""
    small = np.linalg.matrix_rank(ideal_matrix(frame_camera((19, 19), lenses)).toarray()) if leaves else 0
    assert leaves_null_space(frame_camera((59, 59), lenses)) is leaves
    assert small < 19**2


def test_too_little_memory_for_any_method_is_refused() -> None:
    scene = wide((239, 239), noise=NOISE, estimator={"memory": "1 MB"})
    with pytest.raises(InputError, match=r"estimator needs .* GB .*0\.0 GB are allowed; raise estimator\.memory"):
        choose_method(scene, derive(scene), exact=True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["frame", "auto"], ids=["frame", "dense"])
@pytest.mark.parametrize("prior", [{}, {"kind": "exponential", "correlation_length": "8 mm"}], ids=["pixels", "waves"])
def test_errors_of_drawn_images_are_uniform_in_their_quantiles(prior: dict[str, Any], method: str) -> None:
    """Simulation-based calibration (Talts et al. 2018): pixels inside, at an edge and in a corner, a mean of 5 x 5."""
    shape = 35, 33
    described = with_apertures(wide(shape, noise=NOISE, prior=prior, estimator={"method": method}), 0.4)
    camera = derive(described)
    model, rng = ideal_model(described, camera), np.random.default_rng(7)
    spectrum = spectrum_of(described.assumed_prior, shape, camera.target_pitch)
    regions = np.zeros((4, *shape))
    regions[0, 17, 16] = regions[1, 0, 15] = regions[2, -1, -1] = 1.0
    regions[3, 10:15, 20:25] = 1 / 25
    weights = regions.reshape(len(regions), -1)
    scores: list[FloatArray] = []
    deviations: FloatArray | None = None
    choice, execution = choose_method(described, camera, exact=True), Execution(prepared=Prepared(model))
    for _ in range(SIMULATIONS):
        truth = 127.5 + coloured(spectrum, rng.normal(size=shape)).ravel()
        stack = recorded(described, truth, VARIANCE, int(rng.integers(2**31)), matrix=model.as_linear_operator())
        if deviations is None:
            result = restore(stack, model, prepared=execution.prepared).result
            deviations = np.sqrt([result.variance_of_sum(each) for each in weights])
        scores.append(weights @ (assumptions_for(stack, model, choice, execution).method.image - truth) / deviations)
    for each in np.array(scores).T:
        assert stats.kstest(stats.norm.cdf(each), "uniform").pvalue > 1e-3
        assert abs(np.square(each).mean() - 1) < 4 * (2 / SIMULATIONS) ** 0.5
