"""The Pareto front against every pair of points."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from ommatid.bench.slopes import pareto_front


@given(st.lists(st.tuples(st.floats(1e-3, 1e3), st.floats(1e-9, 1e6)), max_size=12))
def test_no_point_beats_the_front_and_none_of_it_is_beaten(points: list[tuple[float, float]]) -> None:
    front = pareto_front(points, lambda point: point[0], lambda point: point[1])
    for cost, error in points:
        assert any(best_cost <= cost and best_error <= error for best_cost, best_error in front)
    for cost, error in front:
        assert not any(other[0] < cost and other[1] <= error for other in points)
    assert front == sorted(front)
    errors = [error for _, error in front]
    assert errors == sorted(set(errors), reverse=True), "each costs more for a smaller error"
