"""The picture of an estimate, one pixel each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import write_whole
from ommatid.scenes.constants import WHITE


def write_estimate(path: Path, estimate: FloatArray) -> None:
    """Write an estimate, (rows, columns), as 8-bit PNG, one pixel each; values outside 0 to 255 are clipped."""
    from skimage import io

    pixels = np.clip(np.round(estimate), 0, WHITE).astype(np.uint8)
    imsave: Any = io.imsave  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    write_whole(path, lambda beside: imsave(beside, pixels, check_contrast=False))
