"""Recorded point sources become H, with the variance of each entry; the noise of recorded frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse, stats

from ommatid.runtime.errors import InputError
from ommatid.scenes import model_file
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.fitted import view
from ommatid.scenes.formats import npz
from ommatid.scenes.hardware import point_sources
from ommatid.scenes.hardware.frames import AcquisitionSettings
from ommatid.scenes.hardware.point_sources import CHANCE, background, from_recorded_points, photon_transfer, rounding
from ommatid.scenes.model import RECORDED, Model
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.simulate.calibration.fit.recorded import fit_recorded
from ommatid.simulate.ideal import ideal_matrix

from ..conftest import Command
from ..examples import camera, familywise, not_none, slow
from .mosaics import SCENE, SENSOR, SHAPE, Array, as_mosaic, save
from .test_model_file import sealed

ENTRIES = "--set", "calibration.fit=none"
GAIN, READ = 0.02, 0.3  # units of f: of one electron, and of the read noise


def lit(matrix: sparse.csr_array, sources: Array, rng: np.random.Generator) -> Array:
    """Readings, in units of f, of an image of sources with photon and read noise."""
    light = matrix @ sources
    return rng.poisson(light / GAIN) * GAIN + rng.normal(0, READ, light.size)


def sweep(camera: Camera, matrix: sparse.csr_array, times: int, rng: np.random.Generator) -> Array:
    """Mosaics of a point source on each pixel of f in turn, `times` times."""
    points = [
        as_mosaic(camera, lit(matrix, 255.0 * source, rng)) for _ in range(times) for source in np.eye(camera.unknowns)
    ]
    return np.array(points, dtype=np.float32)


def calibrated(ommatid: Command, frames: Array | list[str], *options: str | Path, warning: str = "") -> Model:
    """The model of recorded frames, of an array that is saved as points.npy or of named files."""
    names = frames if isinstance(frames, list) else ["points.npy"]
    if not isinstance(frames, list):
        np.save("points.npy", frames)
    ended = ommatid("calibrate", "scene.toml", "--points", *names, "-o", "h.npz", *options)
    assert ended.code == 0, ended.err
    assert warning in ended.err, ended.err
    assert warning or "recorded once" not in ended.err, ended.err
    return model_file.read(Path("h.npz"))


def with_dead(camera: Camera, frames: Array, dead: int | slice) -> Array:
    """The frames with dead pixels."""
    values = np.zeros(camera.measurements)
    values[dead] = np.nan
    return frames + as_mosaic(camera, values).astype(np.float32)


def blurred_matrix(camera: Camera) -> sparse.csr_array:
    """An H that differs from the ideal one by a slight blur of the target, within the margin."""
    sizes = camera.rows, camera.columns
    kernel = [sparse.diags_array([0.2, 0.6, 0.2], offsets=[-1, 0, 1], shape=(size, size)) for size in sizes]
    return sparse.csr_array(ideal_matrix(camera) @ sparse.kron(*kernel, format="csr"))


def assert_model_is(found: Model, truth: sparse.csr_array, known: Array | slice = slice(None)) -> None:
    """Assert that entries agree with `truth` to their variances, that these are exact, and that no entry is missing.

    The mean of z^2 has the standard error sqrt(3 / n), from the excess kurtosis of few photons.
    """
    rows = np.repeat(np.arange(found.measurements), np.diff(found.matrix.indptr))
    missing = truth.toarray()
    missing[rows, found.matrix.indices] = 0.0
    assert not missing.any()
    expected = np.asarray(truth[rows, found.matrix.indices]).ravel()
    z = (found.matrix.data - expected)[known] / np.sqrt(found.variance[known])
    # Few photons are not normal: the tails of a Poisson distribution are longer, by up to 30 % here.
    assert np.abs(z).max() < 1.3 * stats.norm.isf(familywise(z.size) / 2)
    assert np.mean(z**2) == pytest.approx(1, abs=5 * (3 / z.size) ** 0.5)


@pytest.mark.parametrize("times", [1, 2, slow(5)])
def test_swept_points_give_h_within_its_variance(imaging_camera: Camera, ommatid: Command, times: int) -> None:
    """With one sweep only the background shows noise, not that of photons; so that case has no photon noise."""
    rng = np.random.default_rng(times)
    truth = blurred_matrix(imaging_camera)
    if times == 1:
        light = [truth @ (255 * source) for source in np.eye(imaging_camera.unknowns)]
        frames = np.array([as_mosaic(imaging_camera, values + rng.normal(0, READ, values.size)) for values in light])
    else:
        frames = sweep(imaging_camera, truth, times, rng)
    found = calibrated(ommatid, frames, warning="recorded once" if times == 1 else "")
    assert_model_is(found, truth)
    described = found.record["method"], found.record["exposures"]
    assert described == (RECORDED, times * imaging_camera.unknowns)


def test_variance_from_a_recorded_model_is_the_scatter_of_h_f(imaging_camera: Camera, tmp_path: Path) -> None:
    """Over 200 simulated calibrations with errors of entries and of whole rows, to five standard errors."""
    rng = np.random.default_rng(8)
    truth, image = ideal_matrix(imaging_camera), rng.uniform(0, 255, imaging_camera.unknowns)
    entries = truth.copy()
    deviation: NDArray[np.float64] = np.linspace(0.01, 0.03, entries.nnz)
    squares: list[Array] = []
    for _ in range(200):
        of_rows = np.repeat(rng.normal(0, 0.01, imaging_camera.measurements), np.diff(truth.indptr))
        entries.data = truth.data + rng.normal(0, deviation) + of_rows
        squares.append((entries @ image - truth @ image) ** 2)
    batches = np.full((1, truth.nnz), 0.01, dtype=np.float32)
    scene = read(tmp_path / "scene.toml")
    recorded = Model(scene, imaging_camera, truth, deviation**2, batches, {"method": RECORDED})
    ratio = np.mean(squares, axis=0) / recorded.variance_from_model(image)
    assert ratio.mean() == pytest.approx(1, abs=5 * (2 / 200 / ratio.size) ** 0.5)
    level = np.full(imaging_camera.unknowns, 100.0)
    np.testing.assert_allclose(recorded.prior_variance_from_model(0 * level, 100), recorded.variance_from_model(level))


def grids(camera: Camera, apart: int) -> list[Array]:
    """Rows and columns of sources lit together, on grids `apart` pixels wide."""
    return [
        np.array([(i, j) for i in range(row, camera.rows, apart) for j in range(column, camera.columns, apart)])
        for row in range(apart)
        for column in range(apart)
    ]


def write_positions(path: str, positions: list[Array], names: list[str]) -> None:
    pairs = zip(names, positions, strict=True)
    lines = [f"{name},{row},{column}" for name, of_image in pairs for row, column in of_image]
    Path(path).write_text("\n".join(["image,row,column", *lines, ""]), encoding="utf-8")


def record_grids(camera: Camera, matrix: sparse.csr_array, positions: list[Array], name: str, seed: int) -> list[str]:
    rng = np.random.default_rng(seed)
    names: list[str] = []
    for number, of_image in enumerate(positions):
        sources = np.zeros(camera.shape)
        sources[of_image[:, 0], of_image[:, 1]] = 255.0
        light = lit(matrix, sources.ravel(), rng)
        names.append(save(Path(f"{name}{number:02d}.exr"), as_mosaic(camera, light)).name)
    return names


def test_several_points_can_be_lit_at_once(imaging_camera: Camera, ommatid: Command) -> None:
    truth, positions = blurred_matrix(imaging_camera), grids(imaging_camera, 6)
    names = record_grids(imaging_camera, truth, positions, "a", 5)
    names += record_grids(imaging_camera, truth, positions, "b", 6)
    write_positions("p.csv", [*positions, *positions], names)
    assert_model_is(calibrated(ommatid, names, "--places", "p.csv", *ENTRIES), truth)


def with_ghost(camera: Camera) -> sparse.csr_array:
    """The ideal H, except that the first sensor pixel also sees the target's last pixel, far away."""
    last = sparse.csr_array(([0.05], ([0], [camera.unknowns - 1])), shape=(camera.measurements, camera.unknowns))
    return sparse.csr_array(ideal_matrix(camera) + last)


def displaced(camera: Camera) -> sparse.csr_array:
    """The ideal H, except that the last sub-imager, of 3 x 4 pixels, looks five and a half pixels of f to the left."""
    shift = sparse.diags_array([0.5, 0.5], offsets=[5, 6], shape=(camera.columns, camera.columns))
    matrix = ideal_matrix(camera)
    moved = matrix[-12:] @ sparse.kron(sparse.eye_array(camera.rows), shift, format="csr").T
    return sparse.csr_array(sparse.vstack([matrix[:-12], moved]))


@pytest.mark.parametrize("light", [with_ghost, displaced])
def test_light_far_from_its_footprint_is_found_for_single_points(
    imaging_camera: Camera, ommatid: Command, light: Callable[[Camera], sparse.csr_array]
) -> None:
    truth = light(imaging_camera)
    frames = sweep(imaging_camera, truth, 4, np.random.default_rng(3))
    assert_model_is(calibrated(ommatid, frames, *ENTRIES), truth)


def turned(camera: Camera) -> sparse.csr_array:
    """H behind a sensor that is rotated by 0.3 degrees, with displaced sub-images."""
    rng = np.random.default_rng(1)
    parts: list[sparse.csr_array] = []
    for sub in camera.sub_imagers:
        numbers = view.designed(sub)
        numbers[view.ROTATION] = np.deg2rad(0.3)
        numbers[[view.ROW, view.COLUMN]] = rng.normal(0, 0.5, 2)
        parts.append(view.entries(camera, sub, numbers))
    return sparse.csr_array(sparse.vstack(parts, format="csr"))


@pytest.mark.parametrize(("part", "array", "seeds"), [("1", 2, 2), ("2/3", 2, 2), slow("2/3", 3, 2), slow("1", 3, 20)])
@pytest.mark.usefixtures("imaging_camera")
def test_views_replace_the_entries_of_a_rotated_sensor(ommatid: Command, part: str, array: int, seeds: int) -> None:
    """Readings of a picture err by no more than stated, on average, and far less than with entries.

    part : side of the open part of the pixels over their pitch
    array : rows and columns of the second lens type
    """
    scene = Path("scene.toml")
    text = scene.read_text("utf-8").replace("[camera]", f'[camera]\nfill_factor = "{part}"', 1)
    scene.write_text(text.replace("array = [3, 3]", f"array = [{array}, {array}]"), "utf-8")
    camera = derive(read(scene))
    truth, image = turned(camera), np.random.default_rng(0).uniform(0, 255, camera.unknowns)
    refused = 0
    measured: list[float] = []
    squares: list[float] = []
    stated: list[float] = []
    setup = Setup.from_scene(read(Path("scene.toml")))
    for seed in range(seeds):
        np.save("points.npy", sweep(camera, truth, 2, np.random.default_rng(seed)))
        recorded = from_recorded_points(setup, [Path("points.npy")], AcquisitionSettings()).model
        fitted = fit_recorded(recorded)
        errors = not_none(fitted.errors(image))
        refused += len(fitted.record["fit"]["refused"])
        measured.append(float(np.mean(np.square(recorded.forward(image) - truth @ image))))
        squares.append(float(np.mean(np.square(fitted.forward(image) - truth @ image))))
        stated.append(float(np.mean(errors.variance + fitted.variance_from_model(image))))
    assert refused <= 2  # of 260, each recording at a significance of a hundredth
    assert np.mean(squares) < np.mean(measured) / 100
    ratios = np.divide(squares, stated)
    assert 0.1 < ratios.mean() < 1 + 3 * ratios.std(ddof=1) / seeds**0.5
    error = calibrated(ommatid, np.load("points.npy")).forward(image) - truth @ image
    assert np.mean(np.square(error)) == pytest.approx(squares[-1])


def test_a_sub_imager_that_no_view_explains_keeps_its_entries(imaging_camera: Camera, ommatid: Command) -> None:
    truth = with_ghost(imaging_camera)
    found = calibrated(ommatid, sweep(imaging_camera, truth, 4, np.random.default_rng(3)))
    assert found.record["fit"]["refused"] == ["I.00.00"]
    kept = int(found.matrix.indptr[imaging_camera.slices()[0].stop])
    assert_model_is(found, truth, slice(0, kept))
    np.testing.assert_allclose(
        found.matrix[imaging_camera.slices()[0].stop :].toarray(), truth[imaging_camera.slices()[0].stop :].toarray()
    )


def test_a_dead_sub_imager_and_exact_points_have_entries_alone(imaging_camera: Camera, ommatid: Command) -> None:
    frames = sweep(imaging_camera, ideal_matrix(imaging_camera), 2, np.random.default_rng(4))
    model = calibrated(ommatid, with_dead(imaging_camera, frames, imaging_camera.slices()[2]))
    assert model.record["fit"]["refused"] == [imaging_camera.sub_imagers[2].name]
    arrays = npz.read(Path("h.npz"))
    for lens in imaging_camera.types:
        arrays[f"views.{lens.name}.explained"] = np.ones(lens.count, dtype=np.bool_)
    sealed(Path("twice.npz"), arrays)
    with pytest.raises(InputError, match="rows of H that both few numbers and entries describe"):
        model_file.read(Path("twice.npz"))
    exact = [as_mosaic(imaging_camera, ideal_matrix(imaging_camera) @ unit) for unit in np.eye(imaging_camera.unknowns)]
    assert "fit" not in calibrated(ommatid, 255 * np.array(exact, dtype=np.float32), warning="recorded once").record


@pytest.mark.parametrize(
    ("scan", "words"),
    [
        (np.s_[::-1, ::-1], "scanned from the last pixel to the first, expected"),
        (np.s_[:, ::-1], "scanned from right to left, expected"),
        (np.s_[::-1], "scanned from the bottom up, expected"),
        (np.random.default_rng(6).permutation(12), "scanned in another order, expected"),
        (None, "got noise alone in that of II.02.02; check --origin"),
    ],
)
def test_points_in_another_order_are_refused(imaging_camera: Camera, ommatid: Command, scan: Any, words: str) -> None:
    truth = ideal_matrix(imaging_camera).tolil()
    truth[-12 if scan is None else truth.shape[0] :] = 0  # the last sub-imager saw no point
    frames = sweep(imaging_camera, truth.tocsr(), 1, np.random.default_rng(3)).reshape(*imaging_camera.shape, *SHAPE)
    np.save("points.npy", (frames if scan is None else frames[scan]).reshape(-1, *SHAPE))
    ended = ommatid("calibrate", "scene.toml", "--points", "points.npy", "-o", "h.npz")
    assert (ended.code, words in ended.err) == (2, True), ended.err


def test_points_that_leave_a_pixel_dark_are_dark_frames_of_it(imaging_camera: Camera, ommatid: Command) -> None:
    """The error that the dark level leaves in H f of a bright image is counted, to five standard errors, and small."""
    truth, rng = blurred_matrix(imaging_camera), np.random.default_rng(5)
    frames = 40 + sweep(imaging_camera, truth, 2, rng)
    dark = save(Path("dark.npy"), as_mosaic(imaging_camera, rng.normal(40, READ, imaging_camera.measurements)))
    found, image = calibrated(ommatid, frames, "--dark", dark, *ENTRIES), np.full(imaging_camera.unknowns, 255.0)
    counted = found.variance_from_model(image)
    ratio = np.square(found.matrix @ image - truth @ image) / counted
    assert ratio.mean() == pytest.approx(1, abs=5 * (2 / ratio.size) ** 0.5)
    assert (counted < (READ * np.diff(found.matrix.indptr)) ** 2).all()  # of a single dark frame


def test_stray_light_of_several_points_gives_a_warning(imaging_camera: Camera, ommatid: Command) -> None:
    positions = [np.array([(row, column), (row, column + 7)]) for row in range(12) for column in range(7)]
    names = record_grids(imaging_camera, with_ghost(imaging_camera), positions, "a", 5)
    write_positions("p.csv", positions, names)
    ended = ommatid("calibrate", "scene.toml", "--points", *names, "-o", "h.npz", "--places", "p.csv", *ENTRIES)
    assert (ended.code, "1 readings beyond the footprints" in ended.err) == (0, True), ended.err


def test_entries_of_a_dead_pixel_are_unknown(imaging_camera: Camera, ommatid: Command) -> None:
    frames = sweep(imaging_camera, ideal_matrix(imaging_camera), 2, np.random.default_rng(4))
    found = calibrated(ommatid, with_dead(imaging_camera, frames, 17), *ENTRIES)
    dead = slice(*found.matrix.indptr[17:19])
    assert not found.matrix.data[dead].any()
    assert (found.variance[dead] == 1).all()


def test_calibration_accounts_for_dark_flat_and_rounding(imaging_camera: Camera, ommatid: Command) -> None:
    """Readings rounded to coarse steps without other noise: the variance is 1/12 of a step squared."""
    truth = ideal_matrix(imaging_camera)
    rng = np.random.default_rng(6)
    gain, offset = rng.uniform(0.3, 0.5, imaging_camera.measurements), rng.integers(10, 20, imaging_camera.measurements)
    light = (
        as_mosaic(imaging_camera, offset + gain * (truth @ (255.0 * source)))
        for source in np.eye(imaging_camera.unknowns)
    )
    dark = save(Path("dark.npy"), as_mosaic(imaging_camera, offset))
    flat = save(Path("flat.npy"), as_mosaic(imaging_camera, offset + 255 * gain))
    frames = np.array([np.rint(values) for values in light]).astype(np.uint8)
    found = calibrated(ommatid, frames, "--dark", dark, "--flat", flat, *ENTRIES, warning="recorded once")
    rows = np.repeat(np.arange(found.measurements), np.diff(found.matrix.indptr))
    np.testing.assert_allclose(found.variance, (1 / (255 * gain[rows])) ** 2 / 12, rtol=1e-6)
    error = np.asarray(truth[rows, found.matrix.indices]).ravel() - found.matrix.data
    assert np.abs(error * 255 * gain[rows]).max() <= 0.5 + 1e-9


def test_with_a_sensor_one_sweep_has_photon_noise(imaging_camera: Camera, ommatid: Command) -> None:
    """Saturated readings are ignored: one frame exceeds the sensor's range."""
    text = SCENE.replace("pixels =", 'aperture = "0.06 mm"\npixels =') + SENSOR + "gain = 0.1\n"
    Path("scene.toml").write_text(text, encoding="utf-8")
    truth, rng = ideal_matrix(imaging_camera), np.random.default_rng(9)
    frames: list[Array] = []
    for source in np.eye(imaging_camera.unknowns):
        light = truth @ (2550 * source)  # electrons, of which a digital number has 10
        digital = rng.poisson(light) * 0.1 + rng.normal(10, 0.7, light.size)
        frames.append(as_mosaic(imaging_camera, np.rint(np.maximum(digital, 0)), outside=10))
    full = imaging_camera.unknowns // 2
    frames[full] = np.where(frames[full] > 30, 4095, frames[full])
    dark, flat = (save(Path(f"{name}.npy"), np.full(SHAPE, level)) for name, level in (("dark", 10.0), ("flat", 265.0)))
    found = calibrated(ommatid, np.array(frames).astype(np.uint16), "--dark", dark, "--flat", flat)
    assert_model_is(found, truth, found.variance < 1)
    assert set(found.matrix.indices[found.variance == 1]) == {full}


def test_several_points_need_the_footprints_of_pinholes() -> None:
    paper_camera = camera()
    several = [np.array([[0, 0], [9, 9]])]
    point_sources._check_separable(paper_camera, several, Path("places.csv"))  # pyright: ignore[reportPrivateUsage]
    optics = replace(paper_camera.types[0].optics, distortion=(0.1, 0.0))
    distorted = replace(paper_camera, types=(replace(paper_camera.types[0], optics=optics),))
    with pytest.raises(InputError, match="record one point per image"):
        point_sources._check_separable(distorted, several, Path("places.csv"))  # pyright: ignore[reportPrivateUsage]


# --- noise of recorded frames


def test_photon_transfer_finds_dark_and_photon_noise() -> None:
    """For Poisson counts with normal noise, to five standard errors of the sample variances that decide each."""
    rng = np.random.default_rng(0)
    light = np.repeat([0.0, 1.0, 5.0, 40.0], 500)
    readings = rng.poisson(light / GAIN, (6, light.size)) * GAIN + rng.normal(0, READ, (6, light.size))
    mean, variance = readings.mean(axis=0), readings.var(axis=0, ddof=1)
    dark, photons = photon_transfer(mean, variance, np.full(light.size, 6))
    assert dark == pytest.approx(READ**2, rel=5 * (2 / 5 / 500) ** 0.5)
    assert photons == pytest.approx(GAIN, rel=5 * (2 / 5 / 1000) ** 0.5)


@pytest.mark.parametrize("deviation", [0.0, 0.1, 0.2, 0.4])
def test_rounding_is_an_upper_bound_within_a_factor_of_three(deviation: float) -> None:
    """The exact mean of rounded normal readings, averaged over positions between two steps by the trapezoidal rule."""
    steps = np.arange(-8, 9)
    positions = np.linspace(-0.5, 0.5, 201)[:, None]
    if deviation == 0:
        mean, square = np.rint(positions[:, 0]), np.rint(positions[:, 0]) ** 2
    else:
        above, below = (stats.norm.cdf((steps + half - positions) / deviation) for half in (0.5, -0.5))
        mean, square = (above - below) @ steps, (above - below) @ steps**2
    variance = np.trapezoid((mean - positions[:, 0]) ** 2, positions[:, 0])
    of_readings = np.trapezoid(square - mean**2, positions[:, 0])
    bound = float(rounding(np.array([of_readings]), np.ones(1))[0])
    step_error = 3 / 200  # of the trapezoidal rule without noise, where the integrand jumps
    assert variance == pytest.approx(bound, rel=step_error) if deviation == 0 else bound / 3 < variance <= bound


@pytest.mark.parametrize("sources", [1, 2])
def test_background_takes_noise_for_light_at_the_stated_rate(sources: int) -> None:
    """Of sources lit alone, whose neighbours are tested together, and of several, whose readings are tested by one."""
    rng, small = np.random.default_rng(1), camera((12, 12), (("1/3", [2, 2], [3, 3]),))
    lone = np.arange(small.unknowns) if sources == 1 else np.full(small.unknowns, -1)
    near = np.zeros((small.unknowns, small.measurements), dtype=bool)
    found = [background(small, noise, near, lone, 8) for noise in rng.normal(0, 1, (100, *near.shape))]
    false_alarms = sum(bool(each.far.any()) or each.stray > 0 for each in found)
    assert stats.binomtest(false_alarms, 100, CHANCE).pvalue > 0.001
    assert np.mean([each.variance.mean() for each in found]) == pytest.approx(1, abs=5 * (2 / 100 / near.size) ** 0.5)
