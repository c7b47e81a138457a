"""A short campaign of kills: the long one is `python -m tests.kills`."""

from __future__ import annotations

import subprocess
from collections.abc import Generator
from pathlib import Path

import pytest

from .campaign import COMMANDS, campaign, prepared

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def starter(tmp_path_factory: pytest.TempPathFactory) -> Generator[tuple[subprocess.Popen[str], Path]]:
    """A process that starts commands, and the folder of their scenes."""
    here = tmp_path_factory.mktemp("kills")
    with prepared(here) as process:
        yield process, here


@pytest.mark.parametrize("name", COMMANDS)
def test_killed_commands_are_resumed_to_the_same_bits(name: str, starter: tuple[subprocess.Popen[str], Path]) -> None:
    tally = campaign(*starter, name, kills=1, seed=3)
    assert tally.wrong == []
    assert tally.kills >= 1
