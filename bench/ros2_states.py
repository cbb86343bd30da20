"""What a ROS program gets of a robot's joint states: rate, losses and age, at 50 Hz and at 1 kHz.

A robot of `robots/` in real time, with its bridge; a foreign program listens by a reliable subscription, then
one by a best-effort subscription. The age of a message is from its stamp to its arrival in that program; what
the robot's log has between the first and the last message, and the program did not get, is lost.

    DXLRUN_ROS2_PYTHON=PYTHON python bench/ros2_states.py [--seconds 30]
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
from mcap.reader import make_reader
from tests.ros2.started import Place, stamp_ns

ROBOTS = {"bioloid_torso": 50, "humanoid_20": 1000}
"""Hz"""
BEFORE_S = 3.0
"""What robot and bridge need to run evenly"""


def main() -> None:
    """Run both robots, listen, and print the figures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=30.0)
    words = parser.parse_args()
    for name, rate in ROBOTS.items():
        with tempfile.TemporaryDirectory() as folder:
            os.environ["XDG_RUNTIME_DIR"] = folder
            measured(Place(Path(folder)), name, rate, words.seconds)


def measured(place: Place, name: str, rate: int, seconds: float) -> None:
    """Print the figures of one robot."""
    try:
        robot = place.robot(name, rate)
        place.bridge(name)
        received = {}
        for reliable in (True, False):
            key = "reliable" if reliable else "best effort"
            listener = place.foreign(key.replace(" ", "_"))
            listener.do("hear", key, "/joint_states", "sensor_msgs/msg/JointState", reliable)
            listener.do("heard", key)
            time.sleep(BEFORE_S)
            since = listener.do("count", key)
            time.sleep(seconds)
            received[key] = listener.do("heard", key, 1, since)
            listener.end()
        robot.end()
    finally:
        place.end()
    with robot.log.open("rb") as stream:
        logged = np.array([one.log_time for *_, one in make_reader(stream).iter_messages(["/joint_states"])])
    for key, heard in received.items():
        stamps = np.array([stamp_ns(one) for one in heard["messages"]])
        lost = np.setdiff1d(logged[(logged >= stamps[0]) & (logged <= stamps[-1])], stamps)
        hz = (len(stamps) - 1) / (stamps[-1] - stamps[0]) * 1e9
        ages = np.percentile((np.array(heard["times_ns"]) - stamps) / 1e6, (50, 99, 100))
        sys.stdout.write(
            f"{name}, {rate} Hz, {key}: {len(stamps)} messages, {hz:.1f} Hz, {len(lost)} of the log's lost, "
            f"age p50 {ages[0]:.2f} ms, p99 {ages[1]:.2f} ms, longest {ages[2]:.2f} ms\n"
        )


if __name__ == "__main__":
    main()
