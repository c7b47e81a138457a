"""Traced H against H in closed form, entry by entry: defocus, diffraction, distortion, misalignment.

With independent samples an entry is a share of n rays, with the variance H (1 - H) / n: the statistic is normal with a
known standard error, not one estimated from the data. Entries that few rays meet are summed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import sparse, stats

from ommatid.scenes.formats.picture import load
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.ray_transport import responses_from_rays
from ommatid.simulate.ideal import ideal_matrix, true_matrix
from ommatid.simulate.render import light

from ..examples import OPTICS, TWO, assert_student, familywise, needs, with_optics

SAMPLES = 2**14
DIFFRACTS = {"wavelength": "550 nm", "lens_pitch": "1 mm"}
FEWEST = 25  # rays expected in an entry, above which their number is normal
CLOSED = OPTICS | {
    "a thin lens in focus": ({"aperture": "0.4 mm"}, {}),
    "far out of focus": ({"aperture": "0.4 mm", "focus": "700 mm"}, {}),
    "diffraction out of focus": ({"aperture": "0.8 mm", "focus": "900 mm"}, DIFFRACTS),
    "distorted and misaligned": ({"distortion": [-0.04, 0.02]}, OPTICS["misaligned"][1]),
}


def scores(found: sparse.csr_array, expected: sparse.csr_array, rays: int) -> np.ndarray:
    """Return the deviation of each entry in standard errors, and of each row's sum over its rare entries."""
    dense, known = found.toarray(), expected.toarray()
    rare = known * rays < FEWEST
    many = ~rare
    each = (dense[many] - known[many]) / np.sqrt(known[many] * (1 - known[many]) / rays)
    ours, theirs = (np.where(rare, matrix, 0.0).sum(axis=1) for matrix in (dense, known))
    enough = theirs * rays >= FEWEST
    together = (ours[enough] - theirs[enough]) / np.sqrt(theirs[enough] * (1 - theirs[enough]) / rays)
    return np.concatenate([each, together])


@pytest.mark.parametrize("kind", CLOSED)
def test_traced_h_is_the_closed_form(kind: str) -> None:
    needs("llvm_ad_mono")
    render = {"sampler": "independent", "complete": True}
    described, camera = with_optics(*CLOSED[kind], calibration={"samples": SAMPLES}, render=render)
    traced = responses_from_rays(Setup(described, camera))
    found = scores(traced.matrix, true_matrix(camera), traced.passes * traced.samples)
    assert found.size > 5000
    assert np.abs(found).max() < stats.norm.isf(familywise(found.size) / 2)
    assert float(np.square(found).mean()) == pytest.approx(1, abs=5 * (2 / found.size) ** 0.5)


@pytest.mark.parametrize("kind", CLOSED)
def test_the_statistic_detects_another_camera(kind: str) -> None:
    """No other optics pass for an ideal pinhole, except a lens in focus, which is one."""
    if kind in ("pinhole", "a thin lens in focus"):
        return
    _, camera = with_optics(*CLOSED[kind])
    _, pinholes = with_optics(*OPTICS["pinhole"])
    found = scores(ideal_matrix(pinholes), true_matrix(camera), SAMPLES)
    assert np.abs(found).max() > 2 * stats.norm.isf(familywise(found.size) / 2)


@pytest.mark.parametrize("kind", ["out of focus", "diffraction", "distortion", "misaligned"])
def test_rendered_sub_images_of_a_photograph(kind: str) -> None:
    """The rendering, with the picture's edge and the black around it, is H f."""
    needs("llvm_ad_mono")
    tables: dict[str, Any] = {"render": {"samples": 4096, "complete": True}}
    described, camera = with_optics(*CLOSED[kind], TWO, **tables)
    image = load(described)
    rendered = light(Setup(described, camera, image))
    difference = rendered.mean - true_matrix(camera) @ image.ravel()
    assert_student(difference, rendered.variance, rendered.passes)
