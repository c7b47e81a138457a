"""The best mixture of lens types and its bound, against other ways to the same numbers; candidates for it."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from ommatid.analysis.best_camera import BestCamera, candidates, design_space, scene_of
from ommatid.analysis.design import LensCandidate, magnifications, with_lens
from ommatid.analysis.mixture import Goal, WaveGroups, best_mixture, best_whole
from ommatid.analysis.predict import predict_scene
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import derive
from ommatid.scenes.layout import sensor_extent
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.tables.gallery import GALLERY
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import not_none, scene, sets
from ..runs import document

PRIOR, NOISE = 5461.25, 1e-2


def transfer(ratio: int, side: int) -> FloatArray:
    """Return the transfer function of a box along one axis of a ring of pixels."""
    box = np.zeros(side)
    box[:ratio] = 1 / ratio
    return np.abs(np.fft.fft(box))


def periodic(ratios: list[int], side: int, noise: float = NOISE) -> WaveGroups:
    """The waves of a target without edges, which independent pixels fill."""
    rows = [(np.outer(transfer(ratio, side), transfer(ratio, side)) * (PRIOR / noise) ** 0.5) for ratio in ratios]
    pixels = np.full((side**2, 1), PRIOR**0.5)
    costs = np.ones(len(ratios))
    shaped = np.array(rows).reshape(len(ratios), -1).T[..., None]
    return WaveGroups(shaped, pixels[..., None], np.arange(len(ratios)), costs, (side, side))


def anywhere(_: tuple[int, ...]) -> bool:
    return True


def best_camera(scene: Scene, wanted: list[LensCandidate]) -> BestCamera:
    space = design_space(scene, wanted)
    return space.best(space.budget)


@pytest.mark.parametrize(
    ("least", "error", "areas"),
    [(3, 0.9465, (1.16, 1.05, 0.78)), (4, 2.850, (1.08, 1.04, 0.44, 0.44)), (5, 5.861, (1.05, 1.01, 0.76, 0.19))],
)
def test_the_best_mixtures_of_the_paper_s_noise(least: int, error: float, areas: tuple[float, ...]) -> None:
    """Three readings per pixel by magnifications from 1/least on; numbers computed apart."""
    groups = periodic(list(range(least, 10)), 240)
    mixture = best_mixture(groups, 3.0)
    assert mixture.found.error == pytest.approx(error, rel=1e-3)
    assert mixture.gap < 1e-4 * mixture.found.error
    np.testing.assert_allclose(mixture.amounts[: len(areas)], areas, atol=0.01)
    assert np.all(mixture.amounts[len(areas) :] < 1e-3)


def test_the_paper_s_types_are_a_hundredth_from_the_best() -> None:
    groups = periodic(list(range(3, 10)), 240)
    mixture = best_mixture(groups, 3.0)
    best, *_ = best_whole(groups, 3.0, mixture, 3, anywhere)
    assert best.counts == (1, 1, 1, 0, 0, 0, 0)
    assert best.found.error / mixture.bound - 1 == pytest.approx(0.012, abs=1e-3)


def test_the_error_is_that_of_all_boxes_on_a_ring() -> None:
    """Eq. 5 by a matrix of all readings, of two arrays of 1/2 and one of 1/3 on 12 x 12 pixels without edges."""
    side, counts = 12, (2, 1)
    precision = np.eye(side**2) / PRIOR
    for ratio, count in zip((2, 3), counts, strict=True):
        box = np.zeros((side, side))
        box[:ratio, :ratio] = 1 / ratio**2
        rows = [np.roll(box, (row, column), (0, 1)).ravel() for row in range(side) for column in range(side)]
        precision += count / NOISE * np.array(rows).T @ np.array(rows)
    found = periodic([2, 3], side).evaluate(np.array(counts, dtype=np.float64))
    assert found.error == pytest.approx(np.trace(np.linalg.inv(precision)) / side**2, rel=1e-9)
    _, bits = np.linalg.slogdet(PRIOR * precision)
    assert periodic([2, 3], side).information(np.array(counts)) == pytest.approx(bits / side**2 / np.log(4), rel=1e-9)


FIT = tuple(f"camera.lens.{name}.pixels=fit" for name in ("I", "II", "III"))
CORRELATED = "prior.kind=exponential", "prior.correlation_length=25 mm"


def photo(*changes: str) -> Scene:
    return read(GALLERY / "photo.toml", ("target.shape=[119,119]", *changes))


def test_the_error_of_the_scene_s_camera_is_the_predicted_one_far_from_the_edges() -> None:
    described = photo("target.detail=3", "prior.kind=exponential", "prior.correlation_length=25 mm", "noise.variance=1")
    best = best_camera(described, [])
    own = not_none(best.space.own)
    assert own.counts == (1, 1, 1)
    trimmed = not_none(predict_scene(described, rays=False).trimmed_mse)
    assert own.found.error == pytest.approx(trimmed, rel=0.03)
    assert best.mixture.bound <= own.found.error


def test_fill_factors_beat_magnifications_at_low_noise_and_not_at_high() -> None:
    """As the table of docs/choose-a-camera.md has it: 0.21 for 0.87, and the same at a noise of ten grey levels."""
    world = "target.shape=[59,59]", "target.detail=3", "prior.kind=exponential", "prior.variance=5461"
    lenses = [Fraction(1, 3), Fraction(1, 4), Fraction(1, 5)]
    for noise, gain in (("1e-2", 3.9), ("100", 1.0)):
        changes = *world, "prior.correlation_length=25 mm", f"noise={{variance={noise}}}"
        errors: list[float] = []
        for table in ('fill_factors=[1,"1/3"]', "fill_factors=[1]"):
            described = photo(*changes, f"design={{{table}}}")
            errors.append(best_camera(described, candidates(described, lenses)).whole[0].found.error)
        assert errors[1] / errors[0] == pytest.approx(gain, rel=0.1)


def test_the_command_writes_the_best_cameras(here: Path, ommatid: Command) -> None:
    listed = "--set", 'design.magnifications="1/3,...,1/5"', "-o", "best"
    found = document(ommatid("design", "tile19", *listed, "--json"))
    assert found["cameras"][0]["arrays"] == [1, 1, 1]
    assert found["bound"] <= found["mixture"]["mse"] <= found["cameras"][0]["mse"] == found["own"]["mse"]
    written = {path.name for path in (here / "best").iterdir()}
    assert {"camera1.toml", "camera2.toml", "camera3.toml", "front.csv", "front.png"} <= written
    predicted = document(ommatid("predict", "best/camera1.toml", "--no-rays", "--json"))[0]
    assert predicted["mse"] == pytest.approx(found["cameras"][0]["with_edges"], rel=1e-9)
    lines = ommatid("design", "tile19", *listed).out
    assert "no such camera is better than" in lines
    assert "1/3 + 1/4 + 1/5" in lines


APERTURES = tuple(f"camera.lens.{name}.aperture=0.1 mm" for name in ("I", "II", "III"))
SOME = 'design.magnifications="1/3,1/4"'
MANY = [
    "design.fill_factors=[" + ",".join(f'"1/{n}"' for n in range(2, 21)) + "]",
    'design.magnifications="1/2,...,1/20"',
]
REFUSED: dict[str, list[str]] = {
    "without noise": ["noise="],
    "their own patch": ["camera.walls=false", "calibration={method='transport',fit='none'}", *APERTURES],
    "design.thickness is 0.1 mm": ["design.thickness=0.1 mm"],
    "knows noise and prior": ["estimator.noise_variance=10"],
    "design.bits are of averages": ["camera.binning=sum", "design.bits=[8]"],
    "both limit the camera": ["design.readings=3", "design.sensor_area=1/2.3"],
    "the smallest array takes 0.0": ['design.sensor_area=["0.01 mm", "0.01 mm"]'],
    "the least is": ["design.error=1e-9", SOME],
    "design.goal is 'information'": ["design.error=1", "design.goal=information"],
    "the smallest array takes": ["design.readings=0.1"],
    "at most 200 lens types": MANY,
    "design.magnifications: expected a magnification": ['design.magnifications="3"'],
    "none fits the sensor": [
        "noise.variance=1",
        'design={magnifications="1/3,1/4,1/5",error=50,sensor_area=["0.01 mm","10 mm"]}',
    ],
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_has_no_bound_is_refused_in_one_sentence(words: str, here: Path, ommatid: Command) -> None:
    ended = ommatid("design", "tile19", *sets(*REFUSED[words]))
    assert (ended.code, words in ended.err) == (2, True), ended.err
    assert len(ended.err.splitlines()) == 1
    assert [path.name for path in here.iterdir()] == ["tiny.toml"]


def test_the_light_of_a_small_dark_target_counts() -> None:
    """Shot noise is that of the picture, of which a square of a hundred pixels has other light."""
    dark = (
        "target.origin=[200,150]",
        "target.shape=[40,40]",
        'prior.kind="exponential"',
        "prior.correlation_length=5 mm",
    )
    described = read(GALLERY / "sensor.toml", (*dark, "target.detail=1", "camera.wavelength=none", *FIT))
    best = best_camera(described, [])
    trimmed = not_none(predict_scene(described, rays=False).trimmed_mse)
    assert best.mixture.bound <= best.whole[0].found.error <= 1.03 * trimmed


def test_candidates_have_the_optics_of_the_last_lens_type() -> None:
    """Of those that are ranked one by one, too."""
    described = photo("camera.lens.III.fill_factor=1/2")
    (candidate,) = candidates(described, [Fraction(1, 6)])
    ranked = with_lens(described, Fraction(1, 6)).camera.lens[-1]
    assert scene_of(described, [candidate]).camera.lens[0].fill_factor == ranked.fill_factor == (0.5, 0.5)


FINER = "target.shape=[59,59]", "target.detail=3", *CORRELATED
FIFTHS = "camera.lens.I.magnification=3/5", "camera.lens.I.array=[2,2]", "camera.lens_pitch=2 mm"
LEFT_OUT = {  # changes of the scene, magnifications, what is kept, one of those refused, and the reason
    "too wide": (('design={apertures=["0.4 mm","9 mm"]}', *FINER), [3], "1/3, 1/3 0.4 mm, 1/4, 1/5", "1/3 9 mm", ""),
    # Behind pinholes every reading is a sum of whole pixels of f, and behind apertures none is.
    "detail": (('design={apertures=["0.4 mm"]}',), [3], "1/3, 1/4, 1/5", "1/3 0.4 mm", "detail finer than f"),
    # Of 3/5 a camera of single pixels on whole pixels of f would be better than any mean over fractions.
    "fractions": (FIFTHS, [3, Fraction(5, 2)], "1/3", "2/5", "whole m"),
    # Behind 1/m the sensor stands 6 mm / m from the lenses.
    "too deep": (('design.thickness="1.3 mm"',), range(3, 8), "1/5, 1/6, 1/7", "1/3", "thickness is 1.3 mm"),
}


@pytest.mark.parametrize("name", LEFT_OUT)
def test_types_that_no_camera_can_have_are_named_and_left_out(name: str) -> None:
    changes, wanted, kept, refused, reason = LEFT_OUT[name]
    described = read(GALLERY / "tile19.toml", changes) if name == "too deep" else photo(*changes)
    space = best_camera(described, candidates(described, [1 / Fraction(ratio) for ratio in wanted])).space
    assert ", ".join(each.words for each in space.types) == kept
    assert reason in space.refused[refused]
    assert (space.own is None) == (name in ("fractions", "too deep"))


def test_cameras_of_no_more_than_the_budget() -> None:
    """1.995 readings buy one array, and not two; and no camera is better than the bound."""
    described = read(GALLERY / "tile19.toml", ("noise.variance=1", "design.readings=1.995"))
    best = best_camera(described, candidates(described, [Fraction(1, 3)]))
    assert all(best.space.cost(each) <= 1.995 and best.above(each.found) >= 0 for each in best.whole)


def test_readings_are_those_of_the_pixels() -> None:
    """Of arrays of 2 x 2 pixels each, which are no arrays that see all of the target."""
    described = read(GALLERY / "tile19.toml", tuple(f"camera.lens.{name}.pixels=[2,2]" for name in ("I", "II", "III")))
    space = design_space(described, candidates(described, [Fraction(1, 3)]))
    assert space.budget == pytest.approx(4 * (9 + 16 + 25) / 19**2)
    assert space.own is None
    with pytest.raises(InputError, match="the smallest array takes 1 readings"):
        space.best(space.budget)


def test_no_candidate_changes_the_light_of_another() -> None:
    """Lenses far from the axis have less; each type is alone in front of the target."""
    near = "target.distance=40 mm", "target.detail=1", "camera.wavelength=none"
    described = read(GALLERY / "sensor.toml", (*near, *FIT, "target.shape=[40,40]"))
    errors: list[float] = []
    for most in (5, 9):
        own = not_none(
            best_camera(described, candidates(described, [Fraction(1, ratio) for ratio in range(3, most)])).space.own
        )
        errors.append(own.found.error)
    assert errors[0] == pytest.approx(errors[1], rel=1e-9)


@pytest.mark.parametrize("size", ['["0.3 mm","1.5 mm"]', '["0.02 mm","0.6 mm"]'])
def test_small_sensors_have_cameras_or_none(size: str, here: Path, ommatid: Command) -> None:
    """A front without a camera is drawn, too."""
    changes = "noise.variance=1", f"design.sensor_area={size}", 'design.magnifications="1/3,1/4,1/5"'
    ended, none = ommatid("design", "tile19", *sets(*changes), "-o", "best"), size == '["0.02 mm","0.6 mm"]'
    assert ended.code == 0, ended.err
    assert ("none fit the sensor" in ended.out) is none
    assert ({path.name for path in (here / "best").iterdir()} == {"front.csv", "front.png"}) is none


def test_cameras_whose_readings_are_saturated_have_the_error_of_the_prior(ommatid: Command) -> None:
    magnifications = "--set", 'design.magnifications="1/3,1/4"', "--json"
    found = document(ommatid("design", "tile19", "--set", "noise.saturation=20", *magnifications))
    assert found["bound"] == found["mixture"]["mse"] == pytest.approx(PRIOR)
    nearly = document(ommatid("design", "sensor", "--set", "sensor.saturation=65", *magnifications))
    assert 0.9 * PRIOR < nearly["bound"] <= nearly["mixture"]["mse"] < PRIOR


def test_bits_that_miss_a_wish_are_said(ommatid: Command) -> None:
    table = 'design={magnifications="1/3,1/4,1/5",error=50,bits=[2,12]}'
    assert "an error of 50 is out of reach" in ommatid("design", "tile19", "--set", table).out


def test_cameras_of_real_lenses_are_those_of_the_scene_s_target() -> None:
    small = read(GALLERY / "planoconvex.toml")
    with pytest.raises(InputError, match="lenses with surfaces in front of more than"):
        best_camera(small, [])
    assert len(scene_of(small, candidates(small, [Fraction(1, 3)])).camera.lens) == 1


@pytest.mark.parametrize("number", range(20))
def test_the_best_of_tiny_cameras_is_that_of_all_sets_of_three(number: int) -> None:
    """By matrices of all readings, edges included; no camera is below the bound of their mixtures."""
    side, noise, count = 9 + number % 7, 10.0 ** (number % 5 - 2), 3 + number % 2
    tiny = read(GALLERY / "tile19.toml", (f"target.shape=[{side},{side}]",))
    types = [LensCandidate(Fraction(ratio)) for ratio in range(2, 2 + count)]
    matrices = [ideal_matrix(derive(scene_of(tiny, [each]))).toarray() * (PRIOR / noise) ** 0.5 for each in types]
    rows, owners = np.concatenate(matrices), np.repeat(np.arange(count), [len(matrix) for matrix in matrices])
    groups = WaveGroups(rows[None], np.eye(side**2)[None] * PRIOR**0.5 / side, owners, np.ones(count), (1, 1))
    mixture = best_mixture(groups, 3.0)
    best, *_ = best_whole(groups, 3.0, mixture, 1, anywhere)
    errors: list[float] = []
    for chosen in combinations_with_replacement(range(count), 3):
        stacked = np.concatenate([matrices[index] for index in chosen])
        errors.append(PRIOR * float(np.trace(np.linalg.inv(np.eye(side**2) + stacked.T @ stacked))) / side**2)
    assert mixture.bound <= min(errors) * (1 + 1e-9)
    assert best.found.error == pytest.approx(min(errors), rel=1e-9)


@pytest.mark.parametrize(
    ("goal", "noise"), [("information", 1.0), ("resolution", 1.0), *(("error", noise) for noise in (1e-3, 1.0, 300.0))]
)
def test_no_mixture_is_better_than_the_bound_and_exchanges_find_the_best(goal: Goal, noise: float) -> None:
    """Of 10,000 draws of mixtures, and of the 84 sets of three of seven types."""
    groups, rng = replace(periodic([2, 3, 4, 5, 6, 7, 8], 24, noise), goal=goal), np.random.default_rng(2)
    mixture = best_mixture(groups, 3.0)
    assert mixture.gap <= 1e-4 * abs(mixture.found.value)
    least = min(groups.evaluate(draw).value for draw in 3.0 * rng.dirichlet(np.full(7, 0.4), 10_000))
    best, *_ = best_whole(groups, 3.0, mixture, 1, anywhere)
    sets = (np.bincount(chosen, minlength=7) for chosen in combinations_with_replacement(range(7), 3))
    values = [groups.evaluate(each.astype(np.float64)).value for each in sets]
    assert best.found.value == pytest.approx(min(values), rel=1e-12)
    assert mixture.bound <= min(least, *values)
    assert mixture.found.value <= least


def test_information_ranks_otherwise_than_the_error() -> None:
    """At a noise of 1, three arrays of 1/3 hold more bits than the paper's, with 4.4 times their error."""
    groups = periodic([3, 4, 5], 240, noise=1.0)
    paper, alike = np.array([1.0, 1.0, 1.0]), np.array([3.0, 0.0, 0.0])
    assert groups.information(alike) > groups.information(paper)
    assert groups.evaluate(alike).error / groups.evaluate(paper).error == pytest.approx(4.4, rel=0.02)


def test_slopes_and_falls_are_those_of_differences() -> None:
    groups = periodic([2, 3, 4], 24, noise=1.0)
    for goal in ("error", "information", "resolution"):
        each, amounts = replace(groups, goal=goal), np.array([0.5, 1.0, 0.0])
        before = each.evaluate(amounts)
        for index in range(3):
            added = np.eye(3)[index]
            assert (before.value - each.evaluate(amounts + added).value) == pytest.approx(each.falls(amounts)[index])
            slope = (before.value - each.evaluate(amounts + 1e-6 * added).value) / 1e-6
            assert slope == pytest.approx(before.gains[index], rel=1e-3)


def test_a_wish_is_met_at_the_least_cost() -> None:
    """One array fewer does not meet it, and the bound on the cost is that of mixtures."""
    described = read(GALLERY / "tile19.toml")
    space = design_space(described, candidates(described, [Fraction(1, ratio) for ratio in range(3, 8)]))
    least, best = space.cheapest(0.0072)
    cost = space.cost(best.whole[0])
    assert best.whole[0].found.error <= 0.0072
    assert best_mixture(space.groups, least).bound > 0.0072
    assert least <= cost
    fewer = space.best(cost - 0.5, 1)
    assert fewer.whole[0].found.error > 0.0072


def test_whole_cameras_fit_the_sensor() -> None:
    described = read(GALLERY / "tile19.toml", ('design.sensor_area=["0.17 mm", "0.3 mm"]',))
    best = best_camera(described, candidates(described, [Fraction(1, ratio) for ratio in range(3, 8)]))
    assert best.budget == pytest.approx(0.051)
    assert best.whole
    for each in best.whole:
        tall, wide = sensor_extent(derive(best.space.camera(each.counts)).sub_imagers, 0.006)
        assert (tall <= 0.17 + 1e-9, wide <= 0.3 + 1e-9) == (True, True)
    with pytest.raises(InputError, match=r"camera\.sensor\.size"):
        derive(best.space.camera([9] * len(best.space.types)))


def test_fewer_bits_never_help(here: Path, ommatid: Command) -> None:
    options = "--set", 'design={magnifications="1/3,1/4,1/5", bits=[8, 12]}', "--set", "noise.variance=1e-4"
    found = document(ommatid("design", "tile19", *options, "-o", "best", "--json"))
    assert found["bits"] == 12
    rows = [line.split(",") for line in (here / "best" / "front.csv").read_text(encoding="utf-8").splitlines()]
    columns = {name: [row[index] for row in rows[1:]] for index, name in enumerate(rows[0])}
    keys = zip(*(columns[name] for name in ("bits", "limit", "budget", "depth")), strict=True)
    errors = dict(zip(keys, columns["mse"], strict=True))
    for (bits, *limit), error in errors.items():
        if bits == "8":
            assert float(error) > float(errors["12", *limit])
    assert {name for name in columns["scene"] if name} <= {path.name for path in (here / "best").iterdir()}


@pytest.mark.slow
def test_tolerances_count_in_the_errors_of_the_cameras(ommatid: Command) -> None:
    options = "--set", 'design.magnifications="1/3,1/4,1/5"', "--set", 'camera.tolerance={position="41 nm"}'
    found = document(ommatid("design", "tile19", *options, "--json"))
    assert found["bound"] == pytest.approx(0.009354, rel=1e-2)
    assert found["cameras"][0]["with_edges"] > 0.02798


# --- candidates


def test_lists_of_magnifications() -> None:
    assert magnifications("1/2,1/3,...,1/9") == [Fraction(1, m) for m in range(2, 10)] == magnifications("1/2,...,1/9")
    assert magnifications("1, 2/5 ,1/4") == [1, Fraction(2, 5), Fraction(1, 4)]
    assert magnifications("1/2,2/5,...,1/4") == [1 / Fraction(half, 2) for half in range(4, 9)]
    assert magnifications("1/3,1/3") == [Fraction(1, 3)]


@pytest.mark.parametrize("text", ["", "3", "0", "x", "1/0", "...,1/9", "1/2,1/3,...", "1/2,1/4,...,1/9"])
def test_malformed_lists_of_magnifications_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"design\.magnifications"):
        magnifications(text)


def test_the_added_type_is_as_large_as_fits() -> None:
    camera = derive(with_lens(scene(), Fraction(1, 4)))
    assert [lens_type.name for lens_type in camera.types] == ["A", "added"]
    assert (camera.types[1].array, camera.types[1].pixels) == ((4, 4), (4, 4))
    twice = with_lens(with_lens(scene(), Fraction(1, 4)), Fraction(1, 5))
    assert [lens.name for lens in twice.camera.lens] == ["A", "added", "added-2"]
