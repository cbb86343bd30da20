"""Monitors of the loop: which are built, and how they act."""

from pathlib import Path
from types import SimpleNamespace
from typing import Self

import pytest
from msgspec.structs import replace
from tests.kit.loops import loop_plan

from dxlrun.channels.cycle import CycleRecord
from dxlrun.control.monitors import build_monitors
from dxlrun.control.monitors.monitor_stage import MonitorStage
from dxlrun.control.monitors.policy_actions import PolicyActions
from dxlrun.features.feature import Feature, S
from dxlrun.features.lost_servos import LostServos
from dxlrun.features.sensors.monitor import NeededSensors
from dxlrun.features.sensors.plan import SensorPlan, encode_sensors
from dxlrun.plan.loop_plan import JointPlan, LoopPlan, SourcePlan
from dxlrun.testing import VirtualRobot, plan_of

ROBOT = Path(__file__).parents[2] / "robots" / "single_joint.yaml"


class Broken:
    """Raises in its first cycle."""

    error: BaseException = ValueError("no such joint")

    @classmethod
    def build(cls, plan: LoopPlan, record: CycleRecord, actions: PolicyActions) -> Self:
        """Return a monitor for every robot."""
        return cls()

    def check_cycle(self, time_ns: int) -> None:
        raise self.error


class Exiting(Broken):
    """Ends the process, as a script does."""

    error = SystemExit(3)


class OneMonitor(Feature, frozen=True, kw_only=False):
    """A feature that has a monitor only."""

    monitor: type[Broken] = Broken

    def stage(self, kind: type[S]) -> S | None:
        found = MonitorStage(self.monitor)
        return found if isinstance(found, kind) else None


@pytest.mark.parametrize(
    ("monitor", "raised"), [(Broken, "ValueError: no such joint"), (Exiting, "SystemExit: 3")]
)
def test_monitor_that_raises_ends_the_run_by_on_fault(monitor, raised: str) -> None:
    plan = plan_of(ROBOT, duration_s=2.0)
    features = (*plan.features, OneMonitor("broken", "", "tests 1", monitor))
    robot = VirtualRobot(replace(plan, loop=replace(plan.loop, features=features)))
    result = robot.run()
    detail = f"the monitor {monitor.__name__} of {__name__} raised {raised}; on_fault: limp"
    assert (result.reason, result.detail) == ("fault", detail)
    assert not any(servo.torque_on for servo in robot.buses[0].servos)


@pytest.mark.parametrize(
    ("on_lost", "built"), [("continue", [LostServos]), ("stop", [LostServos, NeededSensors])]
)
def test_sensors_that_a_run_does_not_need_are_not_monitored(on_lost, built) -> None:
    imu = SensorPlan("imu", "imu", "tests 1", "{}", ("x",), 10_000_000, 50_000_000, on_lost=on_lost)
    source = SourcePlan("imu", "sensor", ("x",))
    plan = loop_plan(
        [JointPlan("a", -1.0, 1.0, None)],
        feature_plans={"sensors": encode_sensors((imu,))},
        sources=(source,),
    )
    found = build_monitors(plan, CycleRecord(plan.layout), None)
    assert [type(one) for one in found] == built


class HeldJoints:
    """Notes which joints a manager has to hold; a gate, too."""

    def __init__(self) -> None:
        self.held: list[tuple[set[int], str]] = []

    def hold_lost(self, rows, until: str) -> tuple[int, ...]:
        self.held.append((set(rows), until))
        return ()

    def ease_in(self, rows) -> None:
        assert rows == ()


def test_controllers_are_held_until_no_policy_holds_them() -> None:
    noted = HeldJoints()
    context = SimpleNamespace(plan=loop_plan([JointPlan("a", -1.0, 1.0, None)]))
    actions = PolicyActions(context, noted, noted)
    first, second = HeldJoints(), HeldJoints()  # two monitors of one class
    for holder, rows in ((first, {0}), (second, {0, 1}), (first, set()), (second, set())):
        actions.hold_controllers(holder, rows, "are cool")  # two monitors may have the same sentence
    assert [rows for rows, _ in noted.held] == [{0}, {0, 1}, {0, 1}, set()]
