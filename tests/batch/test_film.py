"""The moving picture of many frames: its grey levels, its size, what it leaves out, and the index that shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from ommatid.batch import film
from ommatid.batch.film import FILM, FilmScale
from ommatid.runtime.files import digest
from ommatid.scenes import stack as stack_file
from ommatid.scenes.formats import exr
from ommatid.scenes.formats.picture import write_truth

from ..conftest import Command
from .test_frames import write_film

COUNT, SHAPE = 3, (16, 15)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frames of one target that is known, and their model."""
    folder = tmp_path_factory.mktemp("known")
    write_film(folder, SHAPE, COUNT)
    truth = np.random.default_rng(0).uniform(0, 255, SHAPE).astype(np.float32)
    write_truth(folder / "truth.exr", truth.astype(np.float64))
    for path in folder.glob("f?.exr"):
        stack = stack_file.read(path)
        stack.record["truth"] = digest(truth)
        stack_file.write(path, stack)
    return folder


def pictures(path: Path) -> list[Any]:
    with Image.open(path) as moving:
        found: list[Any] = []
        for number in range(getattr(moving, "n_frames", 1)):
            moving.seek(number)
            found.append(np.asarray(moving.convert("L")).astype(float))
        return found


def test_every_pixel_of_the_estimate_has_its_grey_level_in_every_frame(
    frames: Path, tmp_path: Path, ommatid: Command
) -> None:
    files = [frames / f"f{number}.exr" for number in range(COUNT)]
    ended = ommatid("reconstruct", *files, frames / "model.npz", "-o", tmp_path)
    assert ended.code == 0, ended.err
    assert f"film: {tmp_path / FILM}, 3 of 3 frames; {tmp_path / 'index.html'}" in ended.err
    side = FilmScale.of(COUNT, SHAPE, 3).side
    assert side * max(SHAPE) >= film.SMALLEST
    truth = exr.read(frames / "truth.exr")[0].channels["Y"]
    low, high = float(truth.min()), float(truth.max())
    shown = pictures(tmp_path / FILM)
    assert len(shown) == COUNT
    middles = np.arange(SHAPE[0])[:, None] * side + side // 2, np.arange(SHAPE[1]) * side + side // 2
    for file, picture in zip(files, shown, strict=True):
        estimate = exr.read(tmp_path / file.name)[0].channels["estimate"]
        for panel, values in ((0, truth), (2, estimate)):
            left = film.GAP + panel * (SHAPE[1] * side + film.GAP)
            levels = picture[film.TITLE :, left:][middles]
            expected = np.clip((values - low) / (high - low), 0, 1) * 255
            assert np.abs(levels - expected).max() <= 0.51, "rounded to whole grey levels"
    page = (tmp_path / "index.html").read_text(encoding="utf-8")
    assert f'src="{FILM}"' in page
    assert [f'href="f{number}.png"' in page for number in range(COUNT)] == [True] * COUNT


def test_a_film_is_drawn_again_only_for_other_frames(frames: Path, tmp_path: Path, ommatid: Command) -> None:
    files = [frames / f"f{number}.exr" for number in range(COUNT)]
    command = ("reconstruct", *files[:2], frames / "model.npz", "-o", tmp_path)
    ommatid(*command)
    first = (tmp_path / FILM).stat().st_mtime_ns
    ommatid(*command)
    assert (tmp_path / FILM).stat().st_mtime_ns == first
    (tmp_path / FILM).write_bytes(b"GIF89a of another program")
    ommatid(*command)
    assert len(pictures(tmp_path / FILM)) == 2
    ommatid("reconstruct", *files, frames / "model.npz", "-o", tmp_path)
    assert len(pictures(tmp_path / FILM)) == 3


def test_a_page_of_another_program_is_not_replaced(frames: Path, tmp_path: Path, ommatid: Command) -> None:
    (tmp_path / "index.html").write_text("<html>mine</html>", encoding="utf-8")
    ended = ommatid("reconstruct", frames / "f0.exr", frames / "f1.exr", frames / "model.npz", "-o", tmp_path)
    assert ended.code == 2
    assert "is a page of another program" in ended.err
    assert [path.name for path in tmp_path.iterdir()] == ["index.html"]


@pytest.mark.parametrize("count", [2, 59, 61, 5000])
@pytest.mark.parametrize("shape", [(5, 5), (30, 700), (480, 480), (4079, 4079)])
def test_a_film_is_bounded_whatever_its_frames(count: int, shape: tuple[int, int]) -> None:
    for panels in (2, 3):
        scale = FilmScale.of(count, shape, panels)
        shown = len(range(0, count, scale.step))
        rows, columns = (scale.side * (size // scale.block) for size in shape)
        assert shown <= film.MOST_FRAMES
        assert max(rows, columns) <= max(film.LARGEST, 2 * film.SMALLEST)
        assert min(rows, columns) >= 1
        assert shown * panels * rows * columns <= film.MOST_PIXELS
        assert (scale.step == 1) == (count <= film.MOST_FRAMES)
        assert ("one frame in" in scale.words, "means of" in scale.words) == (scale.step > 1, scale.block > 1)
