"""Files of a run and what they hold, for tests that compare runs."""

from __future__ import annotations

import json
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
        "error": {"predicted_mse": 1.0, "budget": {}},
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
    return {key: value for key, value in record.items() if key not in ("seconds", "fingerprint", "sha256")}


def content(folder: Path) -> dict[str, Any]:
    """Everything in the files of a run that does not depend on the time it took."""
    found: dict[str, Any] = {"run.json": numbers(json.loads((folder / "run.json").read_text(encoding="utf-8")))}
    for path in folder.glob("*.exr"):
        for part in exr.read(path):
            record = {**part.record, "record": without_times(part.record.get("record", {}))}
            record |= {"report": numbers(record["report"])} if "report" in record else {}
            found[f"{path.name}/{part.name}"] = without_times(record)
            found |= {f"{path.name}/{part.name}/{name}": pixels.tobytes() for name, pixels in part.channels.items()}
    with np.load(folder / "model.npz", allow_pickle=False) as file:
        found |= {name: (file[name].dtype, file[name].tobytes()) for name in file.files if name != "ommatid"}
    found["model"] = without_times(model_file.read(folder / "model.npz").record)
    # The pictures show no times, and so are equal byte for byte.
    return found | {name: (folder / name).read_bytes() for name in ("scene.toml", "estimate.png", "overview.png")}


def assert_same_content(folder: Path, expected: dict[str, Any]) -> None:
    """The run in `folder` has the same content as `expected`; a failure names the parts that differ."""
    found = content(folder)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []
