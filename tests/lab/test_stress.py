"""The load on the machine: that it works, that it is told when it ends, and that nothing of it stays."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tests.kit.awaited import until

from dxlrun.errors import ProcessFault
from dxlrun_lab import stress
from dxlrun_lab.stress import Stress

pytestmark = pytest.mark.long
SMALL = 16 << 20


@pytest.fixture(autouse=True)
def small(monkeypatch, tmp_path):
    monkeypatch.setattr(stress, "MOST_MEMORY", SMALL)
    monkeypatch.setattr(stress, "_DISK", str(tmp_path))
    monkeypatch.setenv("PATH", str(tmp_path))  # no stress-ng


def children(process: int) -> set[int]:
    text = Path(f"/proc/{process}/task/{process}/children").read_text()
    return set(map(int, text.split()))


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def cpu_ticks(process: int) -> int:
    """Return the processor time of a process (proc(5), utime + stime)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def most_resident(process: int) -> int:
    """Return the most bytes of memory that a process had at once (proc_pid_status(5), VmHWM)."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))


def test_two_processes_load_the_machine_and_end_with_the_block(tmp_path):
    before = children(os.getpid())
    with Stress(wanted=False) as load:
        assert (load.text, load.ended(), children(os.getpid())) == ("", (), before)
    with Stress() as load:
        assert load.text == f"1 busy process, 1 allocating 0.016 GB and writing to {tmp_path}"
        started = children(os.getpid()) - before
        assert len(started) == 2
        until(lambda: all(cpu_ticks(one) > 10 for one in started))
        until(lambda: max(map(most_resident, started)) > SMALL)
        assert load.ended() == ()
    assert not any(map(alive, started))
    assert load.ended() == ()


def test_stress_ng_takes_the_place_of_both_where_it_is_installed(tmp_path):
    program = tmp_path / "stress-ng"
    program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/words\nwhile :; do :; done\n')
    program.chmod(0o755)
    cores = len(os.sched_getaffinity(0))
    with Stress() as load:
        assert load.text.startswith(f"stress-ng: {cores} busy process")
        words = tmp_path / "words"
        until(lambda: words.is_file() and words.read_text().endswith("\n"))
        assert words.read_text().split() == [
            "--quiet", "--cpu", str(cores), "--vm", "2", "--vm-bytes", str(SMALL), "--hdd", "1",
            "--temp-path", str(tmp_path),
        ]  # fmt: skip


def test_it_ends_when_the_process_that_entered_the_block_is_killed():
    source = (
        "import time\nfrom dxlrun_lab import stress\n"
        f"stress.MOST_MEMORY = {SMALL}\n"
        "with stress.Stress():\n    print('loaded', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"loaded\n"
        started = children(parent.pid)
        assert started
        parent.kill()
        until(lambda: not any(map(alive, started)))


def test_a_part_that_is_killed_is_reported():
    before = children(os.getpid())
    with Stress() as load:
        os.kill(min(children(os.getpid()) - before), signal.SIGKILL)
        until(lambda: load.ended() == ("the load ended before the measurement",))


def test_a_disk_that_cannot_be_written_is_one_sentence_and_nothing_stays(tmp_path, monkeypatch):
    before = children(os.getpid())
    monkeypatch.setattr(stress, "_DISK", str(tmp_path / "missing"))
    monkeypatch.setattr(stress, "_START_S", 5.0)
    with pytest.raises(ProcessFault, match="the load did not start"), Stress():
        pass
    assert children(os.getpid()) == before
