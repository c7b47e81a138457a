"""What a scene does not need, and why: nothing here is computed, sampled or allocated for it."""

from __future__ import annotations

from .scene import Scene


def left_out(scene: Scene) -> tuple[tuple[str, str], ...]:
    """Pairs of what is left out and why, from the scene file alone."""
    left = [
        ("samples of an aperture", "every lens is a pinhole in focus"),
        ("light that bounces", "the target shines and nothing else is there: paths have one segment"),
    ]
    if scene.noise is None:
        left.append(("sensor noise and quantisation", "the scene has no [noise]"))
    else:
        if scene.noise.variance == 0:
            left.append(("sensor noise", "noise.variance is 0"))
        if scene.noise.bits is None:
            left.append(("quantisation", "the scene has no noise.bits"))
    if scene.prior.kind == "independent":
        left.append(("covariances between pixels of the prior", "prior.kind is 'independent'"))
    if scene.calibration.method == "ideal":
        left.append(("point sources", "calibration.method is 'ideal', H comes in closed form"))
        left.append(("second estimate for the uncertainty of H", "the ideal H has none"))
    elif scene.prior.kind != "fit" and scene.estimator.noise_variance not in (None, "fit"):
        left.append(("second estimate for the uncertainty of H", "estimator.noise_variance says what to expect"))
    return tuple(left)
