"""Whole robots on virtual time, steered by requests at times (`VirtualRun`) or by code (`DrivenRobot`).

Faults, hands and samples of shafts have times too. The texts of `told_stories.py` and `steering.py` run here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from tests.kit.wire import values_written

from dxlrun import RemoteRobot
from dxlrun.channels.answers import Acceptance, Answer, Completion
from dxlrun.channels.commands import CommandMessage, QueueInbox
from dxlrun.channels.cycle import Floats
from dxlrun.channels.event_records import EventCode
from dxlrun.channels.ring import Payload, RecordKind
from dxlrun.control.controllers.plugin_loading import PlugIns
from dxlrun.log.log_reader import Log, read_log
from dxlrun.plan.robot_plan import Plan
from dxlrun.remote.preparation import Preparation
from dxlrun.testing import VirtualRobot, plan_of
from dxlrun.tooling.runs import VirtualLink
from dxlrun_analysis.replay import ReplayDifference, ReplayReport, Setting, replay_log
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlwire.control_table import find_table

MS = 1_000_000
Asked = Mapping[int, Sequence[CommandMessage]]
"""Commands by the cycle that takes them."""


def ask(kind: str, data: object = None) -> CommandMessage:
    return CommandMessage(0, "", kind, b"" if data is None else msgspec.json.encode(data), "anna")


def send(controller: str, kind: str, *numbers: float, lease_ns: int = 0) -> CommandMessage:
    """Return a command for a controller, as it was prepared."""
    return CommandMessage(0, controller, kind, np.array(numbers).tobytes(), "anna", lease_ns)


def switch(activate: Sequence[str] = (), deactivate: Sequence[str] = ()) -> CommandMessage:
    return ask("switch", {"activate": activate, "deactivate": deactivate})


def rate(hz: float) -> CommandMessage:
    return ask("rate", {"rate": hz})


def torque(joints: Sequence[str], *, on: bool, release: bool = False) -> CommandMessage:
    return ask("torque", {"joints": joints, "on": on, "release": release})


class Clients(QueueInbox):
    """Asks in the cycle that is written, or in the next one where that is skipped; each is answered once."""

    def __init__(self, run: VirtualRun, asked: Asked) -> None:
        super().__init__()
        self.count, self._run, self._last = 0, run, -1
        self.asked = {cycle: [*map(self.numbered, asked[cycle])] for cycle in sorted(asked)}

    def numbered(self, command: CommandMessage) -> CommandMessage:
        self.count += 1
        return replace(command, number=self.count)

    def drain_commands(self) -> Sequence[CommandMessage]:
        self._run.begin_cycle()
        cycle = self._run.record.cycle
        for one in range(self._last + 1, cycle + 1):
            self.waiting.extend(self.asked.get(one, ()))
        self._last = cycle
        return super().drain_commands()

    def answer_command(self, number: int, answer: Answer) -> None:
        before = self.answers.get(number)
        assert before is None or isinstance(before, Acceptance), f"{number} is answered twice: {answer}"
        super().answer_command(number, answer)


class VirtualRun(VirtualRobot):
    """A robot file or plan with clients and faults. Times are ms of the simulated buses; those of requests
    begin with the loop."""

    def __init__(
        self,
        robot: Path | Plan,
        log: Path | None = None,
        asked: Asked = MappingProxyType({}),
        *,
        plugins: PlugIns | None = None,
        watch: Callable[[RecordKind, Payload], None] | None = None,
        **planned: Any,
    ) -> None:
        """`planned`: options of `plan_of`, such as `duration_s`."""
        plan = robot if isinstance(robot, Plan) else plan_of(robot, **planned)
        if log is not None:
            log.unlink(missing_ok=True)
        inbox = Clients(self, asked)
        super().__init__(plan, plugins, log=log, watch=watch, inbox=inbox)
        self.inbox, self.path = inbox, log
        placed = [
            (servo.joint, bus.servo(servo.servo_id))
            for bus, planned_bus in zip(self.buses, plan.buses, strict=True)
            for servo in planned_bus.servos
        ]
        self.servos: dict[str, SimulatedServo] = dict(placed)
        """Servo of each joint, by name; the last one of a joint with several servos."""
        self.rows = {joint.name: row for row, joint in enumerate(plan.loop.joints)}
        self._times: list[float] = []
        self._angles: dict[SimulatedServo, list[float]] = {}

    @classmethod
    def of_text(cls, folder: Path, text: str, duration_s: float | None = None, **more: Any) -> VirtualRun:
        """Return the run of a robot file that is written into a folder, where its log is, too."""
        (folder / "robot.yaml").write_text(text)
        return cls(folder / "robot.yaml", folder / "run.mcap", duration_s=duration_s, **more)

    # What happens

    def begin_cycle(self) -> None:
        """Do something in each cycle, before its requests are taken."""

    @property
    def now_ms(self) -> float:
        return self.clock.now_ns() / MS

    def at(self, ms: float, do: Callable[[], object]) -> None:
        """Let something happen at a time."""
        self.buses[0].at(round(ms * MS), do)

    def ask(self, ms: float, *commands: CommandMessage) -> int:
        """Let a client ask in the first cycle at or after a time; return the number of the last command."""
        cycle = math.ceil(round(ms * MS) / self.plan.loop.period_ns)
        self.inbox.asked.setdefault(cycle, []).extend(map(self.inbox.numbered, commands))
        return self.inbox.count

    def post(self, command: CommandMessage) -> int:
        """Let a client ask now; return the number of the command."""
        self.inbox.waiting.append(self.inbox.numbered(command))
        return self.inbox.count

    def post_at(self, ms: float, command: CommandMessage) -> int:
        """Let a client ask at a time of the buses, while the robot starts too; return its number."""
        numbered = self.inbox.numbered(command)
        self.at(ms, partial(self.inbox.waiting.append, numbered))
        return numbered.number

    @cached_property
    def door(self) -> Preparation:
        """The gateway's checks."""
        return Preparation.from_plan(self.plan)

    def prepared(
        self, controller: str, kind: str, fields: Mapping[str, object], lease_s: float = 0.0
    ) -> CommandMessage:
        """Return a command for a controller, prepared from what a client sends, as by the gateway."""
        plan = next(one for one in self.robot.manager.plans if one.name == controller)
        found = self.door.command(plan, kind, json.dumps(fields).encode())
        lease_ns = round(lease_s * 1e9)
        return CommandMessage(0, controller, kind, found.data, "anna", lease_ns, found.request)

    def fault(self, *lines: str) -> None:
        """Let faults happen, as `dxlrun sim` takes them."""
        FaultScript([*map(parse_fault, lines)]).attach(self.buses)

    def silence(self, servos: Iterable[int], begin_ms: float, end_ms: float) -> None:
        """Let servos of the first bus be silent for a time."""
        for servo in map(self.buses[0].servo, servos):
            self.at(begin_ms, servo.silence)
            self.at(end_ms, partial(servo.silence, False))

    def command(
        self, ms: float, controller: str, kind: str, fields: Mapping[str, object], lease_s: float = 0.0
    ) -> int:
        """Let a client command a controller at a time."""
        return self.ask(ms, self.prepared(controller, kind, fields, lease_s))

    def sample(
        self,
        servos: Iterable[SimulatedServo],
        every_ms: float,
        begin_ms: float = 0.0,
        end_ms: float = math.inf,
    ) -> None:
        """Sample the angles of shafts in a time, which `shaft` returns; called once."""
        angles = [(servo, self._angles.setdefault(servo, [])) for servo in servos]

        def look(ms: float) -> None:
            if ms >= end_ms:
                return
            self._times.append(ms)
            for servo, found in angles:
                servo.advance_to(self.buses[0].now_ns)
                found.append(servo.shaft_angle)
            self.at(ms + every_ms, partial(look, ms + every_ms))

        self.at(begin_ms, partial(look, begin_ms))

    # What came of it

    def finish(self) -> Log:
        """Run to the end of the plan, and replay the run without a difference; return the log."""
        path = self.ended()
        assert self.failures == ()
        return replayed(path)

    def ended(self) -> Path:
        """Run to the end of the plan; return the path of the log."""
        path = self.logged()
        assert self.result is not None
        assert (self.result.reason, self.result.detail) == ("ended", "")
        return path

    def logged(self) -> Path:
        """Run, however it ends; return the path of the log."""
        self.run()
        assert self.path is not None
        return self.path

    def answer(self, number: int) -> Answer:
        return self.inbox.answers[number]

    def require_done(self) -> None:
        """Check that every request was done."""
        done = [number for number, one in self.inbox.answers.items() if isinstance(one, Completion)]
        assert len(done) == self.inbox.count, self.inbox.answers

    def servo(self, servo_id: int) -> SimulatedServo:
        """Return the servo of an ID, on whichever bus it is."""
        return next(one for bus in self.buses for one in bus.servos if one.servo_id == servo_id)

    def shaft(self, servo: SimulatedServo, from_ms: float = 0.0) -> Floats:
        """Return the sampled angles of a shaft since a time, rad from raw 0."""
        return np.array(self._angles[servo])[np.array(self._times) >= from_ms]

    def sent(self, servo_id: int, name: str) -> list[tuple[float, int]]:
        """Return the values of an item that a servo was sent, by the ledger, each with its time in ms."""
        found = []
        for bus in self.plan.buses:
            for servo in (one for one in bus.servos if one.servo_id == servo_id):
                item = find_table(servo.model, bus.protocol).items[name]
                place = {"address": item.address, "size": item.size, "signed": item.signed}
                written = values_written(self.ledger.entries, bus, **place)
                found += [(t_ns / MS, value) for t_ns, one, value in written if one == servo_id]
        return found


class DrivenRobot:
    """A robot file whose client does something each 20 ms."""

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


def source_states(log: Log) -> dict[str, NDArray[np.float64]]:
    """Return the values of each state of a sensor, a device or a controller, cycle by cycle: `imu/x`."""
    named = [f"{source}/{one}" for source, states in log.header.sources.items() for one in states]
    return dict(zip(named, log.cycles["source_state"].T, strict=True))


def replayed(path: Path) -> Log:
    """Return a log; its replay compares every cycle and finds no difference."""
    log, report = read_log(path), replay_log(path)
    assert (report.compared, report.different, report.first) == (len(log.cycles), 0, None)
    assert (report.fault, report.stopped, report.remarks) == ("", "", ())
    assert log.complete
    return log


def differing(path: Path, *settings: str) -> tuple[ReplayReport, ReplayDifference]:
    """Return the report of a replay, with other parameters, and the first difference, which there must be."""
    report = replay_log(path, [Setting.parse(text) for text in settings])
    assert not report.same
    assert report.first is not None
    return report, report.first
