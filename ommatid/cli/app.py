"""The command line: a shell over scenes, simulate, reconstruct and the chain of both, which do the work.

Results go to stdout, as tables or with --json as one document; progress and what went wrong go to stderr.
Exit code 0, or 2 for a scene, option or file to mend, 1 for what the machine denies. Heavy imports stand inside the
command that needs them.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from ommatid.runtime.errors import InputError, MachineError, naming_source

if TYPE_CHECKING:
    from ommatid.batch.batch import Batch, Member
    from ommatid.batch.remote import RunObserver, Stages
    from ommatid.runtime.progress import Progress
    from ommatid.runtime.workers import Workers as Crew
    from ommatid.scenes.camera import Camera
    from ommatid.scenes.hardware.frames import AcquisitionSettings
    from ommatid.scenes.model import Model
    from ommatid.scenes.setup import Setup
    from ommatid.scenes.tables.sensor import NoiseTable

app = typer.Typer(
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Simulate, calibrate and reconstruct the images of flat compound-eye cameras, with error bars.",
)

SceneFile = Annotated[Path, typer.Argument(metavar="SCENE", help="A scene file.")]
SceneFiles = Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scene files.")]
Folder = Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder of the results.")]
Output = Annotated[Path, typer.Option("-o", "--output", metavar="FILE", help="File to write.")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key, as in noise.variance=1e-6; empty removes it."),
]
Lenses = Annotated[
    str, typer.Option("--lens", metavar="NAME,...", help="Keep these lens types; one named twice counts twice.")
]
Sweeps = Annotated[
    list[str] | None,
    typer.Option(
        "--sweep",
        metavar="KEY=VALUE,...",
        help="A scene for each of these values, as in noise.variance=1e-6,1e-4; several options: every combination.",
    ),
]
Complete = Annotated[
    bool, typer.Option("--complete", help="Leave nothing out, however small its effect: render.complete=true.")
]
GALLERY = Path(__file__).parents[1] / "scenes"
STARTED = perf_counter()  # from which --within counts
INTERRUPTED = 130  # what the parser makes of Ctrl-C

Scheduler = Annotated[
    str,
    typer.Option("--scheduler", metavar="ADDRESS", help="Send the scenes to the Dask cluster there: tcp://host:port."),
]
Workers = Annotated[
    int | None,
    typer.Option("--workers", metavar="N", min=1, help="Share the scenes among N processes; absent: as many as help."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else.")]
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
FlatValue = Annotated[float, typer.Option("--flat-value", metavar="VALUE", help="Of the target of --flat, in f.")]
Origin = Annotated[
    str,
    typer.Option(
        "--origin",
        metavar="ROW,COLUMN",
        help="Pixel of the mosaic, from 0, where the first sub-image's patch has its top left corner;"
        " absent: the mosaic's middle is the camera's axis.",
    ),
]
Upright = Annotated[
    bool | None,
    typer.Option(
        "--upright/--turned",
        help="Whether sub-images are upright or turned by 180 degrees, as lenses turn them;"
        " absent: those of a mosaic are turned, pictures of one sub-imager each are upright.",
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
        help="CSV of image,row,column: the pixels of f that shone, from 0; absent: an image a pixel, by rows.",
    ),
]
PointValue = Annotated[float, typer.Option("--point-value", metavar="VALUE", help="Of the sources, in f.")]


@app.command()
def run(
    scenes: SceneFiles,
    output: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    complete: Complete = False,
    within: Annotated[
        str, typer.Option("--within", metavar="TIME", help='The best result that fits into a time, such as "30 s".')
    ] = "",
    as_json: Json = False,
) -> None:
    """Render, calibrate, reconstruct and report."""
    from ommatid.pipeline import stages

    def tell(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        from ommatid.analysis import depth_error, run_table, study
        from ommatid.reconstruct.output.run_json import RunReport

        if not as_json:
            report = RunReport.model_validate(description)
            _table(f"{report.title or member.scene.stem}: {member.folder}", run_table.rows(report))
            if report.depth:
                _table("Error against distance", depth_error.rows(report.depth))
            if report.study:
                _table("The same stack with other models of H", study.rows(report.study))
        return description

    sets = _complete(sets, complete)
    members = _members(scenes, output, sweep, sets, lens)
    does = stages.run
    if within:
        does, workers = _within(within, members, scheduler, workers), 1
    _each(members, output, _batch(sets, lens, does, tell), scheduler, workers, as_json, index=True)


@app.command()
def render(
    scenes: SceneFiles,
    output: Folder = Path("out"),
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    scheduler: Scheduler = "",
    workers: Workers = None,
    complete: Complete = False,
    as_json: Json = False,
) -> None:
    """Render the sub-images alone."""
    from ommatid.pipeline import stages

    def tell(member: Member, description: dict[str, Any]) -> dict[str, Any]:
        return {"file": str(member.folder / "stack.exr"), **description}

    sets = _complete(sets, complete)
    members = _members(scenes, output, sweep, sets, lens)
    _each(members, output, _batch(sets, lens, stages.render, tell), scheduler, workers, as_json)


@app.command()
def calibrate(
    scene: SceneFile,
    output: Output,
    more: MoreImages = None,
    points: Points = None,
    places: Places = None,
    point_value: PointValue = 255,
    dark: Dark = None,
    flat: Flat = None,
    flat_value: FlatValue = 255,
    origin: Origin = "",
    upright: Upright = None,
    sets: Sets = None,
    lens: Lenses = "",
    complete: Complete = False,
    as_json: Json = False,
) -> None:
    """Find the observation matrix H alone.

    It is rendered or computed as the scene says; with --points it is told from recorded frames of a real camera.
    """
    sets = _complete(sets, complete)
    from ommatid.pipeline.stages import calibrated
    from ommatid.runtime.files import check_output
    from ommatid.scenes.scene import read
    from ommatid.scenes.setup import Setup

    check_output(output, scene)
    setup = Setup.from_scene(read(scene, sets or (), _names(lens)))
    if points:
        if lens:
            raise InputError("--lens: recorded frames are of the whole camera; choose lens types in `reconstruct`")
        bench = _bench(dark, flat, flat_value, origin, upright)
        model, made = _told_by_points(setup, output, [*points, *(more or [])], bench, places, point_value)
    elif more or places or dark or flat or origin:
        raise InputError("calibrate: images, --places, --dark, --flat and --origin belong to --points; name its images")
    else:
        with naming_source(scene), _progress("calibrate") as progress:
            model, made = calibrated(setup, output, progress)
    _say(f"calibrate: {_done(made)}, {output}")
    if as_json:
        facts = {"measurements": model.measurements, "unknowns": model.unknowns, "entries": model.entries}
        _print_json({"file": str(output), **facts, **model.record})


@app.command()
def reconstruct(
    stack: Annotated[Path, typer.Argument(metavar="STACK", help="Recorded sub-images, stack.exr.")],
    model: Annotated[Path, typer.Argument(metavar="MODEL", help="Their observation model, model.npz.")],
    output: Output,
    sets: Sets = None,
    lens: Lenses = "",
    region: Annotated[
        str, typer.Option("--region", metavar="ROW,COLUMN,ROWS,COLUMNS", help="Mean of a region and its error bar.")
    ] = "",
    scheduler: Annotated[
        str, typer.Option("--scheduler", metavar="ADDRESS", help="Send the tiles of a frame to this Dask scheduler.")
    ] = "",
    workers: Annotated[
        int | None,
        typer.Option("--workers", metavar="N", min=1, help="Share the tiles of a frame among N processes."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Reconstruct from files alone."""
    from ommatid.analysis import run_table
    from ommatid.reconstruct.output import figures
    from ommatid.reconstruct.output import result_files as results
    from ommatid.reconstruct.output.run_json import RegionReport
    from ommatid.reconstruct.restore import check_region
    from ommatid.runtime.files import check_output
    from ommatid.runtime.pool import check_options
    from ommatid.scenes import model_file
    from ommatid.scenes import stack as stack_file
    from ommatid.scenes.scene import TRUTH

    if output.suffix == ".png":
        raise InputError(f"{output}: expected the name of an OpenEXR file, such as {output.with_suffix('.exr')}")
    corner, size = _region(region)
    check_options(scheduler, workers)
    check_output(output, stack, model, stack.parent / TRUTH)
    recorded, calibrated = stack_file.read(stack), model_file.read(model)
    if lens:
        recorded, calibrated = recorded.restrict(_names(lens)), calibrated.restrict(_names(lens))
    check_region(corner, size, recorded.camera.shape)
    recorded = results.with_estimator_changes(recorded, sets or [], stack)
    truth = results.truth_beside(stack, recorded)
    with _crew(scheduler, workers) as crew, _progress("reconstruct") as progress:
        restoration, report = results.reconstruct(recorded, calibrated, truth, (stack, model), crew, progress)
    if region:
        mean, deviation = restoration.region(corner, size)
        region_mean = RegionReport(corner=corner, size=size, mean=mean, deviation=deviation)
        report = report.with_changes(region=region_mean)
    results.write_estimate(output, restoration, {"title": recorded.scene.title})
    figures.write_estimate(output.with_suffix(".png"), restoration.estimate.reshape(restoration.shape))
    if as_json:
        _print_json({"file": str(output), **report.plain()})
    else:
        _table(str(output), run_table.rows(report))


@app.command("import")
def import_(
    scene: SceneFile,
    images: Annotated[
        list[Path],
        typer.Argument(
            metavar="IMAGE...",
            help="One mosaic of the whole sensor, or a picture a sub-imager, in a folder or in order.",
        ),
    ],
    output: Output,
    dark: Dark = None,
    flat: Flat = None,
    flat_value: FlatValue = 255,
    origin: Origin = "",
    upright: Upright = None,
    sets: Sets = None,
    lens: Lenses = "",
    as_json: Json = False,
) -> None:
    """Cut recorded frames of a real camera into a stack.

    A mosaic is the sensor seen from behind the camera, rows downwards; its numbers are taken as they are.
    """
    from ommatid.analysis.recording_warnings import import_warnings
    from ommatid.runtime.files import check_output
    from ommatid.scenes import stack
    from ommatid.scenes.hardware.frames import files_in
    from ommatid.scenes.hardware.stack_import import import_stack
    from ommatid.scenes.scene import read
    from ommatid.scenes.setup import Setup

    bench = _bench(dark, flat, flat_value, origin, upright)
    check_output(output, scene, *(file for path in (*images, *bench.dark, *bench.flat) for file in files_in(path)))
    setup = Setup.from_scene(
        read(scene, sets or ())
    )  # all of it: lens types that are left out stand on the sensor nevertheless
    if lens and not setup.camera.is_ideal_pinhole:
        raise InputError(f"--lens {lens}: lenses that are more than pinholes are imported all; choose in `reconstruct`")
    made, frames = import_stack(setup, images, bench)
    made = made.restrict(_names(lens)) if lens else made
    stack.write(output, made)
    for warning in import_warnings(frames):
        _say(f"import: {warning}")
    _say(f"import: done, {output}")
    if as_json:
        facts = {"sub_images": len(made.camera.sub_imagers), "beside_pixels": frames.layout.beside}
        _print_json({"file": str(output), **facts, **made.record})


@app.command()
def predict(
    scene: SceneFile,
    sets: Sets = None,
    lens: Lenses = "",
    sweep: Sweeps = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="DIR", help="Of --sweep: folder of its table and plot.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Expected error, rank and null space of H.

    From Eq. 5 and the ideal model: nothing is rendered.
    """
    from ommatid.analysis import prediction_table
    from ommatid.analysis.predict import electrons, predict_scene
    from ommatid.pipeline import stages
    from ommatid.scenes.scene import read
    from ommatid.scenes.setup import Setup

    if sweep:
        members = _members([scene], Path(), sweep, sets, lens)
        batch = _batch(sets, lens, stages.predict_scene, lambda _, description: description)
        _each(members, output, batch, "", None, as_json, folders=False)
        return
    if output is not None:
        raise InputError("predict: -o is for the table and the plot of a --sweep; name keys to sweep, or leave it out")
    described = read(scene, sets or (), _names(lens))
    with naming_source(scene):
        prediction, light = predict_scene(described), electrons(Setup.from_scene(described))
    if as_json:
        _print_json(prediction_table.json_of(prediction) | ({} if light is None else {"light": light}))
        return
    lines, tolerance = prediction_table.rows(prediction), described.camera.tolerance
    if tolerance is not None and prediction.misalignment is None and described.estimator.misalignment == "trust":
        lines.append(("misalignment", "not in these numbers: what it adds is known for small targets and no blur"))
    _table(described.title or scene.stem, lines)
    for title, lines in _optics_sections([], light):
        _table(title, lines)


@app.command()
def design(
    scene: SceneFile,
    candidates: Annotated[
        str, typer.Option("--candidates", metavar="1/M,...", help="Magnifications; dots continue the step before.")
    ] = "1/2,1/3,...,1/9",
    sets: Sets = None,
    lens: Lenses = "",
    as_json: Json = False,
) -> None:
    """Which lens type to add.

    Ranks magnifications by the expected error (Eq. 5) with each.
    """
    from ommatid.analysis.design import DesignCandidate, magnifications, ranked, rows, with_lens
    from ommatid.analysis.predict import predict_scene
    from ommatid.analysis.prediction_table import json_of
    from ommatid.scenes.scene import read

    wanted = magnifications(candidates)
    described = read(scene, sets or (), _names(lens))
    before = predict_scene(described)
    choices: list[DesignCandidate] = []
    with _progress("design") as progress:
        for place, magnification in enumerate(wanted):
            try:
                choices.append(DesignCandidate(str(magnification), predict_scene(with_lens(described, magnification))))
            except InputError as error:
                choices.append(DesignCandidate(str(magnification), None, str(error).removeprefix(f"{scene}: ")))
            progress((place + 1) / len(wanted))
    choices = ranked(choices)
    if as_json:
        _print_json({"before": json_of(before), "candidates": [choice.describe() for choice in choices]})
    else:
        _table(f"{described.title or scene.stem}: what one more lens type would bring", rows(before, choices))


@app.command()
def paper(
    output: Folder = Path("paper"),
    image: Annotated[
        str, typer.Option("--image", metavar="FILE", help="The photograph of Figure 7, or photo:NAME.")
    ] = "photo:camera",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the noise in Figure 7.")] = 0,
    as_json: Json = False,
) -> None:
    """The paper's figures and claims, computed anew."""
    from ommatid.paper.paper import rows, write_paper
    from ommatid.simulate.ideal import ideal_matrix
    from ommatid.simulate.sensor.gaussian import expose, generators

    def record(camera: Camera, light: Any, noise: NoiseTable, number: int) -> Any:
        return expose(light, noise, generators(camera, number), camera.slices())

    with _progress("paper") as progress:
        description = write_paper(output, ideal_matrix, record, image, seed, progress)
    if as_json:
        _print_json(description)
    else:
        _table(f"The paper's claims: {output / 'claims.csv'}", rows(description))


@app.command()
def stability(output: Folder = Path("stability"), as_json: Json = False) -> None:
    """Right digits on stiff and extreme cases, against exact arithmetic."""
    from ommatid.scenes.camera import derive
    from ommatid.scenes.scene import read
    from ommatid.simulate.ideal import ideal_matrix
    from ommatid.stability.cases import CHANGES, LENSES
    from ommatid.stability.stability import rows, write_stability

    tile = GALLERY / "tile19.toml"
    matrices = {name: ideal_matrix(derive(read(tile, CHANGES, lenses))) for name, lenses in LENSES.items()}
    with _progress("stability") as progress:
        summary = write_stability(output, matrices, progress)
    if as_json:
        _print_json(summary)
    else:
        _table("Stiff and extreme cases", rows(summary))


@app.command()
def bench(
    scene: SceneFile,
    output: Folder = Path("out"),
    seconds: Annotated[
        float, typer.Option("--seconds", metavar="N", min=1, help="That it may take; what does not fit is left out.")
    ] = 240,
    sets: Sets = None,
    lens: Lenses = "",
    as_json: Json = False,
) -> None:
    """Error against run time of every stage.

    Measures samplers, methods and ways with more and more samples, and recommends the cheapest that reach the noise.
    """
    from ommatid.bench.bench import bench as measured
    from ommatid.bench.bench import rows
    from ommatid.pipeline.stages import opened

    setup = opened(scene, sets or (), _names(lens))
    with _progress("bench") as progress:
        table, made = measured(setup, output, seconds, progress)
    _say(f"bench: {_done(made)}, {output / 'bench.json'}")
    if as_json:
        _print_json(table.describe())
    else:
        _table(f"Error against run time: {table.title}", rows(table))


@app.command()
def show(
    scene: SceneFile, sets: Sets = None, lens: Lenses = "", complete: Complete = False, as_json: Json = False
) -> None:
    """The geometry, the plan, and what is left out."""
    from ommatid.analysis.predict import electrons
    from ommatid.analysis.predict import optics as optics_of
    from ommatid.analysis.summary import describe, sections
    from ommatid.reconstruct.method_choice import choose_method as choose_way
    from ommatid.scenes.scene import read
    from ommatid.scenes.setup import Setup
    from ommatid.simulate.renderer.variant import choose

    setup = Setup.from_scene(read(scene, _complete(sets, complete), _names(lens)))
    described, camera = setup.scene, setup.camera
    choice = choose_way(described, camera, setup.has_structured_matrix)
    with naming_source(scene):
        optics, light = optics_of(camera), electrons(setup)
    description = describe(setup, choose(described.render.variant), choice, optics, light)
    if as_json:
        _print_json(description)
        return
    geometry, *rest = sections(description)
    for title, lines in (geometry, *_optics_sections(optics, light), *rest):
        _table(title, lines)


@app.command()
def export(scene: SceneFile, output: Output, sets: Sets = None, lens: Lenses = "", as_json: Json = False) -> None:
    """Write a plain Mitsuba scene of stock sensors."""
    from ommatid.pipeline.stages import opened
    from ommatid.runtime.files import check_output
    from ommatid.simulate.renderer.export import export as write

    check_output(output, scene)
    setup = opened(scene, sets or (), _names(lens))
    if setup.scene.world is not None:
        raise InputError(f"{scene}: world.file is a Mitsuba scene already; export serves flat targets, remove [world]")
    picture = write(setup, output)
    sensors = [sub.name for sub in setup.camera.sub_imagers]
    _say(f"{output} and {picture}: {len(sensors)} sensors; render one with: mitsuba -m scalar_rgb -s 0 {output}")
    if as_json:
        _print_json({"file": str(output), "picture": str(picture), "sensors": sensors})


@app.command()
def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The scene file to write.")], as_json: Json = False
) -> None:
    """Write a scene file to start from."""
    from ommatid.runtime.files import write_text

    if file.exists():
        raise InputError(f"{file}: exists already; choose another name or remove it first")
    write_text(file, (GALLERY / "starter.toml").read_text(encoding="utf-8"))
    _say(f"{file}: written; next: ommatid run {file} -o out")
    if as_json:
        _print_json({"file": str(file)})


@app.command()
def schema(as_json: Json = False) -> None:
    """Print the JSON Schema of scene files."""
    del as_json  # it is one JSON document anyway
    from ommatid.scenes.scene import Scene

    _print_json(Scene.model_json_schema())


@app.command()
def doctor(as_json: Json = False) -> None:
    """Which backends work here, and what repairs them."""
    from ommatid.runtime.versions import versions
    from ommatid.simulate.renderer.variant import PREFERENCE, diagnosis, probe

    found = [probe(variant) for variant in PREFERENCE]
    advice = diagnosis(found)
    installed = versions("mitsuba", "drjit", "OpenEXR", "scipy", "scikit-image")
    if as_json:
        backends = [{"variant": one.variant, "reason": one.reason, "samples_per_second": one.speed} for one in found]
        _print_json({"backends": backends, "advice": advice, "versions": installed, "cores": os.cpu_count()})
        return
    lines = [
        (one.variant, f"works, {one.speed / 1e6:.0f} million samples a second" if not one.reason else one.reason)
        for one in found
    ]
    _table("Backends", lines)
    _table("Versions", list(installed.items()))
    print(advice)


def main() -> None:
    """Run the command line; every failure ends in one sentence on stderr and an exit code."""
    try:
        code = app(standalone_mode=False)
        if code == INTERRUPTED:
            raise KeyboardInterrupt
    except Exception as error:
        code = _complain(error)
    except KeyboardInterrupt:
        _say("ommatid: stopped; finished files stay, the next run carries on from them")
        code = 1
    sys.exit(_delivered(code if isinstance(code, int) else 0))


def _delivered(code: int) -> int:
    """The exit code once what was printed has arrived: when Python ends, nobody says in a sentence that it has not."""
    try:
        print(end="", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # for what cannot be delivered, or Python would try again
        return code or _complain(error)
    return code


def _complain(error: Exception) -> int:
    """Say in one sentence what went wrong; the exit code."""
    if isinstance(error, _Worst):
        return error.code
    if hasattr(error, "format_message"):  # of the command line's own parser
        _say(f"ommatid: {cast(Any, error).format_message()}")
        return 2
    if isinstance(error, InputError | MachineError):
        _say("ommatid: " + " ".join(str(error).splitlines()))
        return 2 if isinstance(error, InputError) else 1
    if os.environ.get("OMMATID_TRACEBACK"):
        raise error
    if isinstance(error, MemoryError):
        _say("ommatid: not enough memory; crop the target or close other programs")
    elif isinstance(error, OSError):
        _say(f"ommatid: {error.filename or 'the machine'}: {error.strerror or error}")
    else:
        what = " ".join(f"{type(error).__name__}: {error}".split())
        _say(f"ommatid: unexpected {what}; set OMMATID_TRACEBACK=1 to see where, and report it")
    return 1


class _Worst(Exception):
    def __init__(self, code: int) -> None:
        self.code = code


def _batch(
    sets: list[str] | None, lens: str, stages: Stages, tell: Callable[[Member, dict[str, Any]], dict[str, Any]]
) -> Batch:
    """What is asked of every scene: changes, the stages, and what to tell the user when they are done."""
    from ommatid.batch.batch import Batch
    from ommatid.batch.remote import RunObserver
    from ommatid.pipeline.stages import facts, fitting, member_opened

    def watch(folder: Path) -> RunObserver:
        return RunObserver(_progress, partial(_say_done, folder))

    asked = tuple(sets or ()), _names(lens)
    return Batch(partial(member_opened, *asked), stages, watch, tell, facts, partial(fitting, *asked))


def _within(text: str, members: list[Member], scheduler: str, workers: int | None) -> Stages:
    """What is done of each scene where all of them together have a time, counted from the start of the program."""
    if scheduler or workers is not None:
        raise InputError("--within divides the time of this machine's one process; leave out --scheduler and --workers")
    from ommatid.pipeline.time_budget import shared_time
    from ommatid.scenes.tables.units import duration

    try:
        return shared_time(duration(text), [member.folder for member in members], STARTED, _say)
    except ValueError as error:
        raise InputError(f"--within: {error}") from error


def _members(
    scenes: list[Path], output: Path, sweep: list[str] | None, sets: list[str] | None, lens: str
) -> list[Member]:
    """The scenes of a batch, each as often as a sweep has combinations. Raises InputError before any work."""
    from ommatid.batch.sweep import check_keys, members, sweep_axes

    swept = sweep_axes(sweep or ())
    for scene in scenes:
        check_keys(scene, swept, sets or (), _names(lens))
    return members(scenes, swept, output)


def _each(
    members: list[Member],
    output: Path | None,
    batch: Batch,
    scheduler: str,
    workers: int | None,
    as_json: bool,
    *,
    folders: bool = True,
    index: bool = False,
) -> None:
    """Do every scene of a batch, whatever happens to the others; then end with the worst exit code.

    folders : whether there is one for each;  index : whether a page of all of them is written
    """
    results: dict[Member, dict[str, Any]] = {}
    failures: dict[Member, str] = {}
    worst = 0
    for member, work in batch.works(members, scheduler, workers):
        told: dict[str, Any] = {"scene": str(member.scene)}
        if member.changes:
            told |= {**({"folder": str(member.folder)} if folders else {}), "values": member.values}
        try:
            results[member] = {**told, **work()}
        except Exception as error:
            code = _complain(error)
            failures[member] = str(error) or type(error).__name__
            results[member] = {**told, "error": str(error), "exit_code": code}
            worst = max(worst, code)
    documents = [results[member] for member in members]
    if members[0].changes:
        _tell_sweep(documents, output, as_json)
    if as_json:
        _print_json(documents)
    if index and output is not None:
        from ommatid.page.batch_index import cached_index

        try:
            cached_index(output, {member.folder: failures.get(member, "") for member in members})
        except Exception as error:
            worst = max(worst, _complain(error))
    if worst:
        raise _Worst(worst)


def _tell_sweep(documents: list[dict[str, Any]], output: Path | None, as_json: bool) -> None:
    from ommatid.batch.sweep_row import summary
    from ommatid.batch.sweep_table import lines, write_sweep

    rows = [summary(document) for document in documents]
    if output is not None:
        write_sweep(output, rows)
    if not as_json:
        _table("Sweep" + (f": {output / 'sweep.csv'}" if output is not None else ""), lines(rows))


@contextmanager
def _crew(scheduler: str, count: int | None) -> Generator[Crew | None]:
    """Workers for the tiles of a frame; none where they are done by threads of this process."""
    from ommatid.runtime.pool import worker_pool
    from ommatid.runtime.versions import versions

    if not scheduler and count is None:
        yield None
        return
    with worker_pool(scheduler, count) as crew:
        crew.check_versions(partial(versions, "scipy"))
        yield crew


def _optics_sections(
    optics: list[dict[str, Any]], light: dict[str, Any] | None
) -> list[tuple[str, list[tuple[str, str]]]]:
    found: list[tuple[str, list[tuple[str, str]]]] = []
    if optics:
        from ommatid.simulate.lenses.sharpness import words

        found.append(("Optics", [(f"lens type {one['lens']}", words(one)) for one in optics]))
    if light is not None:
        from ommatid.analysis.light_table import rows

        found.append(("Electrons", rows(light)))
    return found


def _say_done(folder: Path, stage: str, made: bool) -> None:
    files = {"render": "stack.exr", "report": "report.html"}
    _say(f"{stage}: {_done(made)}" + (f", {folder / files[stage]}" if stage in files else ""))


def _bench(
    dark: list[Path] | None, flat: list[Path] | None, flat_value: float, origin: str, upright: bool | None
) -> AcquisitionSettings:
    """What the options say of how frames were recorded. Raises InputError for what cannot be."""
    from ommatid.scenes.hardware.frames import AcquisitionSettings

    corner = None
    if origin:
        try:
            row, column = (int(number) for number in origin.split(","))
        except ValueError as error:
            raise InputError(f"--origin: expected ROW,COLUMN, such as 12,8, got '{origin}'") from error
        corner = row, column
    _refuse_no_value("--flat-value", flat_value)
    return AcquisitionSettings(tuple(dark or ()), tuple(flat or ()), flat_value, corner, upright)


def _refuse_no_value(option: str, value: float) -> None:
    if not 0 < value < float("inf"):
        raise InputError(f"{option}: expected a value above 0, such as 255, got {value:g}")


def _told_by_points(
    setup: Setup,
    output: Path,
    points: list[Path],
    bench: AcquisitionSettings,
    places: Path | None,
    value: float,
) -> tuple[Model, bool]:
    """H told from recorded frames, written, with what the user should know of it."""
    from ommatid.analysis.recording_warnings import calibration_warnings
    from ommatid.runtime.files import check_output
    from ommatid.scenes import model_file
    from ommatid.scenes.hardware.frames import files_in
    from ommatid.scenes.hardware.point_sources import from_recorded_points

    _refuse_no_value("--point-value", value)
    read = [file for path in (*points, *bench.dark, *bench.flat) for file in files_in(path)]
    check_output(output, *read, *([] if places is None else [places]))
    told = from_recorded_points(setup, points, bench, places, value)
    model_file.write(output, told.model)
    for warning in calibration_warnings(told):
        _say(f"calibrate: {warning}")
    return told.model, True


def _region(text: str) -> tuple[tuple[int, int], tuple[int, int]]:
    try:
        row, column, rows, columns = (int(number) for number in (text or "0,0,1,1").split(","))
    except ValueError as error:
        raise InputError(f"--region: expected ROW,COLUMN,ROWS,COLUMNS, such as 8,8,4,4, got '{text}'") from error
    return (row, column), (rows, columns)


def _complete(sets: list[str] | None, complete: bool) -> list[str]:
    return [*(sets or []), *(["render.complete=true"] if complete else [])]


def _names(lens: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in lens.split(",")) if lens else ()


def _done(made: bool) -> str:
    return "done" if made else "up to date, nothing to do"


def _say(text: str) -> None:
    print(text, file=sys.stderr)


def _print_json(document: object) -> None:
    print(json.dumps(document, indent=2, allow_nan=False))


def _table(title: str, lines: list[tuple[str, str]]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("", "", title=title, title_justify="left", show_header=False)
    for name, value in lines:
        table.add_row(name, value)
    Console(markup=False, emoji=False).print(table)  # a title is text, whatever brackets it has


@contextmanager
def _progress(stage: str) -> Generator[Progress]:
    """A bar with the time left on stderr, where that is a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn(f"{stage:10}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(stage, total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)
