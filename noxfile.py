"""The tests that depend on the version of Python, with every version of them that is installed; others are skipped."""

from __future__ import annotations

import tomllib
from pathlib import Path

import nox

PREFIX = "Programming Language :: Python :: "
PROJECT = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSIONS = [line.removeprefix(PREFIX) for line in PROJECT["classifiers"] if line.startswith(PREFIX)]
TESTS = ("tests/machines", "tests/runtime", "tests/batch", "tests/cli", "tests/scenes", "tests/test_wheel.py")

nox.options.default_venv_backend = "venv"
nox.options.error_on_missing_interpreters = False


@nox.session(python=VERSIONS)
def tests(session: nox.Session) -> None:
    """Run TESTS, or those that are named after `--`."""
    session.install("--editable", ".[dev]")
    session.run("python", "-m", "pytest", *(session.posargs or TESTS), env={"OPENBLAS_NUM_THREADS": "1"})
