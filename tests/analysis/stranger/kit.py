"""Robots on virtual time, their motions, and means to inject what no line of the simulation's faults does.

In the log of a run the ports have the names of real adapters: of simulated ones a diagnosis may leave out
what to do about the hardware.
"""

from __future__ import annotations

import itertools
import json
import math
import subprocess
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.awaited import DEADLINE_S

from dxlrun.channels.commands import CommandMessage, QueueInbox
from dxlrun.channels.cycle import Torque
from dxlrun.control.controllers.plugin_loading import load_plugins
from dxlrun.log.log_reader import Log, read_log
from dxlrun.remote.preparation import Preparation
from dxlrun.run import virtual_run
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import simulated_robot
from dxlsim.bus.simulated_bus import SimulatedBus
from dxlsim.bus.simulated_line import LineTransmission
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.servo.simulated_servo import SimulatedServo
from dxlwire.clock import VirtualClock
from dxlwire.wire import protocol1 as wire1
from dxlwire.wire import protocol2 as wire2

MS, S = 1_000_000, 1_000_000_000
HEAD = ("head_yaw", "head_pitch")
LEFT = ("left_shoulder", "left_elbow", "left_knee")
RIGHT = ("right_shoulder", "right_elbow", "right_knee")
JOINTS = (*HEAD, *LEFT, *RIGHT)
Spec = dict[str, Any]
Broken = Any  # A controller that is made to fail

TORSO = """<robot name="torso"><link name="stand"/><link name="torso"><inertial><mass value="1"/>
<inertia ixx="0.004" iyy="0.004" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="{joint}" type="revolute"><parent link="stand"/><child link="torso"/><axis xyz="0 1 0"/>
<limit lower="-2.2" upper="2.2" effort="10" velocity="9"/></joint></robot>"""
"""A torso that one joint tips."""


@dataclass(frozen=True)
class Robot:
    """How eight joints are driven; `buses` gives for each its joints, in the order of their IDs."""

    name: str
    protocol: float
    rate: int
    models: tuple[str, str]  # Of most joints, and of the knees
    buses: dict[str, tuple[str, ...]]
    first_id: int = 1
    return_delay: str = "0 us"

    @property
    def spec(self) -> Spec:
        """The robot file."""
        middle = "150 deg" if self.models[0].startswith("AX") else "180 deg"
        joints: Spec = {}
        number = self.first_id
        for bus, names in self.buses.items():
            for name in names:
                joints[name] = {
                    "bus": bus,
                    "id": number,
                    "model": self.models["knee" in name],
                    "reference": middle,
                    "direction": -1 if name.startswith("right") else 1,
                    "limits": {"position": ["-120 deg", "120 deg"]},
                    "simulation": {"inertia": "0.001 kg m^2", "friction": "0.005 Nm"},
                }
                number += 1
        return {
            "name": self.name,
            "arguments": {"port": {"default": "sim"}},
            "buses": {
                bus: {
                    "port": "${port}",
                    "protocol": self.protocol,
                    "baud_rate": 1_000_000,
                    "adapter": {"latency": "0 ms"},
                    "return_delay_time": self.return_delay,
                }
                for bus in self.buses
            },
            "loop": {"rate": self.rate},
            "joints": joints,
            "controllers": {
                "joint_state_broadcaster": {"type": "joint_state_broadcaster"},
                "body": {"type": "joint_trajectory_controller", "joints": list(JOINTS)},
            },
        }


ROBOTS = {
    robot.name: robot
    for robot in (
        Robot("mx_bulk", 1.0, 100, ("MX-28", "MX-64"), {"main": (*HEAD, *LEFT, *RIGHT)}),
        Robot(
            "mx_two",
            1.0,
            125,
            ("MX-28", "MX-64"),
            {"left": (*LEFT, "head_yaw"), "right": (*RIGHT, "head_pitch")},
        ),
        Robot("ax_single", 1.0, 50, ("AX-12A", "AX-12A"), {"main": (*LEFT, *RIGHT, *HEAD)}, 1, "100 us"),
        Robot("x_fast", 2.0, 100, ("XM430-W350", "XM540-W270"), {"main": (*RIGHT, *HEAD, *LEFT)}, 11),
        Robot(
            "x_three",
            2.0,
            200,
            ("XM430-W350", "XM430-W350"),
            {"head": HEAD, "left_leg": LEFT, "right_leg": RIGHT},
            21,
        ),
        Robot("x_sync", 2.0, 80, ("2XL430-W250", "2XL430-W250"), {"main": (*LEFT, *HEAD, *RIGHT)}, 31),
    )
}
"""MX read by bulk reads, on one and two buses; AX by single reads; X by fast sync reads, on one and three
buses; 2XL by plain sync reads, as they know no fast ones."""


class Client(QueueInbox):
    """Sends what a client would send, each at its time of the run, through the gateway's checks."""

    def __init__(
        self, robot: VirtualRobot, asks: Sequence[tuple[float, str, str, Spec]], names: Sequence[str]
    ) -> None:
        super().__init__()
        loop = robot.plan.loop
        preparation = Preparation({joint.name: joint for joint in loop.joints}, load_plugins())
        plans = {plan.name: plan for plan in loop.controllers}
        self._clock = robot.clock
        self._asks: deque[tuple[float, CommandMessage]] = deque()
        name = itertools.cycle(names)
        for number, (at_s, controller, kind, what) in enumerate(sorted(asks, key=lambda ask: ask[0]), 1):
            data = json.dumps(what).encode()
            if controller:
                data = preparation.command(plans[controller], kind, data).data
            self._asks.append((at_s, CommandMessage(number, controller, kind, data, next(name))))

    def drain_commands(self) -> Sequence[CommandMessage]:
        while self._asks and self._asks[0][0] * S <= self._clock.now_ns():
            self.waiting.append(self._asks.popleft()[1])
        return super().drain_commands()


class Story:
    """One run before it begins: what a case changes of the robot, and what it injects."""

    def __init__(self, robot: Robot, seed: str, directory: Path) -> None:
        self.kind = robot
        self.spec = robot.spec
        self.random = Random(f"{robot.name} {seed}")
        self.directory = directory
        self.duration_s = 6.0
        self.asks: list[tuple[float, str, str, Spec]] = []
        """When (s of the run), controller or "" for the loop, kind, and the command."""
        self.clients: tuple[str, ...] = ("a client",)  # Which ask it: of several each in its turn
        self.evidence: Counter[str] = Counter()
        """What really happened, by kind; a case that left nothing here is worthless."""
        self.checks: list[Callable[[Log], None]] = []
        self.motion: Spec | None = self.swing()
        self.disturb: Callable[[subprocess.Popen[str]], str] | None = None
        """What happens on the machine while it runs in real time, and what it was; None: on virtual time."""
        self.prepared: list[Callable[[], None]] = []
        """Called once the robot is built: there are buses and servos then."""
        self.virtual: VirtualRobot

    # The robot and what it plays

    def joint(self, name: str) -> Spec:
        """Return a joint's entry in the robot file."""
        entry: Spec = self.spec["joints"][name]
        return entry

    def play(self, *parts: Spec) -> None:
        """Play a motion of some parts, or none."""
        self.motion = {"name": "motion", "motions": list(parts)} if parts else None

    def swing(
        self, amplitude: float = 0.4, hertz: float = 0.35, controller: str = "body", **own: str
    ) -> Spec:
        """Return a motion in which each joint swings in its own way, or by a formula in `own`."""
        formulas = {}
        for name in self.spec["controllers"][controller]["joints"]:
            a = amplitude * self.random.uniform(0.6, 1.0)
            w = math.tau * hertz * self.random.uniform(0.7, 1.3)
            formulas[name] = {"position": own.get(name, f"{a:.3f} * sin({w:.3f} * t)")}
        part = {
            "controller": controller,
            "duration": f"{self.duration_s - 2:g} s",
            "samples": 200,
            "joints": formulas,
        }
        return {"name": "swing", "motions": [part]}

    # When

    def at(self, t_s: float, action: Callable[[], object], joint: str | int = 0) -> None:
        """Let something happen at a time, on the bus of a joint, or on one by its number."""

        def plan() -> None:
            self.bus(joint).at(round(t_s * S), lambda: (action(), None)[1])

        self._later(plan)

    def every(
        self, period_s: float, action: Callable[[float], object], joint: str | int = 0, since_s: float = 0.0
    ) -> None:
        """Let something happen again and again, with the time in s, from a time on."""

        def plan() -> None:
            bus = self.bus(joint)

            def again() -> None:
                action(bus.now_ns / S)
                bus.at(bus.now_ns + round(period_s * S), again)

            bus.at(round(since_s * S), again)

        self._later(plan)

    def _later(self, plan: Callable[[], None]) -> None:
        self.prepared.append(plan)

    def fault(self, line: str, joint: str | int = 0, count: bool = True) -> None:
        """Inject a line of the simulation's own faults; `{id}` is that of the joint."""

        def plan() -> None:
            bus = self.bus(joint)
            text = line.format(id=self.id(joint) if isinstance(joint, str) else 0)
            script = FaultScript((parse_fault(f"{text} bus={bus.name}"),), 5)
            script.attach(self.virtual.buses)
            if count:
                self.checks.append(lambda log: self._count_unless(script.waiting, text))

        self._later(plan)

    def _count_unless(self, waiting: object, text: str) -> None:
        self.evidence[text] += not waiting

    def at_end(self, happened: Callable[[], bool], kind: str) -> None:
        """Prove after the run that something happened."""
        self.checks.append(lambda log: self.evidence.update({kind: int(happened())}))

    def upright(self, joint: str) -> None:
        """Let a joint tip the torso with its IMU, and a reflex curl the arms up when it falls."""
        curled = {name: "40 deg" for name in JOINTS if name.endswith(("shoulder", "elbow"))}
        (self.directory / "torso.urdf").write_text(TORSO.format(joint=joint))
        self.spec["model"] = {"urdf": "torso.urdf", "frames_rate": 0}
        self.spec["sensors"] = {"gyro": {"type": "simulated_imu", "rate": self.kind.rate, "link": "torso"}}
        self.spec["controllers"] |= {
            "imu": {"type": "imu_sensor_broadcaster", "sensor": "gyro", "frame": "torso"},
            "curl": {
                "type": "keyframe_player",
                "active": False,
                "joints": list(curled),
                "start": "curl",
                "approach": "3 rad/s",
                "motions": {"curl": {"steps": [{"time": "400 ms", "pose": curled}]}},
            },
            "fall": {"type": "fall_reflex", "imu": "imu", "activate": ["curl"]},
        }
        self.checks.append(
            lambda log: self.evidence.update(falls=sum("takes over" in event.text for event in log.events))
        )

    # What is there

    def bus(self, joint: str | int) -> SimulatedBus:
        """Return the bus of a joint, or one by its number."""
        names = list(self.spec["buses"])
        name = names[joint] if isinstance(joint, int) else self.joint(joint)["bus"]
        return next(bus for bus in self.virtual.buses if bus.name == name)

    @property
    def buses(self) -> range:
        """The numbers of the buses."""
        return range(len(self.spec["buses"]))

    def id(self, joint: str) -> int:
        """Return a joint's ID."""
        number: int = self.joint(joint)["id"]
        return number

    def servo(self, joint: str) -> SimulatedServo:
        """Return a joint's servo."""
        return self.bus(joint).servo(self.id(joint))

    def q(self, joint: str) -> float:
        """Return where a joint really is, rad."""
        entry = self.joint(joint)
        reference = math.radians(float(entry["reference"].split()[0]))
        return float(entry["direction"]) * (self.servo(joint).shaft_angle - reference)

    # What another host sends

    def _wire(self) -> Any:
        return wire1 if self.kind.protocol == 1.0 else wire2

    def ping(self, servo_id: int) -> bytes:
        """Return a ping of another host."""
        packet: bytes = self._wire().ping(servo_id)
        return packet

    def read(self, servo_id: int, item: str) -> bytes:
        """Return a read of another host, of an item of the control table."""
        entry = self.item(item)
        packet: bytes = self._wire().read_range(servo_id, entry.address, entry.size)
        return packet

    def write(self, servo_id: int, item: str, value: int) -> bytes:
        """Return a write of another host."""
        entry = self.item(item)
        packet: bytes = self._wire().write_range(
            servo_id, entry.address, value.to_bytes(entry.size, "little")
        )
        return packet

    def sync_write(self, item: str, data: dict[int, int]) -> bytes:
        """Return a sync write of another host."""
        entry = self.item(item)
        values = {number: value.to_bytes(entry.size, "little") for number, value in data.items()}
        packet: bytes = self._wire().sync_write(entry.address, entry.size, values)
        return packet

    def load_item(self, joint: str) -> str:
        """Return the item that shows a joint's load."""
        return "present_current" if self.joint(joint)["model"].startswith("XM") else "present_load"

    def noted(self, text: str, joint: str) -> bool:
        """Return whether the ledger has a note on a joint's servo."""
        entries = self.bus(joint).ledger.entries
        return any(text in each.note and f"servo {self.id(joint)}" in each.note for each in entries)

    def was_on(self, joint: str, t_s: float) -> bool:
        """Return whether a joint had torque at a time, by the log's states."""
        log = read_log(self.directory / "run.mcap")
        row = int(np.searchsorted(log.cycles["scheduled_ns"], t_s * S))
        return int(log.cycles["torque"][row, log.header.joints.index(joint)]) == Torque.ON

    def item(self, name: str) -> Any:
        """Return an item of the control table that the first joint's servo has."""
        return self.servo(JOINTS[0]).registers.table.items[name]

    def interrupt(self, joint: str, contact: Callable[[], bool]) -> None:
        """Let instructions reach a joint's servo only where `contact` says so."""
        self.servo(joint).interrupt(contact)

    def frozen(self, joint: str, since_s: float) -> None:
        """Prove by the log that from a time on a joint's goal changes, and its position not by a tick."""

        def check(log: Log) -> None:
            row = log.header.joints.index(joint)
            later = log.cycles[log.cycles["scheduled_ns"] > since_s * S]
            assert len(set(later["position"][:, row].tolist())) == 1
            assert later["goal_position"][:, row].max() - later["goal_position"][:, row].min() > 0.2

        self.checks.append(check)

    def now_s(self, joint: str | int = 0) -> float:
        """Return the time of a bus, s."""
        return self.bus(joint).now_ns / S

    # Injection below what a fault's line can do

    def on_request(self, joint: str | int, decide: Callable[[tuple[int, ...], float], None]) -> None:
        """Call `decide` with the IDs that are about to reply to a read, and the time, before they do."""

        def watch(execute: Callable[[Any, int], None]) -> Callable[[Any, int], None]:
            bus = self.bus(joint)

            def watched(packet: Any, end_ns: int) -> None:
                read = bus._codec.group_read(packet)
                if read is not None:
                    decide(tuple(entry.servo_id for entry in read.entries), end_ns / S)
                elif packet.instruction == 0x02 and packet.servo_id != 0xFE:
                    decide((packet.servo_id,), end_ns / S)
                execute(packet, end_ns)

            return watched

        self._later(lambda: instead(self.bus(joint), "_execute", watch))

    def alter(
        self, joint: str, decide: Callable[[float], tuple[Callable[[bytes], bytes], float] | None], kind: str
    ) -> None:
        """Change replies of a joint's servo: `decide` gives what becomes of the bytes, and a delay, s."""

        def before(ids: tuple[int, ...], t_s: float) -> None:
            if self.id(joint) in ids and (change := decide(t_s)) is not None:
                self.evidence[kind] += 1
                self.bus(joint).alter_next(self.id(joint), kind, change[0], delay_ns=round(change[1] * S))

        self.on_request(joint, before)

    def on_arrival(self, joint: str | int, change: Callable[[int, bytes, float], bytes]) -> None:
        """Change bytes between line and host: `change` gets ID, bytes and time; the servos notice nothing."""

        def watch(arrive: Callable[[LineTransmission], None]) -> Callable[[LineTransmission], None]:
            at = 2 if self.kind.protocol < 2 else 4

            def changed(each: LineTransmission) -> None:
                if each.note != "noise":
                    servo_id = each.group.turns[each.turn].servo_id if each.group else each.data[at]
                    each.data = change(servo_id, each.data, each.due_ns / S)
                    if not each.data:
                        return
                arrive(each)

            return changed

        self._later(lambda: instead(self.bus(joint), "_arrive", watch))

    def hand_over_late(self, buses: Iterable[str | int], late_s: Callable[[float], float], kind: str) -> None:
        """Let the host receive intact bytes of some buses later, by a time that depends on the time, s."""

        def plan() -> None:
            for joint in buses:
                _hold_back(self, self.bus(joint), late_s, kind)

        self._later(plan)

    def shown(self, joint: str, item: str, show: Callable[[Callable[[], int]], int], since_s: float) -> None:
        """Let a register show something else from a time on; `show` gets a function of what it would show."""

        def begin() -> None:
            registers = self.servo(joint).registers
            live = registers._live
            name = next(name for name in (item, item.replace("velocity", "speed")) if name in live)
            registers.show_live({**live, name: partial(show, live[name])})
            self.evidence[f"{item} replaced"] += 1

        self.at(since_s, begin, joint)

    def flip(self, joint: str) -> None:
        """Let a servo of Protocol 2.0 count in the other direction, now."""
        servo = self.servo(joint)
        servo.poke("drive_mode", servo.registers["drive_mode"] ^ 1)
        self.evidence["flipped"] += 1

    def never_overloads(self, joint: str) -> None:
        """Let a servo bear any load, as one whose Shutdown is off: what is seen is the fault itself."""

        def bear(t_s: float) -> None:
            shaft = self.servo(joint).shaft
            shaft.mechanics.strain.overloaded[shaft.index] = 0

        self.every(0.05, bear, joint)

    def break_controller(self, name: str, at_s: float, act: Callable[[Any], None]) -> None:
        """Let a controller fail in its update from a time of the run on: `act` gets the controller."""

        def plan() -> None:
            controller = self.virtual.robot.loop.manager._named[name].controller

            def fails(update: Callable[[int, int], None]) -> Callable[[int, int], None]:
                def broken(time_ns: int, period_ns: int) -> None:
                    update(time_ns, period_ns)
                    if time_ns >= at_s * S:
                        self.evidence[f"{name} fails"] += 1
                        act(controller)

                return broken

            instead(controller, "update", fails)

        self._later(plan)

    def slow_controller(self, name: str, at_s: float, extra_s: Callable[[int], float]) -> None:
        """Let updates of a controller take longer, by the number of the update since a time."""
        numbers = itertools.count()

        def act(controller: Broken) -> None:
            by_s = extra_s(next(numbers))
            self.evidence["long update"] += by_s > 0
            self.virtual.clock.wait_until(self.virtual.clock.now_ns() + round(by_s * S))

        self.break_controller(name, at_s, act)

    def stall(self, by_s: Callable[[int], float], since_s: float) -> None:
        """Let the loop wake later than it asked for, by the number of its waits for a deadline."""

        def plan() -> None:
            story, numbers = self, itertools.count()

            class Stalling(VirtualClock):
                __slots__ = ()

                def wait_until(self, deadline_ns: int) -> int:
                    waits = deadline_ns > self.now_ns() + MS and self.now_ns() > since_s * S
                    late_s = by_s(next(numbers)) if waits else 0.0
                    story.evidence["stall"] += late_s > 0
                    return super().wait_until(deadline_ns + round(late_s * S))

            self.virtual.clock.__class__ = Stalling

        self._later(plan)

    # The run

    def run(self) -> Path:
        """Run it, prove that what was injected happened, and return the log."""
        file, log = self.directory / "robot.yaml", self.directory / "run.mcap"
        self.spec["recording"] = {"directory": str(self.directory)}
        file.write_text(json.dumps(self.spec, indent=1))
        played = []
        if self.motion is not None:
            played = [self.directory / "motion.yaml"]
            played[0].write_text(json.dumps(self.motion, indent=1))
        if self.disturb is not None:
            return self._run_live(file, played, self.disturb)
        header = virtual_run.log_header

        def as_of_a_robot(plan: Any, *words: Any, **options: Any) -> Any:
            buses = tuple(replace(bus, port=f"/dev/ttyUSB{place}") for place, bus in enumerate(plan.buses))
            return header(replace(plan, buses=buses), *words, **options)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(virtual_run, "log_header", as_of_a_robot)
            self.virtual = simulated_robot(
                file, play=played, duration_s=self.duration_s, log=log, arguments={"port": "sim"}
            )
        self.virtual.robot.loop.steering.inbox = Client(self.virtual, self.asks, self.clients)
        for plan in self.prepared:
            plan()
        self.virtual.run()
        read = read_log(log)
        for check in self.checks:
            check(read)
        return log

    def _run_live(self, file: Path, played: Sequence[Path], disturb: Callable[..., str]) -> Path:
        """Run it in real time by the command line, on simulated buses that are called so."""
        command = [str(Path(sys.executable).with_name("dxlrun")), str(file), "--no-gateway"]
        command += ["--duration", f"{self.duration_s:g}"]
        for motion in played:
            command += ["--play", str(motion)]
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as process:
            try:
                self.evidence[disturb(process)] += 1
                said, _ = process.communicate(timeout=DEADLINE_S)
            finally:
                process.kill()
        logs = list(self.directory.glob("*.mcap"))
        assert logs, said
        return logs[0]


def instead(owner: object, name: str, make: Callable[[Any], Any]) -> None:
    """Put what `make` returns of a method of an object in its place."""
    setattr(owner, name, make(getattr(owner, name)))


def freeze(story: Story, joint: str, since_s: float, *items: str) -> None:
    """Let registers of a joint's servo show what they showed last, from a time on."""
    for item in items:
        last: list[int] = []

        def stuck(show: Callable[[], int], last: list[int] = last) -> int:
            if not last:
                last.append(show())
            return last[0]

        story.shown(joint, item, stuck, since_s)


def _hold_back(story: Story, bus: SimulatedBus, late_s: Callable[[float], float], kind: str) -> None:
    held: deque[tuple[int, bytes]] = deque()
    take, due = bus.drain_bytes, bus.next_due_ns

    def late(now_ns: int, *, handed_ns: int | None = None) -> bytes:
        data = take(now_ns, handed_ns=handed_ns)
        if data:
            by_ns = round(late_s(now_ns / S) * S)
            story.evidence[kind] += by_ns > 0
            held.append((max(now_ns + by_ns, held[-1][0] if held else 0), data))
        given = b""
        while held and held[0][0] <= now_ns:
            given += held.popleft()[1]
        return given

    def next_due_ns() -> int | None:
        inner = due()
        return inner if not held else min(held[0][0], inner if inner is not None else held[0][0])

    instead(bus, "drain_bytes", lambda _: late)
    instead(bus, "next_due_ns", lambda _: next_due_ns)


def stronger(story: Story, old: float, new: float) -> float:
    """Return a torque for a robot of Protocol 1.0, or one of Protocol 2.0 with its stronger servos."""
    return old if story.kind.protocol == 1.0 else new
