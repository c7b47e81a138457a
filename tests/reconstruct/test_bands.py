"""Groups of aliased waves: the precision of a world finer than f, by a matrix of reflected readings and by frames."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import fft, sparse

from ommatid.reconstruct.frame.bands import Bands
from ommatid.reconstruct.frame.readings import Readings
from ommatid.reconstruct.frame.variance_map import moments
from ommatid.reconstruct.prior import exponential_spectrum, reflecting_root
from ommatid.scenes.observation import repetition

Array = NDArray[np.float64]

SHAPE, DETAIL = (7, 8), 3


def reflected(size: int, length: int, odd: bool, detail: int = DETAIL) -> tuple[list[NDArray[np.intp]], Array]:
    """The world's pixels that each reading sees along an axis, reflected at the edges, and the root of its weight."""
    middles = np.arange(size) + 0.5 if odd else np.arange(size + 1.0)
    roots = np.ones(middles.size)
    if not odd:
        roots[[0, -1]] = 0.5**0.5  # a reading on an edge is its own mirror image
    end = size * detail
    seen = [(np.rint(middle * detail - length / 2).astype(int) + np.arange(length)) % (2 * end) for middle in middles]
    return [np.where(each < end, each, 2 * end - 1 - each) for each in seen], roots


def continued(kernel: Array, odd: bool, detail: int = DETAIL, edges: tuple[int, int, int] | None = None) -> Array:
    """Readings beyond the edges included, as a matrix; edges : an axis, the first reading along it, and their count."""
    axes = [reflected(size, length, odd, detail) for size, length in zip(SHAPE, kernel.shape, strict=True)]
    if edges is not None:
        axis, first, count = edges
        axes[axis] = [first + detail * n + np.arange(kernel.shape[axis]) for n in range(count)], np.ones(count)
    rows: list[Array] = []
    for down, root in zip(*axes[0], strict=True):
        for across, factor in zip(*axes[1], strict=True):
            row = np.zeros((SHAPE[0] * detail, SHAPE[1] * detail))
            inside = np.ix_((down >= 0) & (down < len(row)), (across >= 0) & (across < row.shape[1]))
            np.add.at(
                row, (down[inside[0].ravel()][:, None], across[inside[1].ravel()]), root * factor * kernel[inside]
            )
            rows.append(row.ravel())
    return np.array(rows)


def inverse(spectrum: Array) -> Array:
    """P0^-1 of a prior with this spectrum: (N, N)."""
    waves = np.kron(*(fft.dct(np.eye(size), 2, axis=0, norm="ortho") for size in spectrum.shape))
    return np.asarray(waves.T @ np.diag(1 / spectrum.ravel()) @ waves, dtype=np.float64)


@pytest.fixture(scope="module")
def camera() -> tuple[Bands, Array, list[Array]]:
    """Two lens types, with middles on pixels of f and between them; the inverse precision; and their readings."""
    rng = np.random.default_rng(0)
    spectrum = rng.random((SHAPE[0] * DETAIL, SHAPE[1] * DETAIL)) + 0.1
    kernels: list[Array] = []
    for side in (11, 12):
        kernel = rng.random((side, side))
        kernel = (kernel + kernel[::-1]) / 2
        kernels.append((kernel + kernel[:, ::-1]) / 2 / side)
    types = (Readings(kernels[0][None], (-1, 2), SHAPE), Readings(kernels[1][None], (0, 0), SHAPE))
    weights, readings = (2.0, 0.7), [continued(kernels[0], True), continued(kernels[1], False)]
    precision = inverse(spectrum)
    for each, weight in zip(readings, weights, strict=True):
        precision += weight * each.T @ each
    covariance = np.asarray(np.linalg.inv(precision), dtype=np.float64)
    return Bands(SHAPE, DETAIL, spectrum, types, weights), covariance, readings


def test_groups_invert_the_precision_of_reflected(
    camera: tuple[Bands, Array, list[Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    bands, covariance, _ = camera
    monkeypatch.setattr(Bands, "_edges", {})
    monkeypatch.setattr(Bands, "_corners", [])
    image = np.random.default_rng(1).normal(size=bands.spectrum.shape)
    np.testing.assert_allclose(bands.solve(image).ravel(), covariance @ image.ravel(), atol=1e-12)


@pytest.mark.parametrize("side", [3, 4])
def test_even_and_odd_kernels_invert_the_precision_of_readings(side: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the grid of f, with middles on its pixels and between them."""
    monkeypatch.setattr(Bands, "_edges", {})
    monkeypatch.setattr(Bands, "_corners", [])
    rng = np.random.default_rng(side)
    spectrum, kernel = rng.random(SHAPE) + 0.1, rng.random((side, side))
    upright, turned = kernel + kernel[::-1], kernel - kernel[::-1]
    kernels = np.array([part + sign * part[:, ::-1] for part in (upright, turned) for sign in (1, -1)])
    bands = Bands(SHAPE, 1, spectrum, (Readings(kernels, (0, 0), SHAPE),), (0.7,))
    precision = inverse(spectrum)
    for part in kernels:
        matrix = continued(part, side % 2 == 1, detail=1)
        precision += 0.7 * matrix.T @ matrix
    image = rng.normal(size=SHAPE)
    np.testing.assert_allclose(bands.solve(image).ravel(), np.linalg.solve(precision, image.ravel()), atol=1e-12)


def test_variances_far_from_the_edges_are_those_of_the_averages(camera: tuple[Bands, Array, list[Array]]) -> None:
    bands, covariance, readings = camera
    down, across = (repetition(size, DETAIL).T / DETAIL for size in SHAPE)
    average = sparse.kron(down, across).toarray()
    ratios, pixels = (1.0, 3.0), SHAPE[0] * SHAPE[1]
    gains = [weight * average @ covariance @ each.T for each, weight in zip(readings, bands.weights, strict=True)]
    parts = [np.square(gain).sum() / weight / pixels for gain, weight in zip(gains, bands.weights, strict=True)]
    posterior = float(np.trace(average @ covariance @ average.T)) / pixels
    expected = posterior, posterior - sum(parts), parts[0] + 3 * parts[1]
    np.testing.assert_allclose(bands.variances(1.0, ratios), expected, rtol=1e-10)


@pytest.mark.parametrize("axis", [0, 1])
def test_variances_between_two_edges(camera: tuple[Bands, Array, list[Array]], axis: int) -> None:
    """Along the lines readings continue, across them they end: by a matrix of these readings."""
    bands = camera[0]
    down, across = (repetition(size, DETAIL).T / DETAIL for size in SHAPE)
    pixels = sparse.kron(down, across).toarray()
    prior = inverse(bands.spectrum)
    level, ratios, parts = 1.7, (1.0, 3.0), list[Array]()
    for readings, weight, odd in zip(bands.types, bands.weights, (True, False), strict=True):
        matrix = continued(readings.kernels[0], odd, edges=(axis, readings.first[axis], readings.count[axis]))
        parts.append(level * weight * matrix.T @ matrix)
    columns = pixels @ np.linalg.inv(prior + parts[0] + parts[1])
    matrices = np.linalg.inv(prior + parts[0] + parts[1]), prior, ratios[0] * parts[0] + ratios[1] * parts[1]
    expected = [np.diagonal(pixels @ matrices[0] @ pixels.T)]
    expected += [np.einsum("pn,nm,pm->p", columns, each, columns) for each in matrices[1:]]
    lines = [each.reshape(SHAPE).mean(axis=1 - axis) for each in expected]
    np.testing.assert_allclose(bands.variances_across(axis, level, ratios), lines, rtol=1e-9)


def test_strips_mend_the_edges() -> None:
    """With them P K is near 1 although no reading lies beyond the edges: by its eigenvalues."""
    shape, detail = (16, 14), 2
    fine = shape[0] * detail, shape[1] * detail
    types = tuple(
        Readings(
            np.full((1, side * detail, side * detail), (side * detail) ** -2.0),
            (0, 0),
            (shape[0] - side + 1, shape[1] - side + 1),
        )
        for side in (2, 3, 4)
    )
    spectrum = 900 * exponential_spectrum(fine, 12.0)
    bands = Bands(shape, detail, spectrum, types, (10.0, 10.0, 10.0))
    root = reflecting_root(spectrum)
    precision = np.linalg.inv(root @ root.T)
    for each in types:
        matrix = each.matrix(fine, detail).toarray()
        precision += 10.0 * matrix.T @ matrix
    images = np.eye(fine[0] * fine[1]).reshape(-1, *fine)
    conditioned = np.array([bands.solve(image).ravel() for image in images])
    np.testing.assert_allclose(conditioned, conditioned.T, atol=1e-9 * np.abs(conditioned).max())
    values = np.linalg.eigvals(conditioned @ precision).real
    assert values.min() > 0.05
    assert values.max() < 4


def test_moments_are_products_with_the_covariance() -> None:
    spectrum = exponential_spectrum((12, 10), 4.0)
    root, rng = reflecting_root(spectrum), np.random.default_rng(2)
    matrix = np.asarray(rng.normal(size=(9, 120)) * (rng.random((9, 120)) < 0.3), dtype=np.float64)
    found = moments(sparse.csr_array(matrix), spectrum, 2)
    average = (sparse.kron(repetition(6, 2), repetition(5, 2)).T / 4).toarray()
    covariance = root @ root.T
    np.testing.assert_allclose(found.readings, matrix @ covariance @ matrix.T, atol=1e-10)
    np.testing.assert_allclose(found.both, average @ covariance @ matrix.T, atol=1e-10)
    np.testing.assert_allclose(found.pixels, np.diagonal(average @ covariance @ average.T), atol=1e-10)
