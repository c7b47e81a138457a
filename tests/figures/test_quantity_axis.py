"""Axes of swept keys: positions in one unit, logarithmic from a decade on, names side by side."""

from __future__ import annotations

import pytest

from ommatid.figures.quantity_axis import quantity_axis, spans_decade


@pytest.mark.parametrize(
    ("key", "values", "positions", "title", "logarithmic"),
    [
        ("noise.variance", ["1e-6", "1e-4"], [1e-6, 1e-4], "noise.variance (grey levels squared)", True),
        ("noise.bits", ["6", "8", "12"], [6, 8, 12], "noise.bits (bits)", False),
        ("camera.tolerance.position", ["1 nm", "30 nm", "1 um"], [1, 30, 1000], "camera.tolerance.position (nm)", True),
        ("camera.lens.I.aperture", ["0.1 mm", "200 um"], [0.1, 0.2], "camera.lens.I.aperture (mm)", False),
        ("camera.lens_pitch", ["500 µm", "1 mm", "600um"], [500, 1000, 600], "camera.lens_pitch (µm)", False),
        ("render.time", ["1 s", "2 min"], [1, 120], "render.time (s)", True),
        ("camera.tolerance.tilt", ['"1 deg"', '"2 mrad"', '"1 mrad"'], [17.4532925, 2, 1], None, True),
        ("prior.mean", ["-1", "0", "100"], [-1, 0, 100], "prior.mean (grey levels)", False),
        ("x", ["1/2", "1/3", "0.25"], [0.5, 1 / 3, 0.25], "x", False),
    ],
)
def test_numbers_and_quantities_are_at_their_sizes(
    key: str, values: list[str], positions: list[float], title: str | None, logarithmic: bool
) -> None:
    axis = quantity_axis(key, values)
    assert [axis.positions[value] for value in values] == pytest.approx(positions)
    assert (axis.logarithmic, axis.categories) == (logarithmic, False)
    assert title is None or axis.title == title


def test_names_and_mixed_kinds_are_categories() -> None:
    for values in ("ideal points", "1mm 1s", "1mm 2", "[2,2] [3,3]", "nan 1", "1e999 1"):
        axis = quantity_axis("some.key", values.split())
        assert list(axis.positions.values()) == [0.0, 1.0]
        assert (axis.categories, axis.logarithmic, axis.title) == (True, False, "some.key")


def test_huge_powers_of_ten_take_no_time() -> None:
    assert quantity_axis("x", ["1e-999999999", "1"]).positions == {"1e-999999999": 0.0, "1": 1.0}


def test_a_decade_is_a_factor_of_ten() -> None:
    assert spans_decade([1e-9, 1e-8])
    assert not spans_decade([1.0, 9.99])
    assert not spans_decade([0.0, 100.0])


@pytest.mark.parametrize(
    ("values", "position", "good", "words"),
    [
        (["1 nm", "1 um"], 162.03, 1, "up to 160 nm"),
        (["1 nm", "1 um"], 162.03, 1000, "from 170 nm"),
        (["1e-6", "1e-5"], 1.29e-6, 1e-6, "up to 1.2e-06"),
        (["1.204", "1.3"], 1.2032, 1.204, "from 1.204"),  # not past a value that is known to be good
        (["0.1", "3"], 2.0, 0.1, "up to 2"),
        (["-1.5", "0.5"], 0.0, 0.5, "from 0"),
    ],
)
def test_limits_are_rounded_towards_the_good_side(values: list[str], position: float, good: float, words: str) -> None:
    assert quantity_axis("x", values).limit(position, good) == words


def test_limits_of_whole_numbers_are_whole() -> None:
    axis = quantity_axis("noise.bits", ["6", "12"])
    limits = [axis.limit(position, good) for position, good in ((12.34, 13), (12.34, 10), (12.0, 16), (11.99, 12))]
    assert limits == ["from 13 bits", "up to 12 bits", "from 12 bits", "from 12 bits"]


def test_positions_are_shared_out_between_values() -> None:
    assert quantity_axis("x", ["1 nm", "100 nm"]).between(1, 100, 0.5) == pytest.approx(10)
    assert quantity_axis("x", ["1", "3"]).between(1, 3, 0.5) == pytest.approx(2)
