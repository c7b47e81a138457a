"""The Pareto front of settings that differ in cost and error."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

Item = TypeVar("Item")


def pareto_front(items: Iterable[Item], cost: Callable[[Item], float], error: Callable[[Item], float]) -> list[Item]:
    """Return the items than which no other has both less cost and less error, the cheapest first.

    Of equal items the first one stays.
    """
    front: list[Item] = []
    for item in sorted(items, key=lambda item: (cost(item), error(item))):
        if not front or error(item) < error(front[-1]):
            front.append(item)
    return front
