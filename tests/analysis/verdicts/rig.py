"""Robots of eight joints on virtual time, their motion, and the places where a fault is put in.

The log of a run has names of real adapters: remedies for simulated ones may omit the hardware.
"""

import itertools
import json
import math
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import pytest
from msgspec.structs import replace
from tests.kit.bus_ports import BusPorts
from tests.kit.line_faults import change_replies, watch_instructions
from tests.kit.virtual_run import VirtualRun, ask

from dxlrun.run import virtual_run
from dxlrun.testing import Log, read_log
from dxlsim.bus.simulated_bus import DisturbedReply, PacketFault, SimulatedBus
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlsim.wire.compiled_line import group_read
from dxlwire.clock import VirtualClock
from dxlwire.wire import protocol1, protocol2

MS, S = 1_000_000, 1_000_000_000
HEAD = ("head_yaw", "head_pitch")
LEFT = ("left_shoulder", "left_elbow", "left_knee")
RIGHT = ("right_shoulder", "right_elbow", "right_knee")
JOINTS = (*HEAD, *LEFT, *RIGHT)
Spec = dict[str, Any]


@dataclass(frozen=True)
class Robot:
    """How eight joints are driven."""

    name: str
    protocol: float
    rate: int
    models: tuple[str, str]  # of most joints, and of the knees
    buses: dict[str, tuple[str, ...]]  # joints in the order of their IDs
    first_id: int = 1
    return_delay: str = "0 us"

    @property
    def spec(self) -> Spec:
        """The robot file."""
        middle = "150 deg" if self.models[0].startswith("AX") else "180 deg"
        placed = [(bus, name) for bus, names in self.buses.items() for name in names]
        joints = {
            name: {
                "bus": bus,
                "id": number,
                "model": self.models["knee" in name],
                "reference": middle,
                "direction": -1 if name.startswith("right") else 1,
                "limits": {"position": ["-120 deg", "120 deg"]},
                "simulation": {"inertia": "0.001 kg m^2", "friction": "0.005 Nm"},
            }
            for number, (bus, name) in enumerate(placed, self.first_id)
        }
        bus_entry = {
            "port": "${port}",
            "protocol": self.protocol,
            "baud_rate": 1_000_000,
            "adapter": {"latency": "0 ms"},
            "return_delay_time": self.return_delay,
        }
        return {
            "name": self.name,
            "arguments": {"port": {"default": "sim"}},
            "buses": {bus: dict(bus_entry) for bus in self.buses},
            "loop": {"rate": self.rate},
            "joints": joints,
            "controllers": {
                "joint_state_broadcaster": {"type": "joint_state_broadcaster"},
                "body": {"type": "joint_trajectory_controller", "joints": list(JOINTS)},
            },
        }


MX, X = ("MX-28", "MX-64"), ("XM430-W350", "XM540-W270")
TWO = {"left": (*LEFT, "head_yaw"), "right": (*RIGHT, "head_pitch")}
THREE = {"head": HEAD, "left_leg": LEFT, "right_leg": RIGHT}
ROBOTS = {
    robot.name: robot
    for robot in (
        Robot("mx_bulk", 1.0, 100, MX, {"main": JOINTS}),
        Robot("mx_two", 1.0, 125, MX, TWO),
        Robot("ax_single", 1.0, 50, ("AX-12A", "AX-12A"), {"main": (*LEFT, *RIGHT, *HEAD)}, 1, "100 us"),
        Robot("x_fast", 2.0, 100, X, {"main": (*RIGHT, *HEAD, *LEFT)}, 11),
        Robot("x_three", 2.0, 200, ("XM430-W350", "XM430-W350"), THREE, 21),
        Robot("x_sync", 2.0, 80, ("2XL430-W250", "2XL430-W250"), {"main": (*LEFT, *HEAD, *RIGHT)}, 31),
    )
}
"""MX read by bulk reads, on one and two buses; AX by single reads; X by fast sync reads, on one and three
buses; 2XL by plain sync reads, as they know no fast ones."""


class Story:
    """One run before it begins: what a case changes of the robot, and what it injects."""

    def __init__(self, robot: Robot, seed: str, directory: Path) -> None:
        self.kind = robot
        self.spec = robot.spec
        self.random = Random(f"{robot.name} {seed}")
        self.directory = directory
        self.duration_s = 6.0
        self.requests: list[tuple[float, str, Spec]] = []
        self.evidence: Counter[str] = Counter()
        """What really happened, by kind; a case that left nothing here is worthless."""
        self.checks: list[Callable[[Log], None]] = []
        self.motion: Spec | None = self.swing()
        self.prepared: list[Callable[[], object]] = []
        """Called once the robot is built: there are buses and servos then."""
        self.virtual: VirtualRun
        self.numbers = itertools.count()
        """Numbers what happens, for a case that counts something"""
        self.ports_in_python = False
        """Whether buses or clock are changed in ways that compiled ports do not see"""
        self.moments: list[tuple[float, float]] = []
        """Begin and end of what happens at some times only"""

    def swing(self, amplitude: float = 0.4, hertz: float = 0.35, own: dict[str, str] | None = None) -> Spec:
        """Return a motion in which each joint swings in its own way, or by a formula in `own`."""
        formulas = {}
        for name in self.spec["controllers"]["body"]["joints"]:
            a = amplitude * self.random.uniform(0.6, 1.0)
            w = math.tau * hertz * self.random.uniform(0.7, 1.3)
            formulas[name] = {"position": (own or {}).get(name, f"{a:.3f} * sin({w:.3f} * t)")}
        part = {"controller": "body", "duration": f"{self.duration_s - 2:g} s", "samples": 200}
        return {"name": "swing", "motions": [part | {"joints": formulas}]}

    def happens(self, percent: float) -> bool:
        """Throw dice."""
        return self.random.random() < percent / 100

    # When

    def at(self, t_s: float, action: Callable[[], object], joint: str | int = 0) -> None:
        """Call something at a time, on the bus of a joint, or on one by its number."""
        self.prepared.append(lambda: self.bus(joint).at(round(t_s * S), lambda: (action(), None)[1]))

    def every(self, period_s: float, since_s: float, action: Callable[[float], object], joint: str | int = 0):
        """Call something again and again, with the time in s, from a time on."""

        def again() -> None:
            bus = self.bus(joint)
            action(bus.now_ns / S)
            bus.at(bus.now_ns + round(period_s * S), again)

        self.at(since_s, again, joint)

    def fault(self, line: str, bus: str | int) -> None:
        """Inject a fault of the simulation, and prove that it happened."""

        def inject() -> None:
            script = FaultScript((parse_fault(f"{line} bus={self.bus(bus).name}"),), 5)
            script.attach(self.virtual.buses)
            self.checks.append(lambda log: self.evidence.update({line: int(not script.waiting)}))

        self.prepared.append(inject)

    # What is there

    def bus(self, joint: str | int) -> SimulatedBus:
        """Return the bus of a joint, or one by its number."""
        names = list(self.spec["buses"])
        name = names[joint] if isinstance(joint, int) else self.spec["joints"][joint]["bus"]
        return next(bus for bus in self.virtual.buses if bus.name == name)

    def servo_id(self, joint: str) -> int:
        number: int = self.spec["joints"][joint]["id"]
        return number

    def servo(self, joint: str) -> SimulatedServo:
        return self.bus(joint).servo(self.servo_id(joint))

    def angle(self, joint: str) -> float:
        """Return where a joint really is, rad."""
        entry = self.spec["joints"][joint]
        reference = math.radians(float(entry["reference"].split()[0]))
        return float(entry["direction"]) * (self.servo(joint).shaft_angle - reference)

    def now_s(self, joint: str | int = 0) -> float:
        return self.bus(joint).now_ns / S

    @property
    def wire(self) -> Any:
        """Packets of the robot's protocol."""
        return protocol1 if self.kind.protocol == 1.0 else protocol2

    # Below what a fault of the simulation can do

    def interrupt(self, joint: str, kind: str, is_cut: Callable[[float], bool]) -> None:
        """Cut a servo off where `is_cut` says so, by the time in s."""

        def contact() -> bool:
            cut = is_cut(self.now_s(joint))
            self.evidence[kind] += cut
            return not cut

        self.evidence[kind] += 0
        self.at(0.01, lambda: self.servo(joint).interrupt(contact), joint)

    def on_request(self, joint: str | int, decide: Callable[[tuple[int, ...], float], None]) -> None:
        """Call `decide` with the IDs that are about to reply to a read, and the time, before they do."""

        def watched(packet: Any, end_ns: int) -> None:
            read = group_read(self.kind.protocol, packet)
            if read is not None:
                decide(tuple(entry.servo_id for entry in read.entries), end_ns / S)
            elif packet.instruction == 0x02 and packet.servo_id != 0xFE:
                decide((packet.servo_id,), end_ns / S)

        self.prepared.append(lambda: watch_instructions(self.bus(joint), watched))

    def on_arrival(self, joint: str | int, change: Callable[[int, bytes, float], bytes]) -> None:
        """Change bytes between line and host: `change` gets ID, bytes and time; the servos notice nothing."""

        def changed(servo_id: int, reply: DisturbedReply) -> PacketFault | None:
            data = change(servo_id, reply.data, reply.due_ns / S)
            return None if data == reply.data else PacketFault("", lambda _: data, is_noticed=False)

        self.prepared.append(lambda: change_replies(self.bus(joint), changed))

    def hold_back(self, bus: SimulatedBus, late_ns: Callable[[int], int]) -> None:
        """Hand intact bytes of a bus over later, by a time that depends on the time."""
        held: deque[tuple[int, bytes]] = deque()
        drain, due = bus.drain_bytes, bus.next_due_ns

        def drain_late(now_ns: int, *, handed_ns: int = -1) -> bytes:
            if data := drain(now_ns, handed_ns=handed_ns):
                self.evidence["handed over late"] += late_ns(now_ns) > 0
                held.append((max(now_ns + late_ns(now_ns), held[-1][0] if held else 0), data))
            given = b""
            while held and held[0][0] <= now_ns:
                given += held.popleft()[1]
            return given

        def next_due_ns() -> int | None:
            times = [held[0][0]] if held else []
            inner = due()
            return min(times if inner is None else [*times, inner], default=None)

        instead(bus, "drain_bytes", lambda _: drain_late)
        instead(bus, "next_due_ns", lambda _: next_due_ns)

    def stall(self, kind: str, since_s: float, by_s: Callable[[], float]) -> None:
        """Let the loop wake later than it asked for, where it waits for a deadline."""
        story = self

        class Stalling(VirtualClock):
            __slots__ = ()

            def wait_until(self, deadline_ns: int) -> int:
                waits = deadline_ns > self.now_ns() + MS and self.now_ns() > since_s * S
                late_s = by_s() if waits else 0.0
                story.evidence[kind] += late_s > 0
                return super().wait_until(deadline_ns + round(late_s * S))

        self.ports_in_python = True
        self.prepared.append(lambda: setattr(self.virtual.clock, "__class__", Stalling))

    def stand_still(self, kind: str, since_s: float, for_ns: int, every_ns: int) -> None:
        """Let the loop get no processor for moments, wherever it is: the next look at the clock is later."""
        story, due_ns = self, [round(since_s * S)]

        class Starved(VirtualClock):
            __slots__ = ()

            def now_ns(self) -> int:
                if super().now_ns() >= due_ns[0]:
                    due_ns[0] += every_ns
                    story.evidence[kind] += 1
                    super().wait_until(super().now_ns() + for_ns)
                return super().now_ns()

        self.ports_in_python = True
        self.prepared.append(lambda: setattr(self.virtual.clock, "__class__", Starved))

    # The run

    def write_files(self) -> tuple[Path, list[Path]]:
        """Write the robot file, and its motion if there is one."""
        file, played = self.directory / "robot.yaml", []
        self.spec["recording"] = {"directory": str(self.directory)}
        file.write_text(json.dumps(self.spec, indent=1))
        if self.motion is not None:
            played = [self.directory / "motion.yaml"]
            played[0].write_text(json.dumps(self.motion, indent=1))
        return file, played

    def run(self) -> Path:
        """Run it, prove that what was injected happened, and return the log."""
        (file, played), log = self.write_files(), self.directory / "run.mcap"
        header = virtual_run.log_header

        def as_of_a_robot(plan: Any, *words: Any, **options: Any) -> Any:
            buses = tuple(replace(bus, port=f"/dev/ttyUSB{place}") for place, bus in enumerate(plan.buses))
            return header(replace(plan, buses=buses), *words, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(virtual_run, "log_header", as_of_a_robot)
            if self.ports_in_python:
                patch.setattr(virtual_run, "VirtualPorts", BusPorts)
            options: dict[str, Any] = {"play": played, "arguments": {"port": "sim"}}
            self.virtual = VirtualRun(file, log, duration_s=self.duration_s, **options)
        for t_s, kind, data in self.requests:
            self.virtual.post_at(1000 * t_s, replace(ask(kind, data), origin="a client"))
        for prepare in self.prepared:
            prepare()
        read = read_log(self.virtual.logged())
        for check in self.checks:
            check(read)
        return log


def instead(owner: object, name: str, make: Callable[[Any], Any]) -> None:
    """Put what `make` returns of a method of an object in its place."""
    setattr(owner, name, make(getattr(owner, name)))
