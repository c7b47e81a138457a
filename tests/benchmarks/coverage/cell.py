"""A cell of the coverage table: one scene with some changes, run with several seeds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ommatid.reconstruct.prior import prior_of
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.files import fingerprint
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.scene import Scene, read, with_tables

SEEDS = 20
DRAWN, MISALIGNED = "image drawn from the prior", "misalignment"  # purposes of seeds besides the scene's own


# Samples of rendering and calibration of scenes that take as many as they need: cells compare fixed numbers.
SAMPLES = {
    "tile19": (4096, 4096),
    "tile35": (1024, 1024),
    "tile41": (1024, 1024),
    "distorted": (4096, 4096),
    "misaligned": (8192, 8192),
    "sensor": (4096, 16384),
    "single": (256, 256),
    "corridor": (1024, 256),
    "still_life": (1024, 256),
}
ENOUGH = 896  # samples of entries of H, where the scene takes as many as the noise justifies


@dataclass(frozen=True)
class Cell:
    """A scene of the gallery with changes, and how often it is run.

    changes, lenses : as of the options --set and --lens
    seconds : of one run on two cores, roughly
    drawn : True if every run has another image, drawn from the scene's prior; False for the scene's picture
    seeds : number of runs
    """

    name: str
    scene: str
    changes: tuple[str, ...]
    seconds: float
    lenses: tuple[str, ...] = ()
    drawn: bool = False
    seeds: int = SEEDS

    @property
    def base(self) -> tuple[str, ...]:
        """Changes of the scene before those of the cell."""
        name = Path(self.scene).stem
        if name not in SAMPLES:
            return ()
        rendering, calibration = SAMPLES[name]
        return f"render.samples={rendering}", f"calibration.samples={calibration}"

    @property
    def definition(self) -> str:
        """Fingerprint of what the results of a run depend on, besides the program; the same in every checkout."""
        scene = read(Path(self.scene), (*self.base, *self.changes), self.lenses)
        if scene.world is not None:
            scene = with_tables(scene, world=scene.world.model_copy(update={"file": Path(scene.world.file).name}))
        return fingerprint([scene.plain(), self.name, self.drawn])

    @property
    def has_few_samples(self) -> bool:
        """True if H is calibrated with fewer samples than the scene of the gallery asks for."""
        own, changed = (
            read(Path(self.scene), changes).calibration for changes in (self.base, (*self.base, *self.changes))
        )
        if "ideal" in (own.method, changed.method):
            return False
        asked = ENOUGH if own.samples == "auto" else own.sample_count
        return changed.samples != "auto" and changed.sample_count < asked

    def described(self, number: int) -> Scene:
        """Return the scene of run `number`, with a seed of its own for data, noise and calibration.

        A camera with tolerances is another draw of them in every run, since the error bars count them as random.
        """
        changes = [*self.base, *self.changes, f"render.seed={derived_seed(0, Purpose.REPEAT, self.name, number)}"]
        if read(Path(self.scene), self.changes).camera.tolerance is not None:
            changes.append(
                f"camera.tolerance.seed={derived_seed(0, Purpose.REPEAT, f'{MISALIGNED}, {self.name}', number)}"
            )
        return read(Path(self.scene), changes, self.lenses)

    def drawn_image(self, scene: Scene, shape: tuple[int, int], number: int) -> FloatArray:
        """Return the image of run `number` drawn from the scene's prior, `shape`, in the renderer's precision."""
        prior = prior_of(scene.prior, shape, scene.target.pixel_pitch)
        rng = np.random.default_rng(derived_seed(0, Purpose.REPEAT, f"{DRAWN}, {self.name}", number))
        image = prior.mean + prior.apply_root(rng.standard_normal(prior.dimension))
        return image.astype(np.float32).astype(np.float64).reshape(shape)
