"""The load on the machine: what it is, that it works, and that nothing of it stays."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from dxlrun.errors import ProcessFault
from dxlrun_lab.stress import Load, Stress, full_load

SMALL = Load(cores=1, memory_processes=2, memory_bytes=1 << 20, directory=tempfile.gettempdir())


def family(process: int) -> set[int]:
    """Return the children and grandchildren of a process."""
    found: set[int] = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            except (OSError, IndexError):
                continue
            if parent == process:
                found |= {int(entry.name)} | family(int(entry.name))
    return found


def alive(process: int) -> bool:
    """Return whether a process still runs; one that ended and waits to be reaped does not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def all_end(processes: set[int], timeout_s: float = 20.0) -> bool:
    limit = time.monotonic() + timeout_s
    while any(map(alive, processes)) and time.monotonic() < limit:
        time.sleep(0.02)
    return not any(map(alive, processes))


def test_the_load_of_the_thesis_is_fitted_to_the_machine() -> None:
    load = full_load()
    assert load.cores == len(os.sched_getaffinity(0))
    assert load.memory_processes == 2
    assert load.memory_bytes <= 2 << 30
    assert load.directory
    assert load.parts[: load.cores] == ("cores",) * load.cores


def test_a_load_says_what_it_is() -> None:
    two = Load(cores=2, memory_processes=2, memory_bytes=2 << 30, directory="/disk")
    assert two.text == "2 busy processes, 2 that allocate 2 GB each, 1 that writes to /disk"
    assert Load(cores=1, memory_processes=2, memory_bytes=0, directory="").text == "1 busy process"
    assert Load(cores=0, memory_processes=0, memory_bytes=0, directory="").text == "nothing"


def test_every_part_is_at_work_and_all_end_with_the_block() -> None:
    before = family(os.getpid())
    with Stress(SMALL) as stress:
        started = family(os.getpid()) - before
        assert len(started) == 1 + len(SMALL.parts)
        assert all(os.sched_getscheduler(one) == os.SCHED_OTHER for one in started)
        time_before = {one: cpu_ticks(one) for one in started}
        limit = time.monotonic() + 20
        while sum(cpu_ticks(one) > time_before[one] for one in started) < 2 and time.monotonic() < limit:
            time.sleep(0.05)
        assert sum(cpu_ticks(one) > time_before[one] for one in started) >= 2
        assert stress.ended() == ()
    assert all_end(started, 0)
    assert stress.ended() == ()


def test_the_memory_is_really_used() -> None:
    size = 96 << 20  # more than the process has without it
    before = family(os.getpid())
    with Stress(Load(cores=0, memory_processes=1, memory_bytes=size, directory="")):
        started = family(os.getpid()) - before
        limit = time.monotonic() + 20
        while (most := max(map(most_resident, started))) < size and time.monotonic() < limit:
            time.sleep(0.02)
    assert most >= size


def most_resident(process: int) -> int:
    """Return the most bytes of memory that a process had at once (proc_pid_status(5), VmHWM)."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    return next(int(line.split()[1]) << 10 for line in lines if line.startswith("VmHWM"))


def cpu_ticks(process: int) -> int:
    """Return the processor time of a process (proc(5), utime + stime)."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return int(fields[11]) + int(fields[12])


def test_all_end_when_the_process_that_entered_the_block_is_killed() -> None:
    source = (
        "import time\nfrom dxlrun_lab.stress import Load, Stress\n"
        f"with Stress({SMALL!r}):\n    print('loaded', flush=True)\n    time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", source], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"loaded\n"
        started = family(parent.pid)
        assert len(started) == 1 + len(SMALL.parts)
        parent.kill()
        assert all_end(started)


def test_a_part_that_is_killed_is_reported() -> None:
    before = family(os.getpid())
    with Stress(Load(cores=1, memory_processes=0, memory_bytes=0, directory="")) as stress:
        (leader,) = {one for one in family(os.getpid()) - before if parent_of(one) == os.getpid()}
        (worker,) = family(leader)
        os.kill(worker, signal.SIGKILL)
        limit = time.monotonic() + 20
        while not stress.ended() and time.monotonic() < limit:
            time.sleep(0.02)
        assert stress.ended() == ("the load became smaller: a busy process ended (SIGKILL)",)


def test_a_load_that_is_killed_as_a_whole_is_reported() -> None:
    before = family(os.getpid())
    with Stress(Load(cores=1, memory_processes=0, memory_bytes=0, directory="")) as stress:
        started = family(os.getpid()) - before
        (leader,) = {one for one in started if parent_of(one) == os.getpid()}
        os.kill(leader, signal.SIGKILL)
        assert all_end(started)
        assert stress.ended() == ("the load ended before the measurement did",)
        assert stress.ended() == ("the load ended before the measurement did",)


def parent_of(process: int) -> int:
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


def test_a_disk_that_cannot_be_written_is_one_sentence_and_nothing_stays(tmp_path: Path) -> None:
    before = family(os.getpid())
    load = Load(cores=1, memory_processes=0, memory_bytes=0, directory=str(tmp_path / "missing"))
    with pytest.raises(ProcessFault) as refused, Stress(load):
        pass
    assert str(refused.value) == (
        "the load did not start: the process that writes to the disk ended (No such file or directory)"
    )
    assert family(os.getpid()) == before
