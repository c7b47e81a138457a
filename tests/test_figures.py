"""Figures that the pages state: those of the commands that print them, and no others.

Those marked `figures` take minutes: `make figures` runs them.
"""

from __future__ import annotations

import csv
import json
import re
import shlex
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ommatid
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.geometry.optical_terms import optical_terms
from ommatid.scenes.optics.radiometry import electrons, transmissions
from ommatid.scenes.scene import read
from ommatid.simulate.ideal import ideal_matrix
from ommatid.simulate.renderer.variant import unusable_reason

from .benchmarks import f_numbers
from .conftest import Command, shell
from .documentation import DOCS, PAGES, Block, blocks, page_name, text_of
from .examples import GALLERY, not_none
from .printed_figures import check_figures, is_printed, stated_figures, unchecked_decimals

STARTER = str(GALLERY / "starter.toml")
needs_fast_backend = pytest.mark.skipif(bool(unusable_reason("llvm_ad_mono")), reason="needs the fast backend")

# Decimal numbers of these sections are no output of a command of the page. A section of `None`: all of a page.
NOT_PRINTED: dict[tuple[str, str | None], str] = {
    ("README.md", "Install"): "the version of Python",
    ("docs/install.md", "Install"): "the version of Python",
    ("docs/install.md", "The fast backend"): "measured once on a machine with a graphics card",
    ("docs/speed.md", None): "times and ratios of `make bench`",
    ("docs/equations.md", "The noise"): "constants of the text",
    ("docs/equations.md", "The common level"): "numbers of equations in a book",
    ("docs/frames.md", "Time and memory"): "times and memory, `python -m tests.benchmarks frames`",
    ("docs/frames.md", "Worlds finer than f"): "experiments against exact solutions, which no command prints",
    ("docs/frames.md", "Whole frames"): "defaults and limits of the program",
    ("docs/frames.md", "Error bars"): "experiments against exact solutions, which no command prints",
    ("docs/frames.md", "Tiles"): "experiments against exact solutions, which no command prints",
    ("docs/calibration.md", "H by few numbers"): "experiments against the true H, which no command prints",
    ("docs/calibration.md", "Learnt kernels"): "an experiment against the closed form, twenty seeds",
    ("docs/calibration.md", "Run time"): "lengths of the example",
    ("docs/camera.md", "The gallery"): "runs of the large scenes, minutes each",
    ("docs/choose-a-camera.md", "Describe the sensor"): "lengths of the example",
    ("docs/choose-a-camera.md", "What diffraction allows"): "lengths of the example",
    ("docs/choose-a-camera.md", "Rendered proof"): "runs of 119 x 119 pixels, a minute each",
    ("docs/choose-a-camera.md", "Masks, or more lens types"): "predictions of 119 x 119 pixels, half a minute each",
    ("docs/diffraction.md", "One wavefront"): "constants of the text",
    ("docs/diffraction.md", "Which f-number"): "f-numbers",
    ("docs/lenses.md", "Pixels that blur"): "tests/simulate/test_pixel_blur.py",
    ("docs/lenses.md", "Walls"): "worlds with 16384 samples, an hour",
    ("docs/lenses.md", "Misalignment"): "constants of the text",
    ("docs/noise.md", "Light"): "constants of the text",
    ("docs/paper.md", "Claims"): "statements, which test_paper.py compares with claims.csv",
    ("docs/paper.md", "Assumptions"): "constants of the text",
    ("docs/pictures.md", "Values"): "constants of the text",
    ("docs/priors.md", "Priors"): "constants of the text",
    ("docs/priors.md", "The common level"): "constants of the text",
    ("docs/recorded.md", "Recorded frames"): "the angle of the example",
    ("docs/scene-file.md", "`[camera]`"): "limits of a key",
    ("docs/scene-file.md", "`[camera.tolerance]`"): "constants of the text",
    ("docs/scene-file.md", "`[sensor]`"): "constants of the text",
    ("docs/time.md", "As many as are needed"): "experiments with the samplers, which no command prints",
    ("docs/trust.md", "The verdict"): "constants of the text",
    ("docs/trust.md", "The held-out check"): "constants of the text",
    ("docs/coverage.md", None): "tables of `python -m tests.benchmarks pictures` and `coverage`, hours",
    ("docs/troubleshooting.md", "Memory"): "an order of magnitude",
    ("docs/units.md", "Positions of the sub-imagers"): "stated and printed in the Python block before it",
}


@cache
def predicted(name: str, *changes: str, lens: str = "") -> float:
    """Return the expected error of Eq. 5 as `predict --no-rays` prints it."""
    return ommatid.predict(ommatid.read_scene(name, set=changes, lens=lens), rays=False).mse


def camera_of(name: str, *changes: str) -> Camera:
    return derive(ommatid.read_scene(name, set=changes))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("figures")


def ran(folder: Path, name: str, *changes: str) -> RunReport:
    """Return run.json of a run of a scene of the gallery with changes."""
    scene = ommatid.read_scene(name, set=changes)
    return ommatid.run(scene, folder / re.sub(r"\W+", "-", "-".join([name, *changes]))).summary


# --- sentences of the pages


def test_the_best_camera(ommatid: Command) -> None:
    magnifications = 'design.magnifications="1/3,1/4,...,1/9"'
    found = json.loads(ommatid("design", "tile19", "--set", magnifications, "--json").out)
    check_figures("camera.md", "has a mean squared error below {} far from the edges.", found["bound"])
    areas = found["mixture"]["arrays"][:3]
    check_figures("camera.md", "takes {} arrays of 1/3, {} of 1/4 and {} of 1/5.", *areas)
    best = found["cameras"][0]
    assert best["arrays"] == [1, 1, 1, 0, 0, 0, 0]
    check_figures("camera.md", "the best camera is the paper's, {} % above the bound.", 100 * best["above"])
    thin = json.loads(
        ommatid("design", "tile19", "--set", magnifications, "--set", "design.thickness=1 mm", "--json").out
    )
    kinds = [words for words, count in zip(thin["types"], thin["cameras"][0]["arrays"], strict=True) if count]
    assert kinds == ["1/6", "1/7", "1/8"]
    check_figures("camera.md", "and its error is {} times larger.", thin["cameras"][0]["mse"] / best["mse"])


def test_steered_windows(ommatid: Command) -> None:
    noise = "--set", "noise.variance=1"
    found = json.loads(ommatid("design", "tile19", *noise, "--steer", "6,6,7,7", "--json").out)
    last, bound = found["windows"][-1]["weighted_mse"], found["bound"]
    check_figures("camera.md", "lower the expected error from {} to {}.", found["before"], last)
    check_figures("camera.md", "No choice of four such windows one pixel apart falls below {}:", bound)
    check_figures("camera.md", "the choice is {} % from the best at most.", 100 * (last / bound - 1))


def test_the_photograph_of_the_readme() -> None:
    camera = camera_of("photo")
    (seconds,) = stated_figures("speed.md", "| `photo` as it is | 239 | {} |")
    figures = camera.unknowns, float(seconds)
    check_figures("README.md", "{} pixels from fifty sub-imagers, reconstructed in {} seconds on two cores", *figures)
    assert len(camera.sub_imagers) == 50


def test_three_types_against_one_in_the_readme() -> None:
    errors = [predicted("tile19", "noise.variance=1e-2", lens=lens) for lens in ("", "I,I,I")]
    camera = camera_of("tile19")
    first = camera.type_slices()[0]
    sizes = camera.measurements, 3 * (first.stop - first.start)
    check_figures("README.md", "squared error {}, not {}, with {} and {} sensor pixels", *errors, *sizes)


def test_the_error_is_proportional_to_the_noise() -> None:
    check_figures("noise.md", "it is {} for `tile19`", predicted("tile19", "noise.variance=1e-6") / 1e-6)


def test_which_type_to_add(ommatid: Command) -> None:
    changes = "--set", "design.readings=2.6", "--set", 'design.magnifications="1/3,...,1/9"'
    result = json.loads(ommatid("design", "tile19", "--lens", "I", *changes, "--json").out)
    assert [camera["arrays"][:3] for camera in result["cameras"][:2]] == [[1, 1, 0], [1, 0, 1]]
    check_figures("camera.md", "Type I alone leaves an error of {}.", predicted("tile19", lens="I"))
    errors = [camera["with_edges"] for camera in result["cameras"][:2]]
    check_figures("camera.md", "a second type of 1/4 reduces it to {}, and 1/5 to {}.", *errors)


def test_electrons_of_white_pixels() -> None:
    scene = ommatid.read_scene("sensor")
    camera = derive(scene)
    types = np.concatenate([np.full(np.prod(sub.type.pixels), sub.type.name) for sub in camera.sub_imagers])
    collected = [255 * electrons(scene, camera)[types == lens].mean() for lens in ("I", "II", "III")]
    sentence = "a white pixel collects {} electrons behind lens type I, {} behind II and {} behind III"
    check_figures("noise.md", sentence, *collected)


def test_light_that_surfaces_reflect() -> None:
    lost = [100 * (1 - transmissions(camera_of(name))["I"]) for name in ("planoconvex", "doublet")]
    check_figures("lenses.md", "`planoconvex` loses {} % of the light and `doublet` {} %", *lost)


@pytest.mark.slow
def test_which_f_number() -> None:
    """Errors are the trace of (H^T H)^-1 here, that of Eq. 5 over a noise variance that goes to zero."""
    stated = (0.1, 0.2, 0.25, 0.3, 0.4)
    errors: list[float] = []
    for ratio in stated:
        camera = f_numbers.camera_of("perfect", ratio * f_numbers.PITCH / 550e-6, "550 nm")
        singular = np.linalg.svd(ideal_matrix(camera).toarray(), compute_uv=False)
        errors.append(np.sum(singular**-2.0) / camera.unknowns)
    perfect = predicted("tile19", "noise.variance=1e-6") / 1e-6
    check_figures("diffraction.md", "in sensor pixels | 0 | {} | {} | {} | {} | {} |\n| ---", *stated)
    airy = [2 * 1.21967 * ratio for ratio in stated]
    check_figures("diffraction.md", "| Airy disk, in sensor pixels | 0 | {} | {} | {} | {} | {} |", *airy)
    check_figures(
        "diffraction.md", "| expected error over noise variance | {} | {} | {} | {} | {} | {} |", perfect, *errors
    )


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The scene file of the page on choosing a camera."""
    path = tmp_path_factory.mktemp("phone") / "phone.toml"
    path.write_text(saved("choose-a-camera.md", "phone.toml"), encoding="utf-8")
    return str(path)


def saved(page: str, name: str) -> str:
    """Return the file that a page asks the reader to save."""
    return next(block.text for block in blocks(DOCS / page) if block.file_name == name)


@pytest.mark.slow
def test_the_lenses_of_three_sensors(ommatid: Command, here: Path) -> None:
    """As the commands of the page print them, and those of the cameras that are a millimetre thinner."""
    ask = saved("choose-a-camera.md", "ask.toml")
    (here / "ask.toml").write_text(ask, encoding="utf-8")
    shown = [block for block in blocks(DOCS / "choose-a-camera.md") if block.language == "sh"]
    errors = dict[str, tuple[float, float, float]]()
    for line in (line for block in shown for line, _ in block.commands() if line.startswith("ommatid design")):
        _, *arguments = shlex.split(line)
        name = arguments[arguments.index("-o") + 1]
        found = json.loads(ommatid(*arguments, "--json").out)
        limit = float(re.findall(r'thickness(?:=| = ")([\d.]+) mm', ask + line)[-1])
        with (here / name / "front.csv").open(newline="", encoding="utf-8") as stream:
            rows = [row for row in csv.DictReader(stream) if row["limit"] == "depth"]
        thin = min(float(row["mse"]) for row in rows if float(row["depth"]) <= limit - 1)
        errors[name] = found["cameras"][0]["mse"], found["bound"], thin
    error, bound, _ = errors["machine"]
    check_figures("choose-a-camera.md", "squared error is {} far from the edges, that is {} grey", error, error**0.5)
    check_figures("choose-a-camera.md", "better by more than {} %.", 100 * (error / bound - 1))
    best = read(here / "machine" / "camera1.toml")
    terms = optical_terms(best, derive(best))
    lengths = terms.types[0].focal_length, terms.types[-1].focal_length, terms.total_track
    check_figures("choose-a-camera.md", "focal lengths are {} mm and {} mm, the total track is {} mm.", *lengths)
    check_figures(
        "choose-a-camera.md",
        "| machine vision | 2 x 1/2 + 1/3 | {} | {} | 1/3 whole, and two open by 1/2: {} |",
        *errors["machine"],
    )
    check_figures(
        "choose-a-camera.md", "| phone | 3 x 1/2 | {} | {} | three of 1/4, open by 1/2: {} |", *errors["phone"]
    )
    check_figures(
        "choose-a-camera.md",
        "| infrared | 3 x 1/2 | {} | {} | 1/3 whole, and two open by 1/2: {} |",
        *errors["infrared"],
    )


def test_the_optics_of_the_chosen_camera(phone: str) -> None:
    scene = ommatid.read_scene(phone)
    camera = derive(scene)
    terms = optical_terms(scene, camera)
    check_figures("choose-a-camera.md", "A pixel of the target is {} mm wide.", camera.target_pitch)
    airy = [float(lens.airy_diameter or 0) for lens in terms.types]
    check_figures("choose-a-camera.md", "the Airy disks are {} to {} pixels wide", min(airy), max(airy))
    cut_off = 550e-6 * camera.depth(camera.types[0]) / 0.5
    check_figures("choose-a-camera.md", "wavelength times f-number, {} um on the sensor", 1000 * cut_off)
    large = camera_of(phone, "camera.pixel_pitch=6.2 um").target_pitch
    check_figures("choose-a-camera.md", "before the large ones have {} mm,", large)
    single = 3 * camera.target_pitch
    check_figures("choose-a-camera.md", "before the small pixels has target pixels of {} mm", single)


def test_the_bits_of_the_chosen_camera(phone: str) -> None:
    bits = [predicted(phone, "camera.pixel_pitch=6.2 um", f"noise.bits={count}") for count in (12, 13)]
    check_figures("choose-a-camera.md", "with 12 and 13 bits it is {} and {}.", *np.sqrt(bits))
    rays = predicted(phone, "camera.wavelength=none", "noise.bits=11")
    check_figures("choose-a-camera.md", "would promise {} with 11 bits", rays**0.5)


def test_the_heights_before_one_chip() -> None:
    camera = derive(ommatid.read_scene("tile35", set="camera.common=sensor"))
    fifth = next(lens_type for lens_type in camera.types if lens_type.ratio == 5)
    lengths = camera.height(fifth), camera.depth(fifth)
    check_figures("camera.md", "Lenses of 1/5 then stand {} mm behind those of 1/3, at {} mm before the chip", *lengths)


def test_one_lens_type_against_three() -> None:
    def row(lens: str) -> list[float]:
        found = ommatid.predict(ommatid.read_scene("tile19", set="noise.variance=1e-2", lens=lens), rays=False)
        return [found.measurements, float(found.null_space or 0), found.mse]

    check_figures("compare.md", "Three types of `tile19` have {} sensor pixels.", row("")[0])
    check_figures("compare.md", "Type I three times has {}:", row("I,I,I")[0])
    check_figures("compare.md", "| I, II, III | {} | {} | {} |", *row("I,II,III"))
    check_figures("compare.md", "| I, II | {} | {} | {} |", *row("I,II"))
    check_figures("compare.md", "| I, I, I | {} | {} | {} |", *row("I,I,I"))
    check_figures("compare.md", "| III, III, III | {} | {} | {} |", *row("III,III,III"))


# --- sentences about runs, which take minutes


@pytest.mark.figures
@needs_fast_backend
def test_the_first_camera(folder: Path) -> None:
    check_figures("first-camera.md", "`predict --no-rays` computes {}, which is the effect", predicted(STARTER))
    report = ran(folder, STARTER, "render.samples=256", "calibration.samples=256")
    needed = not_none(ran(folder, STARTER).error.mse)
    rendering = 100 * report.error.budget["rendering"] / report.error.predicted_mse
    check_figures(
        "time.md",
        "has an error of {} instead of {}, and the budget says why: {} % of it is due to the rendering.",
        *(not_none(report.error.mse), needed, rendering),
    )


@pytest.mark.figures
@needs_fast_backend
def test_the_error_bars_of_the_readme(folder: Path) -> None:
    scene = ommatid.read_scene("photo")
    result = ommatid.run(scene, folder / "photo")
    error = result.summary.error
    beyond = np.abs(result.image - ommatid.target_image(scene)) / result.deviation
    shares = [100 * float(np.mean(beyond < limit)) for limit in (1, 2)]
    check_figures(
        "README.md",
        "RMS error {}, expected {};",
        not_none(error.mse) ** 0.5,
        not_none(error.expected_given_truth).mse ** 0.5,
    )
    check_figures(
        "README.md", "{} % of the pixels are off by less than their error bar, {} % by less than two", *shares
    )
    check_figures("README.md", "{} dB better than the best sub-image", error.gain or 0.0)


@pytest.mark.figures
@needs_fast_backend
def test_a_prior_fitted_to_a_noisy_stack(folder: Path) -> None:
    independent = not_none(ran(folder, "tile35", "noise.variance=1").error.mse)
    fitted = not_none(ran(folder, "tile35", "noise.variance=1", "prior.kind=fit").error.mse)
    check_figures(
        "priors.md",
        "the prior of the paper leaves a mean squared error of {}, and `prior.kind=fit` leaves {}.",
        independent,
        fitted,
    )


@pytest.mark.figures
@needs_fast_backend
def test_two_seeds_of_a_real_sensor(folder: Path) -> None:
    runs = [ran(folder, "sensor", f"render.seed={seed}").error for seed in (0, 1)]
    expected = not_none(runs[0].expected_given_truth)
    measured = [float(run.mse or 0) for run in runs]
    check_figures("noise.md", "Two runs with different seeds measured errors of {} and {};", *measured)
    check_figures(
        "noise.md",
        "the expected error for the picture is {}, and {} to {} its 99 % interval",
        *(expected.mse, expected.low, expected.high),
    )


@pytest.mark.figures
@needs_fast_backend
def test_diversity_by_distortion(folder: Path) -> None:
    flat = predicted("distorted", "target.detail=", "prior.kind=independent")
    error = ran(folder, "distorted").error
    three = predicted("tile19", "noise.variance=1e-2")
    check_figures(
        "lenses.md", "the error is {} at a noise variance of 1e-2, where that of three types is {}.", flat, three
    )
    check_figures(
        "lenses.md",
        "the error is {}, and {} is expected on average, of which {} are detail that f does not hold",
        *(float(error.mse or 0), error.predicted_mse, error.budget["detail"]),
    )


@pytest.mark.figures
@needs_fast_backend
def test_studies_of_a_misaligned_camera(folder: Path) -> None:
    models = 'study.models=["ideal","transport","fitted","true"]'
    changes = ("target.detail=", "prior.correlation_length=25 mm", models)
    fine, flat = (
        {case.model: (float(case.mse or 0), case.predicted) for case in ran(folder, "misaligned", *each).study}
        for each in ((), changes)
    )
    both = {model: (*fine[model], *flat[model]) for model in fine}
    check_figures("lenses.md", 'misalignment ignored (`"trust"`) | {} | {} | {} | {} |', *both["ideal"])
    check_figures("lenses.md", "| transport | {} | {} | {} | {} |", *both["transport"])
    check_figures("lenses.md", "without point sources | | | {} | {} |", *flat["fitted"])
    check_figures("lenses.md", "| true | {} | {} | {} | {} |", *both["true"])


FLAT = ("noise.variance=1e-3", "prior.kind=independent", "prior.correlation_length=", "target.detail=")


@pytest.mark.figures
@needs_fast_backend
def test_sensor_pixels_for_real_lenses() -> None:
    def row(pitch: str) -> list[float]:
        keys = (*FLAT, f"camera.pixel_pitch={pitch}")
        lights = ("camera.wavelength=550 nm", "camera.wavelength=none")
        return [predicted(name, *keys, light) for name in ("planoconvex", "doublet") for light in lights]

    check_figures("lenses.md", "| 6 um | {} | {} | {} | {} |", *row("6 um"))
    check_figures("lenses.md", "| 12 um | {} | {} | {} | {} |", *row("12 um"))
    check_figures("lenses.md", "| 18 um, as in the gallery | {} | {} | {} | {} |", *row("18 um"))


@pytest.mark.figures
def test_errors_by_rays_alone() -> None:
    ratios = [row.waves / row.rays for row in f_numbers.rows(("doublet", "planoconvex"), (5.6, 8.0, 11.0))]
    check_figures("diffraction.md", "The error by rays alone is {} to {} times too small", min(ratios), max(ratios))


# --- output of commands, in text blocks

# First lines of the text blocks that are no output of the command before them: formulas, files, other programs.
NOT_OUTPUT = {
    "batches.md": ("ommatid reconstruct film/0*.exr", "openssl req", "dask scheduler", "#!/bin/sh"),
    "README.md": ("pip install .",),
    "install.md": ("source .venv/bin/activate", "pip install ."),
    "lenses.md": ("# radius  thickness",),
    "python.md": ("import deepinv, torch",),
    "coverage.md": ("python -m tests.benchmarks",),
    "worlds.md": ("offset of the lens",),
}
FORMULAS = ("equations.md",)  # pages whose text blocks are all formulas


def outputs(page: Path) -> list[Block]:
    """Return the text blocks of a page that show what the shell block before them prints."""
    if page.name in FORMULAS:
        return []
    excepted = NOT_OUTPUT.get(page.name, ())
    return [block for block in blocks(page) if block.language == "text" and not block.text.startswith(excepted)]


PAGES_WITH_OUTPUT = [page for page in PAGES if outputs(page)]


@pytest.mark.figures
@needs_fast_backend
@pytest.mark.parametrize("page", PAGES_WITH_OUTPUT, ids=page_name)
def test_outputs_in_a_page_are_those_of_its_commands(page: Path, tmp_path: Path) -> None:
    """Runs the commands up to the last output as they are printed, with all samples."""
    shown = outputs(page)
    everything = blocks(page)
    if "ommatid init mine.toml" not in text_of(page):
        assert shell("init", "mine.toml", cwd=tmp_path).code == 0
    printed = ""
    for block in everything[: everything.index(shown[-1]) + 1]:
        if block.language == "sh":
            printed = ""
            for command, _ in block.commands():
                program, *arguments = shlex.split(command)
                if program == "ommatid":
                    ended = shell(*arguments, cwd=tmp_path)
                    assert ended.code == 0, ended.err
                    printed += ended.out
        elif block in shown:
            assert is_printed(block.text, printed), (
                f"{page.name} states\n{block.text}\nbut the command prints\n{printed}"
            )


def test_every_output_follows_its_command() -> None:
    for page in PAGES:
        everything = blocks(page)
        for block in outputs(page):
            before = [other.language for other in everything[: everything.index(block)] if other.language != "text"]
            assert before[-1:] == ["sh"], f"{page.name}: which command prints this?\n{block.text}"


# --- no others


def test_every_decimal_number_of_a_page_is_checked() -> None:
    """A decimal number is checked by the test of its command, excepted above, or a constant of the text."""
    found = {(page_name(page), heading): number for page in PAGES for heading, number in unchecked_decimals(page)}
    whole = {name for name, heading in NOT_PRINTED if heading is None}
    left = {place: number for place, number in found.items() if place[0] not in whole and place not in NOT_PRINTED}
    assert not left, "check them with check_figures in the test of the command that prints them"
    superfluous = {place for place in NOT_PRINTED if place[1] is not None and place not in found}
    assert (superfluous, whole - {name for name, _ in found}) == (set(), set()), "exceptions for no decimal number"
