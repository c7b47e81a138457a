"""Rendering of a film in bands: all passes of some sensor pixels before those of the next, so that memory holds few."""

from __future__ import annotations

import numpy as np

from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.progress import Progress

from .renderer.renderer import Renderer
from .sampling.checkpoint import Checkpoint, State
from .sampling.passes import Plan, Tally
from .sampling.seeds import sampler_seeds

BAND = 2**22  # sensor pixels, at most, unless rays that start together are of more

Part = tuple[str, slice]  # group, and pixels of it


def render_bands(
    renderer: Renderer, seed: int, work: Plan, progress: Progress, checkpoint: Checkpoint | None
) -> tuple[FloatArray, FloatArray]:
    """Return the mean over all passes on every sensor pixel and its variance, (M,) each, which bands do not change."""
    bands = bands_of(renderer, work.samples)
    mean, variance, first = np.zeros(renderer.camera.measurements), np.zeros(renderer.camera.measurements), 0
    state = State() if checkpoint is None else checkpoint.state()
    if state:
        mean, variance, first = state["mean"], state["variance"], int(state["band"])
    for number, band in list(enumerate(bands))[first:]:
        tally = Tally(sum(pixels.stop - pixels.start for _, pixels in band))
        tally.resume("light", state)
        state = State()  # the other bands have not begun
        for index in range(tally.count, work.passes):
            seeds = sampler_seeds(seed, "data", index, work.passes)
            parts = [renderer.expose(group, work.samples, seeds, block=part)[0] for group, part in band]
            tally.add(np.concatenate(parts))
            if checkpoint is not None:
                done = {"mean": mean, "variance": variance, "band": np.array(number)}
                checkpoint.offer(lambda done=done, tally=tally: {**done, **tally.state("light")})
            progress((number + (index + 1) / work.passes) / len(bands))
        start = renderer.rows(band[0][0]).start + band[0][1].start
        rows = slice(start, start + tally.mean.size)
        mean[rows], variance[rows] = tally.mean, tally.variance
    return mean, variance


def bands_of(renderer: Renderer, samples: int) -> list[list[Part]]:
    """Join the adjacent blocks of pixels whose rays start together to bands."""
    bands, pixels = list[list[Part]](), 0
    for group in renderer.groups:
        rows = renderer.rows(group)
        whole = [slice(0, rows.stop - rows.start)]
        for block in renderer.blocks(group, samples) if renderer.is_fast else whole:
            size = block.stop - block.start
            if not bands or pixels + size > BAND:
                bands.append([])
                pixels = 0
            bands[-1].append((group, block))
            pixels += size
    return bands
