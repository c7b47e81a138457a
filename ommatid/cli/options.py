"""Options that several commands share, and the values that follow from them.

A group of options is a frozen dataclass of annotated fields, which is one parameter of every command that has them.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast, get_type_hints

import typer

from ommatid.runtime.errors import InputError, shortened
from ommatid.scenes.tables.gallery import gallery_names

from .output import Detail

if TYPE_CHECKING:
    from ommatid.figures.saving import FigureFiles
    from ommatid.reconstruct.output.estimate_formats import Format
    from ommatid.runtime.execution.cluster import Cluster
    from ommatid.scenes.hardware.frames import AcquisitionSettings

MOST_WORKERS = 4096
LARGEST_PIXEL = 2**31  # number of a row or a column
LARGEST_VALUE = 1e12  # of a pixel, as in a scene file
_SCENE = f"A scene file, or a scene of the gallery by name: {', '.join(gallery_names())}."

SceneOrModel = Annotated[
    Path,
    typer.Argument(
        metavar="SCENE|MODEL", help=f"A model that ommatid wrote (.npz). Or: {_SCENE}", autocompletion=gallery_names
    ),
]
SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help=_SCENE, autocompletion=gallery_names)]
SceneFiles = Annotated[list[Path], typer.Argument(metavar="SCENE...", help=_SCENE, autocompletion=gallery_names)]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
FolderIfAny = Annotated[Path | None, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Output = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else.")]
Force = Annotated[bool, typer.Option("--force", help="Make again what is up to date.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would be done; write nothing.")]
Formats = Annotated[
    str,
    typer.Option(
        "--format",
        metavar="NAME,...",
        help="Write figures also as svg or pdf, and the estimate as npy, tiff16 or tiff32.",
    ),
]
Baselines = Annotated[
    bool, typer.Option("--baselines", help="Compare the estimate with other methods, where the truth is known.")
]
Sweeps = Annotated[
    list[str] | None,
    typer.Option(
        "--sweep",
        metavar="KEY=VALUE,...",
        help="One scene per value, as in noise.bits=8,...,12; several: every combination.",
    ),
]
Strict = Annotated[bool, typer.Option("--strict", help="Exit with code 3 if a result is not to be trusted.")]
Within = Annotated[
    str, typer.Option("--within", metavar="TIME", help='Do what is best within a time, such as "30 s" or "4 min".')
]


@dataclass(frozen=True)
class Changes:
    """Changes of a scene: its keys, and the lens types that are kept."""

    sets: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a key, as in noise.variance=1e-6 or camera.lens.*.f_number=4; empty removes it.",
        ),
    ] = None
    lens: Annotated[
        str,
        typer.Option("--lens", metavar="NAME,...", help="Use these lens types only; one named twice is used twice."),
    ] = ""

    @property
    def both(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The changes of keys, and the names of `--lens`, empty without the option."""
        return tuple(self.sets or ()), tuple(name.strip() for name in self.lens.split(",")) if self.lens else ()


@dataclass(frozen=True)
class WorldChanges(Changes):
    """Changes of a scene whose world is read."""

    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Let a world name files outside the folder of its own file.")
    ] = False

    @property
    def both(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The changes of keys, that of `--allow-outside` the last, and the names of `--lens`."""
        sets, lenses = super().both
        return (*sets, *(("--allow-outside",) if self.allow_outside else ())), lenses


@dataclass(frozen=True)
class Printing:
    """How much is printed of a result."""

    verbose: Annotated[bool, typer.Option("-v", "--verbose", help="Print all that is known of every result.")] = False
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="Print one line of every result, no progress.")] = False
    as_json: Json = False

    @property
    def detail(self) -> Detail | None:
        """How much is printed, None for JSON. Raises InputError for `-v` and `-q` together."""
        if self.verbose and self.quiet:
            raise InputError("-v and -q: expected one of them, got both")
        return None if self.as_json else "table" if self.verbose else "verdict" if self.quiet else "summary"


@dataclass(frozen=True)
class Processes:
    """Where the work is done."""

    scheduler: Annotated[
        str,
        typer.Option(
            "--scheduler", metavar="ADDRESS", help="Send scenes or tiles to this Dask cluster: tcp://host:port."
        ),
    ] = ""
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers",
            metavar="N",
            min=1,
            max=MOST_WORKERS,
            help="Distribute scenes, stacks or tiles over N processes.",
        ),
    ] = None

    @property
    def pool(self) -> tuple[Cluster | None, int | None]:
        """The cluster of `--scheduler`, None without the option, and the number of processes.

        Raises InputError for both, and for a cluster that cannot be used.
        """
        if not self.scheduler:
            return None, self.workers
        from ommatid.runtime.execution.cluster import Cluster

        if self.workers is not None:
            raise InputError("--scheduler and --workers: expected one, a cluster or the number of processes here")
        cluster = Cluster(self.scheduler)
        cluster.check()
        return cluster, None


@dataclass(frozen=True)
class Jobs(Processes):
    """Where the scenes of a batch are run."""

    job: Annotated[
        str, typer.Option("--job", metavar="I/N", help="Run every N-th scene, from the I-th on; /N in a job array.")
    ] = ""


@dataclass(frozen=True)
class Frames:
    """How frames of a real camera were recorded."""

    dark: Annotated[
        list[Path] | None,
        typer.Option("--dark", metavar="FILE", help="Frame without light, or a folder; several are averaged."),
    ] = None
    flat: Annotated[
        list[Path] | None,
        typer.Option(
            "--flat",
            metavar="FILE",
            help="Frame of a uniform target, or a folder: values become (image - dark)/(flat - dark).",
        ),
    ] = None
    flat_value: Annotated[
        float, typer.Option("--flat-value", metavar="VALUE", help="Value of the target of --flat, in units of f.")
    ] = 255
    origin: Annotated[
        str,
        typer.Option(
            "--origin",
            metavar="ROW,COLUMN",
            help="Pixel of the mosaic, from 0, at the top left corner of the first sub-image"
            " (default: the camera's axis is in the middle).",
        ),
    ] = ""
    upright: Annotated[
        bool | None,
        typer.Option(
            "--upright/--turned",
            help="Sub-images are upright, or rotated by 180 degrees (default: rotated in a mosaic).",
            show_default=False,
        ),
    ] = None

    @property
    def settings(self) -> AcquisitionSettings:
        """The options as settings. Raises InputError for an origin or a value that cannot be."""
        from ommatid.scenes.hardware.frames import AcquisitionSettings

        corner = None
        if self.origin:
            row, column = _integers("--origin", self.origin, "ROW,COLUMN", "12,8")
            corner = row, column
        value = positive("--flat-value", self.flat_value)
        return AcquisitionSettings(tuple(self.dark or ()), tuple(self.flat or ()), value, corner, self.upright)


# Recorded point sources
MoreImages = Annotated[
    list[Path] | None, typer.Argument(metavar="IMAGE...", help="More images of --points.", show_default=False)
]
Points = Annotated[
    list[Path] | None,
    typer.Option(
        "--points",
        metavar="IMAGE",
        help="Recorded point sources: mosaics, a folder of them, or an NPY file of (count, rows, columns).",
    ),
]
Places = Annotated[
    Path | None,
    typer.Option(
        "--places",
        metavar="FILE",
        help="CSV of image,row,column: the lit pixels of f, from 0 (default: one image per pixel, by rows).",
    ),
]
PointValue = Annotated[
    float, typer.Option("--point-value", metavar="VALUE", help="Value of the point sources, in units of f.")
]


def figure_files(text: str) -> FigureFiles:
    """Read the formats of figures that `--format` names beside PNG. Raises InputError for other names."""
    names = formats(text)
    if names[0]:
        raise InputError(f"--format {shortened(text)}: no estimate is written here; expected svg, pdf or both")
    return names[1]


def formats(text: str) -> tuple[tuple[Format, ...], FigureFiles]:
    """Read the formats of the estimate and those of figures, PNG and others, that `--format` names.

    Raises InputError for an unknown name.
    """
    from ommatid.figures.saving import FORMATS, FigureFiles
    from ommatid.reconstruct.output.estimate_formats import formats_of

    names = list(dict.fromkeys(name.strip().lower() for name in text.split(",") if name.strip()))
    figures = tuple(dict.fromkeys(("png", *(name for name in names if name in FORMATS))))
    return formats_of([name for name in names if name not in FORMATS]), FigureFiles(figures)


def seconds(within: str) -> float:
    """Read the time of `--within`. Raises InputError for a text that is no duration."""
    from ommatid.scenes.tables.units import DURATION

    try:
        return DURATION.read(within)
    except ValueError as error:
        raise InputError(f"--within: {error}") from error


def region(option: str, text: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Read the corner and the size of a part of the target. Raises InputError."""
    row, column, rows, columns = _integers(option, text, "ROW,COLUMN,ROWS,COLUMNS", "8,8,4,4")
    return (row, column), (rows, columns)


def positive(option: str, value: float) -> float:
    """Return the value of an option if it is above 0 and no larger than a pixel can be. Raises InputError otherwise."""
    if not 0 < value <= LARGEST_VALUE:
        raise InputError(
            f"{option}: expected a value above 0 and at most {LARGEST_VALUE:g}, such as 255, got {value:g}"
        )
    return value


def _integers(option: str, text: str, expected: str, example: str) -> list[int]:
    try:
        numbers = [int(number) for number in text.split(",")]
        if len(numbers) != len(expected.split(",")) or max(map(abs, numbers)) > LARGEST_PIXEL:
            raise ValueError(text)
    except ValueError as error:
        raise InputError(f"{option}: expected {expected}, such as {example}, got '{shortened(text)}'") from error
    return numbers


def grouped(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command for the parser, which has an option for each field of a group in place of the group itself."""
    signature = inspect.signature(command, eval_str=True)
    annotations: dict[str, Any] = {name: each.annotation for name, each in signature.parameters.items()}
    groups = {name: cast(type[Any], each) for name, each in annotations.items() if is_dataclass(each)}
    parameters = [
        each
        for name, parameter in signature.parameters.items()
        for each in (_options_of(groups[name]) if name in groups else [parameter])
    ]
    named = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in parameters]

    @wraps(command)
    def called(**values: Any) -> None:
        collected = {
            name: group(**{field.name: values.pop(field.name) for field in fields(group)})
            for name, group in groups.items()
        }
        command(**values, **collected)

    called.__signature__ = signature.replace(parameters=named)  # type: ignore[attr-defined]
    called.__annotations__ = {each.name: each.annotation for each in named}
    return called


def _options_of(group: type[Any]) -> list[inspect.Parameter]:
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in fields(group)
    ]
