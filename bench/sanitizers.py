"""Sanitizers: C sources of this project, compiled with AddressSanitizer and UBSan of gcc for campaigns."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from zlib import crc32

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
