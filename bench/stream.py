"""Stream: what a listener of a robot at 1 kHz misses, how old its messages are, and what the loop notices.

robots/humanoid_20.yaml (20 joints, 1 kHz, four simulated buses) in real time, with its log: at first without
a listener, then with one that takes every message of a topic. The age of a message is from the wake-up of its
cycle to its arrival in this process; a cycle's time is that from its wake-up until its goals were sent, as
the log has it.

    python bench/stream.py [--seconds 60] [--topic /joint_states]
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import dxlrun
from dxlrun.log.log_reader import read_log

ROBOT = Path(__file__).parents[1] / "robots" / "humanoid_20.yaml"
BEFORE_S = 3.0
"""What the robot needs to stand at 1 kHz."""


def main() -> None:
    """Run the robot, listen, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--topic", default="/joint_states")
    words = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        command = [Path(sys.executable).with_name("dxlrun"), ROBOT, "--duration", str(3 * words.seconds + 60)]
        with subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL) as process:
            while "humanoid_20" not in dxlrun.running():
                time.sleep(0.05)
            time.sleep(BEFORE_S)
            with dxlrun.connect("humanoid_20", "bench") as robot:
                log = Path(str(robot.info()["log"]))
                alone = robot.states().cycle
                time.sleep(words.seconds)
                begin = robot.states().cycle
                lost, ages_ns = listened(robot, words.topic, words.seconds)
                end = robot.states().cycle
                robot.stop()
            process.wait()
        cycles = read_log(log).cycles
    show("without a listener", cycles, alone, begin)
    show("with a listener", cycles, begin, end)
    p50, p99, p100 = np.percentile(ages_ns, (50, 99, 100)) / 1e6
    sys.stdout.write(
        f"{words.topic}: {len(ages_ns)} messages, {lost} lost, "
        f"age p50 {p50:.2f} ms, p99 {p99:.2f} ms, longest {p100:.2f} ms\n"
    )


def listened(robot: dxlrun.RemoteRobot, topic: str, seconds: float) -> tuple[int, list[int]]:
    """Return how many messages were lost, and the age of each other one, ns."""
    lost, ages_ns, until = 0, list[int](), time.monotonic() + seconds
    gc.disable()
    for message in robot.listen(topic):
        now_ns = time.monotonic_ns()
        lost += message.lost
        ages_ns.append(now_ns - message.time_ns)
        if now_ns > until * 1e9:
            break
    return lost, ages_ns[1:]  # the first is what was there before


def show(what: str, cycles: np.ndarray, first: int, last: int) -> None:
    """Print how long the cycles of a time took, and how many were skipped."""
    rows = cycles[(cycles["cycle"] >= first) & (cycles["cycle"] < last)]
    took = np.percentile(rows["written_ns"] - rows["woken_ns"], (50, 99)) / 1e3
    late = np.percentile(rows["woken_ns"] - rows["scheduled_ns"], 99) / 1e3
    sys.stdout.write(
        f"{what:20}{len(rows)} cycles, {rows['skipped'].sum()} skipped, "
        f"a cycle p50 {took[0]:.0f} us, p99 {took[1]:.0f} us, late p99 {late:.0f} us\n"
    )


if __name__ == "__main__":
    main()
