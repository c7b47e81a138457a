"""Work that is broken off goes on where it stopped, and ends as if nothing had happened."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ommatid.scenes import model_file, stack
from ommatid.scenes.camera import derive
from ommatid.scenes.formats.picture import load
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.simulate.cache import cached_model, cached_stack
from ommatid.simulate.sampling import checkpoint
from ommatid.simulate.sampling.checkpoint import Checkpoint, open_checkpoint

from ..examples import scene


class BrokenOff(Exception):
    """Stands for Ctrl-C."""


def after(fraction: float) -> object:
    """A listener who loses patience."""

    def listen(done: float) -> None:
        if done >= fraction:
            raise KeyboardInterrupt

    return listen


def tiny() -> Scene:
    return scene(
        (20, 20),
        (("1/3", [3, 3], [5, 5]), ("1/4", [4, 4], [4, 4])),
        render={"samples": 64, "variant": "scalar_rgb"},
        calibration={"samples": 64},
        noise={"variance": 1e-2},
    )


def nothing(done: float) -> None:
    del done


@pytest.mark.parametrize("fraction", [0.2, 0.7, 1.0])
def test_a_rendering_goes_on(tmp_path: Path, fraction: float) -> None:
    one = tiny()
    camera, image = derive(one), load(one)
    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", Setup(one, camera, image), after(fraction))  # type: ignore[arg-type]
    assert [path.name for path in tmp_path.iterdir()] == [".stack.exr.partial.npz"]
    heard: list[float] = []
    found, _ = cached_stack(tmp_path / "stack.exr", Setup(one, camera, image), heard.append)
    assert all(done > fraction for done in heard), "passes that were done are not done again"
    whole, _ = cached_stack(tmp_path / "whole.exr", Setup(one, camera, image), nothing)
    np.testing.assert_array_equal(found.values, whole.values)
    np.testing.assert_array_equal(found.variance, whole.variance)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["stack.exr", "whole.exr"]
    assert stack.read(tmp_path / "stack.exr").record["passes"] == 16


@pytest.mark.parametrize("fraction", [0.1, 0.6])
def test_a_calibration_goes_on(tmp_path: Path, fraction: float) -> None:
    """In the first lens type and in the second."""
    one = tiny()
    camera = derive(one)
    with pytest.raises(KeyboardInterrupt):
        cached_model(tmp_path / "model.npz", Setup(one, camera), after(fraction))  # type: ignore[arg-type]
    heard: list[float] = []
    found, made = cached_model(tmp_path / "model.npz", Setup(one, camera), heard.append)
    assert made
    assert min(heard) > fraction - 0.05
    whole, _ = cached_model(tmp_path / "whole.npz", Setup(one, camera), nothing)
    np.testing.assert_array_equal(found.matrix.toarray(), whole.matrix.toarray())
    np.testing.assert_array_equal(found.variance, whole.variance)
    np.testing.assert_array_equal(found.batches, whole.batches)
    assert not list(tmp_path.glob("*partial*"))
    assert model_file.read(tmp_path / "model.npz").record["passes"] == 16


def test_another_scene_does_not_go_on_with_it(tmp_path: Path) -> None:
    one = tiny()
    camera, image = derive(one), load(one)
    with pytest.raises(KeyboardInterrupt):
        cached_stack(tmp_path / "stack.exr", Setup(one, camera, image), after(0.5))  # type: ignore[arg-type]
    other = one.model_copy(update={"render": one.render.model_copy(update={"seed": 1})})
    heard: list[float] = []
    cached_stack(tmp_path / "stack.exr", Setup(other, camera, image), heard.append)
    assert len(heard) == 16


def test_what_is_damaged_counts_as_nothing(tmp_path: Path) -> None:
    path = tmp_path / "result"
    with pytest.raises(BrokenOff), open_checkpoint(path, "mine") as one:  # noqa: PT012
        one.offer(lambda: {"done": np.arange(3)})
        raise BrokenOff
    kept = tmp_path / ".result.partial.npz"
    assert list(Checkpoint(path, "mine").state()) == ["done"]
    assert Checkpoint(path, "of another").state() == {}
    whole = kept.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2], b"PK" + whole[7:], whole[:200] + b"\0" * 50 + whole[250:]):
        kept.write_bytes(damaged)
        assert Checkpoint(path, "mine").state() == {}


def test_it_is_written_now_and_then(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that a kill or a power cut costs little."""
    monkeypatch.setattr(checkpoint, "SPACING", 0.0)
    with open_checkpoint(tmp_path / "result", "mine") as one:
        one.offer(lambda: {"done": np.array(1)})
        assert Checkpoint(tmp_path / "result", "mine").state()["done"] == 1
    assert not list(tmp_path.iterdir())
