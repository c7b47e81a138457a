"""The paper's claims about simulated reconstructions of a photograph's tiles (Fig. 7)."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray

from .claims import LOUD, QUIET, Claim, verdict
from .photographs import WHOLE_BITS, Photograph, Trials

SIGMAS = 4.0  # standard errors that a ratio may be off, so that one of twenty ratios hardly ever is by chance


def photograph_claims(photograph: Photograph) -> list[Claim]:
    """Check the claims on quantisation and on photographs."""
    return [_quantisation(photograph), _photographs(photograph)]


def _quantisation(photograph: Photograph) -> Claim:
    trials = photograph.quantised
    bits = [noise.bits or 0 for noise in trials.noises]
    ratios, errors = _noise_ratios(trials)
    off = np.flatnonzero(np.abs(ratios - 1) > SIGMAS * errors)
    first = bits[int(off[-1])] + 1 if off.size else bits[0]
    numbers = {
        f"error it causes over predicted at {count} bits": float(ratio)
        for count, ratio in zip(bits, ratios, strict=True)
    }
    whole = float(_noise_ratios(photograph.whole)[0].mean())
    numbers |= {"standard error at most": float(errors.max()), f"whole numbers, from {WHOLE_BITS} bits on": whole}
    holds = first <= WHOLE_BITS
    remark = (
        f"from {first} bits on: where a smooth image changes by less than a step, neighbours are rounded alike; pixels"
        f" that are whole numbers err {1 - whole:.0%} less from {WHOLE_BITS} bits on"
    )
    return Claim(
        "quantisation acts as added noise of variance step^2 / 12",
        verdict(holds, qualified=True),
        numbers,
        remark if holds else "",
    )


def _noise_ratios(trials: Trials) -> tuple[FloatArray, FloatArray]:
    """Return the error that the noise causes over what Eq. 5 predicts, (Q,), and its standard error."""
    ratios = trials.from_noise.mean(axis=1) / trials.noise_part
    return ratios, trials.spread / np.sqrt(trials.from_noise.shape[1])


def _photographs(photograph: Photograph) -> Claim:
    trials = photograph.noisy
    ratios = trials.mean / trials.predicted
    noise = np.array([table.variance for table in trials.noises])
    quiet, loud = noise <= QUIET, noise >= LOUD
    error = float(np.sqrt(np.mean(trials.spread[quiet] ** 2) / (quiet.sum() * trials.measured.shape[1])))
    holds = bool((ratios[loud] < 1).all()) and ratios[quiet].mean() < 1 + SIGMAS * error
    numbers = {
        f"measured over predicted at noise {noise[index]:g}": float(ratios[index]) for index in np.flatnonzero(loud)
    }
    numbers[f"mean up to noise {QUIET:g}"] = float(ratios[quiet].mean())
    numbers["its standard error"] = error
    remark = "a photograph is smoother than the prior, which helps where the prior decides; at low noise it is no help"
    return Claim("real photographs do somewhat better than predicted", verdict(holds), numbers, remark if holds else "")
