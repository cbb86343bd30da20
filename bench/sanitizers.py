"""Sanitizers: C sources of this project, compiled with AddressSanitizer and UBSan of gcc for campaigns."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import NoReturn
from zlib import crc32

from dxlwire.compiled import load_compiled

_FOLDER = "DXLRUN_SANITIZED"  # Environment variable with the folder of the sanitized objects
_GCC = shutil.which("gcc") or "gcc"


def compile_sanitized(source: Path, folder: Path) -> Path:
    """Compile a source into a folder; return the object, which `load_compiled` accepts."""
    target = folder / f"lib{source.stem}.so"
    flags = ["-std=c11", "-O1", "-g", "-fPIC", "-shared", "-ffp-contract=off", "-fno-sanitize-recover=all"]
    flags += ["-fsanitize=address,undefined", f"-DSOURCE_CRC={crc32(source.read_bytes())}u"]
    subprocess.run([_GCC, *flags, "-o", str(target), str(source), "-lm"], check=True)
    return target


def sanitizing_environment() -> dict[str, str]:
    """Return the environment in which Python can load these objects."""
    found = [
        subprocess.check_output([_GCC, f"-print-file-name={name}"], text=True).strip()
        for name in ("libasan.so", "libubsan.so")
    ]
    # CPython keeps memory until its end, which is not a leak of the object
    return {**os.environ, "LD_PRELOAD": " ".join(found), "ASAN_OPTIONS": "detect_leaks=0"}


def run_sanitized(modules: Sequence[ModuleType]) -> NoReturn:
    """Run this program's command without `--sanitized`, with the sanitized objects of modules; then exit."""
    with tempfile.TemporaryDirectory() as folder:
        for module in modules:
            compile_sanitized(module.SOURCE, Path(folder))
        command = [sys.executable, *(word for word in sys.argv if word != "--sanitized")]
        sys.exit(subprocess.call(command, env={**sanitizing_environment(), _FOLDER: folder}))


def load_sanitized(modules: Sequence[ModuleType]) -> bool:
    """Let modules load their sanitized objects; return False if `run_sanitized` does not run this command."""
    folder = os.environ.get(_FOLDER)
    if folder is not None:
        for module in modules:
            path = Path(folder, f"lib{module.SOURCE.stem}.so")
            vars(module)["load_compiled"] = partial(load_compiled, path=path)
    return folder is not None
