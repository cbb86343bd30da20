"""What publishing costs: `python tests/bench/topics.py`. No test decides by these figures.

Each line: median and 99th percentile of one `context.publish` into a ring, us, of blocks of COUNT calls.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dxlrun import Floats
from dxlrun.channels import ring
from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.messages import LONGEST_RECORD, MessageRing, message_capacity, usual_message
from dxlrun.control.controllers.topics import TopicLog
from dxlrun.messages import Float64, Header, JointState, Odometry

JOINTS = tuple(f"joint_{index}" for index in range(20))
BLOCKS = 200
COUNT = 50


@dataclass
class State:
    """A controller's state: four rows of joints."""

    header: Header
    reference: Floats
    feedback: Floats
    error: Floats
    output: Floats
    progress: float


def measured(publish: Callable[[], None]) -> tuple[float, float]:
    """Return median and 99th percentile of the time of one call, us."""
    times = []
    for _ in range(BLOCKS):
        began = time.perf_counter_ns()
        for _ in range(COUNT):
            publish()
        times.append((time.perf_counter_ns() - began) / COUNT / 1000)
    return statistics.median(times), statistics.quantiles(times, n=100)[-1]


def main() -> None:
    """Measure messages of several sizes."""
    capacity = message_capacity(1000 * usual_message(len(JOINTS)))
    memory = ring.create("messages", capacity, LONGEST_RECORD)
    record = CycleRecord(CycleLayout(JOINTS, ["wave"]))
    rows = [np.ones(len(JOINTS)) for _ in range(4)]
    log = TopicLog(record, MessageRing(ring.RingWriter(memory)), 1_700_000_000_000_000_000)
    kinds = {"number": Float64, "joints": JointState, "odometry": Odometry, "state": State}
    topics = log.of_controller("wave", 1)
    topics.open(kinds, "bench 1", JOINTS)
    messages: dict[str, object] = {
        "number": Float64(1.0),
        "joints": JointState(Header(), JOINTS, *rows[:3]),
        "odometry": Odometry(child_frame_id="base"),
        "state": State(Header(), *rows, 0.5),
    }
    print(f"ring: {capacity / 2**20:.1f} MiB for one topic of {len(JOINTS)} joints at 1 kHz")
    for name, message in messages.items():
        cycle = 0

        def publish(name: str = name, message: object = message) -> None:
            nonlocal cycle
            cycle += 1
            record.wake(cycle, 0, 1 + cycle * 1_000_000, 1_000_000)
            topics.publish(name, message)

        median, high = measured(publish)
        print(f"{name:10} {median:6.2f} us, 99 % {high:6.2f} us")


if __name__ == "__main__":
    main()
