"""Point-spread functions of waves: on grids and at points, Strehl ratio, modulation transfer, encircled energy.

Lengths are millimetres on the target, frequencies cycles per millimetre there. |U|^2 / wavelength^2 is the share of the
light per area: by Parseval's theorem it integrates to 1 over the whole plane, so that no sum over a grid that ends
somewhere enters the normalisation. The wave's nodes are irregular and the grid is regular: the non-uniform fast Fourier
transform of finufft (A. H. Barnett, J. Magland, L. af Klinteberg, SIAM J. Sci. Comput. 41, C479 (2019)) computes U on
the grid to the requested precision, from nodes that integrate up to the sharp edge of the pupil with high order. A fast
Fourier transform of a Cartesian pupil would have an edge of steps; a direct sum takes forty times longer.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, pi
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError

from .wavefront import Wavefront

PRECISION = 1e-9  # of U, relative to its largest value
CELLS = 4  # per wavelength times f-number; 2 would be enough for the frequencies of |U|^2
MOST_CELLS = 4096


@dataclass(frozen=True, eq=False)
class PointSpread:
    """A point-spread function on a square grid, rows along y and columns along x, both rising.

    values : (n, n) share of all light per cell;  cell : its width
    """

    values: FloatArray
    cell: float

    @property
    def offsets(self) -> FloatArray:
        """Offset of the middles of the cells from the centre, the same along both axes: (n,)."""
        count = len(self.values)
        return self.cell * (np.arange(count, dtype=np.float64) - count // 2)

    @property
    def inside(self) -> float:
        """Share of the light on the grid."""
        return float(self.values.sum())

    def transfer(self, frequencies: FloatArray) -> FloatArray:
        """Return the modulus of the optical transfer function at frequencies (k, 2) along x and y, 1 at 0: (k,).

        Exact but for the light beside the grid, which has no part in frequencies of more than some cycles a grid.
        """
        across, down = (np.exp(-2j * pi * np.outer(axis, self.offsets)) for axis in frequencies.T)
        moved = np.einsum("ky,yx,kx->k", down, self.values, across, optimize=True)
        return np.where((frequencies == 0).all(axis=1), 1.0, np.abs(moved))


def density(wave: Wavefront, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return the share of the light per area at points (x, y) from the wave's centre: (n,)."""
    import finufft  # pyright: ignore[reportMissingTypeStubs]

    transform: Any = finufft.nufft2d3  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    wavelength = _wavelength(wave)
    u, v = 2 * pi / wavelength * (wave.cosines - wave.middle[:, None])
    field = transform(u, v, _strength(wave), x, y, eps=PRECISION, isign=-1, nthreads=1)
    return np.asarray(np.square(np.abs(field)) / wavelength**2, dtype=np.float64)


def relative_intensity(wave: Wavefront, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return |U|^2 at points from the centre relative to the peak of the same pupil without aberrations: (n,)."""
    return density(wave, x, y) * (_wavelength(wave) / wave.amplitude.sum()) ** 2


def grid_of(wave: Wavefront) -> tuple[float, float]:
    """Return the width of a cell and half the width of a grid for a wave."""
    return wave.resolution / CELLS, wave.extent


def point_spread(wave: Wavefront, grid: tuple[float, float] | None = None) -> PointSpread:
    """Return the point-spread function on a grid, cut off beyond.

    grid : from `grid_of`, of this wave or of a wider one; None: its own
    The wave's nodes must serve the whole grid: beyond the `half` of `wavefront_of`, light appears that is not there.
    Raises InputError for a grid of more than MOST_CELLS cells along an axis.
    """
    cell, half = grid or grid_of(wave)
    count = 2 * ceil(half / cell) + 1
    if count > MOST_CELLS:
        raise InputError(
            f"the point-spread function is {2 * wave.spot_radius / wave.resolution:.3g} times as wide as its finest"
            ' detail, more than can be computed; use camera.wavelength = "none", as diffraction is negligible'
        )
    return PointSpread(_on_grid(wave, cell, count), cell)


def _on_grid(wave: Wavefront, cell: float, count: int) -> FloatArray:
    import finufft  # pyright: ignore[reportMissingTypeStubs]

    wavelength = _wavelength(wave)
    # The middle of the cosines turns the phase of U alone; without it the nodes lie within the period of the grid.
    x, y = 2 * pi * cell / wavelength * (wave.cosines - wave.middle[:, None])
    transform: Any = finufft.nufft2d1  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    # A grid that is finer by 1.25, not by 2, takes half the time at this precision.
    field = transform(y, x, _strength(wave), (count, count), eps=PRECISION, isign=-1, nthreads=1, upsampfac=1.25)
    return np.asarray(np.square(np.abs(field)) * (cell / wavelength) ** 2, dtype=np.float64)


def strehl_ratio(wave: Wavefront) -> float:
    """Return the largest |U|^2 relative to that of the same pupil without aberrations."""
    cell, count = wave.resolution / 8, 2 * ceil(8 * (1 + wave.spot_radius / wave.resolution)) + 1
    values = _on_grid(wave, cell, count)
    row, column = np.unravel_index(int(np.argmax(values)), values.shape)
    y, x = ((index - count // 2) * cell for index in (row, column))
    for _ in range(3):  # the maximum of a parabola through nine points, twice refined
        around = np.linspace(-1, 1, 3) * cell
        by, bx = np.meshgrid(y + around, x + around, indexing="ij")
        near = density(wave, bx.ravel(), by.ravel()).reshape(3, 3)
        y, x = y + cell * _vertex(near[:, 1]), x + cell * _vertex(near[1])
        cell /= 4
    return float(relative_intensity(wave, np.array([x]), np.array([y]))[0])


def _vertex(values: FloatArray) -> float:
    """Return where a parabola through three values, at -1, 0 and 1, is largest, within these."""
    bend = values[0] - 2 * values[1] + values[2]
    return float(np.clip((values[0] - values[2]) / (2 * bend), -1, 1)) if bend < 0 else 0.0


def _strength(wave: Wavefront) -> NDArray[np.complex128]:
    return np.asarray(wave.amplitude * np.exp(2j * pi / _wavelength(wave) * wave.path), dtype=np.complex128)


def _wavelength(wave: Wavefront) -> float:
    if wave.wavelength is None:
        raise ValueError("expected a wave with a wavelength, got rays alone")
    return wave.wavelength
