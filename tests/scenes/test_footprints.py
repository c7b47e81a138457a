"""H of distorted and misaligned pinholes against closed forms, polygons, points and the boxes of ideal pinholes."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.errors import InputError
from ommatid.scenes.camera import Camera
from ommatid.scenes.lens_type import LensOptics, SubImager
from ommatid.scenes.optics.boxes import overlap
from ommatid.scenes.optics.distortion import distort, undistort
from ommatid.scenes.optics.footprints import matrix, sub_matrix
from ommatid.scenes.pose import Misalignment, Pose, corner_offset, pose_of, poses

from ..examples import THREE, Lenses, camera

Vector = NDArray[np.float64]

GAUSS = np.polynomial.legendre.leggauss(10)
NUDGED = Misalignment(position=(2e-3, -1e-3), tilt=(0.04, -0.03), rotation=0.05, focal_length=0.02)
TWO_FIFTHS: Lenses = (("2/5", [2, 3], "fit"), ("5/7", [1, 2], "fit"))


def distorted(ideal: Camera, k1: float, k2: float) -> Camera:
    optics = LensOptics(distortion=(k1, k2))
    return replace(ideal, types=tuple(replace(lens_type, optics=optics) for lens_type in ideal.types))


def image_on_patch(pose: Pose, tangents: Vector) -> Vector:
    """(u, v) where chief rays of image tangents, (n, 2), meet the plane of the patch: (n, 2)."""
    rays = np.column_stack([tangents, np.ones(len(tangents))])
    normal = np.cross(pose.axes[:, 0], pose.axes[:, 1])
    points = rays * (normal @ pose.middle / (rays @ normal))[:, None]
    return (points - pose.middle) @ pose.axes


def image_tangents(cam: Camera, sub: SubImager, pose: Pose, row: Vector, column: Vector) -> Vector:
    """Image tangents of points of the target, in pixels of f: (n, 2)."""
    x, y = cam.position(row, column)  # pyright: ignore[reportArgumentType]
    k = sub.type.optics.distortion or (0.0, 0.0)
    tangents = (x - pose.lens[0]) / cam.distance, (y - pose.lens[1]) / cam.distance
    return np.column_stack(distort(*tangents, *k, cam.distance / cam.half_diagonal))


@pytest.mark.parametrize(("shape", "lenses"), [((19, 19), THREE), ((23, 17), TWO_FIFTHS)])
@pytest.mark.parametrize("optics", [LensOptics(), LensOptics(distortion=(0.0, 0.0))])
def test_undistorted_it_is_a_product_of_intervals(shape: tuple[int, int], lenses: Lenses, optics: LensOptics) -> None:
    ideal = camera(shape, lenses)
    cam = replace(ideal, types=tuple(replace(lens_type, optics=optics) for lens_type in ideal.types))
    for sub, pixels in zip(cam.sub_imagers, cam.slices(), strict=True):
        lens_type = sub.type
        down = overlap(lens_type.ratio, lens_type.pixels[0], sub.window[0], cam.rows)
        across = overlap(lens_type.ratio, lens_type.pixels[1], sub.window[1], cam.columns)
        found = sub_matrix(cam, sub, pose_of(sub))
        assert found.shape == (pixels.stop - pixels.start, cam.unknowns)
        assert abs(found - sparse.kron(down, across)).max() < 1e-13
        assert found.nnz == down.nnz * across.nnz


def test_a_moved_and_lengthened_pinhole_sees_moved_and_smaller_boxes() -> None:
    """The lens moves by p: the point of the target behind a sensor point moves by p (1 + Z/d)."""
    cam = camera(lenses=THREE[:1])
    misalignment = Misalignment(position=(3e-3, -2e-3), focal_length=0.03)
    for sub in cam.sub_imagers:
        found = sub_matrix(cam, sub, pose_of(sub, misalignment)).toarray()
        depth = sub.depth * 1.03
        axes: list[Vector] = []
        for axis, size in ((1, cam.rows), (0, cam.columns)):
            lens = sub.lens[axis] + misalignment.position[axis]
            count = sub.type.pixels[1 - axis]
            sides = sub.patch[axis] + (np.arange(count + 1) - count / 2) * cam.pixel_pitch
            seen = size / 2 - (lens - (sides - lens) * cam.distance / depth) / cam.target_pitch
            cells = np.arange(size)
            shared = np.minimum(seen[1:, None], cells + 1) - np.maximum(seen[:-1, None], cells)
            axes.append(np.maximum(shared, 0) / np.diff(seen)[:, None])
        np.testing.assert_allclose(found, np.kron(*axes), rtol=0, atol=1e-13)


@pytest.mark.parametrize("k", [(0.0, 0.0), (-0.2, 0.05)])
def test_a_quarter_turn_of_the_patch_rotates_its_pixels(k: tuple[float, float]) -> None:
    cam = distorted(camera(lenses=THREE[1:2]), *k)
    for sub in cam.sub_imagers[::6]:
        n = sub.type.pixels[0]
        straight = sub_matrix(cam, sub, pose_of(sub)).toarray().reshape(n, n, -1)
        turned = sub_matrix(cam, sub, pose_of(sub, Misalignment(rotation=np.pi / 2))).toarray().reshape(n, n, -1)
        np.testing.assert_allclose(turned, straight[:, ::-1].transpose(1, 0, 2), rtol=0, atol=1e-13)


def test_mirrored_cameras_have_mirrored_matrices() -> None:
    cam = distorted(camera(lenses=THREE[2:]), 0.2, -0.05)
    h = matrix(cam, poses(cam)).toarray().reshape(4, 4, 4, 4, 19, 19)
    np.testing.assert_allclose(h, h[::-1, :, ::-1, :, ::-1, :], rtol=0, atol=1e-13)
    np.testing.assert_allclose(h, h.transpose(1, 0, 3, 2, 5, 4), rtol=0, atol=1e-13)


def clipped(polygon: Vector, axis: int, side: float, sign: int) -> Vector:
    """The part of a polygon, (n, 2), where sign (coordinate - side) > 0 (Sutherland and Hodgman)."""
    kept: list[Vector] = []
    for one, two in pairwise([*polygon, polygon[0]]) if len(polygon) else ():
        a, b = sign * (one[axis] - side), sign * (two[axis] - side)
        if a > 0:
            kept.append(one)
        if (a > 0) != (b > 0):
            kept.append(one + (two - one) * a / (a - b))
    return np.array(kept)


def shoelace(polygon: Vector) -> float:
    if len(polygon) < 3:
        return 0.0
    x, y = polygon.T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def test_a_misaligned_pinhole_against_clipped_polygons() -> None:
    """Without distortion a texel's image is a quadrilateral, on a tilted patch too."""
    cam = camera((9, 9), (("1/3", [1, 1], [3, 3]),))
    sub = cam.sub_imagers[0]
    pose = pose_of(sub, replace(NUDGED, tilt=(0.3, -0.2), rotation=0.4))
    found = sub_matrix(cam, sub, pose).toarray()
    corner, row, column = np.array(corner_offset(cam, sub)), *np.divmod(np.arange(100), 10)
    nodes = image_on_patch(pose, image_tangents(cam, sub, pose, row * 1.0, column * 1.0)) - corner
    nodes = (nodes / cam.pixel_pitch).reshape(10, 10, 2)
    expected = np.zeros((3, 3, 9, 9))
    for r, c in np.ndindex(9, 9):
        quad = nodes[[r, r, r + 1, r + 1], [c, c + 1, c + 1, c]]
        for i, j in np.ndindex(3, 3):
            inside = quad
            for axis, side, sign in ((0, j, 1), (0, j + 1, -1), (1, i, 1), (1, i + 1, -1)):
                inside = clipped(inside, axis, side, sign)
            expected[i, j, r, c] = shoelace(inside)
    np.testing.assert_allclose(found, expected.reshape(9, 81), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("lenses", "k", "misalignment"),
    [
        (THREE[:1], (0.3, 0.2), Misalignment()),
        (THREE[:1], (-0.2, 0.1), NUDGED),
        ((("1/2", [1, 1], "fit"),), (0.8, 0.5), NUDGED),  # one texel's image across many pixels
    ],
)
def test_texels_columns_are_areas_of_images(lenses: Lenses, k: tuple[float, float], misalignment: Misalignment) -> None:
    """Conservation of area, by quadrature over the texel of the patch's area per area of the target."""
    cam = distorted(camera(lenses=lenses), *k)
    for sub in cam.sub_imagers[::4]:
        pose = pose_of(sub, misalignment)
        columns = np.asarray(sub_matrix(cam, sub, pose).sum(axis=0)).reshape(cam.shape)
        grid = np.arange(cam.rows * 10)
        at = grid // 10 + (GAUSS[0][grid % 10] + 1) / 2
        row, column = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
        tangents = image_tangents(cam, sub, pose, row, column)
        x, y = cam.position(row, column)  # pyright: ignore[reportArgumentType]
        square = ((x - pose.lens[0]) ** 2 + (y - pose.lens[1]) ** 2) / cam.half_diagonal**2
        bent = (1 + k[0] * square + k[1] * square**2) * (1 + 3 * k[0] * square + 5 * k[1] * square**2)
        rays = np.column_stack([tangents, np.ones(row.size)])
        normal = np.cross(pose.axes[:, 0], pose.axes[:, 1])
        # Area per solid angle is |s|^3 / (n s) on a patch, and (1 + t^2)^(3/2) on the plane of tangents.
        patch = (normal @ pose.middle) ** 2 / np.abs(rays @ normal) ** 3
        density = (patch * bent * (cam.target_pitch / cam.distance / cam.pixel_pitch) ** 2).reshape(19, 10, 19, 10)
        area = np.einsum("ranb,a,b->rn", density, GAUSS[1] / 2, GAUSS[1] / 2)
        uv = np.abs(image_on_patch(pose, tangents)).reshape(19, 10, 19, 10, 2).max(axis=(1, 3))
        inside = (uv < np.array(sub.type.pixels[::-1]) / 2 * cam.pixel_pitch - 0.5 * cam.pixel_pitch).all(axis=2)
        assert inside.sum() >= 9
        np.testing.assert_allclose(columns[inside], area[inside], rtol=1e-7 if any(k) else 1e-12)


def test_a_steep_patch_has_valid_shares() -> None:
    """Part of the target is behind the plane of the patch, and is imaged nowhere on it."""
    cam = camera((5, 5), (("1/2", [1, 1], [2, 2]),))
    cam = replace(cam, distance=5.0, pixel_pitch=1.0)
    sub = cam.sub_imagers[0]
    h = sub_matrix(cam, sub, pose_of(sub, Misalignment(tilt=(1.2, 0.3))))
    assert h.data.min() > 0
    assert np.asarray(h.sum(axis=1)).max() <= 1 + 1e-12


@pytest.mark.parametrize("k", [(-0.34, 0.0), (0.0, -0.21), (-1.0, 0.4)])
def test_an_image_that_folds_is_refused(k: tuple[float, float]) -> None:
    cam = distorted(camera(lenses=THREE[:1]), *k)
    with pytest.raises(InputError, match=r"camera\.lens\.A\.distortion: .* folds .* the image of the target"):
        matrix(cam, poses(cam))


def test_a_distortion_that_cannot_be_traced_is_refused() -> None:
    cam = distorted(camera(lenses=THREE[:1]), 40.0, 90.0)
    with pytest.raises(InputError, match=r"camera\.lens\.A\.distortion: \[40, 90\] bends .* follow them back"):
        matrix(cam, poses(cam))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_undistort_inverts_distort(dtype: type) -> None:
    """To rounding: that of the image tangent, divided by the derivative."""
    radius = np.linspace(0, 1.5, 151)
    for k1 in np.linspace(-0.3, 0.3, 13):
        for k2 in np.linspace(-0.3, 0.3, 13):
            slope = 1 + 3 * k1 * radius**2 + 5 * k2 * radius**4
            folded = np.flatnonzero(slope < 0.05)
            last = folded[0] if folded.size else radius.size
            x, y = 0.06 * radius[:last], 0.08 * radius[:last]
            image = (tangent.astype(dtype) for tangent in distort(x, y, k1, k2, 10.0))
            numbers = (dtype(number) for number in (k1, k2, 10.0, radius[last - 1]))
            back = undistort(*image, *numbers)
            error = np.hypot(back[0] - x, back[1] - y) * slope[:last]
            assert back[0].dtype == dtype
            assert error.max() < 0.1 * 20 * np.finfo(dtype).eps


def test_undistort_maps_points_beyond_its_limit_beyond_it() -> None:
    x = np.linspace(0, 5, 101)
    found = undistort(x, 0 * x, -0.3, 0.0, 1.0, 1.0)[0]  # folds at r = 1.05, an image of 0.70
    assert (np.diff(found) > 0).all()
    assert (found[x > 0.7] > 1).all()
    assert (found[x < 0.7] < 1).all()
