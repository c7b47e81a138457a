"""The verdict in tables, documents and exit codes. The tiny scene's is against trust: one lens type with a noisy H."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from ommatid.reconstruct.output import run_json

from ..conftest import Command
from ..runs import document


def test_strict_exits_with_3_where_results_are_not_to_be_trusted(kept: Path, ommatid: Command) -> None:
    plain, strict = (ommatid("run", "tiny.toml", "-o", "out", *options) for options in ((), ("--strict",)))
    assert (plain.code, strict.code) == (0, 3)
    assert plain.out == strict.out, "the results are written and printed all the same"
    assert plain.out.startswith("tiny: not to be trusted: ")
    assert not run_json.read(kept).verdict.trusted
    files = kept / "stack.exr", kept / "model.npz", "-o", "again.exr"
    assert ommatid("reconstruct", *files).code == 0
    assert ommatid("reconstruct", *files, "--strict").code == 3
    assert Path("again.exr").is_file()


@pytest.mark.usefixtures("kept")
def test_a_trusted_scene_passes_and_the_worst_exit_code_of_a_batch_counts(ommatid: Command) -> None:
    exact = Path("tiny.toml").read_text(encoding="utf-8").replace("[calibration]", '[calibration]\nmethod = "ideal"')
    Path("exact.toml").write_text(exact, encoding="utf-8")
    alone = ommatid("run", "exact.toml", "-o", "out", "--strict", "--json")
    assert document(alone)[0]["verdict"]["trusted"] is True
    both = ommatid("run", "exact.toml", "tiny.toml", "-o", "out", "--strict", "--json", "--workers", "1")
    assert both.code == 3
    assert [run["verdict"]["trusted"] for run in json.loads(both.out)] == [True, False]
    index = Path("out/index.html").read_text(encoding="utf-8")
    assert index.index(">trusted with a doubt</td>") < index.index(">not to be trusted</td>")
    assert "; not to be trusted: Tiny" in index


def test_results_without_a_verdict_get_one(kept: Path, ommatid: Command) -> None:
    path = kept / "run.json"
    before = json.loads(path.read_text(encoding="utf-8"))
    verdict = before.pop("verdict")
    path.write_text(json.dumps(before), encoding="utf-8")
    refused = ommatid("report", kept)
    assert (refused.code, "run.json: expected the results of a run" in refused.err) == (2, True)
    ended = ommatid("run", "tiny.toml", "-o", "out", "--strict")
    assert ended.code == 3
    assert json.loads(path.read_text(encoding="utf-8"))["verdict"] == verdict
