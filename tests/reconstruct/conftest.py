"""What the tests of pictures of a result share."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from ommatid.scenes.formats import exr


@pytest.fixture(scope="module")
def without_truth(finished: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the finished run whose estimate.exr holds no truth. Tests must not write to it."""
    folder = shutil.copytree(finished, tmp_path_factory.mktemp("overview") / "run")
    [part] = exr.read(folder / "estimate.exr")
    maps = {name: part.channels[name] for name in ("estimate", "variance")}
    exr.write(folder / "estimate.exr", [exr.Part("estimate", maps, part.record)])
    return folder
