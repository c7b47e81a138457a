"""The lens type that would reduce the expected error most, of a few magnifications that the camera does not have.

Measurements of the type, H2 with noise variance s^2, change the posterior covariance C of a window to
(C^-1 + H2^T H2 / s^2)^-1 (Wood et al. 2005, Eq. 5 and section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ommatid.runtime.errors import InputError
from ommatid.runtime.processors import one_thread
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.boxes import designed_box
from ommatid.scenes.scene import Scene

from ..design import with_lens
from .averaging_kernel import ErrorWindow, posterior_covariance

CANDIDATES = tuple(Fraction(1, number) for number in range(2, 9))
TRIED = 2  # of the candidates, the largest first: they see the finest detail


@dataclass(frozen=True)
class AnotherType:
    """Magnification on the pixel grid, number of added measurements, and the error with them over that without."""

    magnification: Fraction
    measurements: int
    ratio: float


@one_thread()
def best_other_type(scene: Scene, window: ErrorWindow) -> AnotherType | None:
    """Return the type of least expected error, None where none fits the target or the closed form does not serve.

    The lenses are ideal pinholes, and their noise is the mean of the recorded one.
    """
    present = derive(scene)
    if not present.has_box_footprints or present.has_detail:
        return None
    used = {lens_type.ratio for lens_type in present.types}
    tried: list[AnotherType] = []
    for magnification in CANDIDATES:
        if 1 / magnification in used or len(tried) == TRIED:
            continue
        try:
            camera = derive(with_lens(scene, magnification))
        except InputError:  # it does not fit the target
            continue
        added = camera.on_grids.types[-1]
        footprints = designed_box(camera.shape, added).submatrix(window.rows, window.columns)
        information = window.information + np.asarray((footprints.T @ footprints).toarray()) / window.noise
        before = window.covariance.diagonal()
        after = posterior_covariance(window.root, information).diagonal()
        pixels = np.arange(before.size) if window.is_whole else window.centre
        tried.append(AnotherType(magnification, added.measurements, float(after[pixels].sum() / before[pixels].sum())))
    return min(tried, key=lambda other: other.ratio, default=None)
