"""Files of models that were made to mislead: every one is refused by one sentence, before it is read or afterwards."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ommatid.runtime.errors import InputError
from ommatid.runtime.files import digest
from ommatid.scenes import model_file
from ommatid.scenes.formats import npz
from ommatid.scenes.formats.provenance import checked
from ommatid.scenes.setup import Setup
from ommatid.simulate.ideal import ideal_model

from ..examples import scene
from ..fuzz.verdicts import PeakMemory

Arrays = dict[str, NDArray[Any]]
Change = Callable[[Arrays], object]


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model with entries."""
    setup = Setup.from_scene(scene(calibration={"method": "transport"}))
    model = ideal_model(setup.resolved, setup.camera)
    path = tmp_path_factory.mktemp("model") / "model.npz"
    model_file.write(path, model)
    return path


def sealed(path: Path, arrays: Arrays) -> None:
    """Write arrays as a model with a valid checksum."""
    record = json.loads(str(arrays["ommatid"][()]))
    inside = {name: each for name, each in arrays.items() if name not in ("format", "_is_array", "ommatid")}
    content = digest(*(inside[name] for name in sorted(inside)))
    record["sha256"] = hashlib.sha256(f"{content}{record['description']}".encode()).hexdigest()
    npz.write(path, {**arrays, "ommatid": np.array(json.dumps(record))})


def described(arrays: Arrays, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the description of a model."""
    record = json.loads(str(arrays["ommatid"][()]))
    description = json.loads(record["description"])
    change(description)
    arrays["ommatid"] = np.array(json.dumps({**record, "description": json.dumps(description)}))


def twice(arrays: Arrays) -> None:
    """Split the first entry into two of the same place."""
    arrays["data"][0] /= 2
    for name in ("data", "indices", "variance"):
        arrays[name] = np.insert(arrays[name], 0, arrays[name][0])
    arrays["batches"] = np.zeros((0, arrays["data"].size), np.float32)
    arrays["indptr"][1:] += 1


def swapped(arrays: Arrays) -> None:
    """Exchange two entries of a row."""
    for name in ("data", "indices"):
        arrays[name][[0, 1]] = arrays[name][[1, 0]]


def put(name: str, value: float) -> Change:
    """Change one number of an array."""
    return lambda arrays: arrays[name].__setitem__(-1, value)


def test_a_sealed_model_is_read(original: Path, tmp_path: Path) -> None:
    sealed(tmp_path / "m.npz", npz.read(original))
    assert model_file.read(tmp_path / "m.npz").entries == model_file.read(original).entries


STORED_FILES: dict[str, Callable[[dict[str, Any]], object]] = {
    "lens": lambda scene: scene["camera"]["lens"][0].update(surfaces="/dev/zero"),
    "glass": lambda scene: scene["camera"].update(glass_catalogue="../all.agf"),
    "light": lambda scene: scene.update(light={"spectrum": "/dev/zero.txt"}),
    "picture": lambda scene: scene["target"].pop("shape"),
}


@pytest.mark.parametrize("change", STORED_FILES.values(), ids=STORED_FILES.keys())
def test_a_stored_scene_opens_no_other_file(
    change: Callable[[dict[str, Any]], object], original: Path, tmp_path: Path
) -> None:
    arrays = npz.read(original)
    described(arrays, lambda description: change(description["scene"]))
    sealed(tmp_path / "m.npz", arrays)
    with pytest.raises(InputError, match=r"expected a scene with"):
        model_file.read(tmp_path / "m.npz")


def member(archive: zipfile.ZipFile, name: str, header: bytes, version: bytes = b"\1\0") -> None:
    """Add an array of which only the header is there."""
    size = len(header).to_bytes(2 if version == b"\1\0" else 4, "little")
    archive.writestr(f"{name}.npy", b"\x93NUMPY" + version + size + header)


def test_misleading_arrays_are_refused(original: Path, tmp_path: Path) -> None:
    """More of them: the family `model, rearranged` of the fuzz."""
    negative, infinite, late = put("variance", -1.0), put("data", np.inf), put("indptr", 2**30)
    for change in (twice, swapped, negative, infinite, late):
        arrays = npz.read(original)
        change(arrays)
        sealed(tmp_path / "m.npz", arrays)
        with pytest.raises(InputError):
            model_file.read(tmp_path / "m.npz")


@pytest.mark.parametrize("name", ["views.A.own", "views.B.shared", "kernels.A.error_coefficients"])
def test_directions_of_errors_are_few(name: str) -> None:
    """Each costs a pass over all measurements: a small file of very many would take hours."""
    shape = (9, 5, 10**6) if name.startswith("views") else (10**6, 16, 1)
    with pytest.raises(ValueError, match=f"{name} has 1000000 directions of errors, more than 256"):
        model_file.check_shapes({name: np.broadcast_to(np.zeros(()), shape)})


def test_records_hold_what_can_be() -> None:
    values: list[Any] = [-1, -0.5, 10**400, float("inf"), float("nan"), True, "1", None, []]
    for key in ("seconds", "samples", "passes", "seed", "versions", "agreement", "fit", "rays"):
        for value in values:
            with pytest.raises(ValueError, match=f"its record should have .* as {key}, got"):
                checked({key: value})


def test_archives_are_refused_within_little_memory(tmp_path: Path) -> None:
    header = b"{'descr': '%s', 'fortran_order': False, 'shape': (300000000,)}\n"
    members = [("shape", header % b"<U0", b"\1\0"), ("shape", header % b"<f8", b"\1\0")]
    members += [("shape", b" " * 20_000_000, b"\2\0"), ("a", b"", b"\1\0")]
    for name, text, version in members:
        with zipfile.ZipFile(tmp_path / "m.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for number in range(25_000 if name == "a" else 0):
                archive.writestr(f"{number}.npy", b"")
            member(archive, name, text, version)
        memory = PeakMemory()
        with pytest.raises(InputError):
            model_file.read(tmp_path / "m.npz")
        assert not memory.excess()
