"""H of a large target from grids of point sources against one source a rendering.

Point sources one by one take minutes to hours, so only some are rendered and their time is scaled to all. Both ways
see the same rays where they share sensors and seeds, so there the entries of H must agree, not only within noise.
"""

# pyright: basic
from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from ommatid.runtime.progress import no_progress
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import read
from ommatid.simulate.calibration.point_sources import SourceSweep, entries_of
from ommatid.simulate.renderer.renderer import Renderer
from ommatid.simulate.sampling.passes import Plan
from ommatid.simulate.sampling.seeds import sampler_seeds

from .alternation import Row, alternate

PASS = Plan(passes=1, samples=16)
SOURCES = 60
REPEATS = {"llvm_ad_mono": 5, "scalar_rgb": 3}
AIM = 50.0
OVERRIDES = ("target.shape=[119,119]", "target.origin=[98,196]")


def calibration_rows(scene_file: Path, variant: str) -> list[Row]:
    """Return a row for single sources in the same renderer, and one for the camera in one sensor, where possible."""
    camera = derive(read(scene_file, OVERRIDES))
    renderer = Renderer(camera, variant, together=False)
    sources = np.random.default_rng(1).choice(camera.unknowns, SOURCES, replace=False)
    matrix = by_grids(renderer, 0)
    singly = by_sources(renderer, sources, 0)
    apart = float(np.abs(matrix[:, sources].toarray() - singly).max())
    ways = [lambda seed: by_grids(renderer, seed), lambda seed: by_sources(renderer, sources, seed)]
    names = ["one source a rendering, a sensor a lens type"]
    checks = [f"H of {SOURCES} sources differs by {apart:.2g} at most, {np.count_nonzero(singly)} entries not 0"]
    if not variant.startswith("scalar"):
        whole = Renderer(camera, variant)
        by_sources(whole, sources[:2], 0)
        ways.append(lambda seed: by_sources(whole, sources, seed))
        names.append("one source a rendering, one sensor in all")
        checks.append("other random numbers, not compared")
    seconds = alternate(ways, REPEATS[variant])
    return [
        Row(
            variant,
            "grids of sources",
            f"{name}; all {camera.unknowns}, scaled from {SOURCES}",
            seconds[0],
            other * (camera.unknowns / SOURCES),
            AIM,
            check,
        )
        for name, other, check in zip(names, seconds[1:], checks, strict=True)
    ]


def by_grids(renderer: Renderer, seed: int) -> sparse.csr_array:
    """H, (M, N), by one pass of grids, the uniform target for its check included."""
    rows: list[sparse.csr_array] = []
    for group in renderer.groups:
        swept = SourceSweep(renderer, group)
        swept.add_pass(PASS, seed, no_progress)
        tally = swept.tally
        rows.append(entries_of(renderer.camera, swept.visible, tally.mean)[0])
    return sparse.csr_array(sparse.vstack(rows, format="csr"))


def by_sources(renderer: Renderer, sources: NDArray[np.int64], seed: int) -> NDArray[np.float64]:
    """Columns of H, (M, sources), by a rendering of the whole camera for each source."""
    camera = renderer.camera
    columns = np.empty((camera.measurements, sources.size))
    for place, source in enumerate(sources):
        image = np.zeros(camera.shape)
        image.flat[source] = 1.0
        renderer.set_target(image)
        for group in renderer.groups:
            own = sampler_seeds(seed, "calibration", 0, PASS.passes)
            columns[renderer.rows(group), place] = renderer.expose(group, PASS.samples, own)[0]
    return columns
