"""The scene file: what the camera is, what it looks at, and what is to be computed.

TOML in, a frozen and validated `Scene` out. Lengths are written with a unit ("6 um"); a bare number where a length
belongs and an unknown key are errors.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any, Literal, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from .errors import InputError
from .explain import explain
from .files import write_text
from .override import apply_overrides, keep_lenses
from .quantities import Corner, ExpectedNoise, Length, Magnification, Memory, Pair, Samples, Step, pair

FULL_SCALE = 256.0
LARGEST = 1e12  # of a value: files hold float32, and squares of values have to fit as well
TRUTH = "truth.exr"
LENS_NAME = r"^[A-Za-z0-9_-]+$"


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Target(_Table):
    """The flat picture that the camera looks at."""

    image: str = Field(description='"photo:NAME" for one that scikit-image ships, or a PNG, TIFF, EXR or NPY file')
    origin: Corner | None = Field(
        default=None, description="row and column where the crop starts; absent: the whole picture"
    )
    shape: Pair | None = Field(default=None, description="rows and columns of the crop")
    pixel_pitch: Length = Field(description="side of one pixel of the target")
    distance: Length = Field(description="from the plane of the lenses to the target")


class Lens(_Table):
    """One lens type: an array of equal sub-imagers."""

    name: str = Field(pattern=LENS_NAME)
    magnification: Magnification = Field(description="image size over object size, at most 1")
    array: Pair = Field(description="rows and columns of sub-imagers")
    pixels: Literal["fit"] | Pair = Field(description='rows and columns of a sub-image, or "fit"')
    step: Step = Field(default=Fraction(1), description="pixels of the target from one sub-imager's window to the next")

    @field_validator("pixels", mode="before")
    @classmethod
    def _pixels(cls, value: object) -> object:
        numbers: list[object] = list(value) if isinstance(value, list | tuple) else []  # type: ignore[arg-type]
        if value == "fit" or (len(numbers) == 2 and all(type(n) is int and n >= 1 for n in numbers)):  # type: ignore[operator]
            return pair(cast(object, value))
        raise ValueError(f'expected two whole numbers of at least 1, such as [5, 5], or "fit", got {value!r}')


class Camera(_Table):
    """A flat sensor behind arrays of micro-lenses."""

    pixel_pitch: Length = Field(description="side of one sensor pixel")
    lens_pitch: Length = Field(description="from one lens's centre to the next")
    lens: Annotated[tuple[Lens, ...], BeforeValidator(pair), Field(min_length=1)]

    @model_validator(mode="after")
    def _names_differ(self) -> Camera:
        names = [lens.name for lens in self.lens]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"expected a name of its own for every lens type, got {name!r} twice")
        return self


class Noise(_Table):
    """What the sensor adds to the light."""

    variance: float = Field(
        default=0.0, ge=0, le=LARGEST**2, description="Gaussian, in squared units of the target's values"
    )
    bits: int | None = Field(default=None, ge=1, le=24, description="of the recorded values; absent: no quantisation")
    saturation: float | None = Field(
        default=None,
        ge=-LARGEST,
        le=LARGEST,
        description="recorded values stop here; pixels that reach it are left out; absent: none does",
    )

    @property
    def level(self) -> float:
        """Height of a quantisation level, full scale / 2^bits; 0 without quantisation."""
        return 0.0 if self.bits is None else FULL_SCALE / 2**self.bits

    @property
    def quantisation_variance(self) -> float:
        """Variance that rounding to levels adds, level^2 / 12 (Wood et al., section 5)."""
        return self.level**2 / 12


class Prior(_Table):
    """What is known of the image before any light is recorded."""

    kind: Literal["independent", "exponential", "power", "fit"] = Field(
        default="independent",
        description="how pixels go together: not at all; exp(-distance / length); a power of frequency; found by fit",
    )
    mean: float = Field(default=127.5, ge=-LARGEST, le=LARGEST)
    variance: float = Field(default=5461.25, gt=0, le=LARGEST**2, description="of every pixel; kind fit finds it")
    correlation_length: Length | None = Field(
        default=None, description="on the target, of kind exponential; kind fit finds it"
    )
    exponent: float | None = Field(
        default=None, ge=0, le=8, description="a of a power spectrum 1/frequency^a, of kind power; absent: 2"
    )

    @model_validator(mode="after")
    def _only_what_the_kind_has(self) -> Prior:
        if self.kind == "exponential" and self.correlation_length is None:
            raise ValueError('kind "exponential" needs a correlation_length, such as "10 mm"')
        if self.kind != "exponential" and self.correlation_length is not None:
            raise ValueError(f'correlation_length belongs to kind "exponential", got kind "{self.kind}"')
        if self.kind != "power" and self.exponent is not None:
            raise ValueError(f'exponent belongs to kind "power", got kind "{self.kind}"')
        return self


class Estimator(_Table):
    """How the image is estimated."""

    noise_variance: ExpectedNoise | None = Field(
        default=None, description='what the estimator expects; "fit": found from the stack; absent: all that is known'
    )
    method: Literal[
        "auto",
        "covariance",
        "information",
        "square-root-information",
        "square-root-covariance",
        "svd",
        "dual",
        "tiles",
        "frame",
    ] = Field(default="auto", description="a dense form, tiles, or the whole frame; auto: the cheapest that is right")
    tolerance: float = Field(default=1e-8, gt=0, le=1, description="relative error that a dense form is allowed")
    accuracy: float = Field(
        default=0.01, gt=0, le=1, description="error that a frame is allowed, in its posterior standard deviations"
    )
    memory: Memory | None = Field(
        default=None, description='never to be exceeded, such as "4 GB"; absent: half of what is free'
    )


class Tiles(_Table):
    """How a frame is cut where it is reconstructed tile by tile."""

    size: int = Field(default=35, ge=4, le=200, description="rows and columns of a tile, in pixels of the target")
    overlap: int = Field(default=8, ge=0, description="border of a tile that its neighbours replace")

    @model_validator(mode="after")
    def _a_core_is_left(self) -> Tiles:
        if 2 * self.overlap >= self.size:
            raise ValueError(
                f"tiles.overlap {self.overlap} leaves nothing of tiles of {self.size}; expected below half"
            )
        return self


class Render(_Table):
    """How the sub-images are rendered."""

    samples: Samples = 256
    seed: int = Field(default=0, ge=0, lt=2**63)
    variant: Literal["auto", "scalar_rgb", "llvm_ad_mono", "cuda_ad_mono"] = "auto"
    sampler: Literal["multijitter", "independent"] = "multijitter"


class Calibration(_Table):
    """How the observation matrix H is found."""

    method: Literal["points", "ideal"] = "points"
    samples: Samples = 256


class Scene(_Table):
    """A camera, its target and what is to be computed."""

    title: str = ""
    target: Target
    camera: Camera
    noise: Noise | None = None
    prior: Prior = Prior()
    estimator: Estimator = Estimator()
    tiles: Tiles = Tiles()
    render: Render = Render()
    calibration: Calibration = Calibration()

    _source: Path = PrivateAttr(default=Path("scene"))

    @property
    def source(self) -> Path:
        """The file that error messages name."""
        return self._source

    def plain(self) -> dict[str, Any]:
        """The scene as TOML and JSON hold it; absent keys stay absent."""
        return self.model_dump(mode="json", exclude_none=True)


def resolved(scene: Scene, shape: tuple[int, int]) -> Scene:
    """The scene as a run's folder holds it: its target is the picture `truth.exr` beside it, whole."""
    target = scene.target.model_copy(update={"image": TRUTH, "origin": None, "shape": shape})
    return _moved(scene.model_copy(update={"target": target}), scene.source)


def parse(data: dict[str, Any], source: Path) -> Scene:
    """Validate a scene's tables. Raises InputError that names the file, the key and what was expected."""
    try:
        scene = Scene.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{source}: {explain(error, data, Scene)}") from error
    return _moved(scene, source)


def _moved(scene: Scene, source: Path) -> Scene:
    scene._source = source  # pyright: ignore[reportPrivateUsage]
    return scene


def read(path: Path, overrides: Iterable[str] = (), lenses: Iterable[str] = ()) -> Scene:
    """Read a scene file, apply `--set` overrides and keep only the named lens types, if any are named.

    The target's picture, where it is a file, is looked for beside the scene file.
    Raises InputError that names the file, the key, what was expected and what came.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such scene file; `ommatid init {path.name}` writes one to start from") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: could not be read as a scene file ({error})") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error
    return with_changes(data, path, overrides, lenses)


def with_changes(data: dict[str, Any], source: Path, overrides: Iterable[str], lenses: Iterable[str]) -> Scene:
    """The scene in `data` after `--set` overrides and `--lens`. Raises InputError."""
    try:
        data = keep_lenses(apply_overrides(data, overrides), lenses)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    scene = parse(data, source)
    image = scene.target.image
    if re.match(r"^photo:", image) or Path(image).is_absolute():
        return scene
    target = scene.target.model_copy(update={"image": str((source.parent / image).resolve())})
    return _moved(scene.model_copy(update={"target": target}), source)


def write(path: Path, scene: Scene) -> None:
    """Write a scene as TOML, defaults included. Raises InputError or DeniedError."""
    import tomli_w

    pair = re.compile(r"\[\s+(\d+),\s+(\d+),\s+\]")  # which the library spreads over four lines
    write_text(path, pair.sub(r"[\1, \2]", tomli_w.dumps(scene.plain())))
