"""The claims of the paper on simulated reconstructions of a photograph's tiles, as `claims` judges the others."""

from __future__ import annotations

import numpy as np

from ommatid.reconstruct.forms.form import Vector

from .claims import LOUD, QUIET, Claim, verdict
from .photographs import WHOLE, Photograph, Trials

SIGMAS = 4.0  # standard errors that a ratio may be off, so that one of twenty ratios hardly ever is by chance


def pictures(found: Photograph) -> list[Claim]:
    """The claims on quantisation and on photographs, which are Fig. 7."""
    return [_quantisation(found), _photographs(found)]


def _quantisation(found: Photograph) -> Claim:
    trials = found.quantised
    bits = [noise.bits or 0 for noise in trials.noises]
    ratios, doubts = _noise_ratios(trials)
    off = np.flatnonzero(np.abs(ratios - 1) > SIGMAS * doubts)
    first = bits[int(off[-1])] + 1 if off.size else bits[0]
    numbers = {f"error it causes over predicted at {one} bits": float(r) for one, r in zip(bits, ratios, strict=True)}
    whole = float(_noise_ratios(found.whole)[0].mean())
    numbers |= {"standard error at most": float(doubts.max()), f"whole numbers, from {WHOLE} bits on": whole}
    why = (
        f"from {first} bits on: where a smooth picture changes less than a step, neighbours are rounded alike; pixels"
        f" that are whole numbers err {1 - whole:.0%} less from {WHOLE} bits on"
    )
    return Claim(
        "quantisation acts as added noise of variance step^2 / 12",
        verdict(first <= WHOLE, catch=True),
        numbers,
        why if first <= WHOLE else "",
    )


def _noise_ratios(trials: Trials) -> tuple[Vector, Vector]:
    """Error that the noise causes over what Eq. 5 predicts, (Q,), and its standard error."""
    ratios = trials.from_noise.mean(axis=1) / trials.noise_part
    return ratios, trials.spread / np.sqrt(trials.from_noise.shape[1])


def _photographs(found: Photograph) -> Claim:
    trials = found.noisy
    ratios = trials.mean / trials.predicted
    noise = np.array([one.variance for one in trials.noises])
    quiet, loud = noise <= QUIET, noise >= LOUD
    doubt = float(np.sqrt(np.mean(trials.spread[quiet] ** 2) / (quiet.sum() * trials.measured.shape[1])))
    holds = bool((ratios[loud] < 1).all()) and ratios[quiet].mean() < 1 + SIGMAS * doubt
    numbers = {f"measured over predicted at noise {noise[at]:g}": float(ratios[at]) for at in np.flatnonzero(loud)}
    numbers[f"mean up to noise {QUIET:g}"] = float(ratios[quiet].mean())
    numbers["its standard error"] = doubt
    return Claim(
        "real photographs do somewhat better than predicted",
        verdict(holds),
        numbers,
        "a photograph is smoother than the prior, which helps where the prior decides; at low noise it is no help"
        if holds
        else "",
    )
