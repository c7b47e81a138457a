"""What would reduce the error of a run, ranked by what it would bring, as far as its own numbers tell.

The parts of the predicted error (Eq. 5) are those of this run's estimator. A noise of `factor` times the variance
changes its part by that factor with the same estimator, and the one that is optimal for the smaller noise is better:
the error stated is the largest to expect. More samples are the prediction of the run itself. Another lens type has
measurements H2 with noise variance s^2, which change the posterior covariance C of a window to
(C^-1 + H2^T H2 / s^2)^-1 (Wood et al. 2005, Eq. 5 and section 6).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.output.verdict_words import LEAST_GAIN, NextStep, steps_of
from ommatid.runtime.errors import InputError
from ommatid.runtime.machine import one_thread
from ommatid.scenes.camera import derive
from ommatid.scenes.optics.boxes import designed_box
from ommatid.scenes.scene import Scene

from .averaging_kernel import ErrorWindow, posterior_covariance
from .design import with_lens


def next_steps(report: RunReport, other: AnotherType | None = None) -> list[NextStep]:
    """Return the changes that reduce the error by a twentieth or more, the best first; none for a run without trust."""
    now = report.error.predicted_mse
    if not report.verdict.trusted or now <= 0:
        return []
    steps = steps_of(report)
    if other is not None:
        how = f"{other.measurements} measurements more; `ommatid design` chooses among all"
        words = f"another lens type, of magnification {other.magnification} on the pixel grid"
        steps.append(NextStep(words, how, _with_other_type(report, other)))
    useful = [step for step in steps if step.mse <= (1 - LEAST_GAIN) * now]
    return sorted(useful, key=lambda step: step.mse)


def _with_other_type(report: RunReport, other: AnotherType) -> float:
    """Return the error with another type, which changes nothing of detail finer than f."""
    fixed = report.error.budget.get("detail", 0.0)
    return fixed + other.ratio * (report.error.predicted_mse - fixed)


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
