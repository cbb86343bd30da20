"""Build the files of a release into `dist/`, and check them.

    pip install '.[release]' && python release/build.py

The files are the sdist, a wheel of dxlrun for each platform, and a wheel of each package in PACKAGES.
`ziglang` compiles for all platforms, so one machine is enough. The same versions of ziglang, hatchling and
the libraries in package-lock.json make the same bytes at each build. npm fetches these libraries: a build
needs a network.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
PLATFORMS = {
    "manylinux_2_17_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux_2_17_aarch64": "aarch64-linux-gnu.2.17",
    "musllinux_1_2_x86_64": "x86_64-linux-musl",
    "musllinux_1_2_aarch64": "aarch64-linux-musl",
}
"""The platform in each wheel's tag, and as zig names it."""
PACKAGES = ("plugins/dxlrun_view",)
"""Packages that are published next to dxlrun, with its version. Their wheels fit all platforms."""


def run(*words: str | Path, folder: Path = ROOT, environment: Mapping[str, str] | None = None) -> str:
    """Return what a module of this interpreter prints. Raises RuntimeError where it fails."""
    command = [sys.executable, "-m", *map(str, words)]
    both = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.STDOUT,
        "text": True,
    }  # hatchling names files on stderr
    ran = subprocess.run(command, cwd=folder, env=environment, check=False, **both)
    if ran.returncode:
        raise RuntimeError(f"{shlex.join(command[1:])} failed:\n{ran.stdout}")
    return ran.stdout


def compiling_for(platform: str, cache: Path) -> dict[str, str]:
    """Return the environment in which `hatch_build.py` compiles for a platform, and tags the wheel."""
    target = PLATFORMS[platform]
    compiler = [sys.executable, "-m", "ziglang", "cc", "-target", target, "-mcpu=baseline", "-g0", "-s"]
    environment = {
        "_PYTHON_HOST_PLATFORM": platform,  # what sysconfig.get_platform() returns
        "ZIG_GLOBAL_CACHE_DIR": str(cache),
        "ZIG_LOCAL_CACHE_DIR": str(cache),
    }
    if "musl" in target:
        # zig would name `libc.so`, which systems have by other names; each interpreter has loaded it already
        found = find_spec("ziglang")
        headers = Path(str(found and found.origin)).with_name("lib") / "libc" / "include"
        compiler += ["-nostdlib", f"-isystem{headers / target}", f"-isystem{headers / 'generic-musl'}"]
        environment["LDLIBS"] = ""
    return {**os.environ, **environment, "CC": shlex.join(compiler)}


def build_sdist(root: Path, dist: Path, place: Path) -> tuple[Path, Path]:
    """Build the sdist of a tree, and unpack it into an empty folder. Returns the file and the tree in it."""
    sdist = dist / Path(run("hatchling", "build", "-t", "sdist", "-d", dist, folder=root).split()[-1]).name
    # tarfile has its filters, without which 3.12 warns, since 3.11.4.
    subprocess.run([str(shutil.which("tar")), "-xf", sdist, "-C", place], check=True)
    (unpacked,) = place.iterdir()
    return sdist, unpacked


def build(root: Path, dist: Path, platforms: Collection[str] = PLATFORMS) -> list[Path]:
    """Build the sdist of a tree, and wheels of that sdist.

    Returns:
        Paths of the sdist, of a wheel for each of `platforms` and of a wheel for each of PACKAGES.

    Raises:
        RuntimeError: A build failed.
    """
    dist = dist.resolve()
    with tempfile.TemporaryDirectory() as made, ThreadPoolExecutor(os.cpu_count()) as several:
        sdist, unpacked = build_sdist(root, dist, Path(made))
        wheel = partial(run, "hatchling", "build", "-t", "wheel", "-d", dist)
        environments = [compiling_for(platform, Path(made, "cache")) for platform in platforms]
        printed = [
            *several.map(lambda environment: wheel(folder=unpacked, environment=environment), environments),
            *several.map(lambda package: wheel(folder=unpacked / package), PACKAGES),
        ]
        return [sdist, *(dist / Path(text.split()[-1]).name for text in printed)]


def judge(files: Collection[Path]) -> None:
    """Raise RuntimeError where an index would refuse a file, or a wheel needs more than its tag promises."""
    run("twine", "check", "--strict", *files)
    # A wheel for any platform has no compiled objects.
    for wheel in (path for path in files if path.suffix == ".whl" and not path.stem.endswith("-any")):
        shown = " ".join(run("auditwheel", "show", wheel).split())
        if f'tag: "{wheel.stem.rpartition("-")[2]}"' not in shown:
            raise RuntimeError(f"the objects in {wheel.name} need another platform: {shown}")


def main() -> int:
    """Build, judge, and print what was built."""
    parser = argparse.ArgumentParser(
        description="Build the files of a release: the sdist, a wheel for each platform, and dxlrun-view."
    )
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="the folder (default: dist)")
    try:
        files = build(ROOT, parser.parse_args().output)
        judge(files)
    except RuntimeError as error:
        print(error, file=sys.stderr)
        return 1
    for path in files:
        print(f"{path.stat().st_size:10,}  {path.name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
