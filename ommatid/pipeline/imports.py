"""Recorded frames of a scene file's camera, cut into a stack and written to a file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ommatid.analysis.recording_warnings import import_warnings
from ommatid.runtime.errors import InputError
from ommatid.runtime.outputs.kinds import check_output
from ommatid.scenes import stack
from ommatid.scenes.hardware.frames import AcquisitionSettings, files_in, import_stack
from ommatid.scenes.scene import read
from ommatid.scenes.setup import Setup
from ommatid.scenes.stack import Stack
from ommatid.scenes.tables.gallery import find_scene


@dataclass(frozen=True)
class ImportOutcome:
    """The stack, the distance of sub-images from whole pixels of the mosaic (sensor pixels), and warnings."""

    stack: Stack
    beside: float
    warnings: list[str]

    def describe(self) -> dict[str, Any]:
        """Describe the stack in JSON's types."""
        sub_images = len(self.stack.camera.sub_imagers)
        return {"sub_images": sub_images, "beside_pixels": self.beside, **self.stack.record}


def import_file(
    path: Path,
    images: Sequence[Path],
    output: Path,
    settings: AcquisitionSettings,
    changes: Sequence[str],
    lenses: Sequence[str],
) -> ImportOutcome:
    """Cut frames that the camera of the scene in `path` recorded into sub-images, and write the stack to `output`.

    Raises InputError for a wrong scene or frame, MachineError for a full disk.
    """
    frames = (*images, *settings.dark, *settings.flat)
    check_output(output, find_scene(path), *(file for frame in frames for file in files_in(frame)))
    setup = Setup.from_scene(read(path, changes))  # with all lens types, since all of them are on the sensor
    if lenses and not setup.camera.is_ideal_pinhole:
        raise InputError(
            f"--lens {','.join(lenses)}: lenses that are more than pinholes are imported all; choose in `reconstruct`"
        )
    whole, recorded = import_stack(setup, images, settings)
    kept = whole.restrict(tuple(lenses)) if lenses else whole
    stack.write(output, kept)
    return ImportOutcome(kept, recorded.layout.beside, import_warnings(recorded))
