"""index.html of a batch: the error of every scene, and failures with their reasons.

A sweep is a batch with `sweep.json`, which lists its folders with the `values` of the varied keys.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from ommatid.batch.film import Film
from ommatid.batch.sweep_row import NUMBERS, read_rows
from ommatid.batch.sweep_table import PICTURE as SWEEP_PICTURE
from ommatid.reconstruct.output import run_json
from ommatid.reconstruct.output.facts import agreement
from ommatid.reconstruct.output.result_files import PICTURE
from ommatid.reconstruct.output.run_json import RunReport
from ommatid.reconstruct.output.verdict_words import heading
from ommatid.runtime.errors import InputError
from ommatid.runtime.files import cached, fingerprint, write_text
from ommatid.runtime.input_files import real_path
from ommatid.runtime.outputs.kinds import check_folder
from ommatid.runtime.printable import printable
from ommatid.scenes.camera import derive
from ommatid.scenes.geometry.optical_terms import optical_terms
from ommatid.scenes.scene import read as read_scene

from .cached import REPORT, check_own_page, read_stamp, sources_digest

INDEX = "index.html"
COLUMNS = (
    ("scene", ""),
    ("verdict", ""),
    ("measurements", ""),
    ("sensor area", "mm²"),
    ("RMS error", "grey levels"),
    ("MSE, measured", "grey levels²"),
    ("MSE, predicted", "grey levels²"),
    ("99 % interval", "of the MSE"),
    ("PSNR", "dB"),
    ("gain", "dB"),
    ("SSIM", ""),
    ("time", "s"),
)  # with their units


@dataclass(frozen=True)
class BatchEntry:
    """Results of one scene of a batch, or the reason of its failure.

    sensor_area : of all recorded pixels, mm^2; None if it is not known
    page, picture : addresses, relative to the index;  values : of the varied keys of a sweep
    """

    name: str
    report: RunReport | None = None
    failure: str = ""
    sensor_area: float | None = None
    page: str = ""
    picture: str = ""
    values: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def title(self) -> str:
        """Title of the scene, or the name of its folder."""
        return printable((self.report.title if self.report else "") or self.name)


def cached_index(output: Path, folders: Mapping[Path, str]) -> bool:
    """Write index.html of a batch unless it is up to date or there is no folder, and return True if it was written.

    folders : of the batch, in order, each with its failure or an empty text; other runs in `output` follow
    Raises MachineError for a full disk, and InputError as `check_own_page` does.
    """
    if not output.is_dir():
        return False
    check_own_page(output / INDEX)
    others = sorted(path.parent for path in output.glob(f"*/{REPORT}") if path.parent not in folders)
    values = dict[str, Mapping[str, Any]]()
    with suppress(InputError):  # there is no sweep.json, or a damaged one
        values = {Path(row.folder or "").name: row.values for row in read_rows(output / NUMBERS)}
    entries = [
        replace(_entry(folder, folders.get(folder, "")), values=values.get(folder.name, {}))
        for folder in (*folders, *others)
    ]
    described = [
        [entry.name, entry.failure, entry.sensor_area, entry.report and entry.report.plain(), entry.values]
        for entry in entries
    ]
    drawn = SWEEP_PICTURE if (output / SWEEP_PICTURE).is_file() else ""
    stamp = fingerprint([described, drawn, sources_digest()])
    content: dict[str, Any] = {"sweep_picture": drawn, "title": f"Batch: {real_path(output).name}"}
    return cached(output / INDEX, stamp, read_stamp, lambda: page(entries, stamp, **content), write_text)[1]


def write_film_index(output: Path, reports: Sequence[tuple[str, RunReport | None, str]], film: Film | None) -> Path:
    """Write index.html of the frames of one camera, with their moving picture, and return its path.

    reports : name of each frame, and its report or the reason of its failure
    """
    entries = [
        BatchEntry(name, report, failure, page=quote(f"{name}.png"), picture=quote(f"{name}.png"))
        for name, report, failure in reports
    ]
    content: dict[str, Any] = {"film": film, "title": f"Film: {real_path(output).name}", "noun": "frames"}
    write_text(output / INDEX, page(entries, fingerprint([name for name, *_ in reports]), **content))
    return output / INDEX


def _entry(folder: Path, failure: str) -> BatchEntry:
    if failure:
        return BatchEntry(folder.name, failure=failure)
    try:
        check_folder(folder)
        report = run_json.read(folder)
    except InputError as error:
        return BatchEntry(folder.name, failure=str(error))
    area = None
    with suppress(InputError):  # a folder of an earlier version, or of recorded frames
        scene = read_scene(folder / "scene.toml")
        area = optical_terms(scene, derive(scene)).sensor_area
    page, picture = (quote(os.fsencode(f"{folder.name}/{file}")) for file in (REPORT, PICTURE))
    return BatchEntry(folder.name, report, sensor_area=area, page=page, picture=picture)


def page(entries: list[BatchEntry], stamp: str, noun: str = "scenes", **content: Any) -> str:
    """Return the index as HTML.

    noun : what the entries are;  content : its `title`; `sweep_picture`, file of the figure of the sweep; `film`
    """
    from .document import fill

    of_batch = {
        "entries": entries,
        "keys": list(dict.fromkeys(key for entry in entries for key in entry.values)),
        "columns": COLUMNS,
        "heading": heading,
        "agreement": agreement,
        "words": words(entries, noun),
    }
    of_page: dict[str, Any] = {"noun": noun, "document": "", "stamp": stamp, "film": None, "sweep_picture": ""}
    return fill("index.html", {**of_page, **of_batch, **content}, "index.js")


def words(entries: list[BatchEntry], noun: str = "scenes") -> str:
    """Return the results of the batch in one sentence; noun : what the entries are."""
    finished = [entry for entry in entries if not entry.failure]
    sentence = f"{len(finished)} of {len(entries)} {noun} are finished"
    reports = [entry.report for entry in finished if entry.report is not None]
    distrusted = [entry.title for entry in finished if entry.report is not None and not entry.report.verdict.trusted]
    if distrusted:
        sentence += f"; not to be trusted: {', '.join(distrusted)}"
    agreements = [found for report in reports if (found := agreement(report.error)) != "unknown"]
    if agreements:
        inside = agreements.count("agrees")
        sentence += f"; the error of {inside} of {len(agreements)} is inside the 99 % interval expected for its image"
    return f"{sentence}."
