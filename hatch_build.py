"""Build backend and hook: hatchling, and what is in C compiled into the wheel.

Where no C compiler works, `pip install .` fetches `ziglang` for the build alone, which has one. The object
carries a checksum of its source, so that an old one is never used. `release/build.py` compiles for other
platforms by CC, LDLIBS and _PYTHON_HOST_PLATFORM, which sysconfig.get_platform() returns.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import hatchling.build
from hatchling.build import build_editable, build_sdist, build_wheel, get_requires_for_build_sdist
from hatchling.builders.hooks.plugin.interface import BuildHookInterface

__all__ = [
    "KernelHook",
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
]
ROOT = Path(__file__).parent
SOURCES = tuple(
    source.relative_to(ROOT)
    for pattern in ("runtime/*/*/*.c", "plugins/dxlrun_analysis/**/*.c")
    for source in sorted(ROOT.glob(pattern))
)
"""Each is compiled into an object of its own, which lies beside it: libkernel.so."""
FLAGS = ("-std=c11", "-O3", "-fPIC", "-shared", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion")
"""No contraction into fused operations: states and goals have the same bits on every processor."""


def compile_kernel(root: Path, compiler: list[str], target: Path, name: Path) -> str:
    """Compile a source; return why that did not work, or nothing."""
    source = root / name
    crc = f"-DSOURCE_CRC={zlib.crc32(source.read_bytes())}u"
    with tempfile.TemporaryDirectory() as cache:
        caches = {"ZIG_GLOBAL_CACHE_DIR": cache, "ZIG_LOCAL_CACHE_DIR": cache}
        command = [
            *compiler,
            *FLAGS,
            crc,
            "-o",
            str(target),
            str(source),
            *shlex.split(os.environ.get("LDLIBS", "-lm")),
        ]
        try:
            built = subprocess.run(
                command, capture_output=True, text=True, check=False, env={**caches, **os.environ}
            )
        except OSError as error:
            return str(error)
    return f"{shlex.join(compiler)} failed\n{built.stderr}" if built.returncode else ""


def system_compiler(root: Path) -> list[str]:
    """Return the C compiler that works here, with its options; empty: none does."""
    found = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    compiler = shlex.split(found or "")  # CC may have options, or a compiler cache in front
    with tempfile.TemporaryDirectory() as folder:
        works = compiler and not compile_kernel(root, compiler, Path(folder, "library.so"), SOURCES[0])
    return compiler if works else []


def compiler_needed() -> list[str]:
    """Return the compiler that a build needs where none works."""
    return [] if system_compiler(Path.cwd()) else ["ziglang"]


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what a wheel needs to be built."""
    return [*hatchling.build.get_requires_for_build_wheel(config_settings), *compiler_needed()]


def get_requires_for_build_editable(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what an editable install needs, which is more than a wheel does."""
    return [*hatchling.build.get_requires_for_build_editable(config_settings), *compiler_needed()]


class KernelHook(BuildHookInterface[Any]):
    """Puts the compiled kernel into the wheel, which then is one for this architecture and any Python 3."""

    PLUGIN_NAME = "custom"
    made = ""
    """The folder of a kernel that was compiled for a wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the wheel's platform."""
        if self.target_name != "wheel":
            return
        root = Path(self.root)
        compiler = system_compiler(root)
        if not compiler and find_spec("ziglang"):
            compiler = [sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline"]
        if version != "editable":  # elsewhere: other builds may go on in this tree
            self.made = tempfile.mkdtemp()
        for source in SOURCES:
            made = source.with_name(f"lib{source.stem}.so")
            target = Path(self.made, made.name) if self.made else root / made
            target.unlink(missing_ok=True)
            if why := compile_kernel(root, compiler or ["cc"], target, source):
                raise RuntimeError(
                    f"{source.name} was not compiled; install a C compiler (sudo apt install gcc):\n{why}"
                )
            if self.made:
                build_data["force_include"][str(target)] = str(Path(*made.parts[1:]))
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        build_data["pure_python"] = False

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled for a wheel, which has it now."""
        if self.made:
            shutil.rmtree(self.made, ignore_errors=True)
