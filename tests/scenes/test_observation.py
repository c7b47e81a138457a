"""H by boxes, by entries and by kernels, applied without a matrix, against the stored one and closed forms."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ommatid.scenes.fitted.kernel_shapes import KernelShapes
from ommatid.scenes.fitted.kernels import LOSS, KernelFootprints, KernelPlaces, read_kernels, terms
from ommatid.scenes.observation import Entries, Observation
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_matrix

from ..examples import THREE, Lenses, camera, with_optics
from ..frames import assert_acts_as, assert_window, observed

CAMERAS: list[tuple[tuple[int, int], Lenses]] = [
    ((19, 19), THREE),
    ((70, 61), tuple((magnification, array, "fit") for magnification, array, _ in THREE)),
    ((13, 17), (("1/4", [2, 3], [2, 3]), ("1/5", [1, 2], [2, 3]))),
    ((12, 12), (("2/5", [2, 2], [3, 4]),)),
    ((11, 12), (("3/10", [2, 1], [2, 3]),)),
    ((7, 5), (("1", [1, 1], [7, 5]),)),
]


@pytest.mark.parametrize(("shape", "lenses"), CAMERAS)
def test_against_the_stored_matrix(shape: tuple[int, int], lenses: Lenses) -> None:
    """By boxes and by entries; in windows, all measurements are found that have no light beside them."""
    cam = camera(shape, lenses)
    matrix, stored = ideal_matrix(cam), Observation(shape, (Entries(ideal_matrix(cam), shape),))
    assert_acts_as(observed(cam), matrix, 1e-14)
    assert observed(cam).entries == matrix.nnz
    for corner in ((0, 0), (2, 3), (4, 5)) if min(shape) > 9 else ():
        window = [slice(start, start + min(size - start, 30) - 1) for start, size in zip(corner, shape, strict=True)]
        outside = np.ones(shape)
        outside[window[0], window[1]] = 0
        for h in (observed(cam), stored):
            assert (
                assert_window(h, matrix, window[0], window[1]) == np.flatnonzero(matrix @ outside.ravel() == 0).tolist()
            )


def test_windows_of_one_signature_have_the_same_h() -> None:
    cam = observed(camera((70, 61), CAMERAS[1][1]))
    first, second, edge = (slice(10, 40), slice(12, 42)), (slice(11, 41), slice(19, 49)), (slice(0, 30), slice(12, 42))
    assert cam.signature(*first) == cam.signature(*second)
    assert (cam.submatrix(*first) - cam.submatrix(*second)).nnz == 0
    assert cam.signature(*first) != cam.signature(*edge)


@pytest.mark.parametrize(
    ("lens", "expected"),
    [
        (("1/3", [3, 3], [2, 2]), True),
        (("1/3", [2, 3], [2, 2]), False),
        (("2/7", [3, 3], [2, 2]), False),
        (("1", [1, 1], [9, 9]), True),
    ],
)
def test_which_lens_types_are_shift_invariant(lens: Lenses, expected: bool) -> None:
    assert camera((19, 19), (lens,)).is_sliding == expected  # type: ignore[arg-type]


# --- another grid of the target


LENSES = (("1/3", [3, 3], [2, 3]), ("2/7", [2, 2], [2, 3]))


@pytest.mark.parametrize("optics", [{}, {"aperture": "0.8 mm"}])
@pytest.mark.parametrize("stored", [False, True])
def test_an_image_of_larger_pixels_reads_as_the_world_that_repeats_them(optics: dict[str, str], stored: bool) -> None:
    lenses = LENSES[:1] if optics else LENSES
    tables = {"calibration": {"method": "ideal"}, "target": {"detail": 2}}
    described, _ = with_optics(optics, {"lens_pitch": "1 mm"}, lenses, (11, 12), **tables)
    camera = Setup.from_scene(described).camera
    fine = observed(camera.world)
    if stored:
        fine = Observation(fine.shape, (Entries(fine.to_sparse(), fine.shape),))
    coarse, rng = fine.coarser(camera, 2), np.random.default_rng(0)
    image, readings = rng.normal(size=camera.shape), rng.normal(size=camera.measurements)
    world = np.kron(image, np.ones((2, 2))).astype(np.float64)
    np.testing.assert_allclose(coarse.forward(image), fine.forward(world), atol=1e-12)
    back = fine.adjoint(readings).reshape(11, 2, 12, 2).sum(axis=(1, 3)).ravel()
    np.testing.assert_allclose(coarse.adjoint(readings), back, atol=1e-12)
    window = slice(2, 9), slice(1, 10)
    np.testing.assert_array_equal(
        coarse.measurements_inside(*window), fine.measurements_inside(slice(4, 18), slice(2, 20))
    )
    rows, columns, numbers = slice(3, 8), slice(2, 9), np.array([0, 7, 30])
    whole = coarse.to_sparse()[numbers].toarray().reshape(-1, 11, 12)
    cut = coarse.rows_on(numbers, rows, columns).toarray().reshape(-1, 5, 7)
    np.testing.assert_allclose(cut, whole[:, rows, columns], atol=1e-15)  # of measurements that see more, too
    assert coarse.rows_on(numbers[:0], rows, columns).shape == (
        0,
        35,
    )  # of a window all of whose readings are saturated
    everything = np.sort(coarse.measurements_inside(slice(0, 11), slice(0, 12)))
    np.testing.assert_array_equal(everything, np.arange(camera.measurements))


# --- kernels


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
    part = random_kernels(margin)
    applied = Observation(CAMERA.shape, (part,))
    assert_acts_as(applied, part.to_sparse(), 1e-10)
    assert_window(applied, part.to_sparse(), slice(2, 17), slice(1, 19))


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


FINE: dict[str, tuple[Any, int, dict[str, Any]]] = {
    "the world of m x m one pixel apart": ((("1/3", [3, 3], [5, 5]),), 2, {}),
    "three times finer": ((("1/2", [2, 2], [5, 6]),), 3, {}),
    "fractional ratios of a world": ((("2/5", [2, 3], [4, 4]),), 2, {"focus": "900 mm"}),
    "other arrays and steps": ((("1/3", [2, 4], [4, 2]),), 1, {"focus": "900 mm"}),
    "a window of its own": ((("1/3", [2, 2], [4, 4]),), 1, {"sub_imager": [{"at": [0, 1], "window": [1, 2]}]}),
}


@pytest.mark.parametrize("kind", FINE)
def test_thin_lenses_have_kernels_on_every_grid(kind: str) -> None:
    lenses, detail, optics = FINE[kind]
    _, made = with_optics({"aperture": "2 mm", **optics}, {"lens_pitch": "4 mm"}, lenses, (19, 19))
    fine = replace(made, detail=detail).world
    assert_acts_as(observed(fine), ideal_matrix(fine), 1e-9 * ideal_matrix(fine).max())


def test_kernels_are_read_as_they_were_described() -> None:
    footprints = random_kernels(2)
    again = read_kernels(CAMERA, footprints.description, footprints.arrays)
    assert abs(again.to_sparse() - footprints.to_sparse()).max() == 0
    assert again.error_coefficients.shape == footprints.error_coefficients.shape
