"""Noise of recorded frames, from the scatter of repeated readings and from unlit pixels (EMVA 1288)."""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from scipy import optimize, stats

from ommatid.runtime.arrays import FloatArray, IntArray

ROUNDS = 20


def photon_transfer(mean: FloatArray, variance: FloatArray, repeats: IntArray) -> tuple[float, float]:
    """Fit the variance a + b mean of a reading, a of the dark and b of the photons, neither below 0.

    mean, variance, repeats : sample mean, sample variance and number of readings of the same light
    The variance of a sample variance is 2 sigma^4 / (repeats - 1); weights follow from the fit, which keeps it
    unbiased.
    """
    light = np.maximum(mean, 0.0)
    typical = float(np.average(variance, weights=repeats - 1))
    if typical <= 0:
        return 0.0, 0.0
    design = np.stack([np.ones_like(light), light], axis=1)
    fit = np.array([typical, 0.0])
    for _ in range(ROUNDS):
        deviation = np.maximum(design @ fit, 1e-6 * typical) / np.sqrt(repeats - 1)
        before, weighted = fit, design / deviation[:, None]
        root = np.linalg.cholesky(weighted.T @ weighted + 1e-12 * np.diag(np.sum(weighted**2, axis=0) + 1e-300))
        right = np.linalg.solve(root, weighted.T @ (variance / deviation))
        fit = np.asarray(cast(Any, optimize).nnls(root.T, right)[0], dtype=np.float64)
        if np.allclose(fit, before, rtol=1e-6, atol=0):
            break
    return float(fit[0]), float(fit[1])


def background(readings: FloatArray, chance: float) -> tuple[float, float]:
    """Mean square of unlit readings, and the reading above which a pixel counts as lit.

    chance : probability that at least one reading counts as lit if all are noise (Sidak); lit readings are left out of
        the mean. Without readings the mean square is NaN and the limit infinite.
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


def rounding(variance: FloatArray, step: FloatArray) -> FloatArray:
    """Variance of rounding to multiples of `step` in the mean of any number of repeated readings.

    It is step^2 / 12 without noise; noise of `variance` moves readings between steps, so that rounding averages out:
    the first harmonic of the sawtooth, and with it this variance, falls as exp(-4 pi^2 variance / step^2).
    """
    noise = np.divide(variance, step**2, out=np.zeros_like(variance), where=step > 0)
    return step**2 / 12 * np.exp(-4 * np.pi**2 * noise)
