"""Send latency: time from a Python client's command to the robot's answer, and where it passes.

A robot of simulated servos runs in real time, and one client sends commands at random times. The loop
executes commands once a period, after it has read the servos, so that half of the commands wait at least half
a period for it, and one in a hundred a whole period. The rest is client, gateway and operating system: about
2 ms of processor time.

The wait remains, although a command could be executed as soon as it arrives. Activation, halt and `resume`
decide on the positions just read; older ones would move a joint back. A controller's `on_command` may take
long, so it must not run just before a read. A replay, also of an older log, executes a command at the same
place of its cycle. The servos get the new goal by the same write in either case.

    python bench/send_latency.py [--robot robots/bioloid_torso.yaml] [--commands 500]
"""

from __future__ import annotations

import argparse
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

import dxlrun
from dxlrun.log.log_reader import read_log

DXLRUN = Path(sys.executable).with_name("dxlrun")
ROBOT = Path(__file__).parents[1] / "robots" / "bioloid_torso.yaml"
COMMAND = ("head", "posvel", {"positions": [0.1, 0.0], "velocities": [1.0, 1.0]})
START_S = 30.0


def connected() -> dxlrun.RemoteRobot:
    """Return the connection to the robot, when it can be steered."""
    give_up = time.monotonic() + START_S
    while True:
        try:
            return dxlrun.connect()
        except dxlrun.DxlrunError:
            if time.monotonic() > give_up:
                raise
            time.sleep(0.1)


def measured(robot: Path, commands: int, folder: str) -> list[tuple[int, int, int]]:
    """Return the cycle of each command, and the times when it was sent and answered, ns."""
    run = subprocess.Popen([DXLRUN, robot], cwd=folder, stdout=subprocess.DEVNULL)
    found = []
    try:
        with connected() as remote:
            for _ in range(commands):
                time.sleep(random.uniform(0.02, 0.06))
                sent = time.monotonic_ns()
                cycle = remote.send(*COMMAND).cycle
                found.append((cycle, sent, time.monotonic_ns()))
    finally:
        run.terminate()
        run.wait()
    return found


def main() -> None:
    """Print the percentiles."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--robot", type=Path, default=ROBOT)
    parser.add_argument("--commands", type=int, default=500)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_RUNTIME_DIR"] = folder  # of the sockets, so that no other robot is found
        found = measured(options.robot.absolute(), options.commands, folder)
        log = read_log(next(Path(folder).rglob("*.mcap")))
    read_ns = dict(zip(log.cycles["cycle"].tolist(), log.cycles["read_ns"].tolist(), strict=True))
    rows: dict[str, list[float]] = {
        "from sending to the answer": [],
        "from sending to its execution": [],
        "from there to the answer": [],
    }
    for cycle, sent, answered in found:
        times = (answered - sent, read_ns[cycle] - sent, answered - read_ns[cycle])
        for row, each_ns in zip(rows.values(), times, strict=True):
            row.append(each_ns * 1e-6)
    print(f"{options.robot.name}: {len(found)} commands, period {log.period_ns * 1e-6:.1f} ms")
    for name, row in rows.items():
        p50, p99 = np.percentile(row, (50, 99))
        print(f"  {name:29} p50 {p50:5.1f} ms   p99 {p99:5.1f} ms")


if __name__ == "__main__":
    main()
