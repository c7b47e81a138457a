"""H by kernels: against closed forms, its own matrix, and the dot test."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ommatid.scenes.fitted.kernel_shapes import KernelShapes
from ommatid.scenes.fitted.kernels import LOSS, KernelFootprints, KernelPlaces, read_kernels, terms
from ommatid.scenes.observation import Observation
from ommatid.simulate.ideal import ideal_matrix
from tests.examples import camera, with_optics
from tests.frames import observed

CAMERA = camera()


def random_kernels(margin: int, degree: int = 2, index: int = 1) -> KernelFootprints:
    """Kernels without any symmetry."""
    places, rng = KernelPlaces(CAMERA, CAMERA.types[index], margin), np.random.default_rng(0)
    shape, count = (places.width, places.width), len(terms(degree))
    return KernelFootprints(
        places,
        degree,
        KernelShapes.dense(rng.normal(size=(3, *shape)), rng.normal(size=(2, *shape))),
        rng.normal(size=(3, count)),
        rng.normal(size=(4, 2, count)),
    )


@pytest.mark.parametrize("margin", [0, 3])
def test_a_box_is_the_kernel_of_an_ideal_pinhole(margin: int) -> None:
    expected = ideal_matrix(CAMERA)
    for lens_type, pixels in zip(CAMERA.types, CAMERA.type_slices(), strict=True):
        places = KernelPlaces(CAMERA, lens_type, margin)
        box = np.pad(np.full((1, int(lens_type.ratio), int(lens_type.ratio)), float(lens_type.ratio) ** -2), margin)
        box = box[margin : margin + 1]
        footprints = KernelFootprints(places, 0, KernelShapes.dense(box), np.ones((1, 1)), np.zeros((0, 0, 1)))
        assert abs(footprints.to_sparse() - expected[pixels]).max() < 1e-15


def test_the_field_is_measured_from_the_lens_s_axis() -> None:
    lens_type = CAMERA.types[0]
    places = KernelPlaces(CAMERA, lens_type, 2)
    field = places.positions(np.arange(lens_type.measurements)) * places.scale * CAMERA.target_pitch
    subs = [sub for sub in CAMERA.sub_imagers if sub.type == lens_type]
    rows, columns = lens_type.pixels
    for number, sub in enumerate(subs):
        for i, j in ((0, 0), (rows - 1, 1)):
            x, y = CAMERA.position(
                float(sub.window[0]) + float(lens_type.ratio) * (i + 0.5),
                float(sub.window[1]) + float(lens_type.ratio) * (j + 0.5),
            )
            down, across = field[(number * rows + i) * columns + j]
            assert (down, across) == pytest.approx((sub.lens[1] - y, sub.lens[0] - x))
    assert np.abs(field).max() == pytest.approx(places.scale * CAMERA.target_pitch)


def test_directions_of_the_error_are_what_changed_kernels_read() -> None:
    image = np.random.default_rng(4).normal(size=CAMERA.shape)
    for margin in (0, 2, 18):
        footprints = random_kernels(margin)
        directions = footprints.error_directions(image)
        assert directions.shape == (CAMERA.types[1].measurements, 4)
        for column, coefficients in zip(directions.T, footprints.error_coefficients, strict=True):
            changed = replace(
                footprints,
                shapes=KernelShapes.dense(footprints.shapes.error_kernels),
                coefficients=coefficients,
                error_coefficients=np.zeros((0, 0, coefficients.shape[1])),
            )
            assert column == pytest.approx(changed.to_sparse() @ image.ravel(), abs=1e-11)


@pytest.mark.parametrize("margin", [0, 2, 18])
def test_it_is_applied_as_its_entries_are(margin: int) -> None:
    """Forwards, backwards, on windows, and by the readings of one pixel."""
    part, rng = random_kernels(margin), np.random.default_rng(5)
    applied, matrix = Observation(CAMERA.shape, (part,)), part.to_sparse()
    image, readings = rng.normal(size=CAMERA.unknowns), rng.normal(size=part.measurements)
    np.testing.assert_allclose(applied.forward(image), matrix @ image, atol=1e-10)
    np.testing.assert_allclose(applied.adjoint(readings), matrix.T @ readings, atol=1e-10)
    rows, columns = slice(2, 17), slice(1, 19)
    inside = applied.measurements_inside(rows, columns)
    dense = matrix[inside].toarray().reshape(-1, *CAMERA.shape)
    window = dense[:, rows, columns]
    assert np.abs(dense).sum() == pytest.approx(np.abs(window).sum(), rel=1e-12)
    expected = window.reshape(inside.size, 15 * 18)
    np.testing.assert_allclose(applied.submatrix(rows, columns).toarray(), expected, atol=1e-14)


def test_every_kernel_of_the_mean_camera_is_the_mean_of_all() -> None:
    part = random_kernels(0)
    counts = [start.size for start in part.places.starts]
    every = part.to_sparse().toarray().reshape(-1, *CAMERA.shape), part.mean.to_sparse().toarray()
    found = part.places.lens_type.by_lines(np.arange(part.measurements, dtype=np.float64)).astype(int)
    wide, total, squares = part.places.width, np.zeros_like(part.mean_kernel), 0.0
    for row, column in np.ndindex(*counts):
        top, left = (start[number] for start, number in zip(part.places.starts, (row, column), strict=True))
        place = slice(top, top + wide), slice(left, left + wide)
        total += every[0][found[row, column]][place] / np.prod(counts)
        squares += np.square(every[0][found[row, column]][place] - part.mean_kernel).sum() / np.prod(counts)
        mean = every[1][found[row, column]].reshape(CAMERA.shape)[place]
        np.testing.assert_allclose(mean, part.mean_kernel, atol=1e-14)
    np.testing.assert_allclose(total, part.mean_kernel, atol=1e-14)
    assert part.variation == pytest.approx((squares / np.square(part.mean_kernel).sum()) ** 0.5, rel=1e-12)
    assert part.mean.variation == 0


def smooth_kernels(index: int) -> KernelFootprints:
    """Kernels that vary by a tenth over the field, then five times by a thousandth."""
    part, rng = random_kernels(2, index=index), np.random.default_rng(index)
    shapes = KernelShapes.dense(np.abs(rng.normal(size=(7, part.reach, part.reach))))
    coefficients = rng.normal(size=(7, 6)) * np.array([[0.0, 0.1, *[0.001] * 5]]).T
    coefficients[0, 0] = 1.0
    return replace(part, shapes=shapes, coefficients=coefficients, error_coefficients=part.error_coefficients[:0, :0])


def test_a_cheaper_h_leaves_out_what_hardly_varies_and_has_its_own_transpose() -> None:
    exact = smooth_kernels(1)
    cheaper = exact.cheaper
    assert cheaper.shapes.count == 2
    full, less = (Observation(CAMERA.shape, (each,)) for each in (exact, cheaper))
    off = (less.to_sparse() - full.to_sparse()).toarray()
    lost = np.square(off).sum(axis=1).mean() ** 0.5 / np.linalg.norm(exact.mean_kernel)
    assert 1e-4 < lost < LOSS
    rng = np.random.default_rng(3)
    image, readings = rng.normal(size=less.unknowns), rng.normal(size=less.measurements)
    np.testing.assert_allclose(less.forward(image), less.to_sparse() @ image, atol=1e-5 * np.abs(image).max())
    assert readings @ less.forward(image) == pytest.approx(less.adjoint(readings) @ image, rel=1e-5)
    alike = exact.mean, random_kernels(2)
    assert [each.cheaper for each in alike] == list(alike)


FINE = {
    "the world of m x m one pixel apart": ((("1/3", [3, 3], [5, 5]),), 2, {}),
    "three times finer": ((("1/2", [2, 2], [5, 6]),), 3, {}),
    "fractional ratios of a world": ((("2/5", [2, 3], [4, 4]),), 2, {"focus": "900 mm"}),
    "other arrays and steps": ((("1/3", [2, 4], [4, 2]),), 1, {"focus": "900 mm"}),
}


@pytest.mark.parametrize("kind", FINE)
def test_thin_lenses_have_kernels_on_every_grid(kind: str) -> None:
    lenses, detail, optics = FINE[kind]
    _, made = with_optics({"aperture": "2 mm", **optics}, {"lens_pitch": "4 mm"}, lenses, (19, 19))
    fine = replace(made, detail=detail).world
    observation, expected = observed(fine), ideal_matrix(fine)
    assert abs(observation.to_sparse() - expected).max() < 1e-9 * expected.max()
    image, readings = (np.random.default_rng(seed).normal(size=size) for seed, size in enumerate(expected.shape[::-1]))
    np.testing.assert_allclose(observation.forward(image), expected @ image, atol=1e-12 * fine.unknowns)
    assert readings @ observation.forward(image) == pytest.approx(observation.adjoint(readings) @ image, rel=1e-10)


def test_steered_lenses_have_kernels_of_their_own() -> None:
    table = {"aperture": "2 mm", "sub_imager": [{"at": [0, 1], "window": [1, 2]}]}
    _, made = with_optics(table, {"lens_pitch": "4 mm"}, (("1/3", [2, 2], [4, 4]),), (19, 19))
    expected = ideal_matrix(made)
    assert abs(observed(made).to_sparse() - expected).max() < 1e-9 * expected.max()


def test_kernels_are_read_as_they_were_described() -> None:
    footprints = random_kernels(2)
    again = read_kernels(CAMERA, footprints.description, footprints.arrays)
    assert abs(again.to_sparse() - footprints.to_sparse()).max() == 0
    assert again.error_coefficients.shape == footprints.error_coefficients.shape
