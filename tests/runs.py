"""Files of a run and what they hold, for tests that compare runs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ommatid.reconstruct.output.run_json import RunReport
from ommatid.scenes import model_file
from ommatid.scenes.formats import exr

from .conftest import Ended

MADE = ("stack.exr", "model.npz", "estimate.exr", "estimate.png", "overview.png", "run.json", "report.html")
FILES = {"scene.toml", "truth.exr", *MADE}
FORBIDDEN = 77  # exit code of a process that imports what it should not


def report_of(**fields: Any) -> RunReport:
    """A report of one pixel with these fields; those that it must have besides are of no consequence."""
    nothing = {"pixels_used": 1, "pixels_dead": 0, "pixels_saturated": 0, "degrees_of_freedom": 1.0, "resolution": 1.0}
    form = {"way": "dense", "method": "information", "why": "", "unit": ""}
    numbers = {"condition": 1.0, "bound": 0.0, "variance_bound": 0.0, "refinements": 0}
    least: dict[str, Any] = {
        "title": "",
        "verdict": {"trusted": True, "reasons": ()},
        "measurements": 1,
        "unknowns": 1,
        "stages": {"render": {}, "calibrate": {}, "reconstruct": {}},
        "error": {"predicted_mse": 1.0, "budget": {"noise": 1.0}},
        "solver": {**form, **numbers},
        "diagnostics": {**nothing, "chi_squared": None},
        "model": {"rms_difference_from_ideal": None, "max_z": None, "p_value": None, "spurious_information": 0.0},
        "skipped": (),
        "versions": {},
        "seeds": {"scene": 0, "data": 0, "calibration": None},
        "spent": {},
    }
    return RunReport.model_validate({**least, **fields})


def without(*packages: str) -> str:
    """Python code that ends the process when one of these packages is imported, even inside a `try`."""
    return f"""
import os, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages!r}:
            os._exit({FORBIDDEN})
sys.meta_path.insert(0, Refuse())
"""


def document(ended: Ended) -> Any:
    """The only JSON document on stdout; anything before or after it is a failure."""
    assert ended.code == 0, ended.err
    return json.loads(ended.out)


def numbers(description: dict[str, Any]) -> dict[str, Any]:
    """A run's description without names, fingerprints, times, the command and the machine."""
    left_out = ("fingerprint", "scene", "file", "spent", "command", "date", "host")
    kept = {key: value for key, value in description.items() if key not in left_out}
    computing = ("render", "calibrate", "reconstruct")
    stages = {name: {**description["stages"][name], "seconds": None} for name in computing}
    return {**kept, "stages": stages}


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    """A record without seconds, and without the fingerprints and hashes that depend on them."""
    kept = {key: value for key, value in record.items() if key not in ("seconds", "fingerprint", "sha256", "seal")}
    if "report" in kept:
        kept["report"] = numbers(kept["report"])
    return kept | ({"record": without_times(kept["record"])} if "record" in kept else {})


def content(folder: Path) -> dict[str, Any]:
    """Everything in the files below a folder that does not depend on the time it took, but for pages and tables."""
    found: dict[str, Any] = {}
    for path in sorted(folder.rglob("[!.]*")):
        name = path.relative_to(folder).as_posix()
        if path.name == "run.json":
            found[name] = numbers(json.loads(path.read_text(encoding="utf-8")))
        elif path.suffix == ".exr":
            for part in exr.read(path):
                found[f"{name}/{part.name}"] = without_times(part.record)
                found |= {
                    f"{name}/{part.name}/{channel}": pixels.tobytes() for channel, pixels in part.channels.items()
                }
        elif path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                arrays = {each: (file[each].dtype, file[each].tobytes()) for each in file.files if each != "ommatid"}
            found |= {f"{name}/{each}": array for each, array in arrays.items()}
            found[name] = without_times(model_file.read(path).record)
        elif path.suffix in (".png", ".toml"):  # pictures show no times, and so are equal byte for byte
            found[name] = path.read_bytes()
    return found


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """Names of the parts of a content that differ, or that only one of two has."""
    return sorted(name for name in {*found, *expected} if name not in found or found[name] != expected.get(name))


def assert_same_content(folder: Path, expected: Mapping[str, Any]) -> None:
    """The files of a run hold the same as others; a failure names the parts that differ."""
    assert differences(content(folder), expected) == []
