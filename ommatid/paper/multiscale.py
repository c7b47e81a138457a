"""The expected errors of Fu, Litterio, Felzenszwalb and Zia, "Multiscale Super Resolution without Image Priors".

Pixels of several sizes see the same picture, each at every shift by a pixel of the estimate, without a prior and with
noise of variance 1 in every reading (arXiv 2604.21810). That is a camera of one lens type of each size; its error far
from the edges is a mean over waves. Along one dimension they are the waves that are constant down the columns.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from fractions import Fraction
from itertools import combinations
from math import gcd
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from ommatid.analysis.best_camera import design_space, scene_of
from ommatid.analysis.design import LensCandidate
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import make_folder
from ommatid.runtime.progress import Progress
from ommatid.runtime.study import write_rows
from ommatid.scenes.scene import Scene, read
from ommatid.scenes.tables.gallery import GALLERY

from .claims import CLAIMS, YES, Claim

SOURCE = "multiscale paper"
FLAT = 1e12  # prior variance, which nothing is learnt from
SIDES = 120, 240  # pixels of f of the squares from which the mean is extrapolated to a picture without edges
CLOSE = 0.01  # relative difference up to which a published error is met
SQUARES = {  # errors in two dimensions, by averages and by sums over a pixel
    (2, 3, 5): (30.441, 0.47826),
    (3, 4, 5): (95.814, 0.44553),
    (5, 6, 7): (598.72, 0.49550),
    (17, 18, 19): (57_691.0, 0.55350),
}
LINES = {(2, 3): 3.2816, (3, 4): 7.1086, (17, 18): 194.28, (17, 18, 19): 117.50}  # in one, by averages


def write_multiscale(folder: Path, progress: Progress) -> dict[str, Any]:
    """Compute the errors, write claims.csv, and describe them in JSON's types. Raises MachineError."""
    started = perf_counter()
    make_folder(folder)
    claims: list[Claim] = []
    for number, (sizes, published) in enumerate(SQUARES.items(), 1):
        for binning, error in zip(("average", "sum"), published, strict=True):
            found = _far_from_edges(lambda waves: float(waves.mean()), sizes, binning)
            claims.append(_claim(f"pixels of {_words(sizes)}, {binning}s", found, error))
        progress(number / (len(SQUARES) + len(LINES)))
    for number, (sizes, error) in enumerate(LINES.items(), len(SQUARES) + 1):
        found = _far_from_edges(lambda waves: float(waves[0].mean()), sizes, "average")
        claims.append(_claim(f"pixels of {_words(sizes)} along one dimension, averages", found, error))
        progress(number / (len(SQUARES) + len(LINES)))
    hidden = is_deficient((2, 3)) and not any(is_deficient(sizes) for sizes in SQUARES)
    claims.append(Claim("two sizes leave a null space in two dimensions", YES if hidden else "no", {}, source=SOURCE))
    write_rows(folder / CLAIMS, [claim.row for claim in claims])
    described = [asdict(claim) for claim in claims]
    return {"folder": str(folder), "files": [CLAIMS], "claims": described, "seconds": perf_counter() - started}


def _far_from_edges(mean: Callable[[FloatArray], float], sizes: Sequence[int], binning: str) -> float:
    """Return a mean over waves without the part of the edges, which falls with the side of the square."""
    small, large = (float(mean(errors_of_waves(sizes, binning, side))) for side in SIDES)
    return (SIDES[1] * large - SIDES[0] * small) / (SIDES[1] - SIDES[0])


def camera_of(sizes: Sequence[int], binning: str, side: int) -> Scene:
    """Return the scene of a camera of one array for each size of pixels; binning : as of [camera]."""
    noise = "noise={variance=1}", f"prior.variance={FLAT}"
    changes = f"target.shape=[{side},{side}]", *noise, f"camera.binning={binning}"
    types = [LensCandidate(Fraction(size)) for size in sizes]
    return scene_of(read(GALLERY / "tile19.toml", changes), types, pitch=2.0 * side)


def errors_of_waves(sizes: Sequence[int], binning: str, side: int) -> FloatArray:
    """Return the expected squared error of each wave of the picture, whose mean is that of a pixel: (side, side)."""
    space = design_space(camera_of(sizes, binning, side), [])
    return space.groups.errors(np.ones(len(space.types)))


def is_deficient(sizes: Sequence[int]) -> bool:
    """Return True if some wave of a plane averages to zero over pixels of every size.

    It has a period along the rows that some of the sizes are multiples of, and another along the columns for the rest.
    """
    for count in range(len(sizes) + 1):
        for some in combinations(sizes, count):
            rest = [size for size in sizes if size not in some]
            if (not some or gcd(*some) > 1) and (not rest or gcd(*rest) > 1):
                return True
    return False


def _claim(name: str, found: float, published: float) -> Claim:
    holds = YES if abs(found / published - 1) <= CLOSE else "no"
    remark = f"{found:.5g}, published {published:.5g}"
    return Claim(name, holds, {"computed": found, "published": published}, remark, SOURCE)


def _words(sizes: Sequence[int]) -> str:
    return ", ".join(map(str, sizes))
