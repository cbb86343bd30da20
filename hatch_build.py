"""Build hook: compiles the exchange's kernel where a C compiler is found, else leaves it out.

`pip install .` is one command in both cases. Without the kernel every cycle goes through the parser in
Python; `dxlrun doctor` and the log show which of the two is in use. The object carries a checksum of
its source, so that an old one is never used.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import sysconfig
import zlib
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = Path("runtime/dxlrun/dynamixel/exchange")
FLAGS = ("-std=c11", "-O2", "-fPIC", "-shared", "-ffp-contract=off", "-Wall", "-Wextra", "-Wconversion")
"""No contraction into fused operations: the parser computes the same bits."""


def compile_kernel(root: Path) -> Path | None:
    """Compile the kernel; return its path, None where that is not possible."""
    found = os.environ.get("CC") or shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    compiler = shlex.split(found or "")  # CC may have options, or a compiler cache in front
    source, target = root / FOLDER / "kernel.c", root / FOLDER / "libkernel.so"
    target.unlink(missing_ok=True)
    if not compiler or not sys.platform.startswith("linux"):
        return None
    crc = f"-DSOURCE_CRC={zlib.crc32(source.read_bytes())}u"
    command = [*compiler, *FLAGS, crc, "-o", str(target), str(source), "-lm"]
    try:
        built = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        sys.stderr.write(f"the kernel was not built, dxlrun runs without it: {error}\n")
        return None
    if built.returncode:
        sys.stderr.write(f"the kernel was not built, dxlrun runs without it:\n{built.stderr}\n")
        return None
    return target


class KernelHook(BuildHookInterface[Any]):
    """Puts the compiled kernel into the wheel, which then is one for this architecture and any Python 3."""

    PLUGIN_NAME = "custom"

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and name the wheel's platform when that went well."""
        if self.target_name != "wheel":
            return
        target = compile_kernel(Path(self.root))
        if target is None:
            self.app.display_warning("no C compiler: dxlrun is installed without its compiled kernel")
            return
        platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{platform}"
        build_data["pure_python"] = False
        build_data["artifacts"].append(str(FOLDER / "libkernel.so"))
