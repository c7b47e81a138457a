"""The paper's figures and claims: reference values by extended precision, statistics, and what is written."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass, replace
from functools import cache
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from ommatid.paper import claims, paper
from ommatid.paper.claims import NO, QUALIFIED, YES
from ommatid.paper.photographs import crop_tiles, load, measure
from ommatid.paper.tile_errors import SIZES, THREE, TWICE, TWO, PaperTile, TileError, Tiles, inner, tile, tiles
from ommatid.runtime.arrays import FloatArray
from ommatid.runtime.errors import InputError
from ommatid.scenes.tables.sensor import NoiseTable

from ..documentation import DOCS
from ..examples import familywise
from ..kept_figures import KeptFigures
from ..printed_figures import check_figures


@dataclass(frozen=True)
class Written:
    """The folder and summary of one run, and the figures as they were drawn."""

    folder: Path
    description: dict[str, Any]
    figures: dict[str, Any]

    def rows(self, name: str) -> list[dict[str, str]]:
        with (self.folder / name).open(newline="", encoding="utf-8") as stream:
            return list(csv.DictReader(stream))

    def claim(self, beginning: str) -> dict[str, Any]:
        (match,) = [claim for claim in self.description["claims"] if claim["claim"].startswith(beginning)]
        return match


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Written:
    folder = tmp_path_factory.mktemp("paper") / "new" / "folder"
    figures = KeptFigures(write=True)
    return Written(folder, paper.write_paper(folder, files=figures), figures.kept)


@pytest.fixture(scope="module")
def computed() -> Tiles:
    return tiles()


@cache
def small(lenses: tuple[str, ...]) -> PaperTile:
    """The 19 x 19 tile with these lens types."""
    return tile(19, lenses)


REFERENCE = [
    ("fig2", "I+I", 1e-6, 1e-6, 2057.42393, None),
    ("fig2", "I+II", 1e-6, 1e-6, 484.100274, None),
    ("fig2", "I+II+III", 1e-6, 1e-6, 2.79776586e-4, None),
    ("fig2", "I+II+III", 1e-2, 1e-4, 0.0330911224, None),
    ("fig2", "I+II", 1e-2, 1e-4, 484.191545, None),
    ("fig2", "I+II+III", 1.0, 1e-2, 35.5841883, None),
    ("fig2", "I+II", 1.0, 1e-2, 589.811609, None),
    ("fig2", "I+I", 1e-4, 1e-2, 2058.5, None),
    ("fig2", "I+II", 1e-4, 1e-2, 489.606, None),
    ("fig2", "I+II+III", 1e-4, 1e-2, 2.79766, 1.85623),
    ("fig4", "I+I", 1e-6, 1e-6, 606.31081, None),
    ("fig4", "I+II", 1e-6, 1e-6, 89.16378, None),
    ("fig4", "I+II+III", 1e-6, 1e-6, 1.54401e-4, None),
    ("fig4", "I+II+III", 1.0, 1.0, 139.233, None),
    ("fig4", "I+II", 1.0, 1.0, 397.08, None),
]


def test_the_errors_of_the_19_x_19_tile_are_those_of_extended_precision() -> None:
    for figure, lenses, expected, actual, mse, trimmed in REFERENCE:
        if figure == "fig2":
            error = small(tuple(lenses.split("+"))).line(expected).at(actual)
            assert error.mean() == pytest.approx(mse, rel=digits(mse))
            if trimmed is not None:
                assert inner(error, 19) == pytest.approx(trimmed, rel=digits(trimmed))


@pytest.mark.slow
def test_the_numbers_of_figures_2_and_4_are_those_of_extended_precision(written: Written) -> None:
    for figure, lenses, expected, actual, mse, trimmed in REFERENCE:
        (row,) = [
            row
            for row in written.rows(f"{figure}.csv")
            if row["lenses"] == lenses
            and float(row["expected_noise_variance"]) == expected
            and np.isclose(float(row["actual_noise_variance"]), actual, rtol=1e-12)
        ]
        assert float(row["mse"]) == pytest.approx(mse, rel=digits(mse))
        if trimmed is not None:
            assert float(row["trimmed_mse"]) == pytest.approx(trimmed, rel=digits(trimmed))


def digits(reference: float) -> float:
    """Half a unit of the last digit that a reference is given with, relative."""
    figures = len(f"{reference:.12g}".split("e")[0].replace(".", "").strip("0"))
    return 0.6 * 10.0 ** (1 - figures)


@pytest.mark.slow
def test_figure_5_holds_the_tile_of_longer_lenses(written: Written) -> None:
    rows = written.rows("fig5.csv")
    matched = {
        row["side"]: float(row["mse"])
        for row in rows
        if float(row["actual_noise_variance"]) == float(row["expected_noise_variance"]) == 1e-6
    }
    assert matched["41"] == pytest.approx(1.24737e-3, rel=digits(1.24737e-3))
    assert set(matched) == {"19", "35", "41"}


@pytest.mark.slow
def test_two_types_of_longer_lenses() -> None:
    assert tile(41, TWO).mse(1e-6) == pytest.approx(194.93058, rel=1e-7)


@pytest.mark.parametrize("lenses", [TWICE, TWO, THREE])
def test_a_line_agrees_with_equation_5_in_dense_matrices(lenses: tuple[str, ...]) -> None:
    shown, expected, actual = small(lenses), 1e-2, 3.0
    h, p0 = shown.problem.matrix.toarray(), 5461.25
    gain = np.linalg.solve(p0 * h @ h.T + expected * np.eye(len(h)), p0 * h).T
    left = np.eye(361) - gain @ h
    covariance = p0 * left @ left.T + actual * gain @ gain.T
    # The textbook form loses 7e-17/v of its digits, and its squares once more.
    np.testing.assert_allclose(shown.line(expected).at(actual), np.diag(covariance), rtol=1e-7)


@pytest.mark.slow
def test_maps_show_the_tile_upright(written: Written, computed: Tiles) -> None:
    rows = written.rows("fig3.csv")
    for number, lenses in enumerate((TWICE, TWO, THREE)):
        image = np.zeros((19, 19))
        for row in rows:
            if row["lenses"] == "+".join(lenses):
                image[int(row["row"]), int(row["column"])] = float(row["expected_squared_error"])
        for trim, axes in zip((0, 2), written.figures["fig3"].axes[number:6:3], strict=True):
            part = image[trim : 19 - trim, trim : 19 - trim]
            np.testing.assert_array_equal(axes.images[0].get_array(), part)
            assert axes.images[0].origin == "upper"
            assert axes.images[0].get_extent() == [trim - 0.5, 18.5 - trim, 18.5 - trim, trim - 0.5]
            assert axes.images[0].get_clim() == (0, part.max())
            assert f"maximum {part.max():.4g}" in axes.get_title()
            assert f"average {part.mean():.4g}" in axes.get_title()
        assert image.mean() == pytest.approx(computed[19, lenses].mse(1e-4), rel=1e-12)


@pytest.mark.slow
def test_larger_tiles_of_three_types_approach_the_whole_frame(written: Written) -> None:
    """From above; far from the edges three types of 1/3, 1/4 and 1/5 leave 95.76 times the noise's variance."""
    rows = {(row["lenses"], int(row["side"])): row for row in written.rows("tile_sizes.csv")}
    assert float(rows["I+II+III", 19]["mse_of_frame"]) == pytest.approx(95.76 * paper.SIZE_NOISE, rel=1e-4)
    for lenses in ("I+I", "I+II", "I+II+III"):
        assert all(float(rows[lenses, side]["mse"]) > float(rows[lenses, side]["mse_of_frame"]) for side in SIZES)
    errors = [float(rows["I+II+III", side]["mse"]) for side in SIZES]
    assert errors == sorted(errors, reverse=True)
    assert errors[2] == pytest.approx(written_error(written, 19), rel=1e-9)


def written_error(written: Written, side: int) -> float:
    """The error of three types in fig5.csv, of the estimator that expects the noise of the figure of sizes."""
    [row] = [
        row
        for row in written.rows("fig5.csv")
        if row["side"] == str(side)
        and float(row["expected_noise_variance"]) == pytest.approx(paper.SIZE_NOISE, rel=1e-12)
        and row["actual_noise_variance"] == row["expected_noise_variance"]
    ][:1]
    return float(row["mse"])


@pytest.mark.slow
def test_the_tiles_of_figure_6_err_as_figure_7_predicts(written: Written) -> None:
    """Each of three types errs as Eq. 5 says, up to the draw of the noise: 1225 pixels of some 130 free waves."""
    by_lenses = {row.pop("lenses"): [float(cell) for cell in row.values()] for row in written.rows("fig6.csv")}
    predicted = written_error(written, 35)
    assert np.mean(by_lenses["I+II+III"]) == pytest.approx(predicted, rel=0.15)
    assert all(one > two > three for one, two, three in zip(*by_lenses.values(), strict=True))


@pytest.mark.slow
def test_the_page_shows_every_figure_with_its_claims(written: Written) -> None:
    page = (written.folder / paper.PAGE).read_text(encoding="utf-8")
    shown = [page.index(f'src="{name}.png"') for name in paper.FIGURES]
    assert shown == sorted(shown)
    sections = dict(zip(paper.FIGURES, page.split("<section")[1:], strict=True))
    for claim in written.description["claims"]:
        assert claim["claim"] in unescape(sections[claim["figure"]])
    assert page.count("of this program, not of the paper") == 3


@pytest.mark.slow
def test_figure_7_is_drawn_as_it_is_written(written: Written) -> None:
    rows = written.rows("fig7.csv")
    tiles_at = [f"tile_{row}_{column}" for row, column in written.description["picture"]["places"]]
    parts = [row for row in rows if not row["bits"]], [row for row in rows if row["bits"]]
    panels = [axes for axes in written.figures["fig7"].axes if axes.get_yscale() == "log"]
    for axes, part in zip(panels, parts, strict=True):
        wanted = [*tiles_at, "mean", "predicted"]
        for line, column in zip(axes.lines, wanted, strict=True):
            np.testing.assert_array_equal(line.get_ydata(), [float(row[column]) for row in part])
        for row in part:
            assert float(row["mean"]) == pytest.approx(np.mean([float(row[name]) for name in tiles_at]), rel=1e-12)
    for row in parts[1]:
        assert float(row["noise_variance"]) == pytest.approx((256 / 2 ** int(row["bits"])) ** 2 / 12, rel=1e-12)


@pytest.mark.slow
def test_every_axis_has_a_name(written: Written) -> None:
    for name, figure in written.figures.items():
        for axes in figure.axes:
            bar = axes.get_label() == "<colorbar>"
            assert axes.get_ylabel() or not len(axes.get_yticks()), f"{name}: {axes.get_title()}"
            assert axes.get_xlabel() or not len(axes.get_xticks()) or bar, f"{name}: {axes.get_title()}"
        assert (written.folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_all_files_are_written_and_no_others(written: Written) -> None:
    assert {path.name for path in written.folder.iterdir()} == set(written.description["files"])
    assert set(written.figures) == set(paper.FIGURES)
    json.dumps(written.description, allow_nan=False)


VERDICTS = {
    "two sets of type I": QUALIFIED,
    "two types are better": QUALIFIED,
    "one type or two: the null space": YES,
    "three types: the error falls": YES,
    "two types: the error is largest": YES,
    "type I alone": QUALIFIED,
    "three types: the 35 x 35": QUALIFIED,
    "41 x 41": QUALIFIED,
    "three types: trimming the 19 x 19": YES,
    "three types: trimming the 35 x 35": NO,
    "the 35 x 35 tile helps most": YES,
    "a second equal set": YES,
    "joining tiles": YES,
    "one type leaves": YES,
    "two coprime types": YES,
    "quantisation": QUALIFIED,
    "real photographs": YES,
}


@pytest.mark.slow
def test_each_claim_has_the_verdict_measured_beforehand(written: Written) -> None:
    """In the file, in the summary and in the printed table."""
    rows, printed = written.rows("claims.csv"), dict(paper.rows(written.description))
    assert len(rows) == len(VERDICTS)
    for beginning, verdict in VERDICTS.items():
        claim = written.claim(beginning)
        assert claim["holds"] == verdict
        assert bool(claim["remark"]) or claim["holds"] == YES, "a qualification is stated"
        (row,) = [row for row in rows if row["claim"] == claim["claim"]]
        assert (row["holds"], row["remark"]) == (claim["holds"], claim["remark"])
        own = beginning in ("one type leaves", "two coprime types", "three types: trimming the 35 x 35")
        assert row["source"] == ("ommatid" if own else "paper")
        assert all(name in row["numbers"] for name in claim["numbers"])
        assert printed[claim["claim"]].startswith(("not in the paper, " if own else "") + verdict)


NUMBERS = (
    ("two types are better", "19: least noise at which they cross", 3.6),
    ("two types are better", "19: largest noise at which they cross", 7.9),
    ("type I alone", "19: mean of the 17 x 17 pixels it sees", 1209.41),
    ("type I alone", "19: trimmed by 1", 1213.35),
    ("41 x 41", "times less than 19", 4.5),
    ("41 x 41", "times less than 35", 8.1),
    ("three types: trimming the 19 x 19", "I+II: share of the error that it removes", 0.43),
    ("three types: trimming the 19 x 19", "I+II+III: share of the error that it removes", 0.34),
    ("three types: trimming the 35 x 35", "I+II: share of the error that it removes", 0.173),
    ("three types: trimming the 35 x 35", "I+II+III: share of the error that it removes", 0.178),
    ("the 35 x 35 tile helps most", "I+I: error of 19 over error of 35", 3.4),
    ("the 35 x 35 tile helps most", "I+II: error of 19 over error of 35", 5.4),
    ("the 35 x 35 tile helps most", "I+II+III: error of 19 over error of 35", 1.8),
    ("a second equal set", "19: null space of one set", 361 - 225),
    ("a second equal set", "19: null space of two", 361 - 225),
    ("joining tiles", "I+II+III: joined", 1.54401e-4),
    ("joining tiles", "I+II: joined", 89.16378),
    ("one type leaves", "19 I (a = 4): null space", 361 - 225),
    ("one type leaves", "35 I (a = 2): null space", 1225 - 1089),
    ("two coprime", "19 I+II (a = 4, b = 4): null space", 361 - 329),
    ("two coprime", "19 I+III (a = 4, b = 3): null space", 361 - 337),
    ("two coprime", "35 I+II (a = 2, b = 5): null space", 1225 - 1205),
    ("two coprime", "41 I+II (a = 6, b = 5): null space", 1681 - 1621),
    ("one type or two", "19 I+II: error at noise 1e-6", 484.100274),
)


@pytest.mark.slow
def test_the_numbers_of_the_claims(written: Written) -> None:
    for beginning, number, value in NUMBERS:
        actual = written.claim(beginning)["numbers"][number]
        assert actual == (value if isinstance(value, int) else pytest.approx(value, rel=digits(value))), number


@pytest.mark.slow
def test_whole_numbers_are_rounded_with_a_third_less_error(written: Written) -> None:
    numbers = written.claim("quantisation")["numbers"]
    assert numbers["whole numbers, from 12 bits on"] == pytest.approx(2 / 3, abs=0.05)
    fine = [numbers[f"error it causes over predicted at {bits} bits"] for bits in range(10, 17)]
    np.testing.assert_allclose(fine, 1, atol=4 * numbers["standard error at most"])


@pytest.mark.slow
def test_the_page_states_what_trimming_removes(written: Written) -> None:
    claims = [written.claim(f"three types: trimming the {side} x {side} tile")["numbers"] for side in (35, 19)]
    large, small = ([100 * value for _, value in sorted(numbers.items(), reverse=True)] for numbers in claims)
    check_figures("paper.md", "removes {} % of the error with three types and {} % with two", *reversed(large))
    check_figures("paper.md", "of the 19 x 19 tile {} % and {} %.", *reversed(small))


@pytest.mark.slow
def test_the_documentation_states_the_claims_and_the_errors_of_tiles(written: Written) -> None:
    page = (DOCS / "paper.md").read_text(encoding="utf-8")
    for claim in written.description["claims"]:
        own = "" if claim["source"] == "paper" else " (ours)"
        figure = claim["figure"].removeprefix("fig").removeprefix("tile_")
        assert f"| {claim['claim']}{own} | {figure} | {claim['holds']} |" in page
    assert page.count("(ours)") == 3
    rows = {(row["lenses"], row["side"]): row for row in written.rows("tile_sizes.csv")}
    three, two = [rows["I+II+III", side] for side in ("19", "35")], rows["I+II", "19"]
    errors = *(float(row["mse"]) for row in three), float(three[0]["mse_of_frame"])
    check_figures("paper.md", "estimates at a noise variance of {}.", paper.RECONSTRUCTION_NOISE)
    check_figures(
        "paper.md",
        "At a noise variance of {} three types leave an error of {} on the 19 x 19 tile and of {} on the 35 x 35 tile,",
        paper.SIZE_NOISE,
        *errors[:2],
    )
    check_figures("paper.md", "and of {} in a frame far from its edges", errors[2])
    check_figures("paper.md", "{} in place of {}, since", float(two["mse"]), float(two["mse_of_frame"]))


@pytest.mark.slow
def test_claims_fail_on_swapped_tiles(computed: Tiles) -> None:
    swapped = {**computed, (19, TWICE): computed[19, THREE], (19, THREE): computed[19, TWICE]}
    verdicts = {claim.claim: claim.holds for claim in claims.error_claims(swapped)}
    broken = (
        "two sets of type I",
        "two types are better",
        "one type or two",
        "three types: the error falls",
        "41 x 41",
        "the 35 x 35 tile helps most",
        "a second equal set",
    )
    for beginning in broken:
        assert [holds for claim, holds in verdicts.items() if claim.startswith(beginning)] == [NO]


def test_crossing_and_knee_of_lines() -> None:
    first, second = (
        TileError(np.array([9.0, 11.0]), np.array([1.0, 1.0])),
        TileError(np.array([1.0, 3.0]), np.array([4.0, 6.0])),
    )
    assert first.crossing(second) == 2.0
    assert first.at(2.0).mean() == second.at(2.0).mean()
    assert first.crossing(replace(second, noise=np.array([0.5, 0.5]))) == float("inf")
    assert (first.knee, second.knee) == (10.0, 0.4)


def from_prior(shown: PaperTile, count: int, seed: int) -> FloatArray:
    prior, rng = shown.problem.prior, np.random.default_rng(seed)
    return prior.mean + rng.normal(size=(count, prior.mean.size)) * prior.root


@pytest.mark.slow
def test_images_from_the_prior_err_as_predicted() -> None:
    """The error's covariance has the eigenvalues P0 / (1 + s^2): mean and variance of its squared length follow."""
    shown, count = small(TWO), 200
    noises = tuple(NoiseTable(variance=variance) for variance in (1e-6, 1e-3, 1.0, 100.0))
    trials = measure(shown, from_prior(shown, count, 1), noises, 3, 0)
    for level, noise in enumerate(noises):
        eigenvalues = 5461.25 / (1 + shown.squares / noise.variance)
        spread = np.sqrt(2 * np.sum(eigenvalues**2)) / 361
        z = (trials.mean[level] - trials.predicted[level]) / (spread / np.sqrt(count))
        assert abs(z) < stats.norm.isf(familywise(len(noises)) / 2), f"at noise {noise.variance:g}"


@pytest.mark.slow
def test_the_noise_alone_errs_as_predicted() -> None:
    shown, count = small(THREE), 200
    noises = (NoiseTable(variance=1e-4), NoiseTable(variance=1.0), *(NoiseTable(bits=bits) for bits in (4, 8, 12)))
    trials = measure(shown, from_prior(shown, count, 2), noises, 4, 0)
    limit = stats.norm.isf(familywise(len(noises)) / 2)
    z = (trials.from_noise.mean(axis=1) / trials.noise_part - 1) / (trials.spread / np.sqrt(count))
    assert np.abs(z).max() < limit
    for level, noise in enumerate(noises[:2]):  # Gaussian: the sample's deviation is known from the fourth cumulant
        s2 = shown.squares / noise.variance
        weights = s2 / (1 + s2) ** 2
        excess = 12 * np.sum(weights**4) / np.sum(weights**2) ** 2
        deviation = trials.from_noise[level].std(ddof=1) / trials.noise_part[level]
        assert deviation == pytest.approx(trials.spread[level], rel=3 * np.sqrt((2 + excess) / (4 * count)))


def test_noise_is_repeatable_and_independent() -> None:
    shown, noises = small(THREE), (NoiseTable(variance=1e-2),) * 2
    images = np.tile(from_prior(shown, 1, 5), (3, 1))
    trials = measure(shown, images, noises, 6, 0)
    assert np.unique(trials.measured).size == 6, "equal images and levels have different noise"
    fewer = measure(shown, images[:2], noises, 6, 0)
    np.testing.assert_array_equal(fewer.from_noise, trials.from_noise[:, :2])
    for other in ((6, 1), (7, 0)):
        assert not np.intersect1d(measure(shown, images, noises, *other).from_noise, trials.from_noise).size


@pytest.mark.parametrize("shape", [(70, 105), (105, 70), (35, 210), (210, 35), (71, 300)])
def test_tiles_are_cropped_upright_without_overlap(shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).uniform(0, 255, shape)
    chosen = crop_tiles(pixels, 35, "noise", np.random.default_rng(1))
    covered = np.zeros(shape, dtype=int)
    for image, (row, column) in zip(chosen.images, chosen.corners, strict=True):
        covered[row : row + 35, column : column + 35] += 1
        fraction = image.reshape(35, 35) - pixels[row : row + 35, column : column + 35]
        assert np.abs(fraction).max() <= 0.5, "rounding restores whole numbers"
        assert stats.kstest(fraction.ravel() + 0.5, "uniform").pvalue > familywise(36)
    assert len(chosen.corners) == 6
    assert (covered.max(), covered.sum()) == (1, 6 * 35**2), "whole tiles without overlap"


def test_tiles_are_cropped_where_contrast_is_highest() -> None:
    pixels = np.full((400, 600), 99.0)
    pixels[300, 100] = 200.0
    corners = crop_tiles(pixels, 35, "dot", np.random.default_rng(0)).corners
    assert any(row <= 300 < row + 35 and column <= 100 < column + 35 for row, column in corners)


def test_an_image_too_small_for_six_tiles_is_refused() -> None:
    for rows, columns in ((69, 105), (104, 104), (34, 1000), (1000, 34), (35, 209)):
        with pytest.raises(InputError, match=f"6 tiles of 35 x 35 pixels.* got {rows} x {columns} in me.png"):
            crop_tiles(np.zeros((rows, columns)), 35, "me.png", np.random.default_rng(0))


def test_unreadable_images_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    (tmp_path / "note.npy").write_text("no picture", encoding="utf-8")
    np.save(tmp_path / "small.npy", np.zeros((60, 60)))
    for name, expected in (("note.npy", "could not be read"), ("none.png", "No such file"), ("small.npy", "6 tiles")):
        with pytest.raises(InputError, match=f"--image.*{expected}") as refused:
            paper.write_paper(tmp_path / "out", str(tmp_path / name))
        assert "\n" not in str(refused.value)
    assert not (tmp_path / "out").exists()


def test_an_unusable_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way", encoding="utf-8")
    with pytest.raises(InputError, match="expected a folder"):
        paper.write_paper(tmp_path / "file")


def test_the_users_image_is_not_overwritten(tmp_path: Path) -> None:
    from skimage import io

    picture = tmp_path / "fig7.png"
    save_image: Any = io.imsave  # pyright: ignore[reportUnknownMemberType, reportUnknownVariableType]
    save_image(picture, np.arange(80 * 120, dtype=np.uint8).reshape(80, 120), check_contrast=False)
    assert load(str(picture)).shape == (80, 120)
    with pytest.raises(InputError, match=r"fig7\.png: would replace"):
        paper.write_paper(tmp_path, str(picture))
    assert {path.name for path in tmp_path.iterdir()} == {"fig7.png"}
