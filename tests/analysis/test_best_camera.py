"""The best mixture of lens types and its bound, against other ways to the same numbers."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np
import pytest

from ommatid.analysis.best_camera import best_camera, candidates, scene_of
from ommatid.analysis.design import with_lens
from ommatid.analysis.mixture import WaveGroups, best_mixture, best_whole
from ommatid.analysis.predict import predict_scene
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.tables.gallery import GALLERY

from ..conftest import Command
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
    return WaveGroups(np.array(rows).reshape(len(ratios), -1, 1), pixels, np.arange(len(ratios)), costs)


@pytest.mark.parametrize(
    ("least", "error", "areas"),
    [(3, 0.9465, (1.16, 1.05, 0.78)), (4, 2.850, (1.08, 1.04, 0.44, 0.44)), (5, 5.861, (1.05, 1.01, 0.76, 0.19))],
)
def test_the_best_mixtures_of_the_paper_s_noise(least: int, error: float, areas: tuple[float, ...]) -> None:
    """Three readings per pixel by magnifications from 1/least on; numbers computed apart."""
    groups = periodic(list(range(least, 10)), 240)
    mixture = best_mixture(groups, 3.0)
    assert mixture.error == pytest.approx(error, rel=1e-3)
    assert mixture.gap < 1e-4 * mixture.error
    np.testing.assert_allclose(mixture.amounts[: len(areas)], areas, atol=0.01)
    assert np.all(mixture.amounts[len(areas) :] < 1e-3)


def test_the_paper_s_types_are_a_hundredth_from_the_best() -> None:
    groups = periodic(list(range(3, 10)), 240)
    mixture = best_mixture(groups, 3.0)
    best, *_ = best_whole(groups, 3.0, mixture, 3)
    assert best.counts == (1, 1, 1, 0, 0, 0, 0)
    assert best.error / mixture.bound - 1 == pytest.approx(0.012, abs=1e-3)


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
    assert found.information == pytest.approx(bits / side**2 / np.log(4), rel=1e-9)


def test_no_mixture_is_below_the_bound() -> None:
    groups, rng = periodic([2, 3, 4, 5, 6, 7], 24, noise=1.0), np.random.default_rng(1)
    mixture = best_mixture(groups, 2.5)
    draws = 2.5 * rng.dirichlet(np.full(6, 0.4), 3000)
    least = min(groups.evaluate(draw).error for draw in draws)
    assert mixture.bound < least
    assert mixture.error <= least


@pytest.mark.parametrize("noise", [1e-3, 1.0, 300.0])
def test_exchanges_find_the_best_of_all_whole_cameras(noise: float) -> None:
    """Of the 84 sets of three of seven types."""
    groups = periodic([2, 3, 4, 5, 6, 7, 8], 60, noise)
    mixture = best_mixture(groups, 3.0)
    best, *_ = best_whole(groups, 3.0, mixture, 1)
    errors: list[float] = []
    for chosen in combinations_with_replacement(range(7), 3):
        errors.append(groups.evaluate(np.bincount(chosen, minlength=7).astype(np.float64)).error)
    assert best.error == pytest.approx(min(errors), rel=1e-12)
    assert min(errors) >= mixture.bound


CORRELATED = "prior.kind=exponential", "prior.correlation_length=25 mm"


def scene(*changes: str) -> Scene:
    return read(GALLERY / "photo.toml", ("target.shape=[119,119]", *changes))


def test_the_error_of_the_scene_s_camera_is_the_predicted_one_far_from_the_edges() -> None:
    described = scene("target.detail=3", "prior.kind=exponential", "prior.correlation_length=25 mm", "noise.variance=1")
    best = best_camera(described, [])
    assert best.own is not None
    counts, own = best.own
    assert counts == (1.0, 1.0, 1.0)
    trimmed = predict_scene(described, rays=False).trimmed_mse
    assert trimmed is not None
    assert own.error == pytest.approx(trimmed, rel=0.03)
    assert best.mixture.bound <= own.error


def test_fill_factors_beat_magnifications_at_low_noise_and_not_at_high() -> None:
    """As the table of docs/choose-a-camera.md has it: 0.21 for 0.87, and the same at a noise of ten grey levels."""
    world = "target.shape=[59,59]", "target.detail=3", "prior.kind=exponential", "prior.variance=5461"
    lenses = [Fraction(1, 3), Fraction(1, 4), Fraction(1, 5)]
    for noise, gain in (("1e-2", 3.9), ("100", 1.0)):
        changes = *world, "prior.correlation_length=25 mm", f"noise={{variance={noise}}}"
        errors: list[float] = []
        for table in ('fill_factors=[1,"1/3"]', "fill_factors=[1]"):
            described = scene(*changes, f"design={{{table}}}")
            errors.append(best_camera(described, candidates(described, lenses)).whole[0].error)
        assert errors[1] / errors[0] == pytest.approx(gain, rel=0.1)


def test_the_command_writes_the_best_cameras(here: Path, ommatid: Command) -> None:
    magnifications = 'design.magnifications="1/3,...,1/5"'
    assert ommatid("design", "tile19", "--set", magnifications).code == 2, "dots need a step"
    listed = "--set", 'design.magnifications="1/3,1/4,1/5"', "-o", "best"
    found = document(ommatid("design", "tile19", *listed, "--json"))
    assert found["cameras"][0]["arrays"] == [1, 1, 1]
    assert found["bound"] <= found["mixture"]["mse"] <= found["cameras"][0]["mse"] == found["own"]["mse"]
    assert {path.name for path in (here / "best").iterdir()} == {f"camera{number}.toml" for number in (1, 2, 3)}
    predicted = document(ommatid("predict", "best/camera1.toml", "--no-rays", "--json"))[0]
    assert predicted["mse"] == pytest.approx(found["cameras"][0]["with_edges"], rel=1e-9)
    lines = ommatid("design", "tile19", *listed).out
    assert "no such camera is better than" in lines
    assert "1/3 + 1/4 + 1/5" in lines


REFUSED: dict[str, tuple[str, ...]] = {
    "without noise": ("--set", "noise="),
    "lenses in their places": ("--set", 'camera.tolerance={position="1 um"}'),
    "see the same everywhere": ("--set", "camera.lens.I.distortion=[0.01,0]"),
    "the smallest array takes": ("--set", "design.readings=0.1"),
    "leave out --candidates": ("--candidates", "1/2", "-o", "x"),
    "at most 200 lens types": (
        "--set",
        f"design.fill_factors={[f'1/{n}' for n in range(2, 21)]}".replace("'", '"'),
        "--set",
        'design.magnifications="1/2,1/3,...,1/20"',
    ),
    "design.magnifications: expected magnifications": ("--set", 'design.magnifications="3"'),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_has_no_bound_is_refused_in_one_sentence(words: str, here: Path, ommatid: Command) -> None:
    ended = ommatid("design", "tile19", *REFUSED[words])
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
    described = read(GALLERY / "sensor.toml", (*dark, "target.detail=1", "camera.wavelength=none"))
    best = best_camera(described, [])
    trimmed = predict_scene(described, rays=False).trimmed_mse
    assert trimmed is not None
    assert best.mixture.bound <= best.whole[0].error <= 1.03 * trimmed


def test_candidates_have_the_optics_of_the_last_lens_type() -> None:
    """Of those that are ranked one by one, too."""
    described = scene("camera.lens.III.fill_factor=1/2")
    (candidate,) = candidates(described, [Fraction(1, 6)])
    ranked = with_lens(described, Fraction(1, 6)).camera.lens[-1]
    assert scene_of(described, [candidate]).camera.lens[0].fill_factor == ranked.fill_factor == (0.5, 0.5)


def test_types_that_no_camera_can_have_are_named_and_left_out() -> None:
    described = scene('design={apertures=["0.4 mm","9 mm"]}', "target.shape=[59,59]", "target.detail=3", *CORRELATED)
    best = best_camera(described, candidates(described, [Fraction(1, 3)]))
    assert [each.words for each in best.types] == ["1/3", "1/3 0.4 mm", "1/4", "1/5"]
    assert [words for words, _ in best.refused] == ["1/3 9 mm"]


def test_types_whose_detail_the_scene_does_not_know_are_left_out() -> None:
    """Behind pinholes every reading is a sum of whole pixels of f, and behind apertures none is."""
    described = scene('design={apertures=["0.4 mm"]}')
    best = best_camera(described, candidates(described, [Fraction(1, 3)]))
    assert [each.words for each in best.types] == ["1/3", "1/4", "1/5"]
    assert ["detail finer than f" in reason for _, reason in best.refused] == [True]


def test_a_camera_of_an_odd_ratio_has_readings_enough_for_itself() -> None:
    described = scene("camera.lens.I.magnification=3/5", "camera.lens.I.array=[2,2]", "camera.lens_pitch=2 mm")
    odd = described.model_copy(
        update={"camera": described.camera.model_copy(update={"lens": described.camera.lens[:1]})}
    )
    assert best_camera(odd, candidates(odd, [Fraction(3, 5)])).whole[0].counts == (1,)


def test_cameras_of_real_lenses_are_those_of_the_scene_s_target() -> None:
    small = read(GALLERY / "planoconvex.toml")
    with pytest.raises(InputError, match="lenses with surfaces in front of more than"):
        best_camera(small, [])
    assert len(scene_of(small, candidates(small, [Fraction(1, 3)])).camera.lens) == 1
