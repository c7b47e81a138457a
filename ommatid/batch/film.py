"""The frames of one camera as a moving picture: the truth where it is known, one sub-image and the estimate.

All frames have one grey scale. GIF, because browsers and programs for slides play it, and because it keeps the 256 grey
levels of its pixels. Long films show every n-th frame, large frames means over blocks of pixels; the picture says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil, sqrt
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ommatid.figures.panels import FigurePanel, FigureScale
from ommatid.reconstruct.output.overview import placed_sub_image
from ommatid.reconstruct.output.result_files import read_estimate
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import cached, fingerprint, write_whole
from ommatid.runtime.input_files import read_bytes
from ommatid.runtime.printable import printable
from ommatid.scenes import stack as stack_file
from ommatid.scenes.formats.picture import averaged

from .frames import Frame, FrameOptions

FILM = "film.gif"
COMMENT = b"!\xfe"  # precedes the length and the text of a comment in GIF files
MOST_BYTES = 100_000_000  # of a file that is read
VERSION = 1  # of the drawing: another one draws films anew
MOST_FRAMES = 60
MOST_PIXELS = 12_000_000  # of all panels of all frames: some 9 MB of a photograph
LARGEST, SMALLEST = 480, 300  # rows and columns of a panel: means above, squares of equal pixels below
GAP, TITLE, FOOT, TEXT = 8, 20, 44, 12  # pixels: around panels, above and below them, height of letters
LONGEST_NAME = 40  # characters of the name of a frame
TIME = 100  # milliseconds of a frame
PAPER, INK = 255, 0
ASIDE = 0.5  # per cent of the pixels of an estimate that are beyond either end of the grey scale


@dataclass(frozen=True)
class Film:
    """A moving picture of a folder of frames: its file, and what of the frames it shows, in words."""

    path: Path
    words: str


@dataclass(frozen=True)
class FilmScale:
    """How many frames are left out from one to the next, and how pixels of f become those of the picture.

    step : of the frames;  block : side of means in pixels of f;  side : of a pixel or mean in the picture
    """

    step: int
    block: int
    side: int

    @classmethod
    def of(cls, count: int, shape: tuple[int, int], panels: int) -> FilmScale:
        """Return the scale of `count` frames of f, (rows, columns), and of `panels` panels a frame."""
        step = ceil(count / MOST_FRAMES)
        most = MOST_PIXELS / (ceil(count / step) * panels)
        block = ceil(max(sqrt(shape[0] * shape[1] / most), max(shape) / LARGEST, 1))
        side = min(ceil(SMALLEST / max(shape)), int(sqrt(most / (shape[0] * shape[1]))))
        return cls(step, block, side if block == 1 else 1)

    @property
    def words(self) -> str:
        """What is left out, in words; empty where nothing is."""
        parts = [f"one frame in {self.step}"] if self.step > 1 else []
        return ", ".join([*parts, f"means of {self.block} x {self.block} pixels"] if self.block > 1 else parts)


def cached_film(folder: Path, frames: Sequence[Frame], options: FrameOptions) -> Film:
    """Write the moving picture of finished frames into their folder unless it is up to date. Raises MachineError."""
    first = read_estimate(frames[0].output).channels
    scale = FilmScale.of(len(frames), first["estimate"].shape, 3 if "truth" in first else 2)
    shown = frames[:: scale.step]
    current = fingerprint([VERSION, len(frames), [(frame.output.name, frame.fingerprint) for frame in shown]])

    def make() -> list[NDArray[np.uint8]]:
        panels = [_panels(frame, options, scale) for frame in shown]
        names = [f"frame {1 + i * scale.step} of {len(frames)}: {f.stack.stem}" for i, f in enumerate(shown)]
        return _drawn(panels, names, scale)

    path = folder / FILM
    cached(path, current, _read_stamp, make, partial(_write, stamp=current), options.force)
    return Film(path, f"{len(shown)} of {len(frames)} frames" + (f", {scale.words}" if scale.words else ""))


def _read_stamp(path: Path) -> tuple[None, str]:
    before, _, after = read_bytes(path, MOST_BYTES).partition(COMMENT)
    if not before.startswith(b"GIF8") or not after:
        raise ValueError("expected a GIF file with a comment")
    return None, after[1 : 1 + after[0]].decode("ascii")


def _write(path: Path, pictures: list[NDArray[np.uint8]], *, stamp: str) -> None:
    from PIL import Image

    first, *others = (Image.fromarray(picture) for picture in pictures)
    moving: dict[str, Any] = {"save_all": True, "append_images": others, "duration": TIME, "loop": 0}
    moving["optimize"] = False  # an optimised palette moves grey levels by up to 3
    write_whole(path, lambda file: first.save(file, format="GIF", comment=stamp, **moving))


def _panels(frame: Frame, options: FrameOptions, scale: FilmScale) -> list[FigurePanel]:
    """Read a frame, and return its panels: maps of float32, as large as they are drawn but for equal pixels."""
    channels = read_estimate(frame.output).channels
    stack = options.applied(stack_file.read(frame.stack), frame.stack)
    maps = {name: _reduced(channels[name].astype(np.float64), scale.block) for name in channels.keys() - {"variance"}}
    grey = FigureScale.grey(maps["truth"]) if "truth" in maps else FigureScale.grey(maps["estimate"], aside=ASIDE)
    sub_image = placed_sub_image(stack, None, grey)
    seen = _on_target(sub_image, maps["estimate"].shape, scale.block)
    title = sub_image.title.partition("\n")[0]
    panels = [FigurePanel("Truth", maps["truth"], grey)] if "truth" in maps else []
    return [*panels, FigurePanel(title, seen, grey), FigurePanel("Estimate", maps["estimate"], grey)]


def _reduced(image: FloatArray, block: int) -> FloatArray:
    """Return means over whole blocks of pixels."""
    rows, columns = (size // block * block for size in image.shape)
    return averaged(image[:rows, :columns], block)


def _on_target(panel: FigurePanel, shape: tuple[int, int], block: int) -> FloatArray:
    """Return the pixels of a sub-image where they look at, in blocks of pixels of f; NaN elsewhere."""
    row, column, side = panel.place
    found = np.full(shape, np.nan)
    kept: list[tuple[Any, Any]] = []  # rows, then columns: of the map and of the sub-image
    for count, start, size in zip(shape, (row, column), panel.image.shape, strict=True):
        places = np.floor((block * (np.arange(count) + 0.5) - start) / side).astype(int)
        inside = (places >= 0) & (places < size)
        kept.append((inside, places[inside]))
    (down, rows), (across, columns) = kept
    found[np.ix_(down, across)] = panel.image[np.ix_(rows, columns)]
    return found


def _drawn(frames: list[list[FigurePanel]], names: Sequence[str], scale: FilmScale) -> list[NDArray[np.uint8]]:
    """Return the pictures of frames, (rows, columns) of grey levels, on the grey scale that holds all of them."""
    low = min(panels[-1].scale.low for panels in frames)
    high = max(panels[-1].scale.high for panels in frames)
    rows, columns = (scale.side * size for size in frames[0][-1].image.shape)
    count = len(frames[0])
    size = TITLE + rows + FOOT, GAP + count * (columns + GAP)
    grey = np.linspace(0, 255, min(columns, 128)).astype(np.uint8)
    page = np.full(size, PAPER, dtype=np.uint8)
    page[TITLE + rows + 8 : TITLE + rows + 16, GAP : GAP + grey.size] = grey
    levels = f"{low:.3g} to {high:.3g} grey levels" + (f"; {scale.words}" if scale.words else "")
    _write_words(page[TITLE + rows + 5 :, 2 * GAP + grey.size :], levels)
    places = [GAP + number * (columns + GAP) for number in range(count)]
    for left, panel in zip(places, frames[0], strict=True):
        _write_words(page[3:TITLE, left : left + columns], panel.title)
    pictures: list[NDArray[np.uint8]] = []
    for panels, name in zip(frames, names, strict=True):
        picture = page.copy()
        for left, panel in zip(places, panels, strict=True):
            grey_levels = np.round(255 * np.clip((panel.image - low) / (high - low), 0, 1))
            pixels = np.nan_to_num(grey_levels, nan=PAPER).astype(np.uint8)
            enlarged = pixels.repeat(scale.side, axis=0).repeat(scale.side, axis=1)
            picture[TITLE : TITLE + rows, left : left + columns] = enlarged
        _write_words(picture[TITLE + rows + 24 :, GAP:], printable(name, LONGEST_NAME))
        pictures.append(picture)
    return pictures


def _write_words(picture: NDArray[np.uint8], words: str) -> None:
    """Write a line at the top left of a part of a picture, in place; what does not fit is cut off."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(picture)
    ImageDraw.Draw(image).text((0, 0), words, fill=INK, font=ImageFont.load_default(TEXT))
    picture[:] = np.asarray(image)
