"""Memory: how much a replay of a long run takes; it must not grow with the log.

A robot runs so many seconds on virtual time with its log, and is replayed by another process, whose largest
resident memory and time are printed.

    python tests/bench/replay_memory.py [ROBOT.yaml] [SECONDS]
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import replay_log

ROBOTS = Path(__file__).parents[2] / "robots"


def replay(log: Path) -> None:
    """Replay a log, and print what it took of this process."""
    begun = time.monotonic()
    report = replay_log(log)
    wall_s = time.monotonic() - begun
    used = resource.getrusage(resource.RUSAGE_SELF)
    print(report.sentence, *report.remarks, report.stopped, sep="\n")
    processor_s = used.ru_utime + used.ru_stime
    print(f"{_peak_mb():.0f} MB at most, {wall_s:.0f} s, {processor_s:.0f} s of processor time")


def _peak_mb() -> float:
    """Return the largest resident memory of this process; that of getrusage has its parent's before exec."""
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def main() -> None:
    """Run and replay."""
    if sys.argv[1:2] == ["--replay"]:
        replay(Path(sys.argv[2]))
        return
    robot = Path(sys.argv[1]) if len(sys.argv) > 1 else ROBOTS / "bioloid_torso.yaml"
    seconds = float(sys.argv[2]) if len(sys.argv) > 2 else 3600.0
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder, "run.mcap")
        motion = ROBOTS / "motions" / "three_parts.yaml"
        play = [motion] if robot.stem == "bioloid_torso" else []
        begun = time.monotonic()
        one = simulated_robot(robot, play=play, duration_s=seconds, log=log)
        one.run()
        size = log.stat().st_size / 1e6
        print(f"{robot.stem}: {one.cycles} cycles, {size:.0f} MB of log in {time.monotonic() - begun:.0f} s")
        subprocess.run([sys.executable, __file__, "--replay", str(log)], check=True)


if __name__ == "__main__":
    main()
