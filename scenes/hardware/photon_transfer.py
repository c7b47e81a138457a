"""Noise of recorded frames: what repeated readings scatter, and what pixels read that see nothing (EMVA 1288)."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, stats

Vector = NDArray[np.float64]

ROUNDS = 20


def photon_transfer(mean: Vector, variance: Vector, repeats: NDArray[np.int64]) -> tuple[float, float]:
    """a and b of the variance a + b mean of a reading: of the dark and of the photons, neither below 0.

    mean, variance, repeats : of the same reading repeated, its sample mean and variance, and how often
    The variance of a sample variance is 2 sigma^4 / (repeats - 1): weights follow from the fit, so that it is unbiased.
    """
    light = np.maximum(mean, 0.0)
    typical = float(np.average(variance, weights=repeats - 1))
    if typical <= 0:
        return 0.0, 0.0
    design = np.stack([np.ones_like(light), light], axis=1)
    found = np.array([typical, 0.0])
    for _ in range(ROUNDS):
        deviation = np.maximum(design @ found, 1e-6 * typical) / np.sqrt(repeats - 1)
        before, weighted = found, design / deviation[:, None]
        root = np.linalg.cholesky(weighted.T @ weighted + 1e-12 * np.diag(np.sum(weighted**2, axis=0) + 1e-300))
        told = np.linalg.solve(root, weighted.T @ (variance / deviation))
        found = np.asarray(cast(Any, optimize).nnls(root.T, told)[0], dtype=np.float64)
        if np.allclose(found, before, rtol=1e-6, atol=0):
            break
    return float(found[0]), float(found[1])


def background(readings: Vector, chance: float) -> tuple[float, float]:
    """Mean square of readings that should be 0, and the height above which one is light.

    chance : that any reading is taken for light though all are noise (Sidak); what is light is left out of the mean.
    Without readings the mean square is NaN, and nothing is light.
    """
    if not readings.size:
        return float("nan"), float("inf")
    score = float(cast(Any, stats).norm.isf(-np.expm1(np.log1p(-chance) / readings.size)))
    dark = readings
    for _ in range(ROUNDS):
        limit = score * float(np.sqrt(np.mean(dark**2)))
        kept = dark[dark <= limit]
        if kept.size == dark.size or not kept.size:
            break
        dark = kept
    mean_square = float(np.mean(dark**2))
    return mean_square, score * mean_square**0.5


def rounding(variance: Vector, step: Vector) -> Vector:
    """Variance that rounding to whole steps leaves in a mean however often a reading is repeated.

    step^2 / 12 without noise; noise of `variance` moves readings from step to step, so that rounding averages out:
    the first harmonic of the sawtooth, and with it this share, falls as exp(-4 pi^2 variance / step^2).
    """
    noise = np.divide(variance, step**2, out=np.zeros_like(variance), where=step > 0)
    return step**2 / 12 * np.exp(-4 * np.pi**2 * noise)
