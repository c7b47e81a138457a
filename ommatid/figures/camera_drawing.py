"""Drawing of a camera: section through lenses and target, the sensor face on, and one sub-image of each lens type.

Where lenses make waves, their contrast is drawn against the place of the sensor, too.

Positions are millimetres, as in the camera: z along its axis, x and y across. The section is broken between the camera,
a few millimetres deep, and the target; the ratio of the scales is written at the break.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from ommatid.runtime.printable import printable_label
from ommatid.scenes.camera import Camera, derive
from ommatid.scenes.geometry.optical_terms import LensTerms, OpticalTerms, ThroughFocus, optical_terms
from ommatid.scenes.lens_type import LensType, SubImager
from ommatid.scenes.scene import Scene

from .saving import COLOURS, INK, figure_format, new_figure, own_style, save_figure
from .sensor_drawing import ARROW, draw_sensor, draw_sub_images, length_words, sensor_aspect, write_beside

WIDTH = 10.0  # inches, as are all lengths of the layout
LEFT, NEAR_WIDTH, FAR_LEFT, FAR_WIDTH = 0.75, 4.7, 6.15, 3.1
ABOVE, SECTION, BETWEEN, BELOW, LINE = 1.05, 2.5, 1.25, 0.55, 0.21
FOCUS = 1.6  # height of the curves through focus
LOWEST, HIGHEST = 1.9, 3.4  # height of the drawing of the sensor
GREY = "#808080"
NEAR, FAR = 0.45, 0.6  # ends of the broken axis: a share of the deepest sensor, and of the target's distance
MOST_WALLS = 80
AIR = 0.12  # between the drawing and its frame, as a share of its width

Ray = tuple[tuple[float, float], ...]  # points (z, x)


@own_style()
def camera_drawing(scene: Scene, camera: Camera, *, described: bool = True, curves: Sequence[ThroughFocus] = ()) -> Any:
    """Draw a camera to scale, with its lengths, as a Matplotlib figure.

    described : False leaves out the title and the table of the lens types, where both stand beside the drawing
    curves : of lens types whose contrast is drawn against the place of the sensor
    """
    colours = {lens_type.name: COLOURS[index % len(COLOURS)] for index, lens_type in enumerate(camera.types)}
    terms = optical_terms(scene, camera)
    face = min(HIGHEST, max(LOWEST, NEAR_WIDTH / sensor_aspect(camera, terms)))
    key, above = (LINE * (len(camera.types) + 2.5), ABOVE) if described else (0.0, ABOVE - 2 * LINE)
    beneath = FOCUS + ABOVE if curves else 0.0
    height = above + SECTION + BETWEEN + face + BELOW + key + beneath
    figure = new_figure(WIDTH, height)

    def axes(left: float, bottom: float, width: float, tall: float) -> Any:
        return figure.add_axes((left / WIDTH, bottom / height, width / WIDTH, tall / height))

    section, lower = height - above - SECTION, BELOW + key + beneath
    near, far = axes(LEFT, section, NEAR_WIDTH, SECTION), axes(FAR_LEFT, section, FAR_WIDTH, SECTION)
    _draw_section(near, far, scene, camera, colours)
    draw_sensor(axes(LEFT, lower, NEAR_WIDTH, face), camera, terms, colours)
    draw_sub_images(axes(FAR_LEFT, lower, FAR_WIDTH + 0.25, face), camera, terms, colours)
    if curves:
        _draw_curves(axes(LEFT, BELOW, FAR_LEFT + FAR_WIDTH - LEFT, FOCUS), curves, camera, colours)
    if not described:
        return figure
    write_key(figure, camera, terms, colours, beneath + key - 1.5 * LINE, LINE)
    name = printable_label(scene.title or scene.source.stem)
    figure.text(LEFT / WIDTH, 1 - 0.3 / height, name, fontsize=12, fontweight="bold", va="center")
    return figure


def write_drawing(path: Path, scene: Scene, curves: Sequence[ThroughFocus] = ()) -> None:
    """Write the drawing of a scene's camera in the format that the file's name says. Raises InputError or MachineError.

    curves : as of `camera_drawing`
    """
    kind = figure_format(path)
    save_figure(camera_drawing(scene, derive(scene), curves=curves), path, (kind,))


def _draw_curves(axes: Any, curves: Sequence[ThroughFocus], camera: Camera, colours: dict[str, str]) -> None:
    """Draw contrast against the place of the sensor, for the axis and for the rim."""
    for curve in curves:
        colour = colours[curve.name]
        axes.plot(1e3 * curve.shifts, curve.axis, color=colour, linewidth=1.4, label=f"{curve.name}, axis")
        axes.plot(1e3 * curve.shifts, curve.rim, "--", color=colour, linewidth=1.2, label=f"{curve.name}, rim")
    axes.axvline(0, color=GREY, linewidth=0.7)
    axes.set_ylim(0, 1)
    axes.set_xlim(*(1e3 * end for end in (min(c.shifts[0] for c in curves), max(c.shifts[-1] for c in curves))))
    frequency = 1 / (4 * camera.pixel_pitch)
    axes.set_title(f"contrast at {frequency:.3g} cycles/mm, half of Nyquist", fontsize=10, loc="left")
    axes.set_xlabel("sensor moved away from the lens (µm)", fontsize=9)
    axes.tick_params(labelsize=8)
    axes.legend(fontsize=8, frameon=False, ncols=max(1, len(curves) // 4 + 1), loc="upper right")


def _draw_section(near: Any, far: Any, scene: Scene, camera: Camera, colours: dict[str, str]) -> None:
    """Draw the camera and the target from above, on axes of their own, and the light of one sub-imager per type."""
    deepest = max(camera.height(lens_type) + camera.depth(lens_type) for lens_type in camera.types)
    for sub in {(sub.type.name, sub.lens[0], sub.patch[0]): sub for sub in camera.sub_imagers}.values():
        _draw_sub_imager(near, camera, sub, colours[sub.type.name])
    ends = [edge for sub in camera.sub_imagers for edge in (sub.lens[0], *_patch_edges(camera, sub))]
    reach = max(max(ends) - min(ends), camera.lens_pitch)
    low, high = min(ends) - AIR * reach, max(ends) + 1.5 * AIR * reach
    if camera.walls:
        _draw_walls(near, camera)
    for lens_type in camera.types:
        light = _light(camera, _middle(camera, lens_type))
        for axes in (near, far):
            for ray in light:
                axes.plot(*zip(*ray, strict=True), color=colours[lens_type.name], linewidth=0.9, alpha=0.85)
    room = 2 if camera.sensor_distance is None else 3  # for the names of all types beside one sensor
    near.set_xlim(-deepest * (1 + room * AIR), deepest * NEAR)
    near.set_ylim(low, high)
    _draw_target(far, scene, camera)
    _label(near, "camera from above, and light of one sub-imager of each type", "left")
    _label(far, "target", "right")
    _mark_break(near, far, camera)
    write_beside(near, "lenses", (0, high), (4, -4), va="top", fontsize=8)
    write_beside(near, "sensor", (-deepest, high), (-4, -4), va="top", fontsize=8)
    for lens_type in camera.types:
        sub = _middle(camera, lens_type)
        words = f"{lens_type.name}: {length_words(sub.depth, 3)}"
        place = _planes(camera, sub)[0], sub.patch[0]
        write_beside(near, words, place, (-6, 0), va="center", fontsize=8, color=colours[lens_type.name])


def _draw_sub_imager(axes: Any, camera: Camera, sub: SubImager, colour: str) -> None:
    """Draw a lens, a pinhole as a dot, and its patch of the sensor behind it."""
    edges, (sensor, z) = _patch_edges(camera, sub), _planes(camera, sub)
    axes.plot([sensor] * 2, edges, color=colour, linewidth=3.5, solid_capstyle="butt")
    aperture, x = sub.type.optics.aperture, sub.lens[0]
    if aperture is None:
        axes.plot([z], [x], "o", color=colour, markersize=3)
    else:
        arrow = {**ARROW, "color": colour, "linewidth": 1.2, "mutation_scale": 5}
        axes.annotate("", (z, x - aperture / 2), (z, x + aperture / 2), arrowprops=arrow)


def _planes(camera: Camera, sub: SubImager) -> tuple[float, float]:
    """Return the z of a sub-imager's patch and of its lens."""
    z = camera.distance - sub.distance
    return z - sub.depth, z


def _patch_edges(camera: Camera, sub: SubImager) -> tuple[float, float]:
    half = sub.type.pixels[1] * camera.pixel_pitch / 2
    return sub.patch[0] - half, sub.patch[0] + half


def _middle(camera: Camera, lens_type: LensType) -> SubImager:
    """Return a sub-imager in the middle of an array."""
    return camera.sub_imager(camera.types.index(lens_type), lens_type.array[0] // 2, lens_type.array[1] // 2)


def _light(camera: Camera, sub: SubImager) -> list[Ray]:
    """Return the straight rays from both edges of a patch through the middle of the lens to the target."""
    x, (sensor, z) = sub.lens[0], _planes(camera, sub)
    return [
        ((sensor, edge), (z, x), (camera.distance, x + (x - edge) * sub.distance / sub.depth))
        for edge in _patch_edges(camera, sub)
    ]


def _draw_walls(axes: Any, camera: Camera) -> None:
    """Draw the walls between neighbouring columns of lenses, from the lens in front to the shallower sensor."""
    places = sorted({(sub.lens[0], *_planes(camera, sub)) for sub in camera.sub_imagers})
    if len(places) > MOST_WALLS:
        return
    for (x, sensor, z), (other, other_sensor, other_z) in pairwise(places):
        if other > x:
            axes.plot(
                [max(z, other_z), max(sensor, other_sensor)],
                [(x + other) / 2] * 2,
                color=GREY,
                linewidth=0.5,
                alpha=0.7,
            )


def _draw_target(axes: Any, scene: Scene, camera: Camera) -> None:
    width, height = camera.columns * camera.target_pitch, camera.rows * camera.target_pitch
    axes.plot([camera.distance] * 2, [-width / 2, width / 2], color=INK, linewidth=4, solid_capstyle="butt")
    axes.set_xlim(camera.distance * FAR, camera.distance * (1 + (1 - FAR) * 2 * AIR))
    seen = [abs(ray[-1][1]) for lens_type in camera.types for ray in _light(camera, _middle(camera, lens_type))]
    across = max(width / 2, *seen) * (1 + 3 * AIR)
    axes.set_ylim(-across, across)
    size = f"{length_words(width)} x {length_words(height)}" if width != height else f"{length_words(width)} square"
    what = "plane of f, " if scene.world is not None else ""
    grid = f"{camera.rows} x {camera.columns} pixels of {length_words(camera.target_pitch)}"
    axes.text(0.03, 0.03, f"{what}{size}:\n{grid}", transform=axes.transAxes, fontsize=8, va="bottom")


def _mark_break(near: Any, far: Any, camera: Camera) -> None:
    """Mark where the axis is broken, with the ratios of the scales, and the distance from the lenses to the target."""
    from matplotlib.patches import ConnectionPatch

    near.spines["right"].set_visible(False)
    far.spines["left"].set_visible(False)
    far.yaxis.tick_right()
    far.yaxis.set_label_position("right")
    mark: dict[str, Any] = {
        "marker": [(-1, -1.6), (1, 1.6)],
        "markersize": 9,
        "color": INK,
        "linestyle": "none",
        "clip_on": False,
    }
    near.plot([1, 1], [0, 1], transform=near.transAxes, **mark)
    far.plot([0, 0], [0, 1], transform=far.transAxes, **mark)
    figure, before, after = near.figure, near.get_position(), far.get_position()
    middle, along, across = (before.x1 + after.x0) / 2, _scale_ratio(near, far, 0), _scale_ratio(near, far, 1)
    words = f"break: to the right, z is drawn\n{_times(along)} and x {_times(across)}"
    figure.text(
        middle, before.y0 - 0.56 / figure.get_figheight(), words, ha="center", va="top", fontsize=8, style="italic"
    )
    systems = near.get_xaxis_transform(), far.get_xaxis_transform()
    figure.add_artist(
        ConnectionPatch((0, 1.05), (camera.distance, 1.05), *systems, axesA=near, axesB=far, mutation_scale=9, **ARROW)
    )
    lenses = "lenses" if camera.sensor_distance is None else "foremost lenses"
    words = f"{length_words(camera.distance)} from {lenses} to target"
    figure.text(middle, before.y1 + 0.17 / figure.get_figheight(), words, ha="center", va="bottom", fontsize=9)


def _scale_ratio(near: Any, far: Any, axis: int) -> float:
    """Return how many times more millimetres an inch of the target's axes has than one of the camera's."""
    lengths: list[float] = []
    for axes in (near, far):
        low, high = axes.get_xlim() if axis == 0 else axes.get_ylim()
        box = axes.get_position()
        inches = (box.width if axis == 0 else box.height) * axes.figure.get_size_inches()[axis]
        lengths.append((high - low) / inches)
    return lengths[1] / lengths[0]


def _times(ratio: float) -> str:
    return f"{ratio:.3g} times smaller" if ratio >= 1 else f"{1 / ratio:.3g} times larger"


def _label(axes: Any, title: str, side: str) -> None:
    axes.set_xlabel("z, along the axis (mm)", fontsize=9)
    axes.set_ylabel("x (mm)", fontsize=9)
    axes.set_title(title, fontsize=10, loc=side, pad=24)
    axes.tick_params(labelsize=8)


# Heading of each column, and where it begins, in inches
COLUMNS = (
    ("type", 0.75),
    ("magnification\non the grid", 1.2),
    ("magnification\noptical", 2.15),
    ("array", 3.1),
    ("aperture", 3.65),
    ("focal length", 4.9),
    ("lens to sensor", 5.75),
    ("sub-image", 6.7),
    ("field of view", 7.75),
    ("Airy disk", 9.0),
)


def write_key(
    figure: Any, camera: Camera, terms: OpticalTerms, colours: dict[str, str], top: float, line: float
) -> None:
    """Write magnifications, arrays, lenses and sub-images of all types as a table; `top` and `line` are inches."""
    width, height = figure.get_size_inches()
    style: dict[str, Any] = {"fontsize": 8, "va": "center"}
    for heading, left in COLUMNS:
        figure.text(left / width, (top + line / 2) / height, heading, fontweight="bold", linespacing=1.1, **style)
    for number, (lens_type, lens_terms) in enumerate(zip(camera.types, terms.types, strict=True)):
        level = (top - (number + 1) * line) / height
        for (heading, left), words in zip(COLUMNS, _cells(camera, lens_type, lens_terms), strict=True):
            colour = {"color": colours[lens_type.name], "fontweight": "bold"} if heading == "type" else {}
            figure.text(left / width, level, words, **style, **colour)


def _cells(camera: Camera, lens_type: LensType, terms: LensTerms) -> tuple[str, ...]:
    rows, columns = lens_type.pixels
    return (
        lens_type.name,
        str(terms.grid_magnification),
        f"1/{1 / terms.magnification:.4g}",
        f"{lens_type.array[0]} x {lens_type.array[1]}",
        _aperture_words(lens_type, terms),
        length_words(terms.focal_length),
        length_words(terms.total_track),
        f"{rows} x {columns} pixels",
        " x ".join(f"{angle:.3g}°" for angle in terms.field_of_view),
        _airy_words(camera, lens_type, terms),
    )


def _aperture_words(lens_type: LensType, terms: LensTerms) -> str:
    """Return the diameter and the f-number of a lens, or what it is instead."""
    if terms.aperture is not None and terms.f_number is not None:
        return f"{length_words(terms.aperture)}, f/{terms.f_number:.2g}"
    surfaces = lens_type.optics.surfaces
    return "pinholes" if surfaces is None else f"{len(surfaces)} surfaces"


def _airy_words(camera: Camera, lens_type: LensType, terms: LensTerms) -> str:
    if terms.airy_diameter is None:
        return "none" if lens_type.optics.surfaces is None else ""  # that of surfaces is traced elsewhere
    return f"{terms.airy_diameter:.2g} pixels" + ("" if camera.wavelength else ", left out")
