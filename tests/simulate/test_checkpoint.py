"""Interrupted computations continue from their checkpoint, with the result of an uninterrupted run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ommatid.runtime.errors import InputError
from ommatid.runtime.progress import Progress, no_progress
from ommatid.scenes import model_file, stack
from ommatid.scenes.setup import Setup
from ommatid.simulate import render
from ommatid.simulate.calibrate import cached_model
from ommatid.simulate.render import cached_stack
from ommatid.simulate.sampling import checkpoint
from ommatid.simulate.sampling.checkpoint import Checkpoint, open_checkpoint

from ..examples import VARIANTS, needs, scene


class Interruption(Exception):
    """Interrupts a computation."""


def after(fraction: float) -> Progress:
    """Return a progress callback that raises KeyboardInterrupt at a fraction of the work."""

    def listen(done: float) -> None:
        if done >= fraction:
            raise KeyboardInterrupt

    return listen


def tiny() -> Setup:
    described = scene(
        (20, 20),
        (("1/3", [3, 3], [5, 5]), ("1/4", [4, 4], [4, 4])),
        render={"samples": 64, "variant": "scalar_rgb"},
        calibration={"samples": 64},
        noise={"variance": 1e-2},
    )
    return Setup.from_scene(described)


@pytest.mark.parametrize("fraction", [0.2, 0.7, 1.0])
def test_a_rendering_continues(tmp_path: Path, fraction: float) -> None:
    setup = tiny()
    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", setup, after(fraction))
    assert [path.name for path in tmp_path.iterdir()] == [".stack.exr.partial.npz"]
    fractions: list[float] = []
    continued, _ = cached_stack(tmp_path / "stack.exr", setup, fractions.append)
    assert all(done > fraction for done in fractions), "finished passes are not repeated"
    whole, _ = cached_stack(tmp_path / "whole.exr", setup, no_progress)
    np.testing.assert_array_equal(continued.values, whole.values)
    np.testing.assert_array_equal(continued.variance, whole.variance)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stack.exr", "whole.exr"]
    assert stack.read(tmp_path / "stack.exr").record["passes"] == 16


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_rendering_continues_within_a_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variant: str) -> None:
    """The film of 481 pixels is rendered in two blocks, an interruption in the second of them."""
    needs(variant)
    render = tiny().scene.render.model_copy(update={"variant": variant})
    setup = replace(tiny(), scene=tiny().scene.model_copy(update={"render": render}))
    whole, _ = cached_stack(tmp_path / "whole.exr", setup, no_progress)
    monkeypatch.setattr("ommatid.simulate.renderer.rays.MOST_RAYS", 2**10)
    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", setup, after(0.7))
    fractions: list[float] = []
    continued, _ = cached_stack(tmp_path / "stack.exr", setup, fractions.append)
    assert min(fractions) > 0.7
    assert fractions == sorted(fractions)
    at_once, _ = cached_stack(tmp_path / "once.exr", setup, no_progress)
    np.testing.assert_array_equal(continued.values, at_once.values)
    np.testing.assert_array_equal(continued.variance, at_once.variance)
    if variant.startswith("scalar"):  # elsewhere the streams of samplers follow from the rays that start together
        np.testing.assert_array_equal(continued.values, whole.values)


@pytest.mark.parametrize("fraction", [0.1, 0.6])
def test_a_calibration_continues(tmp_path: Path, fraction: float) -> None:
    """Interrupted in the first lens type and in the second."""
    setup = tiny()
    with pytest.raises(KeyboardInterrupt):
        cached_model(tmp_path / "model.npz", setup, after(fraction))
    fractions: list[float] = []
    continued, made = cached_model(tmp_path / "model.npz", setup, fractions.append)
    assert made
    assert min(fractions) > fraction - 0.05
    whole, _ = cached_model(tmp_path / "whole.npz", setup, no_progress)
    np.testing.assert_array_equal(continued.matrix.toarray(), whole.matrix.toarray())
    np.testing.assert_array_equal(continued.variance, whole.variance)
    np.testing.assert_array_equal(continued.batches, whole.batches)
    assert not list(tmp_path.glob("*partial*"))
    assert model_file.read(tmp_path / "model.npz").record["passes"] == 16


def test_another_scene_ignores_the_checkpoint(tmp_path: Path) -> None:
    setup = tiny()
    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", setup, after(0.5))
    seed = setup.scene.render.model_copy(update={"seed": 1})
    other = replace(setup, scene=setup.scene.model_copy(update={"render": seed}))
    fractions: list[float] = []
    cached_stack(tmp_path / "stack.exr", other, fractions.append)
    assert len(fractions) == 2 * 16, "all passes of two lens types"


@pytest.mark.parametrize(
    "state", [{"other": np.array(1)}, {"mean": np.zeros(2), "variance": np.array("x"), "block": np.array(0)}]
)
def test_a_checkpoint_of_other_arrays_is_named(state: dict[str, Any], tmp_path: Path) -> None:
    setup, path = tiny(), tmp_path / "stack.exr"
    with pytest.raises(Interruption), open_checkpoint(path, render.made_from(setup)) as one:  # noqa: PT012
        one.offer(lambda: state)
        raise Interruption
    with pytest.raises(InputError, match=r"partial\.npz: expected the state of an interrupted run"):
        cached_stack(path, setup, no_progress)


def test_checkpoints_are_written_regularly(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a kill or a power cut loses little."""
    monkeypatch.setattr(checkpoint, "SPACING", 0.0)
    with open_checkpoint(tmp_path / "result", "mine") as one:
        one.offer(lambda: {"done": np.array(1)})
        assert Checkpoint(tmp_path / "result", "mine").state()["done"] == 1
    assert not list(tmp_path.iterdir())
