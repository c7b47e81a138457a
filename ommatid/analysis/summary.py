"""What follows from a scene, for people: the geometry of every lens type, what it sees, and the plan of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from ommatid.reconstruct.method_choice import choose_method
from ommatid.runtime.errors import naming_source
from ommatid.scenes.camera import Camera
from ommatid.scenes.scene import Scene
from ommatid.scenes.setup import Setup
from ommatid.scenes.skipped import skipped_effects
from ommatid.simulate.renderer.variant import choose as choose_variant

from .predict import electrons, optics


def describe_scene(scene: Scene) -> dict[str, Any]:
    """Describe the geometry and the plan of a scene in JSON's types. Raises InputError that names the scene file."""
    setup = Setup.from_scene(scene)
    camera = setup.camera
    choice = choose_method(scene, camera, setup.has_structured_matrix)
    with naming_source(scene.source):
        lens_optics, light = optics(camera), electrons(setup)
    return describe(scene, camera, choose_variant(scene.render.variant), choice.plan(), lens_optics, light)


def describe(
    scene: Scene,
    camera: Camera,
    variant: str,
    reconstruction: dict[str, Any],
    lens_optics: list[dict[str, Any]] | None = None,
    light: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Geometry and plan in JSON's types; lengths are millimetres.

    reconstruction : the plan of the last stage;  lens_optics : what each lens type with an aperture does to sharpness
    light : electrons that are collected, of a scene with a [sensor]
    """
    seen = camera.types_seeing()
    fewer = {
        str(count): int(np.sum(seen == count)) for count in range(len(camera.types)) if bool(np.any(seen == count))
    }
    return {
        "title": scene.title,
        "target": {
            "rows": camera.rows,
            "columns": camera.columns,
            "width": camera.columns * camera.target_pitch,
            "height": camera.rows * camera.target_pitch,
            "distance": camera.distance,
        },
        "lens_types": [_lens_type(camera, place) for place in range(len(camera.types))],
        "measurements": camera.measurements,
        "unknowns": camera.unknowns,
        "pixels_seen_by_fewer_types": fewer,
        "where": _where(camera),
        **({"optics": lens_optics} if lens_optics else {}),
        **({"light": light} if light is not None else {}),
        "plan": _plan(scene, camera, variant, reconstruction),
        "skipped": [left.describe() for left in skipped_effects(scene, camera)],
    }


def _lens_type(camera: Camera, place: int) -> dict[str, Any]:
    kind = camera.types[place]
    return {
        "name": kind.name,
        "magnification": str(1 / kind.ratio),
        "array": list(kind.array),
        "pixels": list(kind.pixels),
        "step": str(kind.step),
        "sees_rows": [kind.origin[0], float(kind.origin[0] + kind.span[0])],
        "sees_columns": [kind.origin[1], float(kind.origin[1] + kind.span[1])],
        "sensor_depth": camera.depth(kind),
        "focal_length": camera.focal_length(kind),
        "sub_image_width": kind.pixels[1] * camera.pixel_pitch,
        "measurements": kind.measurements,
    }


def _where(camera: Camera) -> list[str]:
    """In words, which edges of the target each lens type does not see."""
    found: list[str] = []
    for kind in camera.types:
        top, left = kind.origin
        bottom, right = camera.rows - top - kind.span[0], camera.columns - left - kind.span[1]
        edges = (("top", top), ("bottom", bottom), ("left", left), ("right", right))
        missed = [f"{float(width):g} at the {edge}" for edge, width in edges if width > 0]
        if missed:
            found.append(f"type {kind.name} does not see the pixels {', '.join(missed)}")
    return found


def _plan(scene: Scene, camera: Camera, variant: str, reconstruction: dict[str, Any]) -> dict[str, Any]:
    plan: dict[str, Any] = {
        "render": {"variant": variant, "samples": _samples(scene), "sensors": len(camera.sub_imagers)},
        "calibrate": {"method": scene.calibration.method},
        "reconstruct": reconstruction,
    }
    if scene.calibration.method == "points":
        plan["calibrate"] |= {"variant": variant, "samples": scene.calibration.samples, "sources": camera.unknowns}
    if scene.calibration.method == "transport":
        plan["calibrate"] |= {"variant": variant, "samples": scene.calibration.samples}
    return plan


def _samples(scene: Scene) -> int | str:
    ends = "" if scene.render.time is None else f" for {scene.render.time:g} s at most"
    return f"{scene.render.samples}{ends}" if ends else scene.render.samples


def sections(description: dict[str, Any]) -> list[tuple[str, list[tuple[str, str]]]]:
    """The same as titled tables of two columns."""
    target = description["target"]
    geometry = [
        ("target", f"{target['rows']} x {target['columns']} pixels, {target['height']:g} x {target['width']:g} mm"),
        ("distance", f"{target['distance']:g} mm"),
        ("measurements", f"{description['measurements']} for {description['unknowns']} unknowns"),
    ]
    if description["pixels_seen_by_fewer_types"]:
        for count, pixels in description["pixels_seen_by_fewer_types"].items():
            geometry.append((f"pixels seen by {count} of {len(description['lens_types'])} types", str(pixels)))
        geometry += [("edges", words) for words in description["where"]]
    else:
        geometry.append(("edges", "every pixel is seen by every lens type"))
    lenses = [
        (f"lens type {kind['name']}, {kind['magnification']}", _lens_words(kind)) for kind in description["lens_types"]
    ]
    stages = [
        (stage, ", ".join(f"{key} {value}" for key, value in does.items()))
        for stage, does in description["plan"].items()
    ]
    skipped = [(skip["what"], skipped_words(skip)) for skip in description["skipped"]]
    title = description["title"] or "Camera"
    return [
        (title, geometry),
        ("Lens types", lenses),
        ("What will run", stages),
        ("What is left out, and why", skipped),
    ]


def skipped_words(skip: dict[str, Any]) -> str:
    """In words, with the bound on what it changes."""
    bound = f"; no measurement changes by more than {skip['bound']:.2g}" if "bound" in skip else ""
    return f"{skip['why']}{bound}"


def _lens_words(kind: dict[str, Any]) -> str:
    array, pixels = kind["array"], kind["pixels"]
    return (
        f"{array[0]} x {array[1]} sub-imagers of {pixels[0]} x {pixels[1]} pixels,"
        f" {kind['sub_image_width']:.3g} mm wide,"
        f" focal length {kind['focal_length']:.4g} mm, sensor {kind['sensor_depth']:.4g} mm behind the lens,"
        f" rows {kind['sees_rows'][0]:g} to {kind['sees_rows'][1]:g}"
    )
