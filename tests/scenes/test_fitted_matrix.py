"""H by few numbers against exact areas of overlap, and the errors of the numbers against differences of H."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from ommatid.scenes import observation as observations
from ommatid.scenes.camera import Camera
from ommatid.scenes.fitted.fitted_matrix import FittedMatrix, Views, designed_views
from ommatid.scenes.fitted.view import (
    COLUMN,
    COUNT,
    K1,
    MAGNIFICATION,
    ROTATION,
    ROW,
    designed,
    displacements,
    entries,
    misaligned,
    misalignment,
    real_box,
)
from ommatid.scenes.optics import boxes
from ommatid.scenes.optics.footprints import sub_matrix
from ommatid.scenes.pose import Misalignment, pose_of

from ..examples import camera, not_none
from ..frames import assert_acts_as, assert_window

ODD = (("1/3", [2, 2], [4, 5]), ("2/5", [2, 1], [3, 4]))
lengths = st.floats(-0.005, 0.005)


def with_numbers(cam: Camera, numbers: np.ndarray, own: np.ndarray | None = None) -> FittedMatrix:
    """Return H with the same numbers, and errors of them, for every sub-imager."""
    views: dict[str, Views] = {}
    for lens in cam.types:
        subs = [sub for sub in cam.sub_imagers if sub.type == lens]
        moved = designed_views(subs) + numbers
        factors = np.zeros((lens.count, COUNT, 0)) if own is None else np.tile(own, (lens.count, 1, 1))
        structure = tuple("own" if number else "designed" for number in numbers)
        explained = np.ones(lens.count, dtype=np.bool_)
        views[lens.name] = Views(moved, explained, factors, np.zeros((lens.count, COUNT, 0)), structure)
    return FittedMatrix(cam, views)


@settings(max_examples=10, deadline=None)
@given(lengths, lengths, st.floats(-0.1, 0.1), st.floats(-0.05, 0.05))
def test_the_numbers_of_a_misaligned_pinhole_give_its_exact_h(x: float, y: float, turn: float, longer: float) -> None:
    wrong, pinholes = (
        Misalignment((x, y), rotation=turn, focal_length=longer),
        camera((9, 9), (("1/3", [2, 1], [2, 2]),)),
    )
    for sub in pinholes.sub_imagers:
        numbers = misaligned(pinholes, sub, wrong)
        again = misalignment(pinholes, sub, numbers)
        np.testing.assert_allclose([*again.position, again.focal_length], [x, y, longer], atol=1e-12)
        assert abs(entries(pinholes, sub, numbers) - sub_matrix(pinholes, sub, pose_of(sub, wrong))).max() < 1e-10


@settings(max_examples=20, deadline=None)
@given(st.floats(-9, 9), st.floats(-9, 9), st.floats(-0.1, 0.1))
def test_displaced_boxes_are_exact_areas(row: float, column: float, magnification: float) -> None:
    cam = camera((17, 19), ODD)
    for sub in cam.sub_imagers:
        numbers = designed(sub)
        numbers[[ROW, COLUMN, MAGNIFICATION]] = row, column, magnification
        box = real_box(cam.shape, sub, numbers)
        product = sparse.kron(box.down.shares, box.across.shares, format="csr")
        assert abs(sparse.csr_array(product) - entries(cam, sub, numbers)).max() < 1e-9


def test_it_is_applied_as_its_entries_are_by_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    cam, numbers = camera((70, 61), ODD), np.array([0.3, -1.7, 0.01, 0.0, 0.0])
    fitted = with_numbers(cam, numbers)
    observation, rng, found = not_none(fitted.observation), np.random.default_rng(0), set[bytes]()
    assert (fitted.is_as_designed, fitted.is_nearly_designed) == (False, False)
    assert with_numbers(cam, numbers / 50).is_nearly_designed
    assert_acts_as(observation, fitted.to_sparse())
    assert assert_window(observation, fitted.to_sparse(), slice(5, 40), slice(3, 30))
    f, g = rng.normal(size=cam.unknowns), rng.normal(size=cam.measurements)
    monkeypatch.setattr(boxes, "SLOW", 0)
    for count in (1, 2, 5):
        monkeypatch.setattr(observations, "processors", lambda count=count: count)
        found.add(observation.forward(f).tobytes() + observation.adjoint(g).tobytes())
    assert len(found) == 1


@pytest.mark.parametrize("number", range(COUNT))
def test_displacements_are_those_of_exact_footprints(number: int) -> None:
    """By the centroids of pixels of f, which move as those of areas do but for 1 % of what k1 does at the corner."""
    cam = replace(camera((41, 37), (("1/3", [2, 2], [5, 5]),)), lens_pitch=9.0)
    for sub in cam.sub_imagers:
        step = 1e-5 * (np.arange(COUNT) == number)
        sides = [entries(cam, sub, designed(sub) + sign * step) for sign in (1, -1)]
        row, column = np.divmod(np.arange(cam.unknowns), cam.columns)
        index = np.indices(sub.type.pixels).reshape(2, -1).astype(float)
        for at, moves in zip((row, column), displacements(cam, sub, (index[0], index[1])), strict=True):
            ahead, behind = (np.asarray(side @ at) / side.sum(axis=1) for side in sides)
            np.testing.assert_allclose((ahead - behind) / 2e-5, moves[:, number], atol=0.01, rtol=2e-3)


@pytest.mark.parametrize(
    ("shift", "rotation"), [(0.0, 0.0), (0.3, 0.0), (0.3, 0.01)], ids=["whole pixels", "beside the target", "rotated"]
)
def test_the_errors_of_numbers_are_differences_of_h(shift: float, rotation: float) -> None:
    """Of H as it is within pixels of f, and where views of outer sub-imagers leave the target."""
    cam, rng = camera((17, 17), (("1/3", [2, 2], [5, 5]),)), np.random.default_rng(1)
    numbers = np.array([shift, -shift, 0.0, rotation, 0.0])
    own = np.diag([1.0, 1.0, 0.0, 0.0, 0.0])[:, :2]
    fitted, f = with_numbers(cam, numbers, own), rng.normal(127, 50, cam.unknowns)
    assert (fitted.to_sparse().sum(axis=1).min() < 0.95) == (shift > 0)
    errors = fitted.errors(f)
    directions = errors.matrix.toarray()
    assert directions.shape == (cam.measurements, 8)
    for axis in (ROW, COLUMN):
        step = 1e-4 * (np.arange(COUNT) == axis)
        ahead, behind = (with_numbers(cam, numbers + sign * step).to_sparse() @ f for sign in (1, -1))
        expected = (ahead - behind) / 2e-4
        for sub, place in zip(range(4), cam.slices(), strict=True):
            found = directions[place, 2 * sub + axis]
            np.testing.assert_allclose(found, expected[place], atol=0.3 if rotation else 1e-7)
            assert not np.delete(directions[:, 2 * sub + axis], np.r_[place]).any()
    np.testing.assert_allclose(errors.variance, np.square(directions).sum(axis=1), rtol=1e-12)
    draws = errors.draws(np.random.default_rng(2), 400)
    ratio = np.square(draws).mean(axis=0).sum() / np.square(directions).sum()
    assert abs(ratio - 1) < 4 * (2 / (400 * 8)) ** 0.5


def test_rotation_and_distortion_need_entries() -> None:
    cam = camera((23, 23), ODD)
    for number in (ROTATION, K1):
        fitted = with_numbers(cam, 1e-3 * (np.arange(COUNT) == number))
        assert fitted.observation is None
        sub, place = cam.sub_imagers[1], cam.slices()[1]
        exact = entries(cam, sub, designed(sub) + 1e-3 * (np.arange(COUNT) == number))
        assert abs(fitted.to_sparse()[place] - exact).max() == 0


def number(index: int, value: float) -> Callable[[dict[str, Any]], object]:
    """Change one number of the first sub-imager."""

    def change(arrays: dict[str, Any]) -> None:
        arrays["v.numbers"] = arrays["v.numbers"].copy()
        arrays["v.numbers"][0, index] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        *(number(2, value) for value in (-1.0, -2.0, -0.9999999, 1e18)),
        *(number(index, value) for index in range(COUNT) for value in (np.nan, -np.inf, 1e300)),
        *(lambda arrays, key=key: arrays.update({key: arrays[key][..., 0]}) for key in ("v.own", "v.shared")),
        *(lambda arrays, key=key: arrays.update({key: arrays[key] + 1e200}) for key in ("v.own", "v.shared")),
        lambda arrays: arrays.update({"v.structure": np.array(["free"] * COUNT)}),
    ],
)
def test_views_that_no_camera_has_are_refused(change: Callable[[dict[str, Any]], object]) -> None:
    errors = np.full((3, COUNT, 1), 1e-3)
    arrays: dict[str, Any] = {"v.numbers": np.zeros((3, COUNT)), "v.explained": np.ones(3, bool)}
    arrays |= {"v.own": errors, "v.shared": errors, "v.structure": np.array(("own",) * COUNT)}
    assert Views.from_arrays(arrays, "v").structure == ("own",) * COUNT
    change(arrays)
    with pytest.raises(ValueError, match="views v "):
        Views.from_arrays(arrays, "v")
