"""The tests of `make test`, with every version of Python that is installed here; versions that are missing are skipped.

`tests-3.11` and its kin take the versions of constraints.txt, as `make test` does; `lowest` takes the oldest that
pyproject.toml allows, and `newest` whatever was released last. Tests are named after `--`; the default is all.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import nox

PREFIX = "Programming Language :: Python :: "
PROJECT = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))["project"]
VERSIONS = [line.removeprefix(PREFIX) for line in PROJECT["classifiers"] if line.startswith(PREFIX)]

nox.options.default_venv_backend = "uv"
nox.options.error_on_missing_interpreters = False


def _test(session: nox.Session, *options: str) -> None:
    session.install(*options, "--editable", ".[dev]")
    command = ("python", "-m", "pytest", "-n", "2", "--dist", "worksteal", *session.posargs)
    session.run(*command, env={"OPENBLAS_NUM_THREADS": "1"})


@nox.session(python=VERSIONS)
def tests(session: nox.Session) -> None:
    """Run the tests with the versions of constraints.txt."""
    _test(session, "--constraint", "constraints.txt")


@nox.session(python=VERSIONS[0])
def lowest(session: nox.Session) -> None:
    """Run the tests with the lowest versions that pyproject.toml allows."""
    _test(session, "--resolution", "lowest-direct")


@nox.session(python=VERSIONS[-1])
def newest(session: nox.Session) -> None:
    """Run the tests with the newest versions of everything."""
    _test(session, "--upgrade")
