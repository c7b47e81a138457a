"""Stacks of real sensors: dead, saturated and rounded pixels, or none at all; and priors that are fitted to them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage, stats

from ommatid.reconstruct.noise import censored, common_rounding, overexposed, usable_pixels
from ommatid.reconstruct.output import facts
from ommatid.reconstruct.output.report import report_of
from ommatid.reconstruct.restore import Reconstruction, restore
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes import stack as stacks
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.model import Model
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.sensor import NoiseTable
from ommatid.simulate.ideal import ideal_model
from ommatid.simulate.sensors import expose, generators

from ..conftest import Command
from ..examples import THREE, inside_interval, not_none, scene, slow, with_keys
from ..frames import FITTED, recorded, wide
from ..runs import document

SENSOR = {"variance": 1.0}


def recording(described: Scene) -> tuple[Stack, Model, FloatArray]:
    """The stack that an ideal camera records of the scene's picture with the scene's noise, its H, and the truth."""
    camera, truth = derive(described), load(described).ravel()
    model = ideal_model(described, camera)
    values = expose(model.forward(truth), not_none(described.noise), generators(camera, 3), camera.slices())
    record = {"seconds": 0.0, "versions": {}, "seed": 3, "first_seed": 3}
    model = replace(model, record={**model.record, "seconds": 0.0, "versions": {}})
    return Stack(described, camera, values, np.zeros_like(values), record), model, truth


def restored(described: Scene) -> Reconstruction:
    return restore(*recording(described))


def rows(restoration: Reconstruction, stack: Stack, model: Model) -> dict[str, str]:
    return dict(facts.rows(report_of(stack, model, restoration)))


def test_dead_pixels_are_left_out_and_counted() -> None:
    """The estimate is that of a camera without these pixels, to the last digit, whatever their values."""
    stack, model, truth = recording(scene(lenses=THREE, noise=SENSOR))
    dead = np.zeros(stack.values.size, dtype=bool)
    dead[[0, 17, 400]] = True
    broken = replace(stack, values=np.where(dead, np.nan, stack.values))
    restoration = restore(broken, model, truth)
    assert (restoration.usable.dead, restoration.usable.saturated, int(restoration.usable.used.sum())) == (3, 0, 703)
    whole = restore(stack, model, truth)
    assert restoration.expected.mse > whole.expected.mse
    assert np.isfinite(restoration.estimate).all()
    assert inside_interval(restoration)
    assert "3 dead" in rows(restoration, broken, model)["sensor pixels left out"]
    assert "sensor pixels left out" not in rows(whole, stack, model)


@pytest.mark.parametrize("bits", [None, 6])
def test_saturated_pixels_are_known_to_reach_the_limit(bits: int | None) -> None:
    """Taken for readings, they raise chi-squared of the residual; as censored, the error stays inside its interval."""
    noise = {"variance": 1.0, "saturation": 30.3} | ({} if bits is None else {"bits": bits})
    stack, model, truth = recording(scene(lenses=THREE, noise=noise, prior={"level": "known"}))
    assert stack.values.max() == 30.3
    restoration = restore(stack, model, truth)
    assert restoration.usable.saturated > 30
    assert not_none(restoration.error).mse < not_none(restoration.interval).high
    without_level = replace(stack, scene=stack.scene.model_copy(update={"noise": NoiseTable(variance=1.0, bits=bits)}))
    used = not_none(restore(without_level, model, truth).residual)
    assert restoration.residual is not None
    assert abs(restoration.residual.chi_squared - restoration.residual.expected) < 4 * restoration.residual.deviation
    assert abs(used.chi_squared - used.expected) > 4 * used.deviation


@pytest.mark.parametrize(("radius", "known"), [(7, True), (7, False), (5, False)])
def test_a_region_that_saturated_pixels_alone_see_is_not_trusted(radius: int, known: bool) -> None:
    """Whether the truth is known or not: by how much the light there exceeds the limit, no reading tells."""
    described = scene(lenses=THREE, noise={"variance": 1.0, "saturation": 200.0})
    stack, model, truth = recording(described)
    row, column = np.indices(stack.camera.shape)
    bright = np.hypot(row - 9, column - 8) < radius
    truth = np.where(bright, 250.0, np.minimum(truth, 170.0).reshape(row.shape)).ravel()
    values = expose(model.forward(truth), not_none(described.noise), generators(stack.camera, 3), stack.camera.slices())
    result = restore(replace(stack, values=values), model, truth if known else None)
    hidden = model.adjoint(np.where(result.usable.full, 0.0, 1.0)) == 0
    large = radius == 7  # more than a fiftieth of the image, else a doubt
    assert overexposed(model, result.usable) == hidden.mean()
    assert hidden.mean() > 0.05 if large else 0 < hidden.mean() < 0.01
    said = result.verdict.reasons if large else result.verdict.doubts
    assert any("seen by saturated sensor pixels alone" in words for words in said)
    assert result.verdict.level == ("red" if large else "amber")
    squares = np.square(result.estimate - truth) / result.expected.variance
    assert np.median(squares[~hidden]) < 1 < np.median(squares[hidden])


@pytest.mark.slow
@pytest.mark.parametrize("bits", [None, 7])
def test_light_just_below_saturation_is_not_biased(bits: int | None) -> None:
    """Over images of the prior the estimate is right on average, with an error as expected, though some saturates.

    Without the saturated pixels it is too dark, by tens of standard errors.
    """
    seeds, prior = 20, {"mean": 236.0, "variance": 25.0}
    noise = {"variance": 4.0, "saturation": 240.0} | ({} if bits is None else {"bits": bits})
    described = scene((12, 12), (("1/2", [2, 2], "fit"), ("1/3", [3, 3], "fit")), noise=noise, prior=prior)
    camera, record = derive(described), {"seconds": 0.0, "versions": {}, "seed": 0, "first_seed": 0}
    model = ideal_model(described, camera)
    model = replace(model, record={**model.record, "seconds": 0.0, "versions": {}})
    differences, ratios, inside = np.empty(seeds), np.empty(seeds), 0
    for seed in range(seeds):
        truth = 236 + np.random.default_rng(seed).normal(0, 5, model.unknowns)
        values = expose(model.forward(truth), not_none(described.noise), generators(camera, seed), camera.slices())
        result = restore(Stack(described, camera, values, np.zeros_like(values), record), model, truth)
        assert result.usable.saturated > 0
        differences[seed] = model.forward(result.estimate - truth).mean()
        ratios[seed] = not_none(result.error).mse / result.expected.mse
        inside += inside_interval(result)
    for mean, samples in ((0, differences), (1, ratios)):
        assert abs(samples.mean() - mean) < 4 * samples.std(ddof=1) / seeds**0.5
    assert inside >= seeds - 2


def test_a_saturated_sensor_is_censored_at_the_reading_it_would_have() -> None:
    """The limit in units of f, of a [sensor] and of rounded values: light at the limit saturates half of all pixels."""
    for bits in (None, 5):
        noise = {"variance": 25.0, "saturation": 200.0} | ({} if bits is None else {"bits": bits})
        stack, model, _ = recording(scene(lenses=THREE, noise=noise))
        limit = 200.0 if bits is None else 196.0  # 200 is 25 levels of 8: rounded to from 24.5 on
        usable = usable_pixels(stack, model)
        full = replace(usable, used=np.zeros_like(usable.used), full=np.ones_like(usable.used))
        values, _ = censored(stack, model, full, np.full(model.unknowns, limit), None)
        deviation = (25 + (0 if bits is None else 64 / 12)) ** 0.5
        # At the limit half of a normal distribution remains, of mean s (2 / pi)^0.5 and variance s^2 (1 - 2 / pi).
        assert values.values == pytest.approx(np.full(706, limit + deviation * (2 / np.pi) ** -0.5), rel=1e-9)


def test_saturation_survives_the_file(tmp_path: Path) -> None:
    """The stack holds float32: a level that float32 rounds down is still known."""
    stack, _, _ = recording(scene(lenses=THREE, noise={"variance": 1.0, "saturation": 30.3}))
    stacks.write(tmp_path / "stack.exr", stack)
    assert usable_pixels(stacks.read(tmp_path / "stack.exr")).saturated == usable_pixels(stack).saturated > 0


def test_a_stack_without_usable_pixels_gives_the_prior_and_a_warning() -> None:
    stack, model, truth = recording(scene(lenses=THREE, noise=SENSOR, prior={"mean": 99.0, "variance": 16.0}))
    for kind in ("independent", "fit"):
        nothing = replace(stack, values=np.full(706, np.nan), scene=with_keys(stack.scene, prior={"kind": kind}))
        restoration = restore(nothing, model, truth)
        assert restoration.estimate == pytest.approx(np.full(361, 99.0))
        assert restoration.expected.variance == pytest.approx(np.full(361, 16.0 + 64.0**2)), "the level is not known"
        assert restoration.usable.dead == 706
        assert "this is the prior and not an image" in rows(restoration, nothing, model)["verdict"]


def test_dead_pixels_from_files(kept: Path, ommatid: Command) -> None:
    """A stack with NaN in it goes through the command line, and run.json's fields count them."""
    stack = stacks.read(kept / "stack.exr")
    values = stack.values.copy()
    values[5] = np.nan
    stacks.write(kept / "stack.exr", replace(stack, values=values))
    report = document(ommatid("reconstruct", kept / "stack.exr", kept / "model.npz", "-o", "dead.exr", "--json"))
    assert report["diagnostics"]["pixels_dead"] == 1
    assert report["diagnostics"]["pixels_used"] == report["measurements"] - 1


@pytest.mark.slow
def test_a_fitted_prior_and_noise_from_the_stack_alone() -> None:
    """On a photograph the error falls below a third, the noise is fitted, and both are in the table."""
    paper = restored(scene(lenses=THREE, noise=SENSOR))
    tables: dict[str, Any] = {"prior": {"kind": "fit"}, "estimator": {"noise_variance": "fit"}}
    stack, model, truth = recording(scene(lenses=THREE, noise=SENSOR, **tables))
    restoration = restore(stack, model, truth)
    assert not_none(restoration.error).mse < not_none(paper.error).mse / 3
    assert not_none(restoration.fit).noise_variance == pytest.approx(
        1.0, rel=4 * not_none(restoration.fit).numbers["noise_variance"][1]
    )
    lines = rows(restoration, stack, model)
    assert {"fitted variance", "fitted correlation length", "fitted noise variance"} <= set(lines)


def test_a_region_outside_the_image_is_refused() -> None:
    with pytest.raises(InputError, match="does not lie inside an image of 19 x 19"):
        restored(scene(lenses=THREE, noise=SENSOR)).region((18, 0), (2, 1))


def test_a_region_from_the_command_line(kept: Path, ommatid: Command) -> None:
    files = (kept / "stack.exr", kept / "model.npz", "-o", "region.exr", "--region")
    report = document(ommatid("reconstruct", *files, "2,3,4,5", "--json"))["regions"][0]
    assert (report["corner"], report["size"]) == ([2, 3], [4, 5])
    assert report["deviation"] > 0
    both = ommatid("reconstruct", *files, "2,3,4,5", "--region", "0,0,2,2").out
    assert "mean of 4 x 5 pixels at 2, 3" in both
    assert "mean of 2 x 2 pixels at 0, 0" in both
    for wrong in ("2,3", "a,b,c,d", "0,0,99,99"):
        assert ommatid("reconstruct", *files, wrong).code == 2


def test_settings_beyond_float32_are_refused(kept: Path, ommatid: Command) -> None:
    """Files hold float32, and JSON has no Infinity."""
    files = ("reconstruct", kept / "stack.exr", kept / "model.npz", "-o", "far.exr", "--json", "--set")
    for setting in ("prior.mean=1e300", "prior.variance=1e300", "estimator.noise_variance=1e300"):
        ended = ommatid(*files, setting)
        assert (ended.code, ended.out) == (2, "")
        assert setting.split("=")[0] in ended.err
    document(ommatid(*files, "prior.mean=1e12"))


def test_negative_variances_are_refused(kept: Path, ommatid: Command) -> None:
    stack = stacks.read(kept / "stack.exr")
    variance = stack.rendering_variance.copy()
    variance[0] = -1.0
    stacks.write(kept / "stack.exr", replace(stack, rendering_variance=variance))
    ended = ommatid("reconstruct", kept / "stack.exr", kept / "model.npz", "-o", "below.exr")
    assert ended.code == 2
    assert "expected variances of 0 or more" in ended.err


def test_without_noise_there_is_no_chi_squared() -> None:
    pixel_by_pixel = (1, [1, 1], [12, 12]), ("1/3", [3, 3], [3, 3])
    noiseless: dict[str, Any] = {"noise": {"variance": 0.0}, "estimator": {"noise_variance": 0.0}}
    stack, model, truth = recording(scene((12, 12), pixel_by_pixel, **noiseless))
    restoration = restore(stack, model, truth)
    assert restoration.residual is None
    assert "chi-squared of the residual" not in rows(restoration, stack, model)
    assert restoration.estimate == pytest.approx(truth, rel=1e-6)


@pytest.mark.parametrize("estimator", [{"noise_variance": "fit"}, slow({})])
def test_a_fit_with_an_uncertain_h(estimator: dict[str, Any]) -> None:
    """The variance due to H is computed at the fitted image: chi-squared is as expected."""
    described = scene(lenses=THREE, noise=SENSOR, prior={"kind": "fit"}, estimator=estimator)
    stack, model, truth = recording(described)
    rng = np.random.default_rng(0)
    spread = 0.002 * rng.normal(size=model.matrix.nnz)
    uncertain = replace(
        model,
        stored=model.matrix
        + type(model.matrix)((spread, model.matrix.indices, model.matrix.indptr), model.matrix.shape),
        variance=np.full(model.matrix.nnz, 0.002**2),
        record={"method": "points", "versions": {}},
    )
    restoration = restore(stack, uncertain, truth)
    assert restoration.residual is not None
    assert abs(restoration.residual.chi_squared - restoration.residual.expected) < 4 * restoration.residual.deviation
    assert not not_none(restoration.fit).doubtful


# --- rounded readings


VARIANCE, SEEDS = 1e-3, 24  # 0.03 steps of eight bits
SIGNIFICANCE = 1e-3


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.2, 0.4])
def test_the_common_variance_is_the_mean_square_of_the_mean_error(noise: float) -> None:
    """Over lights spread evenly within a step, the expected reading from the normal distribution at every edge."""
    light = (np.arange(4000) + 0.5) / 4000
    edges = np.arange(-8, 9) + 0.5
    above = stats.norm.sf(edges, light[:, None], noise) if noise else (light[:, None] > edges).astype(np.float64)
    error = above.sum(axis=1) - 8 - light
    step = 0.25
    rounding = np.full(4000, step**2 / 12)
    # Dark frames have the same error in every exposure, which dithers none of them.
    variances = {"noise": np.full(4000, (noise * step) ** 2), "quantisation": rounding, "frames": rounding}
    columns = common_rounding(variances, step * light)
    found = np.square(columns).sum(axis=0)
    np.testing.assert_allclose(found, step**2 * np.square(error).mean(), rtol=0.05, atol=1e-12)
    assert columns[0] @ columns[1] == pytest.approx(0, abs=1e-9 + 1e-3 * found.sum())


def rounded(kind: str, shape: tuple[int, int], seed: int) -> tuple[Reconstruction, FloatArray]:
    """The reconstruction of a picture at eight bits, and its truth."""
    rng = np.random.default_rng(seed)
    truth = np.full(shape, rng.uniform(20, 220))
    if kind == "smooth":
        truth += 6 * ndimage.gaussian_filter(rng.normal(size=shape), 3)
    if kind == "ramp":
        truth = 40 + 150 * np.linspace(0, 1, shape[0] * shape[1]).reshape(shape)
    described = wide(shape, FITTED, noise={"variance": VARIANCE, "bits": 8}, prior={"kind": "fit"})
    stack = recorded(described, truth.ravel(), VARIANCE, seed)
    stack = replace(stack, values=np.round(stack.values))
    return restore(stack, ideal_model(described, derive(described)), truth.ravel()), truth


@pytest.mark.parametrize(
    ("kind", "shape", "seeds"),
    [
        ("flat", (13, 13), 3),
        slow("smooth", (19, 19), SEEDS),
        slow("ramp", (19, 19), SEEDS),
        slow("flat", (47, 45), SEEDS),
    ],
)
def test_means_of_smooth_pictures_err_by_what_is_stated(kind: str, shape: tuple[int, int], seeds: int) -> None:
    """The largest error of a mean is half a step, and what is stated root 12 times less than one: at most 1.7 times."""
    scores: list[list[float]] = []
    inside = 0
    for seed in range(seeds):
        found, truth = rounded(kind, shape, seed)
        assert found.verdict.trusted
        assert any("times the quantisation step" in note for note in found.verdict.notes)
        inside += float(np.square(found.estimate - truth.ravel()).mean()) <= not_none(found.interval).high
        regions = ((5, 6), (1, 1)), ((3, 4), (5, 5)), ((0, 0), shape)
        means = [found.region(*region) for region in regions]
        true = [truth[r : r + h, c : c + w].mean() for (r, c), (h, w) in regions]
        scores.append([(mean - value) / deviation for (mean, deviation), value in zip(means, true, strict=True)])
    assert inside >= stats.binom.ppf(SIGNIFICANCE, seeds, 0.99)
    squares = np.square(scores).sum(axis=0)
    assert (squares < stats.chi2.ppf(1 - SIGNIFICANCE, seeds)).all()
    if kind == "flat":
        assert (squares > stats.chi2.ppf(SIGNIFICANCE, seeds)).all()
