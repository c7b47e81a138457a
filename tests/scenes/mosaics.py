"""Mosaics of a small camera, as its flat sensor records them."""

from __future__ import annotations

from math import floor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from skimage import io

from ommatid.scenes.camera import Camera
from ommatid.scenes.formats import exr
from ommatid.scenes.formats.picture import write_truth
from ommatid.simulate.ideal import ideal_matrix

Array = NDArray[Any]
SCENE = """
[target]
image = "photo:camera"
shape = [12, 14]
pixel_pitch = "1 mm"
distance = "1 m"

[camera]
pixel_pitch = "6 um"
lens_pitch = "0.064 mm"

[[camera.lens]]
name = "I"
magnification = "1/2"
array = [2, 2]
pixels = "fit"

[[camera.lens]]
name = "II"
magnification = "1/3"
array = [3, 3]
pixels = [3, 4]
"""
SHAPE = (42, 62)
NOISE = "\n[noise]\nvariance = 0.25\n"
SENSOR = """
[sensor]
illuminance = "500 lux"
exposure = "10 ms"
frames = 50
"""


def as_mosaic(camera: Camera, values: Array, shape: tuple[int, int] = SHAPE, outside: float = 0.0) -> Array:
    """The mosaic of measurements, by the positions of sensor pixels; `outside` elsewhere.

    The mosaic is seen from behind the camera: right is -x, down is -y, and its middle is x = y = 0. Sub-images are
    rotated by 180 degrees, since a pixel of an upright sub-image looks along (-x, -y).
    """
    mosaic = np.full(shape, outside)
    pitch = camera.pixel_pitch
    for sub, pixels in zip(camera.sub_imagers, camera.slices(), strict=True):
        rows, columns = sub.type.pixels
        for row in range(rows):
            for column in range(columns):
                x = sub.patch[0] + (column + 0.5 - columns / 2) * pitch
                y = sub.patch[1] + (row + 0.5 - rows / 2) * pitch
                position = floor(shape[0] / 2 - y / pitch), floor(shape[1] / 2 - x / pitch)
                mosaic[position] = values[pixels].reshape(rows, columns)[row, column]
    return mosaic


def save(path: Path, pixels: Array) -> Path:
    if path.suffix == ".npy":
        np.save(path, pixels)
    elif path.suffix == ".exr":
        write_truth(path, pixels)
    else:
        save_image: Any = io.imsave  # pyright: ignore[reportUnknownVariableType]
        save_image(path, pixels, check_contrast=False)
    return path


def recorded_image(camera: Camera, seed: int = 1) -> tuple[Array, Array]:
    """An image drawn from the prior, and the ideal camera's measurements of it with noise of variance 0.25."""
    rng = np.random.default_rng(seed)
    image = rng.normal(127.5, 5461.25**0.5, camera.unknowns)
    return image, ideal_matrix(camera) @ image + rng.normal(0, 0.5, camera.measurements)


def assert_error_as_expected(image: Array, estimated: Path, predicted: float) -> None:
    """Assert that the mean squared error is the predicted one, to three standard errors of independent pixels, doubled.

    Errors of pixels are correlated, which the doubling allows for.
    """
    channels = exr.read(estimated)[0].channels
    error = channels["estimate"].ravel() - image
    variance = channels["variance"].ravel().astype(np.float64)
    standard_error = 2 * np.sqrt(2 * np.sum(variance**2)) / variance.size
    assert variance.mean() == pytest.approx(predicted, rel=1e-5)
    assert abs(np.mean(error**2) - predicted) < 3 * standard_error
    assert predicted < 5461.25 / 2
