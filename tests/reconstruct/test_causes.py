"""Every cause of the table happens to a camera, and the residual and the held-out check name it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import ndimage, sparse

from ommatid.reconstruct.held_out.check import check_held_out
from ommatid.reconstruct.restore import restore
from ommatid.reconstruct.verdict.causes import CAUSES, remedies
from ommatid.runtime.arrays import FloatArray
from ommatid.scenes import model_file
from ommatid.scenes import stack as stack_file
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.lens_type import SubImager
from ommatid.scenes.model import RECORDED, Model
from ommatid.scenes.stack import Stack
from ommatid.simulate.ideal import ideal_model

from ..examples import THREE, Lenses, scene
from ..frames import recorded as stack_of
from ..frames import wide

FINER, BEYOND = 8, 8  # samples of the picture in a pixel of f along an axis, and pixels of f beyond the target
BETWEEN: Lenses = (("2/7", [3, 3], [4, 4]), ("2/9", [4, 4], [3, 3]), ("1/4", [4, 4], [4, 4]))  # pixels of f are cut
WRONG, OTHER = 20, 27  # sub-imagers B.02.01 and B.03.03
View = Callable[[SubImager, int, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]  # rows, columns
Change = Callable[[Camera, FloatArray], FloatArray]


def picture(width: float, seed: int = 0) -> FloatArray:
    """A random picture with structures of this width in pixels of f, sampled more finely than f."""
    size = (19 + 2 * BEYOND) * FINER
    noise = ndimage.gaussian_filter(np.random.default_rng(seed).normal(size=(size, size)), width * FINER, mode="wrap")
    noise *= np.clip(np.linspace(-1.5, 1.5, size) if width < 1 else 1.0, 0.0, 1.0)  # flat on the left if it is fine
    return 120 + 50 * noise / noise.std()


def seen(camera: Camera, world: FloatArray, view: View) -> FloatArray:
    """Readings as means of samples of the picture where `view` takes those of a sub-imager, from its middle."""
    readings: list[FloatArray] = []
    for index, sub in enumerate(camera.sub_imagers):
        (rows, columns), across = sub.type.pixels, round(float(sub.type.ratio) * FINER)
        y, x = np.indices((rows * across, columns * across)) / FINER + 0.5 / FINER
        middle = np.array([rows, columns]) * float(sub.type.ratio) / 2
        y, x = view(sub, index, y - middle[0], x - middle[1])
        start = [middle[axis] + float(sub.window[axis]) + BEYOND for axis in (0, 1)]
        at = [np.floor((place + start[axis]) * FINER).astype(int) for axis, place in enumerate((y, x))]
        readings.append(world[at[0], at[1]].reshape(rows, across, columns, across).mean(axis=(1, 3)).ravel())
    return np.concatenate(readings)


def as_designed(_sub: SubImager, _index: int, y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    return y, x


def moved(chosen: Callable[[SubImager, int], bool], change: Callable[[FloatArray, FloatArray], Any]) -> View:
    return lambda sub, index, y, x: change(y, x) if chosen(sub, index) else (y, x)


def one(_sub: SubImager, index: int) -> bool:
    return index == WRONG


def first_type(sub: SubImager, _index: int) -> bool:
    return sub.type.name == "A"


def parallax(distance: float, nearer: Callable[[FloatArray], Any] = np.ones_like) -> View:
    """A lens beside the axis sees a world at another distance displaced, that of columns x of f where it is."""

    def view(sub: SubImager, _index: int, y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        further = (1000.0 / distance - 1) * nearer(x + float(sub.window[1]))
        return y - further * sub.lens[1], x - further * sub.lens[0]

    return view


def changed(change: Callable[[FloatArray], FloatArray], chosen: Callable[[SubImager, int], bool] = one) -> Change:
    """Change the sub-images that are chosen."""

    def readings(camera: Camera, values: FloatArray) -> FloatArray:
        values = values.copy()
        for index, (sub, part) in enumerate(zip(camera.sub_imagers, camera.slices(), strict=True)):
            if chosen(sub, index):
                values[part] = change(values[part].reshape(sub.type.pixels)).ravel()
        return values

    return readings


def exchanged(camera: Camera, values: FloatArray) -> FloatArray:
    first, second = (values[camera.slices()[index]].copy() for index in (WRONG, OTHER))
    values[camera.slices()[WRONG]], values[camera.slices()[OTHER]] = second, first
    return values


def damaged(_camera: Camera, values: FloatArray) -> FloatArray:
    values[[30, 250, 600]] += np.array([30.0, -25.0, 40.0])
    return values


def same(_camera: Camera, values: FloatArray) -> FloatArray:
    return values


def recorded(
    noise: float,
    view: View = as_designed,
    change: Change = same,
    *,
    lenses: Lenses = THREE,
    width: float = 1.0,
    factor: float = 1.0,
) -> tuple[Stack, Model]:
    """A stack with a fault or `factor` times the stated noise, and the H of the design."""
    described = scene(lenses=lenses, noise={"variance": noise}, calibration={"method": "ideal"})
    camera, rng = derive(described), np.random.default_rng(1)
    light = seen(camera, picture(width), view)
    values = change(camera, light + rng.normal(size=light.size) * (factor * noise) ** 0.5)
    return Stack(described, camera, values, np.zeros(values.size), {}), ideal_model(described, camera)


def gains(camera: Camera, values: FloatArray) -> FloatArray:
    each = np.random.default_rng(2).normal(1, 0.1, len(camera.sub_imagers))
    return values * np.repeat(each, [part.stop - part.start for part in camera.slices()])


def shuffled(image: FloatArray) -> FloatArray:
    return np.random.default_rng(4).permutation(image.ravel())


def everywhere(_sub: SubImager, _index: int) -> bool:
    return True


MADE: dict[str, tuple[str, str, dict[str, Any]]] = {  # to the cause, what a sentence says of it, and the fault
    "gain": ("gain", "a gain of 1.2 in sub-imager (2, 1) of type B", {"change": changed(lambda v: 1.2 * v)}),
    "gains": ("gain", "others in other sub-imagers", {"change": gains}),
    "whole type": ("gain", "a gain of 1.1 in lens type A", {"change": changed(lambda v: 1.1 * v, first_type)}),
    "offset": ("offset", "levels in sub-imager (2, 1) of type B", {"change": changed(lambda v: 8.0 + v)}),
    "shift": (
        "shift",
        "0.51 pixels of f too far down and 0.27 left",
        {"view": moved(one, lambda y, x: (y + 0.5, x - 0.3))},
    ),
    "rotation": (
        "rotation",
        "4.4 degrees in lens type A",
        {"view": moved(first_type, lambda y, x: (y + 0.07 * x, x - 0.07 * y))},
    ),
    "scale": (
        "scale",
        "1.1 times as wide in lens type A",
        {"view": moved(first_type, lambda y, x: (1.08 * y, 1.08 * x))},
    ),
    "flip": ("flip", "upside down in sub-imager (2, 1) of type B", {"change": changed(lambda v: v[::-1])}),
    "all turned": ("flip", "180 degrees in all", {"change": changed(lambda v: v[::-1, ::-1], everywhere)}),
    "swap": ("swap", "(3, 3)", {"change": exchanged}),
    "dead": ("dead", "in sub-imager (2, 1) of type B", {"change": changed(lambda v: 0.05 * v)}),
    "pixels": ("pixels", "3 in all", {"change": damaged}),
    "clipping": ("clipping", "noise.saturation = 160", {"change": lambda _, v: np.minimum(v, 160.0)}),
    "bits": ("bits", "noise.bits = 6", {"change": lambda _, v: 4 * np.round(v / 4)}),
    "noise": ("noise", "", {"factor": 9.0}),
    "depth": ("depth", "", {"view": parallax(960.0)}),
    "depths": ("depths", "", {"view": parallax(850.0, lambda x: x / 9 - 1)}),
    "sub-imager": ("sub-imager", "(2, 1) of type B", {"change": changed(shuffled)}),
    "detail": ("detail", "target.detail", {"lenses": BETWEEN, "width": 0.3}),
    "either": ("either", "noise.variance", {"lenses": BETWEEN, "factor": 9.0, "width": 2.0}),
}


def assert_named(cause: str, said: str, reason: str) -> None:
    """The reason has the words of the cause between its numbers, and what is said of it."""
    [words] = (each.words for each in CAUSES if each.name == cause)
    pieces = [piece.partition("}")[2] if "}" in piece else piece for piece in words.split("{")]
    assert max(pieces, key=len) in reason, reason
    assert said in reason, reason


@pytest.mark.parametrize("name", MADE)
def test_a_cause_that_happens_is_named(name: str) -> None:
    cause, said, fault = MADE[name]
    stack, model = recorded(1e-2, **fault)
    assert_named(cause, said, restore(stack, model).verdict.reasons[0])


@pytest.mark.parametrize("name", ["gain", "shift", "swap", "pixels", "depth"])
def test_the_held_out_check_names_the_same_cause(name: str) -> None:
    cause, said, fault = MADE[name]
    stack, model = recorded(1e-2, **fault)
    assert_named(cause, said, check_held_out(stack, model, fitted=False).verdict.reasons[0])


def test_a_frame_of_ten_thousand_readings_names_its_cause() -> None:
    described = wide((59, 59), noise={"variance": 1.0}, calibration={"method": "ideal"}, prior={"kind": "fit"})
    camera = derive(described)
    image = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=camera.shape), 1.5)
    stack = stack_of(described, 120 + 50 * image.ravel() / image.std(), 1.0)
    turned = changed(lambda v: v[::-1])(camera, stack.values)
    done = restore(replace(stack, values=turned), ideal_model(described, camera))
    assert done.choice.method == "frame"
    assert_named("flip", "upside down in sub-imager (2, 1) of type B", done.verdict.reasons[0])


def test_noise_is_named_where_the_picture_is_flat() -> None:
    described = scene(lenses=THREE, noise={"variance": 1e-2}, calibration={"method": "ideal"})
    stack = stack_of(described, np.full(361, 100.0), 9e-2)
    assert "noise of 8" in restore(stack, ideal_model(described, stack.camera)).verdict.reasons[0]


def test_steps_of_the_bits_that_the_scene_states_are_no_cause() -> None:
    """Noise of twice the stated variance, in steps of 10 bits: another 0.0052 in variance would explain half of it."""
    noise, step = {"variance": 1e-2, "bits": 10}, 0.25
    described = scene(lenses=THREE, noise=noise, calibration={"method": "ideal"})
    camera, rng = derive(described), np.random.default_rng(1)
    light = seen(camera, picture(1.0), as_designed)
    values = step * np.round((light + rng.normal(size=light.size) * 2e-2**0.5) / step)
    stack = Stack(described, camera, values, np.zeros(values.size), {})
    assert_named("noise", "noise.variance", restore(stack, ideal_model(described, camera)).verdict.reasons[0])


def test_a_black_level_shows_where_lenses_lose_light_unevenly() -> None:
    stack, model = recorded(1e-2)
    lost = np.random.default_rng(5).uniform(0.6, 1.0, stack.values.size)
    matrix = sparse.csr_array(model.matrix.multiply(lost[:, None]))
    model = replace(model, stored=matrix, record={"method": "transport"})
    stack = replace(stack, values=lost * stack.values + 5.0)
    assert_named("black level", "a black level of 4.96 grey levels", restore(stack, model).verdict.reasons[0])


def test_what_was_done_is_not_recommended() -> None:
    stack, model = recorded(1e-2)
    task = restore(stack, model).task

    def said(way: str, record: dict[str, Any], misalignment: str = "trust") -> dict[str, str]:
        settings = task.settings.model_copy(update={"misalignment": misalignment})
        made = replace(task, model=replace(model, record={"method": way}), settings=settings)
        return remedies(replace(stack, record=record), made)

    assert "misalignment" in said("ideal", {})["calibrate"]
    assert "misalignment" not in said("ideal", {}, "fit")["calibrate"]
    assert "misalignment" not in said("points", {})["calibrate"]
    assert said(RECORDED, {})["calibrate"].startswith("record the point sources again")
    imported = {"method": "imported", "flat": False}
    assert "--points" in said("points", imported)["calibrate"]
    assert "--flat" in said("ideal", imported)["flat"]
    assert "--flat" not in said("ideal", imported | {"flat": True})["flat"]
    assert "--flat" not in said("ideal", {})["flat"]


def test_an_h_beside_which_no_reading_counts_has_no_cause(finished: Path) -> None:
    stack, model = stack_file.read(finished / "stack.exr"), model_file.read(finished / "model.npz")
    assert model.stored is not None
    stored = model.stored.copy()
    stored.data[:] = 1e6
    verdict = restore(stack, replace(model, stored=stored), None).verdict
    assert not verdict.trusted
