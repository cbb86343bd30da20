"""What a chain of three controllers costs in a cycle, beside the same three on their own.

    python tests/bench/chains.py [CYCLES]

A trajectory commands the positions of a PID controller, that one the velocities of another, and the last one
the efforts of 20 servos; all of them move. On their own, each of the three commands servos, and the record
has the references that it follows. All managers run in turn, cycle by cycle, so that what the machine does
meanwhile hits them alike. The time is that of `Manager.update`; `none`: no controller is active.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.channels.events import EventCode, Severity
from dxlrun.clock import VirtualClock
from dxlrun.compile import compile_robot
from dxlrun.control.controllers.manager import Manager
from dxlrun.control.controllers.plugins import load_plugins
from dxlrun.description import read_motion, read_robot
from dxlrun.description.modes import Mode
from dxlrun.plan.loop_plan import ControllerPlan, LoopPlan

JOINTS = 20
PERIOD_NS = 5_000_000
NAMES = ("top", "middle", "bottom")
WARM = 100
"""Cycles that are not counted."""


@dataclass(frozen=True)
class Cost:
    """Median times of `Manager.update`, us."""

    none: float
    alone: tuple[float, float, float]
    chain: float

    @property
    def sum(self) -> float:
        """Of the three on their own: the manager's own part is in it once."""
        return self.none + sum(one - self.none for one in self.alone)

    @property
    def ratio(self) -> float:
        """The chain's time by that of the three on their own."""
        return self.chain / self.sum


class _Silence:
    def emit(self, code: EventCode, severity: Severity, source: str, text: str, data: bytes = b"") -> None:
        if code == EventCode.CONTROLLER_FAULT:
            raise RuntimeError(text)


def robot() -> str:
    joints = [f"j{row}" for row in range(JOINTS)]
    lines = [
        "name: chain",
        "buses:",
        "  main: {port: sim, protocol: 2.0, baud_rate: 4_000_000, return_delay_time: 0 us}",
        "loop: {rate: 100}",
        "joints:",
        *(
            f"  {joint}: {{bus: main, id: {row + 1}, model: XM430-W350, reference: 180 deg, direction: 1}}"
            for row, joint in enumerate(joints)
        ),
        "controllers:",
        f"  top: {{type: joint_trajectory_controller, joints: [{', '.join(joints)}], into: middle}}",
        f"  middle: {{type: pid_controller, joints: [{', '.join(joints)}], reference: position, "
        "command_interface: velocity, gains: {p: 2.0, i: 0.1, d: 0.01}, into: bottom}",
        f"  bottom: {{type: pid_controller, joints: [{', '.join(joints)}], reference: velocity, "
        "command_interface: effort, gains: {p: 0.1, i: 0.1, d: 0.001}}",
    ]
    return "\n".join(lines) + "\n"


def motion() -> str:
    points = [
        f"      - {{time: {10 * at} s, joints: {{"
        + ", ".join(f"j{row}: {{position: {0.01 * (at % 7) * (row + 1):.3f} rad}}" for row in range(JOINTS))
        + "}}"
        for at in range(60)
    ]
    return "\n".join(["name: long", "motions:", "  - controller: top", "    points:", *points]) + "\n"


def plan() -> LoopPlan:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory)
        (path / "robot.yaml").write_text(robot())
        (path / "long.yaml").write_text(motion())
        description = read_robot(path / "robot.yaml", {})
        return compile_robot(description, [read_motion(path / "long.yaml")]).plan.loop


def manager(loop: LoopPlan, active: tuple[str, ...]) -> tuple[Manager, CycleRecord]:
    """Return a manager of which these are active; one alone commands servos."""

    def chosen(one: ControllerPlan) -> ControllerPlan:
        return replace(one, active=one.name in active, into=one.into if len(active) > 1 else ())

    own = replace(
        loop,
        controllers=tuple(map(chosen, loop.controllers)),
        commands=loop.commands if "top" in active else (),
    )
    layout = CycleLayout([joint.name for joint in own.joints], NAMES, own.references)
    record = CycleRecord(layout)
    states = record.states
    states.position[:], states.velocity[:], states.effort[:] = 0.0, 0.0, 0.0
    states.valid[:], states.age_ns[:], record.goals.position[:] = True, 0, 0.0
    mode = {"top": Mode.POSITION, "middle": Mode.VELOCITY}.get(
        active[0] if len(active) == 1 else "", Mode.EFFORT
    )
    states.mode[:] = mode
    found = Manager(own, load_plugins(), record, _Silence(), VirtualClock(0))
    found.configure()
    found.activate(0)
    if len(active) == 1:
        record.reference[:] = 0.1
    return found, record


def measure(cycles: int) -> Cost:
    """Return what each of the managers needs for a cycle."""
    loop = plan()
    cases = [(), *((name,) for name in NAMES), NAMES]
    managers = [manager(loop, case) if case else manager_of_none(loop) for case in cases]
    times: list[list[int]] = [[] for _ in cases]
    now = time.perf_counter_ns
    for cycle in range(WARM + cycles):
        time_ns = cycle * PERIOD_NS
        for (one, record), kept in zip(managers, times, strict=True):
            record.states.position[:] = 1e-3 * np.sin(cycle * 0.01)
            if record.reference.size and one.active in (("middle",), ("bottom",)):
                record.reference[:] = 0.1 + 1e-5 * cycle
            record.wake(cycle, time_ns, 1 + time_ns, PERIOD_NS)
            one.begin()
            begin = now()
            one.update(cycle, time_ns)
            kept.append(now() - begin)
            if one.fault:
                raise RuntimeError(one.fault)
    none, top, middle, bottom, chain = (statistics.median(kept[WARM:]) / 1000 for kept in times)
    return Cost(none, (top, middle, bottom), chain)


def manager_of_none(loop: LoopPlan) -> tuple[Manager, CycleRecord]:
    """Return a manager of which no controller is active."""
    idle = replace(
        loop, controllers=tuple(replace(one, active=False) for one in loop.controllers), commands=()
    )
    record = CycleRecord(CycleLayout([joint.name for joint in idle.joints], NAMES, idle.references))
    found = Manager(idle, load_plugins(), record, _Silence(), VirtualClock(0))
    found.configure()
    found.activate(0)
    return found, record


def main() -> int:
    """Print the medians."""
    cost = measure(int(sys.argv[1]) if len(sys.argv) > 1 else 20_000)
    for name, value in zip(("none", *NAMES), (cost.none, *cost.alone), strict=True):
        print(f"{name:8} {value:8.1f} us")
    print(f"{'sum':8} {cost.sum:8.1f} us")
    print(f"{'chain':8} {cost.chain:8.1f} us, {cost.ratio:.2f} of the sum")
    return 0


if __name__ == "__main__":
    sys.exit(main())
