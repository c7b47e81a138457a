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
from ..examples import scene
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
    ("text", "millimetres"),
    [
        ("6 um", 0.006),
        ("1 inch", 25.4),
        ("0.5mm", 0.5),
        ("1 µm", 0.001),
        (" 6 um ", 0.006),
        ("1/4 mm", 0.25),
    ],
)
def test_lengths_become_millimetres(text: str, millimetres: float) -> None:
    changed = with_changes(scene().plain(), Path("a.toml"), [f'target.pixel_pitch="{text}"'], ())
    assert changed.target.pixel_pitch == pytest.approx(millimetres, rel=1e-12)


@pytest.mark.parametrize(("text", "degrees"), [("1 deg", 1.0), ("1°", 1.0), ("60 arcmin", 1.0)])
def test_angles_become_radians(text: str, degrees: float) -> None:
    changed = with_changes(scene().plain(), Path("a.toml"), [f'camera.tolerance={{tilt="{text}"}}'], ())
    assert changed.camera.tolerance is not None
    assert changed.camera.tolerance.tilt == pytest.approx(radians(degrees), rel=1e-12)


@pytest.mark.parametrize(
    ("value", "ratio"),
    [('"1/3"', Fraction(1, 3)), ("0.25", Fraction(1, 4)), ("1", Fraction(1)), ('"3/10"', Fraction(3, 10))],
)
def test_magnification_is_an_exact_ratio(value: str, ratio: Fraction) -> None:
    changed = with_changes(scene().plain(), Path("a.toml"), [f"camera.lens.A.magnification={value}"], ())
    assert changed.camera.lens[0].magnification == ratio


@given(st.floats(min_value=1e-6, max_value=1e6), st.sampled_from(["nm", "um", "mm", "cm", "m", "km"]))
def test_a_length_survives_writing_to_the_last_bit(number: float, unit: str) -> None:
    first = with_changes(scene().plain(), Path("a.toml"), [f'target.distance="{number!r} {unit}"'], ())
    again = with_changes(first.plain(), Path("a.toml"), (), ())
    assert again.target.distance == first.target.distance


def test_overrides_set_create_and_remove() -> None:
    changes = ["noise.variance=1e-6", "noise.bits=12", "title=plain words", "estimator.noise_variance=1e-3"]
    changed = with_changes(scene().plain(), Path("a.toml"), changes, ())
    assert changed.noise is not None
    assert (changed.noise.variance, changed.noise.bits, changed.title) == (1e-6, 12, "plain words")
    removed = with_changes(changed.plain(), Path("a.toml"), ["noise.bits=", "estimator.noise_variance="], ())
    assert removed.noise is not None
    assert removed.noise.bits is None
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
    ],
)
def test_refusals_name_file_key_and_what_was_expected(change: str, words: list[str]) -> None:
    with pytest.raises(InputError) as refusal:
        with_changes(scene().plain(), Path("a.toml"), [change], ())
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
