"""A robot file on virtual time: clients ask at times, faults happen, the shafts of all joints are sampled."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from tests.kit.stories import Clients, replayed
from tests.kit.wire import values_written

from dxlrun.channels.answers import Answer
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.cycle import Floats
from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.servo.simulated_servo import SimulatedServo

MS = 1_000_000


class SampledRun:
    """A run. Times are ms of the simulated buses, but those of clients since the loop began.

    Angles are those of servos, rad, from half a turn on.
    """

    def __init__(self, folder: Path, text: str, seconds: float) -> None:
        self.file, self.path = folder / "robot.yaml", folder / "run.mcap"
        self.file.write_text(text)
        self.path.unlink(missing_ok=True)
        self.robot: VirtualRobot = simulated_robot(self.file, duration_s=seconds, log=self.path)
        self.plan, self.bus = self.robot.plan, self.robot.buses[0]
        self.servos: dict[str, SimulatedServo] = {
            servo.joint: bus.servo(servo.servo_id)
            for bus, planned in zip(self.robot.buses, self.plan.buses, strict=True)
            for servo in planned.servos
        }
        self._times: list[int] = []
        self._angles: list[list[float]] = []
        self._clients = Clients(self.robot, {})
        self._asked = 0
        self._sample()

    def _sample(self) -> None:
        self._times.append(self.bus.now_ns)
        self._angles.append([servo.shaft.angle - math.pi for servo in self.servos.values()])
        self.bus.at(self.bus.now_ns + self.plan.loop.period_ns, self._sample)

    def at(self, ms: float, do: Callable[[], object]) -> None:
        """Let something happen at a time."""
        self.bus.at(round(ms * MS), do)

    def ask(self, ms: float, *commands: CommandMessage) -> int:
        """Let a client ask at a time; return the number of the last command."""
        numbered = [replace(one, number=self._asked + at) for at, one in enumerate(commands, 1)]
        self._asked += len(commands)
        cycle = round(ms * MS) // self.plan.loop.period_ns
        earlier = self._clients.asked.get(cycle, ())
        self._clients.asked = {**self._clients.asked, cycle: [*earlier, *numbered]}
        return self._asked

    def fault(self, *lines: str) -> None:
        """Let faults happen, as `dxlrun sim` takes them."""
        FaultScript([parse_fault(line) for line in lines]).attach(self.robot.buses)

    def run(self, reason: str = "ended") -> Log:
        """Run, and replay a run to its end without a difference."""
        result = self.robot.run()
        assert result.reason == reason, result
        return replayed(self.path) if reason == "ended" else read_log(self.path)

    def answer(self, number: int) -> Answer:
        return self._clients.answers[number]

    def shaft(self, joint: str, from_ms: float = 0.0, to_ms: float = math.inf) -> Floats:
        """Return the angles of a joint's servo in a time; one each period."""
        row = [*self.servos].index(joint)
        times = np.array(self._times) / MS
        return np.array(self._angles)[(from_ms <= times) & (times < to_ms), row]

    def goals(self, joint: str, address: int, size: int) -> list[tuple[float, int]]:
        """Return the values of an item that a servo of the first bus was sent: ms and signed number."""
        entries, bus = self.robot.ledger.entries, self.plan.buses[0]
        found = values_written(entries, bus, address, size, signed=size == 4)
        return [(t_ns / MS, value) for t_ns, one, value in found if one == self.servos[joint].servo_id]
