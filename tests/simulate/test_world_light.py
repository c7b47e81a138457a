"""Light of worlds that is no light is refused in one sentence, and Mitsuba's messages are warnings, once each."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.scenes.setup import Setup
from ommatid.simulate.ground_truth import truth
from ommatid.simulate.render import light
from ommatid.simulate.renderer.variant import activate

from ..examples import VARIANTS, needs
from .world_files import Z, glow, rectangle, world


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("radiance", ["nan", "inf", "-1", "1e30"])
def test_light_that_is_none_is_refused(tmp_path: Path, variant: str, radiance: str) -> None:
    needs(variant)
    content = rectangle(4, 4, 0, 0, Z, glow(radiance)) + rectangle(40, 40, 0, 0, 2 * Z, glow(1))
    described, camera = world(tmp_path, content, variant=variant)
    for make in (light, truth):
        with pytest.raises(InputError, match=r"^test.toml: world.file: .*: expected readings of 0 to 1e\+15, .*, got"):
            make(Setup(described, camera))


@pytest.mark.parametrize("variant", VARIANTS)
def test_bright_worlds_and_signed_pictures_are_rendered(tmp_path: Path, variant: str) -> None:
    needs(variant)
    described, camera = world(tmp_path, rectangle(40, 40, 0, 0, Z, glow(1e12)), variant=variant)
    assert light(Setup(described, camera)).mean == pytest.approx(255e12, rel=1e-5)
    if variant.startswith("scalar"):
        return  # where Mitsuba's films take no negative light
    picture = {"image": "photo:camera", "origin": [96, 224]}
    described, camera = world(tmp_path, '<emitter type="constant"/>', target=picture, variant=variant)
    image = np.random.default_rng(1).normal(size=camera.shape)
    assert light(Setup(described, camera, image)).mean.min() < 0


def test_every_kind_of_message_appears_once(caplog: pytest.LogCaptureFixture) -> None:
    activate("scalar_rgb")
    import mitsuba as mi

    log: Any = mi.Log
    with caplog.at_level(logging.WARNING, "mitsuba"):
        for number in range(3):
            log(mi.LogLevel.Warn, f'"mesh{number}.ply": {number} vertices of this test are odd')
    assert len(caplog.records) == 1
    assert caplog.records[0].getMessage().endswith('"mesh0.ply": 0 vertices of this test are odd')
