"""Makes a folder of traps. Each leaves a mark, a file of its name in another folder, when it is executed or loaded."""

from __future__ import annotations

import os
import py_compile
import shutil
import subprocess
from pathlib import Path

MODULES = (
    "json", "numpy", "scipy", "signal", "simulate", "scenes", "reconstruct", "ommatid", "mitsuba", "drjit",
    "matplotlib", "typing", "pickle", "sitecustomize", "usercustomize", "conftest", "__init__", "setup", "noxfile",
    "__main__", "random", "struct", "tempfile", "socket", "psutil", "typer", "rich", "pydantic", "tifffile",
    "OpenEXR", "tomllib", "evil", "threading", "_bootlocale", "readline", "zlib", "dask", "distributed", "skimage",
    "PIL", "pyexpat",
)  # fmt: skip
PACKAGES = ("encodings", "importlib", "multiprocessing", "plugins", "yaml")
LIBRARIES = (
    "plugins/evil.so", "plugins/path.so", "plugins/cube.so", "evil.so", "libLLVM.so", "libLLVM-19.so", "libLLVM.so.1",
    "libmitsuba.so", "libdrjit-core.so", "libcuda.so", "libm.so.6", "libopenblas.so", "_ctypes.so", "_json.so",
    "math.cpython-311-x86_64-linux-gnu.so",
)  # fmt: skip
SCRIPTS = (
    "python", "python3", "git", "ldconfig", "gcc", "cc", "ld", "sh", "nvidia-smi", "llvm-config", "lscpu", "uname",
)  # fmt: skip
SETTINGS = {
    "matplotlibrc": "backend: module://evil\naxes.formatter.min_exponent: 9\n",
    ".env": "PYTHONSTARTUP=evil.py\nPYTHONPATH=.\n",
    "evil.pth": "import evil\n",
    "evil.start": "evil:main\n",
    "pyvenv.cfg": "home = .\ninclude-system-site-packages = true\n",
    "python311._pth": ".\nimport site\n",
    "pyproject.toml": "[tool.ommatid]\nplugins = ['evil']\n",
    "setup.cfg": "[distutils]\ncommand_packages = evil\n",
    "tox.ini": "[pytest]\naddopts = -p evil\n",
    "pytest.ini": "[pytest]\naddopts = -p evil\n",
    "dask.yaml": "distributed: {worker: {preload: [evil]}}\n",
    "distributed.yaml": "distributed: {scheduler: {preload: [evil]}}\n",
    "mitsuba.conf": "plugins\n",
    ".netrc": "machine x\n",
    "typeshed.toml": "[",
    "gallery.toml": "[",
}
FIFOS = (
    "report.html", "index.html", "run.json", "bench.json", "sweep.json", "stack.exr", "model.npz", "scene.toml",
    "LICENSE", "tile19", ".jobs", "metadata.json",
)  # fmt: skip
NAMES = (
    "\x1b[31mred.toml", "\x1b]0;title\x07", "\udcff.toml", "a\nb.toml", "..toml", "...toml", "-o", "--help",
    "x" * 255,
)  # fmt: skip
LIBRARY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>
__attribute__((constructor)) static void loaded(void) {
    Dl_info info;
    char path[4096];
    if (!dladdr((void *) loaded, &info)) return;
    const char *name = strrchr(info.dli_fname, '/');
    snprintf(path, sizeof path, "%s/%s", MARKS, name ? name + 1 : info.dli_fname);
    close(open(path, O_CREAT | O_WRONLY, 0600));
}
"""


def make_traps(folder: Path, marks: Path) -> int:
    """Fill a folder with traps that leave their marks in another, and return how many there are."""
    for name in MODULES:
        _module(folder / f"{name}.py", marks, name)
    for name in PACKAGES:
        (folder / name).mkdir()
        _module(folder / name / "__init__.py", marks, name)
    for name in SCRIPTS:
        (folder / name).write_text(f"#!/bin/sh\n: > '{marks}/{name}'\n", encoding="ascii")
        (folder / name).chmod(0o755)
    for name, text in SETTINGS.items():
        (folder / name).write_text(text, encoding="ascii")
    (folder / ".config" / "dask").mkdir(parents=True)
    shutil.copy(folder / "dask.yaml", folder / ".config" / "dask")
    for name in FIFOS:
        os.mkfifo(folder / name)
    for name in NAMES:
        (folder / name).touch()
    (folder / "loop").symlink_to("loop")
    (folder / "here").symlink_to(".")
    (folder / "up").symlink_to("..")
    _libraries(folder, marks)
    return sum(map(len, (MODULES, PACKAGES, SCRIPTS, SETTINGS, FIFOS, NAMES, LIBRARIES))) + 4


def _module(path: Path, marks: Path, name: str) -> None:
    """Write a module that leaves a mark, and its compiled form beside it."""
    path.write_text(f"open({str(marks / name)!r}, 'w').close()\nmain = print\n", encoding="utf-8")
    py_compile.compile(str(path), quiet=1)


def _libraries(folder: Path, marks: Path) -> None:
    """Compile a library that leaves a mark, under many names; none where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        return
    source, first = marks.parent / "evil.c", folder / LIBRARIES[0]
    source.write_text(LIBRARY, encoding="ascii")
    command = [compiler, "-shared", "-fPIC", f'-DMARKS="{marks}"', str(source), "-o", str(first)]
    subprocess.run(command, check=True, capture_output=True)
    for name in LIBRARIES[1:]:
        shutil.copy(first, folder / name)
