"""What tests of the simulation share."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Set the number of Dr.Jit's threads for this test alone."""
    import drjit as dr

    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)
