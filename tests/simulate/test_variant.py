"""Choice of a backend: a broken LLVM is never loaded, since it kills the process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ommatid.runtime.errors import InputError, MachineError
from ommatid.simulate.renderer import variant
from ommatid.simulate.renderer.variant import BackendStatus, choose, diagnosis, probe, unusable_reason

from ..conftest import shell

BROKEN = [path for version in (15, 16) for path in Path("/usr/lib").glob(f"*/libLLVM-{version}.so*")]


@pytest.fixture
def llvm(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Simulate a version of LLVM in Dr.Jit."""
    import drjit as dr

    def claim(version: tuple[int, int, int] | None) -> None:
        backend = dr.JitBackend.LLVM
        monkeypatch.setattr(dr, "has_backend", lambda asked: asked == backend and version is not None)
        monkeypatch.setattr(dr.detail, "llvm_version", lambda: version)

    return claim


def test_only_a_good_llvm_is_chosen(llvm: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import drjit as dr

    llvm((19, 1, 7))
    assert choose("auto") == "llvm_ad_mono"
    for version in ((15, 0, 7), (16, 0, 6)):
        llvm(version)
        assert choose("auto") == "scalar_rgb"
        with pytest.raises(InputError, match=rf"LLVM {version[0]}.*run: |LLVM {version[0]}.*install"):
            choose("llvm_ad_mono")
    llvm(None)
    assert choose("auto") == "scalar_rgb"
    assert "no usable LLVM" in unusable_reason("llvm_ad_mono")
    llvm((19, 1, 7))
    monkeypatch.delattr(dr.detail, "llvm_version")
    assert choose("auto") == "scalar_rgb", "of an unknown version"


@pytest.mark.skipif(not BROKEN, reason="no LLVM 15 or 16 on this machine")
def test_a_real_broken_llvm_does_not_kill_the_process() -> None:
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": str(BROKEN[0])}
    script = "from ommatid.simulate.renderer.variant import unusable_reason, choose, probe\n"
    script += "print(choose('auto'), '|', unusable_reason('llvm_ad_mono'), '|', probe('llvm_ad_mono').reason)"
    ended = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True)
    chosen, why, probed = ended.stdout.strip().split(" | ")
    assert chosen == "scalar_rgb"
    assert "LLVM 15" in why or "LLVM 16" in why
    assert probed == why


def test_without_llvm_nothing_foreign_is_on_the_error_stream(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(here / "none"))
    predicted = shell("predict", "tiny.toml", "--no-rays", cwd=here)
    assert (predicted.code, predicted.err) == (0, "")
    script = "import os; from ommatid.simulate.renderer.variant import unusable_reason as reason\n"
    script += "print(reason('llvm_ad_mono')); os.write(2, b'kept')"
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert (str(here / "none") in ended.stdout, ended.stderr) == (True, "kept")
    foreign = "import os, sys; os.write(2, b'jitc_llvm_init(): none\\nanother line\\n')"
    (here / "drjit.py").write_text(foreign, encoding="utf-8")
    ended = subprocess.run([sys.executable, "-c", script.replace("llvm_ad", "scalar")], capture_output=True, text=True)
    assert ended.stderr == "another line\nkept"


def test_a_probe_renders_or_says_why_not_with_one_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    assert probe("scalar_rgb").speed > 0
    slow = [BackendStatus("llvm_ad_mono", "none", 0), BackendStatus("scalar_rgb", "", 1e6)]
    assert "slow" in diagnosis(slow)
    assert "nothing to repair" in diagnosis([BackendStatus("llvm_ad_mono", "", 1e7)])
    monkeypatch.setattr(variant, "_PROBE", "import os; os.abort()")
    assert "trial rendering failed" in probe("llvm_ad_mono").reason


def test_a_library_that_mitsuba_does_not_find_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Dr.Jit hides the reason behind a NameError: small systems lack libatomic.so.1."""
    package = "try:\n    raise ImportError('libatomic.so.1: cannot open')\nexcept ImportError:\n    missing_name\n"
    (tmp_path / "drjit.py").write_text(package, encoding="utf-8")
    monkeypatch.delitem(sys.modules, "drjit", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(MachineError, match=r"^Mitsuba could not be loaded \(libatomic.so.1: cannot open\); install"):
        unusable_reason("scalar_rgb")
