"""Rays through the lenses of `zemax_lenses` by optiland and rayoptics, for `oracle_rays.json`.

Both read the file themselves, with their own glass catalogues. They bring graphical toolkits of a gigabyte with them,
and so are no dependency of the tests. To make the figures anew:

    python -m venv oracles && oracles/bin/pip install optiland==0.6.3 rayoptics==0.9.8
    oracles/bin/python tests/simulate/oracle_rays.py tests/simulate/oracle_rays.json

Every ray starts at the object, at a height along y, towards a point of the entrance pupil, which is the vertex plane of
the first surface. A row is x, y in the image plane, the direction cosines along x and y, and the optical path from the
object point.
"""

from __future__ import annotations

import json
import sys
import tempfile
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import numpy as np

HEIGHTS = (0.0, 3.0, 6.0)
RINGS, SPOKES = (0.35, 0.7, 0.98), 8
WAVELENGTH = 0.55  # micrometres


def pupil_points() -> tuple[list[float], list[float]]:
    """Return points of the unit disk: the centre, then three rings."""
    turns = 2 * np.pi * (np.arange(SPOKES) + 0.25) / SPOKES
    rings = np.array(RINGS)[:, None]
    return [0.0, *(rings * np.cos(turns)).ravel()], [0.0, *(rings * np.sin(turns)).ravel()]


def by_optiland(path: Path) -> dict[str, Any]:
    optic = import_module("optiland.fileio").load_zemax_file(str(path))
    for geometry in (surface.geometry for surface in optic.surfaces):
        if hasattr(geometry, "tol"):
            geometry.tol = 1e-14  # of Newton's method, in mm; its own 1e-10 leaves 2e-8 in the optical path
    px, py = (np.array(values) for values in pupil_points())
    rays: dict[str, list[list[float]]] = {}
    for height in HEIGHTS:
        traced = optic.trace_generic(Hx=0 * px, Hy=0 * px + height / HEIGHTS[-1], Px=px, Py=py, wavelength=WAVELENGTH)
        rays[str(height)] = np.stack([traced.x, traced.y, traced.L, traced.M, traced.opd]).T.tolist()
    return {"focal_length": float(optic.paraxial.f2()), "rays": rays}


def by_rayoptics(path: Path, lenses: Any, name: str) -> dict[str, Any]:
    model, _ = import_module("rayoptics.zemax.zmxread").read_lens(path, lenses.zmx(name))
    model.update_model()
    trace = import_module("rayoptics.raytr.raytrace").trace
    radius, (px, py) = lenses.PUPIL[name] / 2, pupil_points()
    rays: dict[str, list[list[float]]] = {}
    indices = [1.0, *(float(row[0]) for row in model.seq_model.rndx[1:])]
    for height in HEIGHTS:
        rows = rays[str(height)] = []
        for across, down in zip(px, py, strict=True):
            start = np.array([0.0, height, 0.0])
            way = np.array([across * radius, down * radius, lenses.OBJECT]) - start
            segments = trace(model.seq_model, start, way / np.linalg.norm(way), WAVELENGTH * 1e3)[0]
            length = sum(index * segment[2] for index, segment in zip(indices, segments[:-1], strict=False))
            point, direction = segments[-1][0], segments[-2][1]
            rows.append([float(value) for value in (point[0], point[1], direction[0], direction[1], length)])
    focal_length = model["analysis_results"]["parax_data"].fod.efl
    return {"focal_length": float(focal_length), "rays": rays}


def main(output: Path) -> None:
    sys.path.insert(0, str(Path(__file__).parent))
    lenses = import_module("zemax_lenses")
    versions = {name: metadata.version(name) for name in ("optiland", "rayoptics")}
    figures: dict[str, Any] = {"versions": versions, "lenses": {}}
    with tempfile.TemporaryDirectory() as folder:
        for name in lenses.ROWS:
            path = Path(folder) / f"{name}.zmx"
            path.write_text(lenses.zmx(name), encoding="utf-8")
            figures["lenses"][name] = {
                "optiland": by_optiland(path),
                "rayoptics": by_rayoptics(path, lenses, name),
            }
    output.write_text(json.dumps(figures).replace("], [", "],\n[") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
