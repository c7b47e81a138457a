"""The error of an estimate whose truth is known, and of the best single sub-image, the camera without reconstruction.

A sub-image is enlarged to f's grid by cubic convolution (bicubic; Keys 1981, a = -1/2) at the position, scale, rotation
and distortion of its view as designed. Beyond the edges of its view the values of the edge continue.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from scipy import ndimage, sparse

from ommatid.runtime.arrays import FloatArray
from ommatid.scenes.camera import Camera
from ommatid.scenes.constants import WHITE
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.optics.distortion import coefficients, distort
from ommatid.scenes.pose import corner_offset, pose_of
from ommatid.scenes.stack import Stack

TRIM = 2  # pixels of the border that trimmed errors leave out
SMALLEST_SSIM = 7  # pixels, the window of structural similarity
MOST_COMPARED = 2**16  # pixels of f on which the sub-images of a large frame are compared: every n-th row
SHARPNESS = -0.5  # Keys's a, with which quadratic pictures are interpolated exactly


@dataclass(frozen=True)
class MeasuredError:
    """An estimate against the truth; None where the image is too small or too large for the measure, or equal to it."""

    mse: float
    trimmed_mse: float | None
    psnr: float | None
    ssim: float | None


def trimmed_mean(values: FloatArray, shape: tuple[int, int]) -> float | None:
    """Return the mean of a map, (N,), without its border of 2 pixels; None where nothing is left."""
    inner = values.reshape(shape)[TRIM:-TRIM, TRIM:-TRIM]
    return float(inner.mean()) if inner.size else None


def measure_error(estimate: FloatArray, truth: FloatArray, shape: tuple[int, int]) -> MeasuredError:
    """Return mean squared error, PSNR (peak 255) and structural similarity of an estimate, (N,), to the truth, (N,)."""
    squared = (estimate - truth) ** 2
    mse = float(squared.mean())
    psnr = 10 * float(np.log10(WHITE**2 / mse)) if mse > 0 else None
    ssim: float | None = None
    if min(shape) >= SMALLEST_SSIM:
        from skimage import metrics

        similarity = cast(Any, metrics).structural_similarity
        # It holds ten maps of the image, which in float32 are half as large, and right to six digits.
        images = (np.asarray(image, dtype=np.float32).reshape(shape) for image in (truth, estimate))
        with np.errstate(over="ignore", invalid="ignore"):  # from values of 1e9 on
            value = float(similarity(*images, data_range=WHITE))
        ssim = value if np.isfinite(value) else None
    return MeasuredError(mse, trimmed_mean(squared, shape), psnr, ssim)


@dataclass(frozen=True)
class SingleSubImage:
    """A sub-image on f's grid, (rows, columns), and its error; None where PSNR or SSIM has no value."""

    name: str
    image: FloatArray
    mse: float
    psnr: float | None
    ssim: float | None


def best_single_sub_image(stack: Stack, truth: FloatArray | None) -> SingleSubImage | None:
    """Return the sub-image with the highest PSNR over the whole target; None without the truth.

    truth : f, (rows, columns) or (N,)
    In a frame of more than 65,536 pixels the sub-images are compared on evenly spaced rows, and the best is measured
    on all of them.
    """
    if truth is None:
        return None
    camera = stack.camera
    truth = truth.reshape(camera.shape)
    rows = np.arange(0.0, camera.rows, -(-truth.size // MOST_COMPARED))
    pairs = [(sub, image) for sub, image in zip(camera.sub_imagers, stack.images(), strict=True)]
    errors = [_squared_error(enlarged(camera, sub, image, rows), truth[rows.astype(int)]) for sub, image in pairs]
    sub, image = pairs[int(np.argmin(errors))]
    picture = enlarged(camera, sub, image, np.arange(float(camera.rows)))
    error = measure_error(picture.ravel(), truth.ravel(), camera.shape)
    return SingleSubImage(sub.name, picture, error.mse, error.psnr, error.ssim)


def enlarged(camera: Camera, sub: SubImager, image: FloatArray, rows: FloatArray) -> FloatArray:
    """Interpolate a sub-image, as bright as f, at the pixels of some rows of f: (rows, columns of f)."""
    known, columns = without_gaps(image) / float(sub.type.light), np.arange(float(camera.columns))
    if sub.rotation == 0 and sub.type.optics.distortion is None:
        down, _ = positions(camera, sub, rows, np.zeros(rows.size))
        _, across = positions(camera, sub, np.zeros(camera.columns), columns)
        return _weights(down, known.shape[0]) @ known @ _weights(across, known.shape[1]).T
    picture = np.empty((rows.size, camera.columns))
    for index, row in enumerate(rows):
        down, across = positions(camera, sub, np.full(camera.columns, row), columns)
        lines = _weights(down, known.shape[0]) @ known
        picture[index] = np.asarray(_weights(across, known.shape[1]).multiply(lines).sum(axis=1)).ravel()
    return picture


def positions(camera: Camera, sub: SubImager, rows: FloatArray, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return where the middles of pixels of f are imaged as designed: rows and columns of the sub-image, from 0."""
    pose = pose_of(sub)
    x = (camera.columns / 2 - columns - 0.5) * camera.target_pitch - pose.lens[0]
    y = (camera.rows / 2 - rows - 0.5) * camera.target_pitch - pose.lens[1]
    tangents = distort(x / sub.distance, y / sub.distance, *coefficients(sub), sub.distance / camera.half_diagonal)
    points = [-sub.depth * tangent - middle for tangent, middle in zip(tangents, pose.middle, strict=False)]
    u, v = pose.axes[:2].T @ np.stack(points)
    corner_u, corner_v = corner_offset(camera, sub)
    return (v - corner_v) / camera.pixel_pitch - 0.5, (u - corner_u) / camera.pixel_pitch - 0.5


def _weights(positions: FloatArray, size: int) -> sparse.csr_array:
    """Return the weights of `size` samples at positions between them: (positions, size), four in each row."""
    inside = np.clip(positions, 0, size - 1)
    first = np.floor(inside)
    indices = first[:, None] + np.arange(-1, 3)
    distance, a = np.abs(inside[:, None] - indices), SHARPNESS
    near = ((a + 2) * distance - (a + 3)) * distance**2 + 1
    far = a * (((distance - 5) * distance + 8) * distance - 4)
    values = np.where(distance <= 1, near, far)
    columns = np.clip(indices, 0, size - 1).astype(np.int64)
    rows = np.repeat(np.arange(positions.size), values.shape[1])
    return sparse.csr_array((values.ravel(), (rows, columns.ravel())), shape=(positions.size, size))


def without_gaps(image: FloatArray) -> FloatArray:
    """Return a sub-image whose dead pixels, NaN, have the values of the nearest others; zero where all are dead."""
    dead = ~np.isfinite(image)
    if not dead.any() or dead.all():
        return np.nan_to_num(image, nan=0.0)
    nearest: Any = ndimage.distance_transform_edt(dead, return_distances=False, return_indices=True)
    return image[tuple(nearest)]


def _squared_error(image: FloatArray, truth: FloatArray) -> float:
    return float(np.mean((image - truth) ** 2))
