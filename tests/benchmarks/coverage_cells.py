"""The cells of the coverage table: scenes of the gallery with some changes, the cheapest and most informative first.

They span the gallery, sizes from 19 to 479 pixels, ways to H, numbers of samples, samplers, one to three lens types,
and bright, dark and flat crops. `transport` yields the H of `points`, sooner. A name states the scene, its size or
crop, the lens types where not all are used, and H with its number of samples.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ommatid.interface import read_scene
from ommatid.reconstruct.prior import prior_of
from ommatid.runtime.files import fingerprint
from ommatid.runtime.streams import Purpose, derived_seed
from ommatid.scenes.camera import derive
from ommatid.scenes.scene import Scene, with_tables

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
WITHOUT_PRIOR = ("photo", "single", "still_life", "corridor")  # of the paper's prior here, which they do not name
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
        prior = ("prior.kind=independent",) if self.scene in WITHOUT_PRIOR else ()
        if self.scene not in SAMPLES:
            return prior
        rendering, calibration = SAMPLES[self.scene]
        return *prior, f"render.samples={rendering}", f"calibration.samples={calibration}"

    @property
    def definition(self) -> str:
        """Fingerprint of what the results of a run depend on, besides the program; the same in every checkout."""
        scene = read_scene(self.scene, (*self.base, *self.changes), self.lenses)
        if scene.world is not None:
            scene = with_tables(scene, world=scene.world.model_copy(update={"file": Path(scene.world.file).name}))
        return fingerprint([scene.plain(), self.name, self.drawn])

    @property
    def has_few_samples(self) -> bool:
        """True if H is calibrated with fewer samples than the scene of the gallery asks for."""
        own, changed = (
            read_scene(self.scene, changes).calibration for changes in (self.base, (*self.base, *self.changes))
        )
        if "ideal" in (own.method, changed.method):
            return False
        asked = ENOUGH if own.samples == "auto" else own.sample_count
        return changed.samples != "auto" and changed.sample_count < asked

    def described(self, number: int, *changes: str) -> Scene:
        """Return the scene of run `number`, with a seed of its own for data, noise and calibration.

        A camera with tolerances is another draw of them in every run, since the error bars count them as random.
        """
        seeds = [f"render.seed={derived_seed(0, Purpose.REPEAT, self.name, number)}"]
        if read_scene(self.scene, self.changes).camera.tolerance is not None:
            seed = derived_seed(0, Purpose.REPEAT, f"{MISALIGNED}, {self.name}", number)
            seeds.append(f"camera.tolerance.seed={seed}")
        return read_scene(self.scene, (*self.base, *self.changes, *seeds, *changes), self.lenses)

    def prepared(self, number: int, folder: Path) -> Scene:
        """Return the scene of run `number`, whose image is drawn from its prior where the cell says so."""
        scene = self.described(number)
        if not self.drawn:
            return scene
        path, shape = folder / "drawn.npy", derive(scene).shape
        prior = prior_of(scene.prior, shape, scene.target.pixel_pitch)
        rng = np.random.default_rng(derived_seed(0, Purpose.REPEAT, f"{DRAWN}, {self.name}", number))
        image = prior.mean + prior.apply_root(rng.standard_normal(prior.dimension))
        np.save(path, image.astype(np.float32).reshape(shape))
        return self.described(number, f"target.image={path}", "target.origin=[0, 0]")


IDEAL, POINTS = "calibration.method=ideal", "calibration.fit=none"  # points are the scene's method
COARSE = "render.samples=256"  # so few that rendering is most of the noise
FITTED = "calibration.fit=geometry"
FIT = "prior.kind=fit"  # of scenes that get the prior of the paper here
# Corners of crops of the photograph, each the most extreme in its mean or its standard deviation at that size.
CROPS_19 = {"bright": (165, 30), "dark": (315, 135), "flat": (145, 25)}
CROPS_119 = {"bright": (70, 330), "dark": (240, 30), "flat": (20, 290)}
TILE = (
    "target.shape=[19, 19]",
    "camera.lens.I.pixels=[5, 5]",
    "camera.lens.II.pixels=[3, 3]",
    "camera.lens.III.pixels=[4, 4]",
)


def _samples(number: int) -> tuple[str, ...]:
    return "calibration.method=transport", f"calibration.samples={number}", "calibration.fit=none"


def _origin(corner: tuple[int, int]) -> str:
    return f"target.origin=[{corner[0]}, {corner[1]}]"


def _size(pixels: int) -> str:
    return f"target.shape=[{pixels}, {pixels}]"


def _apertures(diameter: str) -> tuple[str, ...]:
    """Return apertures that diffract, of all three lens types."""
    return (
        "camera.wavelength=550 nm",
        "camera.lens_pitch=1 mm",
        *(f"camera.lens.{name}.aperture={diameter}" for name in ("I", "II", "III")),
    )


def _tiles() -> Iterable[Cell]:
    """The paper's tiles, pinholes."""
    yield Cell("tile19-coarse-ideal", "tile19", (IDEAL, COARSE), 0.2)
    yield Cell("tile19-coarse-transport-1024", "tile19", (COARSE, *_samples(1024)), 0.4)
    yield Cell("tile19-coarse-I-prior-ideal", "tile19", (IDEAL, COARSE), 0.2, ("I",), drawn=True)
    yield Cell("tile19-ideal", "tile19", (IDEAL,), 0.6)
    for samples, seconds in ((4096, 1.5), (1024, 1.0), (256, 0.9), (64, 0.8)):
        seeds = 40 if samples == 256 else 20
        yield Cell(f"tile19-transport-{samples}", "tile19", _samples(samples), seconds, seeds=seeds)
    for name, corner in CROPS_19.items():
        yield Cell(f"tile19-{name}-transport-1024", "tile19", (_origin(corner), *_samples(1024)), 1.0)
    yield Cell("tile19-prior-ideal", "tile19", (IDEAL,), 0.6, drawn=True)
    for samples, seconds in ((16384, 3), (4096, 1.5), (1024, 1.0), (256, 0.9)):
        yield Cell(f"tile19-prior-transport-{samples}", "tile19", _samples(samples), seconds, drawn=True)
    for types in (("I",), ("I", "II")):
        name = "+".join(types)
        yield Cell(f"tile19-{name}-ideal", "tile19", (IDEAL,), 0.5, types)
        yield Cell(f"tile19-{name}-transport-4096", "tile19", _samples(4096), 1.0, types)
    for sampler in ("independent", "stratified", "orthogonal", "ldsampler"):
        yield Cell(f"tile19-{sampler}-4096", "tile19", (f"render.sampler={sampler}", *_samples(4096)), 1.5)
    yield Cell("tile35-transport-1024", "tile35", _samples(1024), 4)
    yield Cell("tile41-ideal", "tile41", (IDEAL,), 5)
    yield Cell("tile41-transport-1024", "tile41", _samples(1024), 6)


def _lenses() -> Iterable[Cell]:
    """Other cameras: diffraction, surfaces, distortion, misalignment, a sensor, one lens, and worlds with depth."""
    bright = _origin((20, 250))
    yield Cell("tile19-bright-0.8mm-16384", "tile19", (bright, *_apertures("0.8 mm"), *_samples(16384)), 5)
    yield Cell("tile19-bright-0.4mm-32768", "tile19", (bright, *_apertures("0.4 mm"), *_samples(32768)), 6)
    yield Cell("tile19-fitted-256", "tile19", (*_samples(256), FITTED), 8)
    yield Cell("tile19-fitted-4096", "tile19", (*_samples(4096), FITTED), 10)
    yield Cell("tile19-points-4096", "tile19", (POINTS,), 10)
    yield Cell("still_life-29-ideal", "still_life", (_size(29), COARSE), 2)
    yield Cell("corridor-29-ideal", "corridor", (_size(29), COARSE), 2)
    yield Cell("misaligned-19-transport-8192", "misaligned", (*TILE, *_samples(8192)), 6)
    yield Cell("sensor-19-transport-4096", "sensor", (*TILE, *_samples(4096)), 8)
    yield Cell("single-29-transport-256", "single", (_size(29), *_samples(256)), 3)
    yield Cell("distorted-transport-4096", "distorted", (), 20)
    yield Cell("doublet-transport-8192", "doublet", ("render.samples=8192", *_samples(8192)), 12)
    yield Cell(
        "planoconvex-transport-8192", "planoconvex", ("render.samples=8192", "noise.variance=1e-2", *_samples(8192)), 12
    )


def _frames() -> Iterable[Cell]:
    """The photograph through three lens types, two and one."""
    yield Cell("photo-59-ideal", "photo", (_size(59), IDEAL), 10)
    yield Cell("photo-59-transport-896", "photo", (_size(59), *_samples(896)), 14)
    yield Cell("photo-59-I-ideal", "photo", (_size(59), IDEAL), 12, ("I",))
    yield Cell("photo-59-I+II-ideal", "photo", (_size(59), IDEAL), 8, ("I", "II"))
    yield Cell("photo-119-ideal", "photo", (_size(119), IDEAL), 16)
    yield Cell("photo-119-transport-896", "photo", (_size(119), *_samples(896)), 24, seeds=40)
    for name, corner in CROPS_119.items():
        yield Cell(f"photo-119-{name}-896", "photo", (_size(119), _origin(corner), *_samples(896)), 24)
    yield Cell("photo-119-transport-256", "photo", (_size(119), *_samples(256)), 20)
    yield Cell("photo-119-flat-256", "photo", (_size(119), _origin(CROPS_119["flat"]), *_samples(256)), 20)
    yield Cell("photo-79-prior-896", "photo", (_size(79), *_samples(896)), 20, drawn=True)
    yield Cell("photo-119-I-ideal", "photo", (_size(119), IDEAL), 6, ("I",))
    yield Cell("photo-119-I+II-ideal", "photo", (_size(119), IDEAL), 12, ("I", "II"))
    yield Cell("photo-119-0.4mm-ideal", "photo", (_size(119), *_apertures("0.4 mm"), IDEAL), 10)
    misaligned = "camera.tolerance.position=41 nm"
    yield Cell("photo-119-misaligned-896", "photo", (_size(119), misaligned, *_samples(896)), 24)
    yield Cell("sensor119", "sensor119", (), 30)
    # The default: a fitted prior, and as many samples as the noise justifies.
    yield Cell("photo-119-I-fit", "photo", (_size(119), FIT), 15, ("I",))
    yield Cell("photo-119-I+II-fit", "photo", (_size(119), FIT), 15, ("I", "II"))
    yield Cell("photo-119-0.4mm-fit", "photo", (_size(119), *_apertures("0.4 mm"), FIT), 30)
    yield Cell("photo-119-misaligned-fit", "photo", (_size(119), misaligned, FIT), 45)
    yield Cell("doublet119", "doublet119", (), 230)
    yield Cell("machine_vision", "machine_vision", (), 300, seeds=5)
    # A drawn image is rough, so its rendering is noisy: with few samples the null space would be hidden in that noise.
    framed = (_size(59), IDEAL, "estimator.method=frame", "render.samples=16384")
    yield Cell("photo-59-I+II-prior-frame", "photo", framed, 15, ("I", "II"), drawn=True)
    yield Cell("photo-239-ideal", "photo", (IDEAL,), 30)
    yield Cell("photo-239-transport-896", "photo", _samples(896), 80)
    yield Cell("photo-359-transport-896", "photo", (_size(359), *_samples(896)), 180)
    yield Cell("photo-479-transport-896", "photo", (_size(479), _origin((16, 16)), *_samples(896)), 320)


CELLS: tuple[Cell, ...] = (*_tiles(), *_lenses(), *_frames())
