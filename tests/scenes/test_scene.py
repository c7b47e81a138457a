"""The scene file: units, strictness, overrides, and the identity of writing then reading."""

from __future__ import annotations

from fractions import Fraction
from math import radians
from pathlib import Path
from typing import Any

import pint
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ommatid.runtime.errors import InputError
from ommatid.scenes.scene import Scene, parse, read, resolved, with_changes, write
from ommatid.scenes.tables import toml
from ommatid.scenes.tables.toml import apply_overrides
from ommatid.scenes.tables.units import FACTORS

from ..conftest import TINY
from ..examples import not_none, scene
from ..modules import tracked


@pytest.mark.parametrize("path", tracked("ommatid/scenes/*.toml"), ids=lambda path: path.stem)
def test_gallery_reads_and_survives_writing(path: Path, tmp_path: Path) -> None:
    first = resolved(read(path), (19, 19))
    write(tmp_path / "scene.toml", first)
    again = read(tmp_path / "scene.toml")
    picture = "truth.exr" if first.target.detail == 1 else "target.exr"
    assert again.target.image == (None if first.world else str(tmp_path / picture))
    assert resolved(again, (19, 19)).plain() == first.plain()


@pytest.mark.parametrize(
    ("key", "texts", "value"),
    [
        ("target.pixel_pitch", ["6 um", "0.006mm", " 6 um ", "6 µm", "6/1000 mm"], 0.006),
        ("target.distance", ["1 inch", "25.4 mm"], 25.4),
        ("camera.tolerance.tilt", ["1 deg", "1°", "60 arcmin"], radians(1)),
        ("camera.lens.A.magnification", ["3/10", "0.3"], Fraction(3, 10)),
        ("camera.lens.A.magnification", ["1", "1.0"], Fraction(1)),
    ],
)
def test_quantities_are_millimetres_radians_and_exact_ratios(key: str, texts: list[str], value: Any) -> None:
    for text in texts:
        changed: Any = with_changes(scene().plain(), Path("a.toml"), [f'{key}="{text}"'], ())
        for name in key.split("."):
            changed = changed[0] if name == "A" else getattr(changed, name)
        assert changed == (value if isinstance(value, Fraction) else pytest.approx(value, rel=1e-12))


@given(st.floats(min_value=1e-6, max_value=1e6), st.sampled_from(["nm", "um", "mm", "cm", "m", "km"]))
def test_a_length_survives_writing_to_the_last_bit(number: float, unit: str) -> None:
    first = with_changes(scene().plain(), Path("a.toml"), [f'target.distance="{number!r} {unit}"'], ())
    again = with_changes(first.plain(), Path("a.toml"), (), ())
    assert again.target.distance == first.target.distance


def test_overrides_set_create_and_remove() -> None:
    changes = ["noise.variance=1e-6", "noise.bits=12", "title=plain words", "estimator.noise_variance=1e-3"]
    changed = with_changes(scene().plain(), Path("a.toml"), changes, ())
    assert (not_none(changed.noise).variance, not_none(changed.noise).bits, changed.title) == (1e-6, 12, "plain words")
    removed = with_changes(changed.plain(), Path("a.toml"), ["noise.bits=", "estimator.noise_variance="], ())
    assert not_none(removed.noise).bits is None
    assert removed.estimator.noise_variance is None


@pytest.mark.parametrize(
    ("override", "keys", "expected"),
    [
        ('target={image="pic.npy", shape=[2, 2]}', ("target", "image"), "pic.npy"),
        ('target={image="photo:camera"}', ("target", "image"), None),
        ('light={spectrum="lamp.csv"}', ("light", "spectrum"), "lamp.csv"),
        ('light={spectrum="D65"}', ("light", "spectrum"), None),
        ('camera={glass_catalogue="a.agf"}', ("camera", "glass_catalogue"), "a.agf"),
        ('camera={lens=[{name="I", surfaces="a.zmx"}]}', ("camera", "lens", 0, "surfaces"), "a.zmx"),
        ('camera={lens=[{surfaces=[{glass="N-BK7"}]}]}', ("camera", "lens", 0, "surfaces", 0, "glass"), None),
    ],
)
def test_files_named_inside_tables_are_relative_to_the_current_folder(
    override: str, keys: tuple[str | int, ...], expected: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As those of dotted keys are; other values, and names that are no files, stay as they are."""
    monkeypatch.chdir(tmp_path)
    found: Any = apply_overrides({}, [override])
    plain: Any = toml.loads(override)
    for key in keys:
        found, plain = found[key], plain[key]
    assert found == (plain if expected is None else str(tmp_path / expected))


def test_lens_types_are_kept_in_the_order_named_and_doubled() -> None:
    data = scene(lenses=(("1/3", [3, 3], [5, 5]), ("1/5", [5, 5], [3, 3]))).plain()
    kept: Scene = with_changes(data, Path("a.toml"), (), ("B", "A", "B"))
    assert [lens.name for lens in kept.camera.lens] == ["B", "A", "B-2"]
    assert kept.camera.lens[2].magnification == Fraction(1, 5)


EXPOSED = 'illuminance="500 lux", exposure="10 ms"'
NO_ACCEPTANCE = (
    *('[["2 deg", 1], ["1 deg", 0.5]]', '[["90 deg", 0.5]]', '[["5 deg", 0]]', "[[5, 1]]", '[["5 deg"]]'),
    *("[]", "[7]", "5"),
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("noise.varience=1", ["noise.varience", "unknown key", "'noise.variance'"]),
        ("samples=16", ["unknown key 'samples'", "render.samples"]),
        ('target.distance="1 kg"', ["target.distance", "1 kg"]),
        ("camera.lens.A.magnification=2", ["camera.lens.A.magnification", "at most 1", "2"]),
        ("render.samples=8", ["render.samples: expected a number of at least 16 or 'auto', got 8"]),
        ("prior.level=-3", ["prior.level: expected 'known' or a number above 0, got -3"]),
        ("prior.variance=inf", ["prior.variance", "finite"]),
        ("camera.lens.Z.array=[1, 1]", ["'Z'", "'A'"]),
        ("estimator.misalignment=robust", ["estimator.misalignment", "withdrawn; take 'fit'"]),
        ("estimator.method=svd", ["estimator.method", "take 'auto'"]),
        ('prior={kind="exponential"}', ["needs a correlation_length"]),
        ('prior={correlation_length="1 mm"}', ["belongs to kind"]),
        ('prior={kind="exponential", correlation_length=3.0}', ["bare number"]),
        ('prior={kind="exponential", correlation_length="1 mm", exponent=2.0}', ["exponent belongs"]),
        ("prior={variance=0.0}", ["above 0"]),
        ('prior={kind="gaussian"}', ["'independent', 'exponential', 'power' or 'fit'"]),
        *((f"sensor={{{EXPOSED}, acceptance={curve}}}", ["acceptance"]) for curve in NO_ACCEPTANCE),
        (f'sensor={{{EXPOSED}, acceptance=[["5 deg", 0.9]]}}', ["walls"]),
    ],
)
def test_refusals_name_file_key_and_what_was_expected(change: str, words: list[str]) -> None:
    plain = scene(calibration={"method": "transport"}).plain()
    if "sensor" in change:
        plain["camera"]["walls"] = "walls" not in words
    with pytest.raises(InputError) as refusal:
        with_changes(plain, Path("a.toml"), [change], ())
    message = str(refusal.value)
    assert message.startswith(("a.toml: ", "a.toml with --set "))
    assert "\n" not in message
    for word in words:
        assert word in message


REGISTRY = pint.UnitRegistry()


@given(unit=st.sampled_from(sorted(FACTORS)), number=st.integers(1, 10**6) | st.floats(1e-6, 1e6))
def test_common_units_are_those_of_pint_to_the_last_bit(unit: tuple[str, str], number: float) -> None:
    """A scene means the same with and without the table of factors."""
    exact = float(REGISTRY.Quantity(f"{number} {unit[0]}").to(unit[1]).magnitude)
    assert float(number) * FACTORS[unit] == exact


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        ("", "fit"),
        ("prior.level=known", "fit"),
        ("prior.kind=power", "power"),
        ("prior.variance=900", "independent"),
        ("noise.variance=0", "independent"),
        ("estimator.noise_variance=0", "independent"),
        ("estimator.noise_variance=1", "fit"),
        ("estimator.method=tiles", "independent"),
        ("estimator.prior_variance=400", "independent"),
        ("target.detail=2", "fit"),
        ("camera.lens.I.magnification=2/7", "fit"),
        ("camera.tolerance.position=1 um", "fit"),
        ("estimator.misalignment=fit", "independent"),
    ],
)
def test_a_prior_without_a_kind_is_fitted(tmp_path: Path, change: str, kind: str) -> None:
    path = tmp_path / "plain.toml"
    path.write_text(TINY.replace('[prior]\nkind = "independent"\n', ""), encoding="utf-8")
    scene = read(path, [change] if change else [])
    assert scene.prior.kind == kind
    assert parse(scene.plain(), path).prior.kind == kind
