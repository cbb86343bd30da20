"""dxlrun on ARM: the wheel for aarch64 in a Debian arm64 root under qemu-user, beside this machine.

    sudo apt install qemu-user-static debootstrap && .venv/bin/pip install '.[release]'
    sudo .venv/bin/python bench/arm.py /tmp/arm64 --qemu /usr/bin/qemu-aarch64
    sudo .venv/bin/python bench/arm.py /tmp/arm64 fuzz --streams 2000

Makes the root, installs this commit with the versions of the packages that it has here, and runs there the
README's first command on virtual time, tests, and that command in all processes. The kernel's fuzz and the
runs of same_runs.py are done here, too, and must show the same: bytes, log, states and goals to the bit.

The step `processes` needs TCGETS2, which qemu 11.1 of Debian sid has, and 7.2 of Debian 12 has not.
On x86 qemu keeps stores in order: that ARM may not is the matter of tests/run/channels/ring_model.c. Nor are
times measured: it is some seven times slower [measured], and knows no real-time scheduling and no hardware.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.kit.loaded import loaded

HERE = Path(__file__).parents[1]
build = loaded(HERE / "release/build.py").build

PLATFORMS = ("manylinux_2_17_aarch64", "manylinux2014_aarch64", "manylinux_2_28_aarch64")
BINFMT = Path("/proc/sys/fs/binfmt_misc")
RUN = "dxlrun robots/bioloid_torso.yaml --play robots/motions/three_parts.yaml"
TESTS = (
    "tests/run/channels tests/sensors/test_readings.py tests/compile/test_{cases,limits}.py "
    "tests/dxlwire/test_{protocols,bus}.py "
    "tests/dynamixel/test_{kernel,idle}.py "
    "tests/control/test_{gate,loop,manager}.py "
    "tests/log/test_{messages,log,recorder}.py"
)
"""The exchange with its kernel, what processes share, gate and loop, checks of robot files, the log."""
INSIDE = """cd "$0" && for one in proc sys dev; do mount --rbind /$one $one || exit; done
mount -t tmpfs tmpfs tmp && exec chroot . env -i PATH=/dxlrun/.venv/bin:/usr/bin:/bin HOME=/root \\
LANG=C.UTF-8 bash -c "cd /dxlrun; $1"
"""


def run(*words: str | Path) -> str:
    """Run a program of this machine; return what it prints. Raises RuntimeError where it fails."""
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "errors": "replace"}
    ran = subprocess.run(words, cwd=HERE, check=False, **both)
    if ran.returncode:
        raise RuntimeError(
            f"{shlex.join(map(str, words))} ended with {ran.returncode}:\n{ran.stdout[-6000:]}"
        )
    return ran.stdout


class Arm:
    """A root, and what is done in it; each method but `inside` is a step, and returns what it found."""

    def __init__(self, root: Path, qemu: Path, streams: int, runs: int) -> None:
        self.root, self.clone, self.qemu = root, root / "dxlrun", qemu
        self.streams, self.runs = streams, runs

    def inside(self, line: str) -> str:
        """Run a line of shell in the clone; its mounts end with it."""
        return run("unshare", "--mount", "--propagation", "private", "sh", "-c", INSIDE, self.root, line)

    def make(self) -> str:
        """Install Debian 12 for arm64."""
        if not (BINFMT / "register").exists():
            run("mount", "-t", "binfmt_misc", "binfmt_misc", BINFMT)
        if os.uname().machine != "aarch64" and not (BINFMT / "qemu-aarch64").exists():
            *known, _, flags = Path("/usr/lib/binfmt.d/qemu-aarch64.conf").read_text().split(":")
            (BINFMT / "register").write_text(":".join([*known, str(self.qemu.resolve()), flags]))
        if (self.root / "usr").exists():
            return "it is there"
        packages = "--include=python3-venv,ca-certificates,gcc,libc6-dev"
        made = ("bookworm", self.root, "http://deb.debian.org/debian")
        return run("debootstrap", "--arch=arm64", "--variant=minbase", packages, *made)

    def install(self) -> str:
        """Put this commit there, with packages that the pip of this machine fetches: it is quicker."""
        shutil.rmtree(self.clone, ignore_errors=True)
        self.clone.mkdir()
        with tempfile.TemporaryDirectory() as folder:
            run("git", "archive", "-o", f"{folder}/tree.tar", "HEAD")
            shutil.unpack_archive(f"{folder}/tree.tar", self.clone)
            self.inside("python3 -m venv .venv")
            (packages,) = self.clone.glob(".venv/lib/python3*/site-packages")
            _, wheel = build(self.clone, Path(folder), PLATFORMS[:1])
            same = Path(folder, "same.txt")
            same.write_text(run(sys.executable, "-m", "pip", "freeze", "--exclude-editable"))
            options = ["--target", packages, "--only-binary=:all:", "-c", same]
            options += [word for platform in PLATFORMS for word in ("--platform", platform)]
            options += ["--python-version", packages.parent.name.removeprefix("python")]
            run(sys.executable, "-m", "pip", "install", "-q", *options, f"{wheel}[test,report]")
            shutil.copy(wheel, self.clone)
        return self.inside(f"pip install --force-reinstall --no-deps --no-index {wheel.name}")

    def virtual(self) -> str:
        """Run the README's first command on virtual time."""
        return self.inside(f"{RUN} --virtual")

    def tests(self) -> str:
        """Run tests."""
        return self.inside(f"python -m pytest -n 2 -q --timeout 1800 {TESTS}")

    def processes(self) -> str:
        """Run the README's first command: simulated servos on a pseudo-terminal, all processes."""
        return self.inside(f"{RUN} --duration 10")

    def fuzz(self) -> str:
        """Compare what the kernel's fuzz shows, robot by robot."""
        line = f"bench/fuzz_kernel.py {self.streams} --digests"
        both = run(sys.executable, *line.split()), self.inside(f"python {line}")
        here, there = ([one for one in text.splitlines() if one[0].isdigit()] for text in both)
        if here != there:
            raise RuntimeError("\n".join(["not the same there:", *sorted({*here} - {*there})]))
        return f"{here[-1].split()[1]} streams of {len(here)} robots: the same bytes, log and states"

    def same(self) -> str:
        """Compare the hashes of whole runs on virtual time."""
        program, numbers = "bench/same_runs.py", [str(number) for number in range(self.runs)]
        with tempfile.TemporaryDirectory() as folder:
            here = Path(folder, "here.json")
            run(sys.executable, program, HERE, here, *numbers)
            self.inside(f"python {program} . there.json {' '.join(numbers)}")
            return run(sys.executable, program, here, self.clone / "there.json")


STEPS = ["make", "install", "virtual", "tests", "processes", "fuzz", "same"]


def main() -> int:
    """Do the steps, and print a line for each."""
    parser = argparse.ArgumentParser(description="Try dxlrun on emulated ARM, beside this machine.")
    parser.add_argument("root", type=Path, help="folder of the Debian arm64 root")
    parser.add_argument("steps", nargs="*", default=STEPS, help=f"of {STEPS} (default: all)")
    parser.add_argument("--qemu", type=Path, default="/usr/bin/qemu-aarch64-static", help="a static one")
    parser.add_argument("--streams", type=int, default=100_000, help="of the kernel's fuzz")
    parser.add_argument("--runs", type=int, default=40, help="of same_runs.py")
    chosen = parser.parse_args()
    arm, failed = Arm(chosen.root.resolve(), chosen.qemu, chosen.streams, chosen.runs), 0
    for name in chosen.steps:
        began = time.monotonic()
        try:
            text = [line for line in getattr(arm, name)().splitlines() if line.strip()][-1].strip()
        except RuntimeError as error:
            failed, text = 1, f"FAILED: {error}"
        print(f"{name:10} {time.monotonic() - began:6.0f} s  {text}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main())
