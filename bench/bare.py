"""Does a wheel work where nothing else is? Installs it in a system without a compiler and without a network.

    python bench/bare.py dist/dxlrun-0.1.0-py3-none-manylinux_2_17_x86_64.whl /tmp/debian
    python bench/bare.py WHEEL ROOT --python /opt/python/bin/python3 -- tests/description -k units

ROOT is a folder with the files of a system; where there is none yet, Debian 12 with its Python 3.11 is put
there (debootstrap). pip fetches what dxlrun and its tests need for that system. Inside, in namespaces of its
own, the wheel is installed, the README's first robot runs on virtual time, the kernel is compared with the
parser, and tests of the sdist beside the wheel run on what was installed. The exit code is that of the first
step that fails. Needs root, for chroot(2).
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

TESTS = ("tests/description", "tests/dxlwire/control_table", "tests/dynamixel/test_kernel.py::TestKernel")
INSIDE = """
set -eu
cd /trial
for one in cc gcc clang; do ! command -v $one || { echo "there is a compiler: $one"; exit 3; }; done
$PYTHON -m venv venv
venv/bin/python -m pip install --quiet --no-index --find-links packages ./$WHEEL $PACKAGES
echo "== dxlrun --version"; venv/bin/dxlrun --version
echo "== a run"; cd sdist
../venv/bin/dxlrun robots/bioloid_torso.yaml --virtual --play robots/motions/three_parts.yaml
rm -r runtime plugins/dxlrun_*  # what was installed is tested
echo "== kernel and parser"; ../venv/bin/python bench/fuzz_kernel.py 2000
echo "== tests"
../venv/bin/python -m pytest -q -n 0 -p no:cacheprovider $TESTS
"""
PACKAGES = (
    "hypothesis",
    "jsonschema",
    "mcap-ros2-support",
    "pytest",
    "pytest-timeout",
    "pytest-xdist",
)
"""Of the extra `test`, what has wheels for all platforms."""


def main() -> int:
    """Make the system, and run the steps in it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("wheel", type=Path)
    parser.add_argument("root", type=Path)
    parser.add_argument("--python", default="/usr/bin/python3", help="in the system (default: %(default)s)")
    parser.add_argument(
        "tests", nargs="*", default=TESTS, help="what pytest runs (default: some hundred tests)"
    )
    options = parser.parse_args()
    wheel, root = options.wheel.resolve(), options.root.resolve()
    platform = wheel.stem.rpartition("-")[2]
    if not root.exists():
        machine = {"x86_64": "amd64", "aarch64": "arm64"}[platform[platform.index("_", 15) + 1 :]]
        debian = (
            "debootstrap",
            f"--arch={machine}",
            "--variant=minbase",
            "--include=python3-venv",
            "bookworm",
        )
        subprocess.run([*debian, root], check=True)
    work = root / "trial"
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir()
    shutil.copy(wheel, work)
    asked = ["chroot", root, options.python, "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    version = subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip()
    fetched = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--only-binary=:all:",
        "--dest",
        work / "packages",
    ]
    olds = (
        [platform.replace("2_17", newer) for newer in ("2_28", "2_26", "2_17")]
        if "many" in platform
        else [platform]
    )
    # also what is tagged for older systems than the wheel itself
    olds += [platform.replace("manylinux_2_17", "manylinux2014"), platform.replace("1_2", "1_1")]
    tags = [word for one in dict.fromkeys(olds) for word in ("--platform", one)]
    subprocess.run([*fetched, "--python-version", version, *tags, wheel, *PACKAGES], check=True)
    sdist = wheel.with_name("-".join(wheel.name.split("-")[:2]) + ".tar.gz")
    # tarfile has its filters, without which 3.12 warns, since 3.11.4.
    subprocess.run([str(shutil.which("tar")), "-xf", sdist, "-C", work], check=True)
    next(path for path in work.iterdir() if path.is_dir() and (path / "pyproject.toml").exists()).rename(
        work / "sdist"
    )
    (work / "steps.sh").write_text(INSIDE)
    words = {"WHEEL": wheel.name, "PACKAGES": " ".join(PACKAGES), "TESTS": " ".join(options.tests)}
    environment = {"HOME": "/root", "PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "LC_ALL": "C.UTF-8"}
    mounts = f"mount --rbind /dev {root}/dev && mount -t proc proc {root}/proc"
    steps = f"{mounts} && exec chroot {root} /bin/sh /trial/steps.sh"
    apart = ["unshare", "--mount", "--net", "--pid", "--fork", "sh", "-c", steps]
    return subprocess.run(apart, env=environment | words | {"PYTHON": options.python}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
