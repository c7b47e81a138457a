"""The real sensor: what a photon-transfer curve finds is what was put in; the ideal one: noise of a variance.

The curve is written out here after EMVA Standard 1288, release 4 (linear), and sees nothing but digital numbers.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from ommatid.reconstruct.methods.method import total_variance
from ommatid.reconstruct.noise import known_noise, usable_pixels
from ommatid.reconstruct.restore import restore
from ommatid.runtime.errors import InputError
from ommatid.runtime.streams import Purpose
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.recording import Recording, expected_recording
from ommatid.scenes.scene import Scene
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.camera import ToleranceTable
from ommatid.scenes.tables.sensor import NoiseTable, SensorTable
from ommatid.simulate import sensors
from ommatid.simulate.ideal import ideal_model
from ommatid.simulate.sensors import expose, generators, quantise, record

from ..examples import THREE, Lenses, camera, familywise, inside_interval, not_none, scene

Vector = NDArray[np.float64]

REAL = {
    "illuminance": "500 lux",
    "exposure": "10 ms",
    "quantum_efficiency": 0.6,
    "full_well": 8000.0,
    "dark_current": 300.0,
    "read_noise": 4.0,
    "dsnu": 3.0,
    "prnu": 0.012,
    "gain": 0.45,
    "black_level": 40.0,
}


def sensor(**changes: Any) -> SensorTable:
    return SensorTable.model_validate(REAL | changes)


def field(side: int, count: int = 1) -> Camera:
    """Sub-imagers of `side` x `side` pixels side by side, each pixel on one of f."""
    size = (side, side + count - 1)
    one = scene(size, ((1, [1, count], [side, side]),))
    wide = one.model_copy(update={"camera": one.camera.model_copy(update={"lens_pitch": 10.0})})
    return derive(wide)


def exposed(told: SensorTable, camera: Camera, light: float | Vector, seed: int, electrons: float = 20.0) -> Recording:
    """Return a recording by pixels that release `electrons` per unit of f."""
    everywhere = np.broadcast_to(np.float64(light), (camera.measurements,))
    return record(everywhere, np.full(camera.measurements, electrons), told, camera, seed)


def test_a_photon_transfer_curve_recovers_the_sensor() -> None:
    """Gain from temporal variance against mean, dark noise from its intercept, DSNU and PRNU from spatial variance."""
    camera, told = field(160), sensor(bits=14)
    pixels = camera.measurements
    pairs = [[exposed(told, camera, light, 2 * n + i).digital for i in (0, 1)] for n, light in enumerate(LEVELS)]
    means = np.array([float(np.mean(pair)) for pair in pairs])
    temporal = np.array([float(np.mean((pair[0] - pair[1]) ** 2)) / 2 for pair in pairs])
    error = temporal * (2 / pixels) ** 0.5
    signal, excess = means - means[0], temporal - temporal[0]
    weights = 1 / error[1:] ** 2
    gain = float(np.sum(weights * signal[1:] * excess[1:]) / np.sum(weights * signal[1:] ** 2))
    # One dark pair is subtracted from every variance, so its error counts in all of them.
    by_dark = float(np.sum(weights * signal[1:]) / np.sum(weights * signal[1:] ** 2)) * error[0]
    assert gain == pytest.approx(0.45, abs=4 * float(np.hypot(np.sum(weights * signal[1:] ** 2) ** -0.5, by_dark)))
    dark = (temporal[0] - 1 / 12) / gain**2
    assert dark == pytest.approx(4.0**2 + 300 * 0.01, abs=4 * float(error[0]) / 0.45**2 + 0.02 * dark)
    assert means[0] == pytest.approx(40 + 0.45 * 300 * 0.01, abs=4 * 0.45 * 5.3 / pixels**0.5)
    spatial = [float(np.var(np.mean(pair, axis=0), ddof=1)) - temporal[n] / 2 for n, pair in enumerate(pairs)]
    doubts = [(value + temporal[n] / 2) * (2 / pixels) ** 0.5 for n, value in enumerate(spatial)]
    assert spatial[0] == pytest.approx((0.45 * 3.0) ** 2, abs=4 * doubts[0])
    half = len(LEVELS) // 2
    prnu = (spatial[half] - spatial[0]) / signal[half] ** 2
    assert prnu == pytest.approx(0.012**2, abs=4 * float(np.hypot(doubts[half], doubts[0])) / signal[half] ** 2)


LEVELS = tuple(np.linspace(0, 300, 13))


def test_photons_are_poisson() -> None:
    """Without other noise the numbers are the counts, with Poisson frequencies (chi-squared)."""
    camera = field(150)
    bare = sensor(**dict.fromkeys(("dark_current", "read_noise", "dsnu", "prnu", "black_level"), 0.0), gain=1.0)
    counts = exposed(bare, camera, 1.0, 3, electrons=6.0).digital
    edges = np.arange(14)
    expected = stats.poisson(6.0).pmf(edges) * counts.size
    observed = np.bincount(np.minimum(counts, 13).astype(int), minlength=14)
    expected[-1] = counts.size - expected[:-1].sum()
    assert float(stats.chisquare(observed, expected).pvalue) > 0.001
    assert (exposed(bare, camera, 0.0, 3).digital == 0).all()


@pytest.mark.parametrize(
    ("changes", "largest"),
    [({"bits": 10}, 1023), ({"bits": 14}, 0.45 * 8000 + 40), ({"bits": 14, "saturation": 2000}, None)],
)
def test_full_pixels(changes: dict[str, Any], largest: float | None) -> None:
    """Numbers are limited by the bits or the well, with or without noise; `saturation` only marks them as full."""
    told, camera = sensor(**changes), field(40)
    found = exposed(told, camera, 1e9, 0)
    assert found.saturated.all()
    if largest is not None:
        assert (found.digital == np.round(largest)).all()
        assert found.digital.max() >= told.full
    half = exposed(told, camera, 255.0, 0, electrons=0.5 * (told.full - 40) / 0.45 / 255)
    assert not half.saturated.any()
    assert not np.isnan(half.values).any()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "electrons", "brightest"),
    [
        ({"frames": 4}, 12.0, 250.0),  # mostly photons
        ({"frames": 2, "read_noise": 60.0, "black_level": 200.0}, 16.0, 250.0),  # at the flat's own level and beyond
        ({"frames": 8, "dark_current": 2e5}, 1.0, 250.0),  # mostly electrons of the dark
        ({"frames": 16, "read_noise": 10.0, "gain": 0.05, "dark_current": 0.0}, 1.0, 10.0),  # a good deal of rounding
    ],
)
def test_the_scatter_of_values_is_their_stated_variance(
    changes: dict[str, Any], electrons: float, brightest: float
) -> None:
    """Over 400 exposures, each with frames of its own: every pixel (chi-squared), all of them, and their means."""
    camera, told, seeds = derive(scene(lenses=(("1/3", [1, 1], [5, 5]),))), sensor(**changes), 400
    light = np.linspace(brightest / 50, brightest, camera.measurements)
    taken = [exposed(told, camera, light, seed, electrons) for seed in range(seeds)]
    values = np.stack([one.values for one in taken])
    said = np.mean([one.noise_variance(light) for one in taken[:40]], axis=0)
    ratio = values.var(axis=0, ddof=1) / said
    low, high = (stats.chi2.ppf(q, seeds - 1) / (seeds - 1) for q in (familywise(25) / 2, 1 - familywise(25) / 2))
    assert (low < ratio).all()
    assert (ratio < high).all()
    assert float(ratio.mean()) == pytest.approx(1, abs=4 * (2 / seeds / ratio.size) ** 0.5)
    # Without a pattern it is what could be foreseen, here with a response that is some per cent off.
    expected = expected_recording(told, camera, np.full(camera.measurements, electrons), light).noise_variance(light)
    assert float(np.mean(said / expected)) == pytest.approx(1, abs=4 * 2 * 0.012 / 5)
    # Flats take PRNU out and darks take DSNU out: what is left of the mean is chance.
    away = (values.mean(axis=0) - light) / np.sqrt(said / seeds)
    assert np.abs(away).max() < float(stats.norm.isf(familywise(25) / 2))


def test_means_of_frames_are_distributed_like_frames_drawn_one_by_one(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse = {"gain": 0.1, "read_noise": 5.0}  # rounding counts, and errs in all frames alike by next to nothing
    camera, told = field(60), sensor(dsnu=0.0, prnu=0.0, frames=9, **coarse)
    found: list[Recording] = []
    for most in (10**9, 0):
        monkeypatch.setattr(sensors, "MOST_READINGS", most)
        found.append(exposed(told, camera, 50.0, most % 7))
    pixels = camera.measurements
    for name in ("dark", "flat"):
        one_by_one, at_once = (np.asarray(getattr(one, name)) for one in found)
        chance = (one_by_one.var() + at_once.var()) ** 0.5 / pixels**0.5
        assert float(one_by_one.mean()) == pytest.approx(float(at_once.mean()), abs=4 * chance)
        ratio = float(one_by_one.var() / at_once.var())
        assert ratio == pytest.approx(1, abs=4 * (4 / pixels) ** 0.5)


def test_the_fixed_pattern_belongs_to_the_camera_and_the_rest_to_the_exposure() -> None:
    quiet = sensor(read_noise=0.0, dark_current=0.0, bits=16, gain=5.0, black_level=100.0, frames=256)
    two, one = field(24, 2), field(24)
    first, again = exposed(quiet, two, 200.0, 0), exposed(quiet, two, 200.0, 1)
    pattern = first.flat / first.flat.mean()
    assert np.corrcoef(pattern, again.flat)[0, 1] > 0.9
    np.testing.assert_array_equal(first.dark, again.dark)  # of which nothing is by chance here
    shot = (first.digital - first.flat * 2, again.digital - again.flat * 2)
    assert abs(np.corrcoef(first.values, again.values)[0, 1]) < 4 / shot[0].size ** 0.5
    alone = exposed(quiet, one, 200.0, 0)
    for name in ("digital", "dark", "flat"):  # whatever else the camera has
        np.testing.assert_array_equal(getattr(alone, name), getattr(first, name)[: one.measurements])
    halves = first.values.reshape(2, -1)
    assert abs(np.corrcoef(halves)[0, 1]) < 4 / halves.shape[1] ** 0.5


def test_all_streams_differ() -> None:
    subs = field(4, 2).sub_imagers
    purposes = (Purpose.DARK_SIGNAL, Purpose.RESPONSE, Purpose.EXPOSURE, Purpose.DARK_FRAMES, Purpose.FLAT_FRAMES)
    drawn = {sensors.generator(seed, what, sub).random() for seed in (0, 1) for what in purposes for sub in subs}
    assert len(drawn) == 2 * 5 * 2
    plain = exposed(
        sensor(dsnu=0.0, frames=2), field(60), 100.0, 0, electrons=0.0
    )  # three times the same kind of frame
    for one, other in ((plain.digital, plain.dark), (plain.digital, plain.flat), (plain.dark, plain.flat)):
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / one.size**0.5
    tolerances = [ToleranceTable(seed=seed) for seed in (0, 1)]
    flats = [exposed(sensor(), replace(field(60), tolerance=one), 0.0, 0).flat for one in (None, *tolerances)]
    np.testing.assert_array_equal(flats[0], flats[1])
    assert abs(np.corrcoef(flats[1], flats[2])[0, 1]) < 0.1 + 4 / plain.flat.size**0.5  # frames' noise is the same


def test_smoothed_light_of_a_uniform_target() -> None:
    """Its mean is that of the target plus one electron per nine pixels, its variance a ninth; it is never zero."""
    camera, told = field(60), sensor(dsnu=0.0, prnu=0.0)
    found = exposed(told, camera, 5.0, 0)
    nearby, own = (one.reshape(60, 60)[1:-1, 1:-1] for one in (found.smoothed_light(camera), found.values))
    chance = 3 * float(own.std()) / own.size**0.5
    assert float(nearby.mean() - own.mean()) == pytest.approx(1 / 9 / 20, abs=chance / 3)
    # Three standard errors of the ratio: the squared autocorrelation of 3 x 3 means sums to (19 / 9)^2, their squared
    # correlations with single pixels to 1.
    assert float(nearby.var() / own.var()) == pytest.approx(1 / 9, rel=3 * (2 * ((19 / 9) ** 2 - 1) / own.size) ** 0.5)
    silent = exposed(sensor(read_noise=0.0, dark_current=0.0, dsnu=0.0), camera, 0.0, 0)
    assert float(silent.smoothed_light(camera).min()) > 0
    holes = replace(found, digital=np.where(np.arange(3600) % 3 == 0, np.nan, found.digital))
    assert float(np.nanmean(holes.smoothed_light(camera))) == pytest.approx(5.0, abs=2 * chance + 1 / 4 / 20)


def test_pixels_without_response_are_dead_and_negative_light_is_refused() -> None:
    camera, told = field(12), sensor()
    response = np.full(144, 10.0)
    response[:12] = 0.0
    found = record(np.full(144, 90.0), response, told, camera, 0)
    assert np.isnan(found.values[:12]).all()
    assert np.isfinite(found.values[12:]).all()
    assert np.isnan(record(np.ones(144), np.zeros(144), told, camera, 0).values).all()
    hot = sensor(dark_current=1e8)  # fills every well
    assert np.isnan(record(np.ones(144), np.full(144, 10.0), hot, camera, 0).values).all()
    with pytest.raises(InputError, match=r"counts the electrons of light, got light below 0 \(least -2\)"):
        record(np.where(response > 0, 1.0, -2.0), response, told, camera, 0)


def taken(lux: float, seed: int = 0, lenses: Lenses = THREE, response: float = 1.0, **tables: Any) -> tuple[Stack, Any]:
    """Return the recording of the scene's picture by an ideal camera with this sensor, and its model."""
    real = REAL | {"illuminance": f"{lux} lux", "dark_current": 0.0}
    described: Scene = scene(lenses=lenses, **tables)
    described = described.model_copy(update={"sensor": SensorTable.model_validate(real)})
    camera, truth = derive(described), load(described).ravel()
    model = ideal_model(described, camera)
    everywhere = np.full(camera.measurements, response * lux / 100)
    found = record(model.forward(truth), everywhere, described.sensor or sensor(), camera, seed)
    told: dict[str, Any] = {"seconds": 0.0, "versions": {}, "seed": seed, "first_seed": seed}
    return Stack(described, camera, found.values, np.zeros(camera.measurements), told, found), model


@pytest.mark.slow
def test_the_second_estimate_of_the_noise_is_more_accurate_and_as_good_a_weight() -> None:
    """Few electrons, where a reading alone says little of the noise it has; against that, and against the truth."""
    errors: list[list[float]] = []
    for seed in range(6):
        stack, model = taken(20.0, seed, prior={"mean": 30.0, "variance": 900.0})
        recording, truth = stack.recording, load(stack.scene).ravel()
        assert recording is not None
        found = restore(stack, model, truth)
        noises = [recording.noise_variance(light) for light in (recording.values, model.forward(truth))]
        first, second = (total_variance(noise) for noise in (known_noise(stack), found.noise))
        assert _distance(second, noises[1]) < _distance(first, noises[1]) < _distance(*noises)
        ideal = stack.scene.model_copy(update={"sensor": None})
        told = [replace(stack, scene=ideal, recording=None, rendering_variance=noise) for noise in noises]
        every = restore(told[0], model, truth), found, restore(told[1], model, truth)
        errors.append([not_none(one.error).mse for one in every])
    by_reading, by_second, by_truth = np.mean(errors, axis=0)
    assert by_second < 0.9 * by_reading
    assert by_second < 1.02 * by_truth


def _distance(one: Vector, other: Vector) -> float:
    return float(np.sqrt(np.mean(np.log(one / other) ** 2)))


def test_saturated_and_dead_pixels_are_left_out() -> None:
    stack, model = taken(2000.0, response=9.0)
    recording = stack.recording
    assert recording is not None
    broken = replace(recording, digital=np.where(np.arange(stack.values.size) % 50 == 0, np.nan, recording.digital))
    stack = Stack(stack.scene, stack.camera, broken.values, stack.rendering_variance, stack.record, broken)
    usable = usable_pixels(stack)
    assert usable.dead == -(-stack.values.size // 50)
    assert 20 < usable.saturated < 500
    found = restore(stack, model, load(stack.scene).ravel())
    assert np.isfinite(found.estimate).all()
    assert not_none(found.error).mse < not_none(found.interval).high


def test_assumed_noise_variance_with_a_sensor() -> None:
    stack, model = taken(500.0)
    told = stack.scene.estimator.model_copy(update={"noise_variance": "fit"})
    with pytest.raises(InputError, match="differs from pixel to pixel"):
        restore(replace(stack, scene=stack.scene.model_copy(update={"estimator": told})), model)
    told = stack.scene.estimator.model_copy(update={"noise_variance": 1.0})
    truth = load(stack.scene).ravel()
    flat = restore(replace(stack, scene=stack.scene.model_copy(update={"estimator": told})), model, truth)
    assert inside_interval(flat)
    assert flat.expected.mse >= restore(stack, model).expected.mse


def test_noise_has_the_requested_variance() -> None:
    rng = np.random.default_rng(0)
    size = 40_000
    noise = expose(np.full(size, 100.0), NoiseTable(variance=0.25), [rng], [slice(0, size)]) - 100
    bounds = stats.chi2.ppf([0.005, 0.995], size - 1) / (size - 1)
    assert bounds[0] < noise.var(ddof=1) / 0.25 < bounds[1]
    assert abs(noise.mean()) < 2.6 * (0.25 / size) ** 0.5


@pytest.mark.parametrize("bits", [4, 8, 12])
def test_quantisation_acts_as_noise_of_a_twelfth_of_the_squared_step(bits: int) -> None:
    values = np.random.default_rng(1).uniform(0, 255, 100_000)
    step = 256 / 2**bits
    error = quantise(values, NoiseTable(bits=bits).level) - values
    assert np.abs(error).max() <= step / 2 * (1 + 1e-12)
    # Four standard errors: the square of a uniform deviate has the relative variance 4/5.
    assert error.var() == pytest.approx(step**2 / 12, rel=4 * (0.8 / error.size) ** 0.5)
    assert NoiseTable(bits=bits).quantisation_variance == pytest.approx(step**2 / 12)
    levels = np.unique(quantise(values, step) / step)
    assert (levels == np.round(levels)).all()


def test_a_sub_imagers_noise_does_not_depend_on_its_neighbours() -> None:
    three, one = camera(), camera(lenses=THREE[:1])
    noise = NoiseTable(variance=1.0)
    whole = expose(np.zeros(three.measurements), noise, generators(three, 5), three.slices())
    alone = expose(np.zeros(one.measurements), noise, generators(one, 5), one.slices())
    np.testing.assert_array_equal(whole[: one.measurements], alone)
    others = expose(np.zeros(one.measurements), noise, generators(one, 6), one.slices())
    assert abs(np.corrcoef(alone, others)[0, 1]) < 4 / 225**0.5
