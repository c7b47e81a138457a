"""A process that forks commands."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator

import pytest

from .attempts import STARTER


@pytest.fixture(scope="session")
def starter() -> Generator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", STARTER], stdin=pipe, stdout=pipe, text=True) as process:
        yield process
