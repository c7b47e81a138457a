"""The common level of the image, where the prior does not know it: one unknown more, which all pixels share.

Pixels that the measurements hardly see take the prior's mean, all of them with the same error: a dark picture, or the
mean of a region, would be far off by more than Eq. 5 says of independent pixels. So f = f0 + l 1 + d, with l of
variance L^2 beside the images d of the prior. A constant image is a wave of the prior, P0 1 = s 1, and with
h = C P0^-1 1 = (I - A H) 1, what the estimate lacks of it,

    v = 1 / (1^T (1 - h) / s + 1 / L^2),   l^ = v 1^T A (g - H f0) / s,   f^ = f0 + A (g - H f0) + l^ h,

which adds v h h^T to Eq. 5 (Rasmussen and Williams 2006, Eq. 2.41 and 2.42, where H^T (H P0 H^T + Rv)^-1 is P0^-1 A).
For a noise Rvm and images of c P0, others than the estimator expects, and a = v Rv^-1 H h, q = A (Rvm - c Rv) a,

    v is v + a^T (Rvm - c Rv) a + (c - 1) (v - v^2 / L^2),   and Eq. 5 gains q h^T + h q^T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ommatid.runtime.arrays import FloatArray


@dataclass(frozen=True)
class Level:
    """The estimate of the level, and what it changes.

    value : l^, grey levels above the prior's mean;  variance : v;  known : L^2, the prior's
    response : h, (unknowns,)
    """

    value: float
    variance: float
    known: float
    response: FloatArray

    @classmethod
    def of(cls, deviation: FloatArray, response: FloatArray, wave: float, known: float) -> Level:
        """Return the level from A (g - H f0) and h, (unknowns,) each, s and L^2."""
        variance = variance_of(response, wave, known)
        return cls(variance * float(deviation.sum()) / wave, variance, known, response)

    def variance_for(self, gain: FloatArray, other: FloatArray, ratio: float) -> float:
        """Return v for another noise and c P0; gain : a;  other : (Rvm - c Rv) a, (measurements used,) both."""
        return self.variance + float(gain @ other) + (ratio - 1) * (self.variance - self.variance**2 / self.known)


def variance_of(response: FloatArray, wave: float, known: float) -> float:
    """Return v from h, (unknowns,), s and L^2."""
    return 1 / (max(float(np.sum(1 - response)), 0.0) / wave + 1 / known)
