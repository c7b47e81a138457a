"""Compare the bits of one scene under every variation, from a wheel, and with other interpreters.

    python -m tests.machines [PYTHON ...]

PYTHON is the path of an interpreter in whose environment the dependencies are installed. The exit code is 1 if a result
differs or a run fails.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from tests.modules import ROOT

from .variations import EVERYTHING, VARIATIONS, Variation, differences, result, run

RENDERINGS = {
    "scalar": ("--set", "render.variant=scalar_rgb"),
    "fast, by transport": ("--set", "render.variant=llvm_ad_mono", "--set", "calibration.method=transport"),
}
BUILD = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"


def wheel(base: Path) -> Path:
    """Build the wheel and unpack it below `base`."""
    subprocess.run([sys.executable, "-c", BUILD, str(base)], cwd=ROOT, check=True, capture_output=True)
    (path,) = base.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        archive.extractall(base / "site")
    return base / "site"


def main(pythons: list[str]) -> int:
    """Print a line for each variation, and return the exit code."""
    with tempfile.TemporaryDirectory() as temporary:
        base = Path(temporary)
        variations = [*VARIATIONS, EVERYTHING, Variation("wheel", {"PYTHONPATH": str(wheel(base))})]
        cases = [(variation, ()) for variation in variations]
        cases += [(Variation(python), (python, "-m", "ommatid")) for python in pythons]
        differing = 0
        for number, (rendering, options) in enumerate(RENDERINGS.items()):
            expected = result(run(Variation("reference"), base / f"{number}", (), options))
            for place, (variation, python) in enumerate(cases):
                said = compare(variation, base / f"{number}-{place}", python, options, expected)
                differing += said != "the same bits"
                print(f"{rendering:20} {variation.name:30} {said}", flush=True)
    return int(differing > 0)


def compare(
    variation: Variation, base: Path, python: tuple[str, ...], options: tuple[str, ...], expected: dict[str, object]
) -> str:
    """Run a variation, and say what of its result differs."""
    try:
        found = result(run(variation, base, python, options))
    except subprocess.CalledProcessError as error:
        return f"exit code {error.returncode}: {' '.join(error.stderr.splitlines()[-1:])}"
    return ", ".join(differences(found, expected)) or "the same bits"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
