"""Every property draws the same examples at each run; a random search is asked for by its profile.

A find of a fixed run repeats itself: run the test again. A random search prints how to repeat its find:

    python -m pytest --hypothesis-profile=search tests/description
"""

from __future__ import annotations

import gc
import os
import subprocess
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import settings

settings.register_profile("fixed", derandomize=True, print_blob=True)
settings.register_profile("search", derandomize=False, print_blob=True, max_examples=2000)
settings.load_profile("fixed")
gc.set_threshold(50_000, 20, 20)  # as in `dxlrun`: the many tests that are collected are no garbage


LONG = (
    "run/test_exits.py",
    "run/test_grants.py",
    "run/test_new_log.py",
    "run/test_policy_ends.py",
    "run/test_unplugs.py",
    "cli/test_sim.py",
    "experiments/characterize/test_known_servos.py",
    "experiments/guided/test_live.py",
    "experiments/identify/test_recovery.py",
    "experiments/sweep/test_sweep.py",
)
"""Runs through all processes, and experiments: some seconds each, of which CI runs a sample."""
SHARE, SEED = int(os.environ.get("DXLRUN_LONG", "4")), os.environ.get("DXLRUN_LONG_SEED", "16")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out long tests that are not in the sample: one in `DXLRUN_LONG` is, 1 runs them all."""

    def sampled(item: pytest.Item) -> bool:
        long = item.path.as_posix().endswith(LONG)
        return not long or zlib.crc32(f"{SEED} {item.nodeid}".encode()) % SHARE == 0

    left_out = [item for item in items if not sampled(item)]
    if left_out and len({item.path for item in items}) > 1:  # a file that is named is run as a whole
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if sampled(item)]


def pytest_collection_finish() -> None:
    """Take the tests out of the collector's sight: a full collection would look at them all again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def _no_state_of_a_user(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Let controllers keep what they learn in a directory of the tests, also those of processes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="session")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A key and its certificate, which is its own authority: for clusters of Dask."""
    path = tmp_path_factory.mktemp("certificate") / "own.pem"
    words = "openssl req -x509 -newkey rsa:2048 -nodes -subj /CN=own -keyout own.pem -out own.crt"
    subprocess.run(words.split(), check=True, capture_output=True, cwd=path.parent)
    path.write_text(path.read_text() + (path.parent / "own.crt").read_text())
    return path


class Listening(NamedTuple):
    """What a process and its descendants listen on."""

    network: list[str]
    """Addresses of TCP and UDP, as /proc/net has them"""
    unix: list[str]
    """Paths; those of abstract sockets, which have no mode, begin with @"""


def _with_descendants(pid: int) -> Iterator[int]:
    yield pid
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from _with_descendants(int(child))


def listening(pid: int) -> Listening:
    """Return what a process and its descendants listen on, from /proc/PID/fd and /proc/net (proc(5))."""
    inodes = set()
    for one in _with_descendants(pid):
        with suppress(OSError):
            for link in Path(f"/proc/{one}/fd").iterdir():
                with suppress(OSError):
                    inodes.add(os.readlink(link).removeprefix("socket:[").removesuffix("]"))
    network, unix = [], []
    for name in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]:
            words = line.split()
            if words[9] in inodes and (words[3] == "0A" or name.startswith("udp")):
                network.append(f"{name} {words[1]}")
    for line in Path("/proc/net/unix").read_text().splitlines()[1:]:
        words = line.split()
        if words[6] in inodes and int(words[3], 16) & 0x10000:  # __SO_ACCEPTCON
            unix.append(words[7] if len(words) > 7 else "")
    return Listening(network, unix)


@pytest.fixture(name="listening")
def _listening() -> Callable[[int], Listening]:
    return listening


@pytest.fixture
def no_memory_left(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Close the descriptors of shared memory that a test leaves open: a process has some hundred of them.

    Only those that were made here: a mapping has a descriptor of its own, which it closes itself.
    """
    made: list[tuple[int, int]] = []
    create = os.memfd_create

    def recorded(name: str, flags: int = os.MFD_CLOEXEC) -> int:
        descriptor = create(name, flags)
        made.append((descriptor, os.fstat(descriptor).st_ino))
        return descriptor

    monkeypatch.setattr(os, "memfd_create", recorded)
    yield
    for descriptor, inode in made:
        with suppress(OSError):  # the test has closed it
            if os.fstat(descriptor).st_ino == inode:
                os.close(descriptor)
