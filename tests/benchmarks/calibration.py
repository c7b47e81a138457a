"""Time to calibrate H of a large target with grids of point sources, against one source per rendering.

Single point sources take minutes to hours, so only some are rendered and their time is scaled to all. With the same
sensors and seeds both methods use the same rays, so that the entries of H must agree, not only within noise.
"""

# pyright: basic
from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy import sparse

from ommatid.runtime.arrays import FloatArray, IntArray
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
TARGET = 50.0
OVERRIDES = ("target.shape=[119,119]", "target.origin=[98,196]")


def calibration_rows(scene_file: Path, variant: str) -> list[Row]:
    """Return a row for single sources with the same sensors, and one for the whole camera in a single sensor."""
    camera = derive(read(scene_file, OVERRIDES))
    renderer = Renderer(camera, variant, together=False)
    sources = np.random.default_rng(1).choice(camera.unknowns, SOURCES, replace=False)
    matrix = from_grids(renderer, 0)
    columns = from_sources(renderer, sources, 0)
    largest = float(np.abs(matrix[:, sources].toarray() - columns).max())
    methods = [lambda seed: from_grids(renderer, seed), lambda seed: from_sources(renderer, sources, seed)]
    names = ["one source per rendering, a sensor per lens type"]
    checks = [f"H of {SOURCES} sources differs by {largest:.2g} at most, {np.count_nonzero(columns)} nonzero entries"]
    if not variant.startswith("scalar"):
        whole = Renderer(camera, variant)
        from_sources(whole, sources[:2], 0)
        methods.append(lambda seed: from_sources(whole, sources, seed))
        names.append("one source per rendering, a single sensor")
        checks.append("other random numbers, not compared")
    seconds = alternate(methods, REPEATS[variant])
    return [
        Row(
            variant=variant,
            ours="grids of sources",
            other=f"{name}; all {camera.unknowns}, scaled from {SOURCES}",
            seconds=seconds[0],
            other_seconds=other * (camera.unknowns / SOURCES),
            target=TARGET,
            check=check,
        )
        for name, other, check in zip(names, seconds[1:], checks, strict=True)
    ]


def from_grids(renderer: Renderer, seed: int) -> sparse.csr_array:
    """Return H, (M, N), from one pass of grids, including the uniform target for its check."""
    rows: list[sparse.csr_array] = []
    for group in renderer.groups:
        sweep = SourceSweep(renderer, group)
        sweep.add_pass(PASS, seed, no_progress)
        rows.append(entries_of(renderer.camera, sweep.visible, sweep.tally.mean)[0])
    return sparse.csr_array(sparse.vstack(rows, format="csr"))


def from_sources(renderer: Renderer, sources: IntArray, seed: int) -> FloatArray:
    """Return columns of H, (M, sources), from a rendering of the whole camera for each source."""
    camera = renderer.camera
    columns = np.empty((camera.measurements, sources.size))
    for index, source in enumerate(sources):
        image = np.zeros(camera.shape)
        image.flat[source] = 1.0
        renderer.set_target(image)
        for group in renderer.groups:
            seeds = sampler_seeds(seed, "calibration", 0, PASS.passes)
            columns[renderer.rows(group), index] = renderer.expose(group, PASS.samples, seeds)[0]
    return columns
