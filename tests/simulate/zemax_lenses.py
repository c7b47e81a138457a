"""Three lenses as files of Zemax, of the tests' own making: object at 100 mm, the stop on the first surface."""

from __future__ import annotations

SURFACE = """SURF {number}
  TYPE {kind}
  CURV {curvature} 0 0 0 0 ""
  CONI {conic}
{terms}  DISZ {thickness}
{glass}  DIAM {semi_diameter} 1 0 0 1 ""
"""
HEAD = """VERS 140124 258 36214
MODE SEQ
NAME {name}
UNIT MM X W X CM MR CPMM
ENPD {pupil}
ENVD 20 1 0
GFAC 0 0
GCAT SCHOTT
RAIM 0 0 1 1 0 0 0 0 0
FTYP 1 0 3 1 0 0 0
XFLN 0 0 0
YFLN 0 3 6
FWGN 1 1 1
WAVM 1 0.55 1
PWAV 1
"""
OBJECT = 100.0  # distance to the first surface
PUPIL = {"singlet": 4.0, "doublet": 5.0, "asphere": 8.0}  # diameters
ROWS: dict[str, list[tuple[float, float, str, float, float, tuple[float, ...]]]] = {
    # radius, thickness, glass, semi-diameter, conic, a4, a6, ...
    "singlet": [(20.0, 3.0, "N-BK7", 4.0, 0.0, ()), (-25.0, 26.0, "", 4.5, 0.0, ())],
    "doublet": [
        (16.0, 4.0, "N-BK7", 5.0, 0.0, ()),
        (-11.5, 1.5, "N-SF11", 5.5, 0.0, ()),
        (-29.0, 29.0, "", 6.0, 0.0, ()),
    ],
    "asphere": [
        (9.0, 4.0, "N-BK7", 5.0, -0.6, (-2e-5, -3e-7, -1e-9)),
        (-60.0, 17.0, "", 5.0, -2.0, (5e-5, -4e-7, 3e-9)),
    ],
}


def zmx(name: str) -> str:
    """Return the text of a file."""
    text = [HEAD.format(name=name, pupil=PUPIL[name])]
    text.append("SURF 0\n  TYPE STANDARD\n  CURV 0\n  DISZ 100\n  DIAM 6 0 0 0 1\n")
    for number, (radius, thickness, glass, semi_diameter, conic, aspheric) in enumerate(ROWS[name], start=1):
        terms = (
            "".join(f"  PARM {n} {term!r}\n" for n, term in enumerate((0.0, *aspheric), start=1)) if aspheric else ""
        )
        text.append(
            SURFACE.format(
                number=number,
                kind="EVENASPH" if aspheric else "STANDARD",
                curvature=repr(1 / radius),
                conic=conic,
                terms=terms,
                thickness=thickness,
                glass=f"  GLAS {glass} 0 0 1.5 50 0 0 0 0 0 0\n" if glass else "",
                semi_diameter=semi_diameter,
            ).replace("SURF 1\n", "SURF 1\n  STOP\n")
        )
    text.append(f"SURF {len(ROWS[name]) + 1}\n  TYPE STANDARD\n  CURV 0\n  DISZ 0\n  DIAM 6 0 0 0 1\n")
    return "".join(text)
