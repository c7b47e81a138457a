"""The geometry of a scene's lens types, their light, and the plan of a run, as JSON and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from ommatid.reconstruct.method_choice import MethodChoice
from ommatid.reconstruct.output.facts import skipped_words
from ommatid.scenes.camera import Camera
from ommatid.scenes.geometry.optical_terms import camera_warnings, optical_terms
from ommatid.scenes.lens_type import LensType
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup

from .lens_table import AXIS_AND_RIM, lens_rows

Section = tuple[str, Sequence[tuple[str, ...]]]  # title and rows, whose first cell names the others
SHORT = (  # names of the quantities of lens types that `show` prints without -v
    *("magnification", "on the sensor", "sub-images", "pixels of each", "field of view, °", "focal length, mm"),
    *("lens to sensor, mm", "f-number", "Airy disk, pixels", "sharp, mm", "contrast at Nyquist/2"),
)
METHODS = {
    "dense": "one dense problem",
    "fit": "one dense problem, H fitted to the stack",
    "tiles": "tile by tile",
    "frame": "the whole frame at once",
}


def describe(
    setup: Setup,
    variant: str,
    choice: MethodChoice | None,
    optics: list[dict[str, Any]] | None = None,
    light: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return geometry and plan in JSON's types; lengths are millimetres.

    choice : of the estimator's method;  optics : the sharpness of lens types with an aperture
    light : collected electrons, of a scene with a [sensor]
    """
    scene, camera = setup.scene, setup.camera
    terms = optical_terms(scene, camera)
    seen = camera.types_seeing()
    counts = range(len(camera.types))
    return {
        "title": scene.title,
        "target": {
            "rows": camera.rows,
            "columns": camera.columns,
            "width": camera.columns * camera.target_pitch,
            "height": camera.rows * camera.target_pitch,
            "distance": camera.distance,
        },
        "light_as": _light_words(camera),
        "camera": terms.describe() | {"common": scene.camera.common},
        "lens_types": [
            _lens_type(camera, lens_type) | lens.describe()
            for lens_type, lens in zip(camera.types, terms.types, strict=True)
        ],
        "measurements": camera.measurements,
        "unknowns": camera.unknowns,
        "pixels_seen_by_fewer_types": {
            str(count): int(np.sum(seen == count)) for count in counts if bool(np.any(seen == count))
        },
        "where": _unseen_edges(camera),
        **({"optics": optics} if optics else {}),
        **({"light": light} if light is not None else {}),
        "plan": _plan(scene, camera, variant, choice),
        "skipped": [skipped.describe() for skipped in setup.skipped],
        "warnings": camera_warnings(scene, camera, terms),
    }


def _pixel_blur(camera: Camera, lens_type: LensType) -> dict[str, float]:
    """Return the blur of a type's pixels, mm, and what their open parts and it leave of the contrast at Nyquist."""
    blur = lens_type.optics.pixel_blur
    if blur is None:
        return {}
    left = [
        float(np.sinc(float(part) / 2) * np.exp(-((np.pi * blur / camera.pixel_pitch) ** 2) / 2))
        for part in lens_type.open
    ]
    return {"pixel_blur": blur, "pixel_contrast": min(left)}


def _light_words(camera: Camera) -> str:
    if not camera.has_width:
        return "rays through pinholes"
    if not camera.wavelengths:
        return "rays, which do not diffract: camera.wavelength is 'none'"
    return ", ".join(f"{wavelength * 1e6:.4g} nm" for wavelength, _ in camera.wavelengths)


def _lens_type(camera: Camera, lens_type: LensType) -> dict[str, Any]:
    return {
        "name": lens_type.name,
        "kind": _kind(lens_type),
        "magnification": str(1 / lens_type.ratio),
        "array": list(lens_type.array),
        "pixels": list(lens_type.pixels),
        "step": lens_type.described_step,
        **({} if lens_type.is_open else {"fill_factor": lens_type.opening}),
        **_pixel_blur(camera, lens_type),
        **({"steered": len(lens_type.steered)} if lens_type.steered else {}),
        "sees_rows": [float(end) for end in lens_type.bounds[0]],
        "sees_columns": [float(end) for end in lens_type.bounds[1]],
        "off_centre": [float(before - after) / 2 for before, after in lens_type.gaps(camera.shape)],
        "sensor_depth": camera.depth(lens_type),
        "sub_image_width": lens_type.pixels[1] * camera.pixel_pitch,
        "measurements": lens_type.measurements,
    }


def _kind(lens_type: LensType) -> str:
    surfaces = lens_type.optics.surfaces
    if surfaces is not None:
        return f"{len(surfaces)} surfaces"
    return "pinhole" if lens_type.optics.aperture is None else "thin lens"


def _unseen_edges(camera: Camera) -> list[str]:
    """Return one sentence per lens type that does not see all edges of the target."""
    sentences: list[str] = []
    for lens_type in camera.types:
        (top, last_row), (left, last_column) = lens_type.bounds
        bottom, right = camera.rows - last_row, camera.columns - last_column
        edges = (("top", top), ("bottom", bottom), ("left", left), ("right", right))
        missed = [f"{float(width):g} at the {edge}" for edge, width in edges if width > 0]
        if missed:
            sentence = f"type {lens_type.name} does not see the pixels {', '.join(missed)}"
            rows, columns = (float(before - after) / 2 for before, after in lens_type.gaps(camera.shape))
            offset = (
                f": its middle is {rows:+g} rows and {columns:+g} columns from the target's" if rows or columns else ""
            )
            sentences.append(sentence + offset)
    return sentences


def _plan(scene: Scene, camera: Camera, variant: str, choice: MethodChoice | None) -> dict[str, Any]:
    render, calibration = scene.render, scene.calibration
    limit = "" if render.time is None else f" for {render.time:g} s at most"
    samples = f"{render.samples}{limit}" if limit else render.samples
    calibrate: dict[str, Any] = {"method": calibration.method}
    if calibration.method in ("points", "transport"):
        calibrate |= {"variant": variant, "samples": calibration.samples}
    if calibration.method == "points":
        calibrate["sources"] = camera.unknowns
    reconstruct: dict[str, str] = {}
    if choice is not None:
        needs = f"{max(choice.seconds, 0.1):.2g} s and {max(choice.memory, 10**8) / 1e9:.1f} GB"
        reconstruct = {"method": METHODS[choice.method], "why": choice.why, "about": needs}
    return {
        "render": {"variant": variant, "samples": samples, "sensors": len(camera.sub_imagers)},
        "calibrate": calibrate,
        "reconstruct": reconstruct,
    }


def sections(description: dict[str, Any]) -> list[Section]:
    """Return the description as titled tables: of names and values, and of the lens types by quantities."""
    target = description["target"]
    geometry = [
        ("target", f"{target['rows']} x {target['columns']} pixels, {target['height']:g} x {target['width']:g} mm"),
        ("distance", f"{target['distance']:g} mm"),
        ("light", description["light_as"]),
        *_camera_rows(description),
        ("measurements", f"{description['measurements']} for {description['unknowns']} unknowns"),
    ]
    if description["pixels_seen_by_fewer_types"]:
        for count, pixels in description["pixels_seen_by_fewer_types"].items():
            geometry.append((f"pixels seen by {count} of {len(description['lens_types'])} types", str(pixels)))
        geometry += [("edges", words) for words in description["where"]]
    else:
        geometry.append(("edges", "every pixel is seen by every lens type"))
    types = description["lens_types"]
    lenses = [("lens type", *(lens["name"] for lens in types)), *lens_rows(types, description.get("optics", ()))]
    stages = [
        (stage, ", ".join(f"{key} {value}" for key, value in plan.items()))
        for stage, plan in description["plan"].items()
    ]
    skipped = [(skip["what"], skipped_words(skip["why"], skip.get("bound"))) for skip in description["skipped"]]
    return [
        (description["title"] or "Camera", geometry),
        (f"Lens types; {AXIS_AND_RIM}" if "optics" in description else "Lens types", lenses),
        ("What will run", stages),
        ("What is left out, and why", skipped),
    ]


def short_lines(description: dict[str, Any]) -> list[str]:
    """Return the title, and target, lenses and measurements in a line."""
    target, camera = description["target"], description["camera"]
    pitch = target["width"] / target["columns"]
    return [
        description["title"] or "Camera",
        f"{target['rows']} x {target['columns']} pixels of {pitch:.4g} mm at {target['distance']:g} mm;"
        f" {camera['lenses']} lenses, total track {camera['total_track']:.4g} mm;"
        f" {description['measurements']} measurements for {description['unknowns']} unknowns",
    ]


def short_section(description: dict[str, Any]) -> Section:
    """Return the table of lens types with the quantities that decide."""
    types = description["lens_types"]
    rows = [row for row in lens_rows(types, description.get("optics", ())) if row[0] in SHORT]
    light = description.get("light", {}).get("lens_types", ())
    electrons = [("electrons at 255", *(f"{each['white']:.4g}" for each in light))] if light else []
    return "Lens types", [("lens type", *(lens["name"] for lens in types)), *rows, *electrons]


def left_out_line(description: dict[str, Any]) -> str:
    """Return what is left out, in a line."""
    names = ", ".join(skip["what"] for skip in description["skipped"]) or "nothing"
    return f"left out: {names}; -v prints why, the plan and all quantities"


def _camera_rows(description: dict[str, Any]) -> list[tuple[str, str]]:
    """Return lenses, their planes and sensor area; the size of the sensor where the scene gives it."""
    camera = description["camera"]
    height, width = camera["sensor_extent"]
    area = f"{camera['sensor_area']:.3g} mm² of pixels, in {height:.4g} x {width:.4g} mm (height x width)"
    if camera["sensor_size"] is not None:
        rows, columns = camera["sensor_size"]
        held = height * width / (rows * columns)
        area += (
            f"\n{camera['sensor_share'] * 100:.2g} % of the sensor of {rows:.4g} x {columns:.4g} mm;"
            f" the arrays take {held * 100:.2g} % of it"
        )
    return [
        ("lenses", f"{camera['lenses']}, total track {camera['total_track']:.4g} mm"),
        *_planes_rows(camera["common"], [lens["sensor_depth"] for lens in description["lens_types"]]),
        ("sensor area", area),
    ]


def _planes_rows(common: str, depths: Sequence[float]) -> list[tuple[str, str]]:
    """Return what lies in one plane in a camera of several depths; nothing if there is a single one."""
    if min(depths) == max(depths):
        return []
    ends = f"{min(depths):.4g} to {max(depths):.4g} mm"
    if common == "sensor":
        return [("planes", f"one of the sensor, lenses {ends} before it")]
    return [("planes", f"one of the lenses, sensors {ends} behind it")]


def light_rows(light: dict[str, Any]) -> list[tuple[str, str]]:
    """The table's lines, label and text, of a `radiometry.summary`."""
    lines = [("light", _spectrum_words(light))] + [
        (f"lens type {row['name']}", _electrons_words(row)) for row in light["lens_types"]
    ]
    for row in light["lens_types"]:
        if "accepted" in row:
            lines.append((f"acceptance of {row['name']}", f"{row['accepted']:.1%} at its steepest chief ray"))
    for name, share in light.get("transmitted", {}).items():
        lines.append((f"surfaces of {name}", f"transmit {share:.1%} of the light"))
    if light["dark"] > 0:
        lines.append(("without light", f"{light['dark']:.4g} electrons in every pixel"))
    if light["cut_off"]:
        why = "noise of the dark signal is cut off at 0 DN, so dim values come out too low; raise sensor.black_level"
        lines.append(("warning", why))
    return lines


def _spectrum_words(light: dict[str, Any]) -> str:
    words, wavelengths = f"{light['efficacy']:.4g} lm/W", [1e6 * at for at, _ in light["wavelengths"]]
    if not wavelengths:
        return words
    return f"{words}; {len(wavelengths)} wavelengths from {wavelengths[0]:.0f} to {wavelengths[-1]:.0f} nm stand for it"


def _electrons_words(row: dict[str, Any]) -> str:
    if row["noise"] is None:
        return "too little light: the readings do not exceed the dark signal"
    text = (
        f"{row['white']:.4g} electrons per pixel at 255, {row['mean']:.4g} at the prior's mean,"
        f" where the standard deviation of a value is {row['noise']:.3g}"
    )
    return f"{text}; full from {row['saturation']:.4g} on" if row["saturates"] else f"{text}; never full"
