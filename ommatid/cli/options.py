"""Options that several commands share, and the values that follow from them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ommatid.runtime.errors import InputError, shortened
from ommatid.scenes.tables.gallery import gallery_names

if TYPE_CHECKING:
    from ommatid.figures.saving import FigureFiles
    from ommatid.runtime.execution.cluster import Cluster
    from ommatid.scenes.hardware.frames import AcquisitionSettings

MOST_WORKERS = 4096
LARGEST_PIXEL = 2**31  # number of a row or a column
LARGEST_VALUE = 1e12  # of a pixel, as in a scene file
_SCENE = f"A scene file, or a scene of the gallery by name: {', '.join(gallery_names())}."

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help=_SCENE, autocompletion=gallery_names)]
SceneFiles = Annotated[list[Path], typer.Argument(metavar="SCENE...", help=_SCENE, autocompletion=gallery_names)]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Output = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else.")]
Sets = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="KEY=VALUE",
        help="Change a key, as in noise.variance=1e-6; empty removes it. Files are relative to the current folder.",
    ),
]
Verbose = Annotated[bool, typer.Option("-v", "--verbose", help="Print the whole table of every result.")]
Quiet = Annotated[bool, typer.Option("-q", "--quiet", help="Print the verdict alone, and no progress.")]
Force = Annotated[bool, typer.Option("--force", help="Make everything again, even if it is up to date.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would be done; write nothing.")]
Formats = Annotated[
    str,
    typer.Option("--format", metavar="NAME,...", help="Write the estimate also as npy, tiff16 or tiff32."),
]
Lenses = Annotated[
    str, typer.Option("--lens", metavar="NAME,...", help="Use these lens types only; a type named twice is used twice.")
]
AllowOutside = Annotated[
    bool, typer.Option("--allow-outside", help="Let a world name files outside the folder of its own file.")
]
Sweeps = Annotated[
    list[str] | None,
    typer.Option(
        "--sweep",
        metavar="KEY=VALUE,...",
        help="One scene per value, as in noise.variance=1e-6,1e-4; several options: every combination.",
    ),
]
Scheduler = Annotated[
    str, typer.Option("--scheduler", metavar="ADDRESS", help="Send the scenes to this Dask cluster: tcp://host:port.")
]
Workers = Annotated[
    int | None,
    typer.Option(
        "--workers", metavar="N", min=1, max=MOST_WORKERS, help="Number of processes (default: chosen automatically)."
    ),
]
Job = Annotated[
    str, typer.Option("--job", metavar="I/N", help="Run every N-th scene, from the I-th on; /N in a job array.")
]
Strict = Annotated[
    bool, typer.Option("--strict", help="Exit with code 3 if the results are not to be trusted; they are written.")
]
Within = Annotated[
    str, typer.Option("--within", metavar="TIME", help='Find the best result within a time, such as "30 s".')
]
FigureFormats = Annotated[
    str, typer.Option("--figure-format", metavar="NAME,...", help="Write figures also in these formats: svg, pdf.")
]
FigureResolution = Annotated[
    int,
    typer.Option("--figure-dpi", metavar="N", min=20, max=1200, help="Dots per inch of PNG figures; 300 for slides."),
]
SCREEN = 110  # dots per inch

# Recorded frames
Dark = Annotated[
    list[Path] | None,
    typer.Option("--dark", metavar="FILE", help="Frame without light, or a folder; several are averaged."),
]
Flat = Annotated[
    list[Path] | None,
    typer.Option(
        "--flat",
        metavar="FILE",
        help="Frame of a uniform target, or a folder: values become (image - dark)/(flat - dark).",
    ),
]
FlatValue = Annotated[
    float, typer.Option("--flat-value", metavar="VALUE", help="Value of the target of --flat, in units of f.")
]
Origin = Annotated[
    str,
    typer.Option(
        "--origin",
        metavar="ROW,COLUMN",
        help="Pixel of the mosaic, from 0, at the top left corner of the first sub-image's patch"
        " (default: the middle of the mosaic is the camera's axis).",
    ),
]
Upright = Annotated[
    bool | None,
    typer.Option(
        "--upright/--turned",
        help="Sub-images are upright, or rotated by 180 degrees as by lenses"
        " (default: rotated in a mosaic, upright in one picture per sub-imager).",
        show_default=False,
    ),
]
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


def lens_names(lens: str) -> tuple[str, ...]:
    """Split the names of `--lens`; empty without the option."""
    return tuple(name.strip() for name in lens.split(",")) if lens else ()


def changes(sets: list[str] | None, allow_outside: bool = False) -> tuple[str, ...]:
    """Collect the changes of `--set` and `--allow-outside`, in the order in which they apply."""
    return (*(sets or ()), *(("--allow-outside",) if allow_outside else ()))


def cluster(scheduler: str) -> Cluster | None:
    """Return the cluster of `--scheduler`; None without the option."""
    from ommatid.runtime.execution.cluster import Cluster

    return Cluster(scheduler) if scheduler else None


def figure_files(formats: str, resolution: int, always: str = "png") -> FigureFiles:
    """Return the files in which a command writes its figures. Raises InputError for an unknown format."""
    from ommatid.figures.saving import FigureFiles, figure_formats

    return FigureFiles(tuple(dict.fromkeys((always, *(figure_formats(formats) if formats else ())))), resolution)


def region(option: str, text: str) -> tuple[tuple[int, int], tuple[int, int]]:
    """Read the corner and the size of a part of the target. Raises InputError."""
    row, column, rows, columns = _integers(option, text, "ROW,COLUMN,ROWS,COLUMNS", "8,8,4,4")
    return (row, column), (rows, columns)


def acquisition(
    dark: list[Path] | None, flat: list[Path] | None, flat_value: float, origin: str, upright: bool | None
) -> AcquisitionSettings:
    """Collect how frames were recorded. Raises InputError for an origin or a value that cannot be."""
    from ommatid.scenes.hardware.frames import AcquisitionSettings

    corner = None
    if origin:
        row, column = _integers("--origin", origin, "ROW,COLUMN", "12,8")
        corner = row, column
    return AcquisitionSettings(
        tuple(dark or ()), tuple(flat or ()), positive("--flat-value", flat_value), corner, upright
    )


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
