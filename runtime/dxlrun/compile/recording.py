"""Recording: how the log is split, and what a trigger keeps, checked against the recorder's memory."""

from __future__ import annotations

from dxlrun.channels.cycle import CycleLayout
from dxlrun.channels.packets import cycle_of_packets
from dxlrun.channels.snapshots import INTERVAL_NS
from dxlrun.compile.problems import RobotFile
from dxlrun.plan.recording_plan import HELD_RECORD, MOST_HELD, RecordingPlan

_LEAST_BYTES, _LEAST_NS = 1_000_000, 1_000_000_000
"""Of a part: each has the robot file and the plan once more."""
_BEFORE_NS, _AFTER_NS = 10_000_000_000, 5_000_000_000


def compile_recording(file: RobotFile, joints: int, controllers: int) -> RecordingPlan:
    """Return what the robot file says about the log of so many joints and controllers.

    What cannot be done becomes a problem.
    """
    written, marks = file.robot.recording, file.marks
    amount = {} if written.split is None else dict([written.split])
    if amount.get("bytes", _LEAST_BYTES) < _LEAST_BYTES or amount.get("ns", _LEAST_NS) < _LEAST_NS:
        file.error(
            marks.value("recording", "split"),
            "parts of a log would be too small: each has the robot file and the plan inside",
            "write 1 MB or 1 s at least",
        )
    if written.trigger is None:
        for key in ("before", "after"):
            if getattr(written, key) is not None:
                file.error(
                    marks.key("recording", key),
                    f"{key} needs a trigger: without one everything is kept",
                    f"write `trigger: fault` beside it, or take {key} out",
                )
        return RecordingPlan(written.directory, amount.get("bytes"), amount.get("ns"))
    before_ns = _BEFORE_NS if written.before is None else written.before
    after_ns = _AFTER_NS if written.after is None else written.after
    most_ns = longest_before_ns(round(1e9 / file.robot.loop.rate), joints, controllers)
    if before_ns > most_ns:
        file.error(
            marks.value("recording", "before" if written.before is not None else "trigger"),
            f"{before_ns / 1e9:g} s before an error take more memory than the recorder has for it, "
            f"{MOST_HELD >> 20} MiB",
            f"write `before: {most_ns // 1_000_000_000} s` or less",
        )
    return RecordingPlan(
        written.directory, amount.get("bytes"), amount.get("ns"), written.trigger, before_ns, after_ns
    )


def longest_before_ns(period_ns: int, joints: int, controllers: int) -> int:
    """Return how long the recorder's memory lasts for cycles and packets of a robot, ns."""
    layout = CycleLayout([f"{joint}" for joint in range(joints)], [f"{one}" for one in range(controllers)])
    held_ns = MOST_HELD // (layout.size + cycle_of_packets(joints) + 2 * HELD_RECORD) * period_ns
    return max(0, held_ns - INTERVAL_NS)  # it reaches back to the snapshots before that
