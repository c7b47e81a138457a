"""The scene file: the camera, its target and the settings of the computation.

TOML in, a frozen and validated `Scene` out. Lengths carry a unit ("6 um"); a bare number where a length is expected
and an unknown key are errors.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

from pydantic import ConfigDict, Field, PrivateAttr, ValidationError, model_validator

from ommatid.runtime.errors import InputError, named, naming_source, shortened
from ommatid.runtime.files import write_text
from ommatid.runtime.input_files import read_text, real_path
from ommatid.runtime.printable import printable

from .geometry.solution import complete
from .tables import toml
from .tables.camera import CameraTable
from .tables.estimation import (
    CalibrationTable,
    DesignTable,
    EstimatorTable,
    PriorTable,
    RenderTable,
    StudyTable,
    TilesTable,
    with_samples_without_noise,
)
from .tables.gallery import find_scene, missing_scene
from .tables.messages import explain
from .tables.sensor import LightTable, NoiseTable, SensorTable
from .tables.table import Table, allow_absent
from .tables.toml import Change, apply_overrides, keep_lenses
from .tables.units import Corner, FileName, Length, Pair
from .tables.world import WorldTable

ALLOW_OUTSIDE = "--allow-outside"  # stands among the changes of a scene, so that it goes where they go
TRUTH = "truth.exr"
WORLD_PICTURE = "target.exr"  # beside it, where the world is finer than f


class TargetTable(Table):
    """The flat picture that the camera looks at, and the grid on which the image is reconstructed."""

    model_config = ConfigDict(json_schema_extra=allow_absent("pixel_pitch", "distance"))

    image: FileName | None = Field(
        default=None,
        description='"photo:NAME" for a picture of scikit-image, or a PNG, TIFF, EXR or NPY file; absent: none',
    )
    origin: Corner | None = Field(
        default=None, description="row and column where the crop starts; absent: the whole picture"
    )
    shape: Pair | None = Field(default=None, description="rows and columns of f, the grid of the reconstruction")
    detail: int = Field(
        default=1,
        ge=1,
        le=16,
        description="the picture and the world are so many times finer than f; f is the average of their pixels",
    )
    pixel_pitch: Length = Field(description="side of one pixel of the target")
    distance: Length = Field(description="distance from the plane of the lenses to the target")


class Scene(Table):
    """A camera, its target and the settings of the computation."""

    title: str = ""
    expect: str | None = Field(
        default=None,
        pattern="^(trusted|not trusted: .+)$",
        exclude=True,  # changes no result, so it is in no fingerprint and no file of a run
        description='the verdict that a run must have: "trusted", or "not trusted: REASON"',
    )
    target: TargetTable
    camera: CameraTable
    world: WorldTable | None = None
    light: LightTable | None = None
    noise: NoiseTable | None = None
    sensor: SensorTable | None = None
    prior: PriorTable = PriorTable()
    estimator: EstimatorTable = EstimatorTable()
    tiles: TilesTable = TilesTable()
    render: RenderTable = RenderTable()
    calibration: CalibrationTable = CalibrationTable()
    study: StudyTable | None = None
    design: DesignTable | None = Field(default=None, exclude=True)  # changes no run

    _source: Path = PrivateAttr(default=Path("scene"))
    _changes: dict[str, str] = PrivateAttr(default_factory=dict[str, str])
    _world_copy: Path | None = PrivateAttr(default=None)
    _allow_outside: bool = PrivateAttr(default=False)

    @model_validator(mode="before")
    @classmethod
    def _count_samples_without_noise(cls, data: Any) -> Any:
        return with_samples_without_noise(data)

    @model_validator(mode="after")
    def _check_combination(self) -> Scene:
        if self.noise is not None and self.sensor is not None:
            raise ValueError("expected [noise] for an ideal sensor or [sensor] for a real one, got both; remove one")
        fits = self.calibration.fit in ("auto", "geometry")
        if not self.camera.walls and (self.calibration.method != "transport" or fits):
            raise ValueError(
                "camera.walls = false leaves H without a closed form: expected calibration.method 'transport', no fit,"
                f" got '{self.calibration.method}'"
            )
        if self.camera.binning == "sum" and self.noise is not None and self.noise.bits is not None:
            raise ValueError(
                "camera.binning 'sum' reads more than the full scale of noise.bits, got both; remove one of the two"
            )
        if self.camera.binning == "sum" and self.sensor is not None:
            raise ValueError(
                "camera.binning 'sum' takes the ideal sensor of [noise], got a [sensor]; remove one of the two"
            )
        if not self.camera.walls and self.sensor is not None and self.sensor.acceptance is not None:
            raise ValueError("sensor.acceptance needs walls, since light through other lenses comes at other angles")
        if self.light is not None and self.camera.wavelength is not None:
            raise ValueError("expected camera.wavelength or light.spectrum, got both; remove one")
        if self.target.image is None and self.target.shape is None:
            raise ValueError("a target without a picture needs target.shape, the grid to reconstruct, got none")
        if self.estimator.prior_variance is not None and (self.prior.kind == "fit" or self.target.detail > 1):
            conflict = "prior.kind 'fit'" if self.prior.kind == "fit" else f"target.detail {self.target.detail}"
            raise ValueError(
                f"estimator.prior_variance takes a known prior of f, got {conflict}; remove one of the two"
            )
        if self.estimator.method == "tiles" and self.prior.level not in (None, "known"):
            raise ValueError(
                "estimator.method 'tiles' takes the level of the image for known, got prior.level"
                f" {self.prior.level:g}; remove one of the two"
            )
        if self.sensor is not None:
            for lens in self.camera.lens:
                if lens.aperture is None and lens.surfaces is None:
                    raise ValueError(
                        f"a [sensor] counts electrons: expected an aperture or surfaces of lens type '{lens.name}',"
                        " got a pinhole"
                    )
        return self

    def __repr__(self) -> str:
        """Return title, target and lens types in one line."""
        shape, lenses = self.target.shape, named(lens.name for lens in self.camera.lens)
        grid = "whole picture" if shape is None else f"{shape[0]} x {shape[1]} pixels"
        return f"<Scene '{shortened(self.title)}': {grid}, lens types {lenses}>"

    __str__ = __repr__

    @property
    def source(self) -> Path:
        """The file that error messages name."""
        return self._source

    @property
    def changes(self) -> dict[str, str]:
        """The options that changed keys of the file, by key, which error messages name beside it."""
        return self._changes

    @property
    def world_copy(self) -> Path | None:
        """The file to read in place of `world.file`, if this is another machine."""
        return self._world_copy

    @property
    def allows_outside(self) -> bool:
        """True if the world may name files outside its folder; a copy on another machine was checked before."""
        return self._allow_outside or self._world_copy is not None

    @property
    def sensor_distance(self) -> float | None:
        """Distance in mm from one sensor of all lens types to the target; None if the lenses stand in one plane.

        `target.distance` is that of the foremost lenses, which have the largest magnification.
        """
        camera, target = self.camera, self.target
        if camera.common == "lenses":
            return None
        largest = max(float(lens.magnification) for lens in camera.lens)
        return target.distance * (1 + largest * camera.pixel_pitch / target.pixel_pitch)

    @property
    def assumed_prior(self) -> PriorTable:
        """The prior that the estimator assumes: [prior], with estimator.prior_variance where it is set."""
        variance = self.estimator.prior_variance
        return self.prior if variance is None else self.prior.model_copy(update={"variance": variance})

    @property
    def prior_ratio(self) -> float:
        """The actual variance of the prior over the one that the estimator assumes."""
        return self.prior.variance / self.assumed_prior.variance

    @property
    def has_noise(self) -> bool:
        """True if the sensor adds noise or rounds."""
        noise = self.noise
        return self.sensor is not None or (noise is not None and noise.variance + noise.quantisation_variance > 0)

    def plain(self) -> dict[str, Any]:
        """The scene in types of TOML and JSON, without absent keys."""
        return self.model_dump(mode="json", exclude_none=True)


def resolved(scene: Scene, shape: tuple[int, int]) -> Scene:
    """The scene as a run's folder stores it: the target is the whole picture `truth.exr` beside the scene file.

    Where the world is finer than f, its picture is `target.exr`, and `truth.exr` the average. With a [world],
    `truth.exr` shows the world too, so the target keeps its own picture, if it has one.
    """
    picture = TRUTH if scene.target.detail == 1 else WORLD_PICTURE
    update: dict[str, Any] = {"image": picture, "origin": None, "shape": shape}
    if scene.world is not None:
        update = {"shape": shape}
    return with_tables(scene, target=scene.target.model_copy(update=update))


def with_tables(scene: Scene, **tables: Any) -> Scene:
    """A copy with some tables exchanged; its errors name the same file."""
    return _with_source(scene.model_copy(update=tables), scene.source)


def parse(data: dict[str, Any], source: Path, world_copy: Path | None = None) -> Scene:
    """Validate a scene's tables. Raises InputError that names the file, the key and what was expected.

    world_copy : file that is read in place of `world.file`, on another machine
    """
    completed, contradiction = complete(data)
    try:
        scene = Scene.model_validate(completed)
    except ValidationError as error:
        absent = all(problem["type"] == "missing" for problem in error.errors())
        raise InputError(f"{source}: {(absent and contradiction) or explain(error, completed, Scene)}") from error
    if contradiction:
        raise InputError(f"{source}: {contradiction}")
    scene = _with_prior_kind(scene)
    scene._world_copy = world_copy  # pyright: ignore[reportPrivateUsage]
    return _with_source(scene, source)


def _with_prior_kind(scene: Scene) -> Scene:
    """Return the scene with a fitted prior, where it names no kind and an image is estimated at once from noisy data.

    Elsewhere pixels are independent: in the paper's tiles, where a misalignment is estimated, and where a variance is
    stated.
    """
    prior, estimator = scene.prior, scene.estimator
    stated = prior.model_fields_set & {"kind", "variance", "correlation_length", "exponent"}
    plain = estimator.method != "tiles" and estimator.misalignment == "trust" and estimator.prior_variance is None
    if stated or not scene.has_noise or not plain or estimator.noise_variance == 0:
        return scene
    return scene.model_copy(update={"prior": prior.model_copy(update={"kind": "fit"})})


def parse_stored(data: object, source: Path) -> Scene:
    """Validate the scene that a stack or a model stores, which needs no other file.

    Raises InputError as `parse` does, and for a scene that names files of lenses, glasses or curves, which a scene has
    only until they are read: a file that was received is not to open others.
    """
    if not isinstance(data, dict):
        raise InputError(f"{source}: expected the tables of a scene, got {printable(repr(data), 40)}; make it again")
    scene = parse(cast(dict[str, Any], data), source)
    named = [f"camera.lens.{lens.name}.surfaces" for lens in scene.camera.lens if isinstance(lens.surfaces, str)]
    named += [] if scene.camera.glass_catalogue is None else ["camera.glass_catalogue"]
    named += [] if scene.light is None or scene.light.file is None else ["light.spectrum"]
    efficiency = None if scene.sensor is None else scene.sensor.quantum_efficiency
    named += ["sensor.quantum_efficiency"] if isinstance(efficiency, str) else []
    if named:
        raise InputError(f"{source}: expected a scene without other files, got a file as {named[0]}; make it again")
    if scene.target.shape is None:
        raise InputError(f"{source}: expected a scene with target.shape, got none; make it again")
    return scene


def _with_source(scene: Scene, source: Path) -> Scene:
    scene._source = source  # pyright: ignore[reportPrivateUsage]
    return scene


def read(path: Path, overrides: Iterable[Change] = (), lenses: Iterable[str] = ()) -> Scene:
    """Read a scene file, apply `--set` overrides and keep only the named lens types, if any are named.

    `path` may be the name of a gallery scene. Relative paths of the target's picture and of the world start at the
    scene file's folder.
    Raises InputError that names the file, the key, what was expected and what came.
    """
    path = find_scene(path)
    try:
        text = read_text(path, toml.LARGEST)
    except FileNotFoundError as error:
        raise InputError(missing_scene(path)) from error
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: expected a scene file, a text in UTF-8, got other bytes at {error.start}; the scene stands before"
            " other files"
        ) from error
    except IsADirectoryError as error:
        raise InputError(f"{path}: expected a scene file, got a folder; name the file in it") from error
    except OSError as error:
        raise InputError(f"{path}: could not be read as a scene file ({error.strerror})") from error
    try:
        data = toml.loads(text)
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    return with_changes(data, path, overrides, lenses)


def with_changes(data: dict[str, Any], source: Path, overrides: Iterable[Change], lenses: Iterable[str]) -> Scene:
    """The scene in `data` after `--set` overrides and `--lens`, with absolute paths. Raises InputError."""
    overrides = list(overrides)
    keys = [override for override in overrides if override != ALLOW_OUTSIDE]
    with naming_source(source):
        data = keep_lenses(apply_overrides(data, keys), lenses)
    changes = toml.options_by_key(keys)
    with naming_source(source, changes):
        scene = parse(data, source)
    scene._changes = changes  # pyright: ignore[reportPrivateUsage]
    scene._allow_outside = len(keys) < len(overrides)  # pyright: ignore[reportPrivateUsage]
    update: dict[str, Any] = {}
    if any(lens.surfaces is not None for lens in scene.camera.lens):
        from .formats.lens_file import with_surfaces

        update["camera"] = with_surfaces(scene.camera, source)
    update |= _with_curves(scene)
    image, world = scene.target.image, scene.world
    if image is not None and not image.startswith("photo:"):
        update["target"] = scene.target.model_copy(update={"image": str(real_path(source.parent / image))})
    if world is not None:
        update["world"] = world.model_copy(update={"file": str(real_path(source.parent / world.file))})
    names = [named for named in (update.get("target", scene.target).image, world and update["world"].file) if named]
    if not all(map(_is_utf8, names)):  # scene.toml of a run names it
        raise InputError(f"{source}: expected files in folders whose names are UTF-8, got others; rename them")
    return with_tables(scene, **update)


def _is_utf8(text: str) -> bool:
    return text == text.encode("utf-8", "replace").decode("utf-8")


def _with_curves(scene: Scene) -> dict[str, Any]:
    """Tables whose files of a curve, relative to the scene file, are replaced by its points. Raises InputError."""
    from .formats.curve import read_curve

    update: dict[str, Any] = {}
    if scene.light is not None and scene.light.file is not None:
        points = read_curve(real_path(scene.source.parent / scene.light.file))
        update["light"] = scene.light.model_copy(update={"spectrum": points})
    if scene.sensor is not None and isinstance(scene.sensor.quantum_efficiency, str):
        points = read_curve(real_path(scene.source.parent / scene.sensor.quantum_efficiency), 1.0)
        update["sensor"] = scene.sensor.model_copy(update={"quantum_efficiency": points})
    return update


def write(path: Path, scene: Scene) -> None:
    """Write a scene as TOML, defaults included. Raises InputError or MachineError."""
    pair = re.compile(r"\[\s+([-+.\de]+),\s+([-+.\de]+),\s+\]")  # tomli_w spreads pairs over four lines
    write_text(path, pair.sub(r"[\1, \2]", toml.dumps(scene.plain())))
