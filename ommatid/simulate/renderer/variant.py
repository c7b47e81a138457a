"""Mitsuba in this process: which of its variants work on this machine, the choice of one, and its log.

LLVM 15 and 16 load, and then kill the process at the first rendering, so the version is checked before the backend is
used. A variant is global to the process. Where Dr.Jit finds no LLVM it prints so as it is loaded: those lines are left
out, since the reason of `unusable_reason` says it where it matters. Of Mitsuba's log, every kind of message becomes one
warning of Python's; samples that are no radiances are counted.
"""

# pyright: basic
from __future__ import annotations

import json
import logging
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from ommatid.runtime.errors import InputError, MachineError
from ommatid.runtime.execution.interpreter import python_command, python_environment
from ommatid.runtime.printable import printable

if TYPE_CHECKING:
    from ommatid.scenes.camera import Camera

OLDEST_LLVM = (17, 0, 0)
COMPLAINTS = (b"jitc_llvm_init():", b"jit_find_library():")  # of Dr.Jit, about LLVM
PATIENCE = 120  # seconds that a trial rendering may take
PREFERENCE = ("cuda_ad_mono", "llvm_ad_mono", "scalar_rgb")

_PROBE = """
import json, sys, time
from ommatid.simulate.renderer.variant import fix_plugin_folder, unusable_reason
variant = sys.argv[1]
reason = unusable_reason(variant)
speed = 0.0
if not reason:
    import mitsuba as mi
    fix_plugin_folder()
    mi.set_variant(variant)
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 1},
        "target": {"type": "rectangle", "emitter": {"type": "area"}},
        "sensor": {"type": "perspective", "near_clip": 0.1,
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0]),
            "film": {"type": "hdrfilm", "width": 128, "height": 128, "pixel_format": "luminance"},
            "sampler": {"type": "multijitter"}},
    })
    import numpy as np
    np.array(mi.render(scene, spp=64, seed=0))
    start = time.perf_counter()
    np.array(mi.render(scene, spp=64, seed=1))
    speed = 128 * 128 * 64 / (time.perf_counter() - start)
print(json.dumps({"reason": reason, "speed": speed}))
"""
INTERRUPTED = "Received interrupt signal"  # suppressed: the command line reports Ctrl-C itself
INVALID = "Invalid sample value"  # negative or not finite, one message per sample, which is then ignored
_HEADING = re.compile(r"\A[-\d]+ [:\d]+ \w+ +(\S+ +)?\[[^\]]*\] *")  # date, level, thread and line of a log message
_NUMBERS_AND_NAMES = re.compile(r"\d+|\"[^\"]*\"")
_APPENDERS: dict[str, Any] = {}
_seen: set[str] = set()
_invalid = {"samples": 0}


@dataclass(frozen=True)
class BackendStatus:
    """Result of a trial of a variant: why it cannot be used ("" if it can), and its samples per second."""

    variant: str
    reason: str
    speed: float


def unusable_reason(variant: str) -> str:
    """Return why a variant cannot be used here, or "" if it can, without loading a backend that kills the process.

    Raises MachineError if Mitsuba cannot be loaded at all.
    """
    try:
        with without_complaints():
            import drjit as dr
    except (ImportError, NameError) as error:  # NameError: Dr.Jit's, of a system library that it does not find
        reason = printable(str(error.__context__ or error))
        raise MachineError(f"Mitsuba could not be loaded ({reason}); install what is missing") from error

    if variant.startswith("cuda"):
        return "" if dr.has_backend(dr.JitBackend.CUDA) else "no CUDA device was found"
    if variant.startswith("llvm"):
        if not dr.has_backend(dr.JitBackend.LLVM):
            named = os.environ.get("DRJIT_LIBLLVM_PATH")
            where = f" at {printable(named)}, which DRJIT_LIBLLVM_PATH names" if named else ""
            return f"no usable LLVM library (libLLVM.so) was found{where}"
        try:
            version = tuple(dr.detail.llvm_version())
        except AttributeError:  # not part of Dr.Jit's public interface
            return "the version of LLVM is unknown"
        if version < OLDEST_LLVM:
            return (
                f"LLVM {version[0]} was found, which fails at the first rendering; {OLDEST_LLVM[0]} or newer is needed"
            )
    return ""


@contextmanager
def without_complaints() -> Generator[None]:
    """Leave out what Dr.Jit prints to the error stream about LLVM while it is loaded, and pass on all other lines."""
    if "drjit" in sys.modules:
        yield
        return
    sys.stderr.flush()
    stream = os.dup(2)
    with tempfile.TemporaryFile() as printed:
        os.dup2(printed.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stream, 2)
            os.close(stream)
            printed.seek(0)
            for line in printed:
                if not line.startswith(COMPLAINTS):
                    os.write(2, line)


def choose(requested: str) -> str:
    """Return the variant to render with. Raises InputError if the requested one does not work here."""
    if requested == "auto":
        return next(variant for variant in PREFERENCE if not unusable_reason(variant))
    reason = unusable_reason(requested)
    if reason:
        raise InputError(f"render.variant: expected one that works here, got '{requested}': {reason}; {remedy()}")
    return requested


def check_fast_variant(camera: Camera, variant: str) -> None:
    """Raise InputError if a camera has lenses or pixels that Mitsuba's scalar backend does not render."""
    if variant.startswith("scalar") and not camera.has_stock_sensors:
        raise InputError(
            "a camera.fill_factor below 1, camera.pixel_blur and"
            f" lenses that are more than pinholes need Mitsuba's fast backend, got {variant}; {remedy()}"
        )


def check_transport_variant(variant: str, key: str = "calibration.method") -> None:
    """Raise InputError if `key` asks for calibration by transport and the variant is scalar."""
    if variant.startswith("scalar"):
        raise InputError(f"{key} 'transport' needs Mitsuba's fast backend, got {variant}; {remedy()}")


def activate(variant: str) -> None:
    """Make a variant Mitsuba's current one, and pass its warnings to Python's log."""
    with without_complaints():
        import mitsuba as mi

    fix_plugin_folder()
    if mi.variant() != variant:
        mi.set_variant(variant)
    redirect_log()


@cache
def mitsuba_folder() -> Path:
    """Return the folder of the installed Mitsuba. Raises ModuleNotFoundError if there is none."""
    spec = find_spec("mitsuba")
    if spec is None or spec.origin is None:
        raise ModuleNotFoundError("No module named 'mitsuba'", name="mitsuba")
    return Path(spec.origin).parent


def fix_plugin_folder() -> None:
    """Make Mitsuba find its plugins and data in its own folder alone, and not in the current one."""
    import mitsuba as mi

    resolver, folder = cast(Any, mi).file_resolver(), str(mitsuba_folder())
    if list(resolver) != [folder]:
        resolver.clear()
        resolver.append(folder)


def release() -> None:
    """Free the memory that Dr.Jit caches, if it is loaded."""
    dr = sys.modules.get("drjit")
    if dr is not None:
        dr.flush_malloc_cache()


def probe(variant: str) -> BackendStatus:
    """Try a variant by a small rendering in a separate process, which a broken backend may kill."""
    try:
        process = subprocess.run(
            python_command(_PROBE, variant),
            env=python_environment(),
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return BackendStatus(variant, f"a trial rendering did not end in {PATIENCE} s", 0.0)
    answer = process.stdout.rfind('{"reason"')  # a backend may have written before it
    if process.returncode != 0 or answer < 0:
        last = process.stderr.strip().splitlines()[-1:] or [f"it ended with status {process.returncode}"]
        return BackendStatus(variant, f"a trial rendering failed: {last[0]}", 0.0)
    status = json.loads(process.stdout[answer:])
    return BackendStatus(variant, status["reason"], status["speed"])


def diagnosis(statuses: list[BackendStatus]) -> str:
    """Summarise the trials in one sentence, with the command that repairs a slow or broken backend."""
    works = {status.variant for status in statuses if not status.reason}
    if "cuda_ad_mono" in works or "llvm_ad_mono" in works:
        return "The fast backend works; nothing to repair."
    if "scalar_rgb" in works:
        return f"Rendering works on scalar_rgb but is slow; for the fast backend {remedy()}"
    return "Mitsuba does not work here; install it again: make clean setup"


def remedy() -> str:
    """Return what to do for a fast backend: to take the one that works here, or the command that installs one."""
    working = next((name for name in PREFERENCE if not name.startswith("scalar") and not unusable_reason(name)), None)
    if working is not None:
        return f"leave out render.variant, since '{working}' works here"
    if shutil.which("apt-get"):
        prefix = "" if os.geteuid() == 0 else "sudo "
        return f"run: {prefix}apt-get install -y libllvm19"
    if shutil.which("brew"):
        return "run: brew install llvm@19, and set DRJIT_LIBLLVM_PATH to its libLLVM.dylib"
    return "install LLVM 17 or newer, and set DRJIT_LIBLLVM_PATH to its libLLVM.so"


def redirect_log() -> None:
    """Hand Mitsuba's warnings to the log of Python."""
    import mitsuba as mi

    logger = cast(Any, mi).logger()
    if logger is not None and not isinstance(logger.appender(0), _log_appender()):
        logger.clear_appenders()
        appender: Any = _log_appender()
        logger.add_appender(appender())
        logger.set_log_level(mi.LogLevel.Warn)


def ignored_samples() -> int:
    """Return the number of samples that Mitsuba ignored since the last call, since they were no radiances."""
    count, _invalid["samples"] = _invalid["samples"], 0
    return count


def _append(text: str) -> None:
    message = _HEADING.sub("", text)
    kind = _NUMBERS_AND_NAMES.sub("", message)
    if INVALID in text:
        _invalid["samples"] += 1
    elif INTERRUPTED not in text and kind not in _seen:
        _seen.add(kind)
        logging.getLogger("mitsuba").warning("%s", message)


def _log_appender() -> Any:
    import mitsuba as mi

    if "log" not in _APPENDERS:

        class LogAppender(mi.Appender):
            def append(self, level: object, text: str) -> None:
                del level
                _append(text)

            def log_progress(self, *arguments: object) -> None:
                del arguments

        _APPENDERS["log"] = LogAppender
    return _APPENDERS["log"]
