"""A robot on virtual time whose client does something each 20 ms, and the goals that its servos were sent."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from tests.kit.wire import values_written

from dxlrun import RemoteRobot
from dxlrun.channels.event_records import EventCode
from dxlrun.plan.robot_plan import Plan
from dxlrun.testing import plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlsim.bus.ledger import LedgerEntry


class DrivenRobot:
    """A robot file on virtual time, whose client does something each 20 ms."""

    def __init__(self, robot: Path, duration_s: float, arguments: Mapping[str, str]) -> None:
        self.link = VirtualLink(plan_of(robot, arguments=arguments, duration_s=duration_s))
        self.virtual = self.link.simulated

    def run(self, begin: Callable[[RemoteRobot], Callable[[float], object]]) -> None:
        """Run; `begin` gets the client in the first cycle, and returns what is called from then on."""
        with RemoteRobot("driven", self.link) as robot:
            tick = begin(robot)
            while self.link.alive:
                due_s = self.link.now_s + 0.02
                tick(self.link.now_s)
                while self.link.alive and self.link.now_s < due_s - 1e-6:
                    self.link.run_cycle()
        result = self.virtual.result
        assert result is not None
        assert (result.reason, result.detail) == ("ended", ""), result
        assert not [event for event in self.link.new()[1] if event.code == EventCode.COMMAND_REFUSED]


def changes(
    entries: Iterable[LedgerEntry], plan: Plan, address: int, size: int = 4
) -> dict[int, list[tuple[float, int]]]:
    """Return what was written into an item, by servo ID: time (s) and value, as often as it changed."""
    kept = tuple(entries)
    found: dict[int, list[tuple[float, int]]] = {}
    for bus in plan.buses:
        for t_ns, servo, value in values_written(kept, bus, address, size, signed=True):
            known = found.setdefault(servo, [])
            if not known or known[-1][1] != value:
                known.append((t_ns * 1e-9, value))
    return found
