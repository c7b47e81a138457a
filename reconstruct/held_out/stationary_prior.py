"""A prior of natural pictures for the check, fitted to a few small tiles of the stack: seconds, whatever the size.

The variances of prediction errors hardly depend on it, since other sub-imagers see most of what one sees. It matters in
components of the image that one sub-imager alone sees.
"""

from __future__ import annotations

import numpy as np

from ommatid.scenes.tables.estimation import PriorTable

from ..fitting.evidence import Evidence
from ..fitting.prior_fit import MAX_COMPLETE, MIN_MEASUREMENTS, evidence_of, fit_prior
from ..methods.method import EstimationTask

TILE = 16  # pixels, side of a tile
MOST_TILES = 4
MIN_USED = 0.2  # share of the measurements that must lie inside one tile; else tiles grow


def fitted_prior(task: EstimationTask) -> PriorTable | None:
    """Return the exponential prior of largest evidence with the task's noise; None if measurements are too few."""
    whole, tiles = evidence_of(task, prior_known=False, noise_known=True)
    if task.model.unknowns <= MAX_COMPLETE:
        tiles = _small_tiles(whole)
    chosen = np.unique(np.linspace(0, len(tiles) - 1, min(len(tiles), MOST_TILES)).round().astype(int))
    tiles = [tiles[index] for index in chosen]
    if sum(tile.residual.size for tile in tiles) < MIN_MEASUREMENTS or not whole.residual.any():
        return None
    fit = fit_prior(whole, tiles)
    if fit.variance is None or fit.length is None:
        return None
    length = fit.length * task.model.camera.target_pitch
    update = {"kind": "exponential", "variance": fit.variance, "correlation_length": length, "exponent": None}
    return task.prior.model_copy(update=update)


def _small_tiles(whole: Evidence) -> list[Evidence]:
    side = TILE
    while side < max(whole.shape):
        tiles = [tile for tile in whole.blocks(side) if tile.residual.size]
        if sum(tile.residual.size for tile in tiles) >= MIN_USED * whole.residual.size:
            return tiles
        side *= 2
    return [whole]
