"""Robot draft: facts of another program's file, written in the form of the hand-written robot files."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from dxlrun import InputError
from dxlrun.tooling.files import Conversion, FileContent, Mark, Problem
from dxlrun.tooling.robots import compile_texts
from dxlrun_import.checked_values import refused, valid_name
from dxlwire import ControlTable, can_count_turns, find_table

RATES = (100, 50, 25, 20, 10, 5, 2, 1)
"""Loop rates to choose from, Hz."""
SHARE = 0.5
"""Largest share of the loop's period that a bus may need at the chosen rate."""
SLACK_DEG = 1.0
"""Excess over a servo's travel that is cut off without a remark: limits are often rounded to whole turns."""
SUSPICIOUS_DEG = 3600.0
"""Position limits beyond ten turns are in another unit, such as ticks."""
AUTO = "auto"
MOST_USED = "XM430-W350"
"""Model of servos for which `auto` is checked"""
_WIDTH = 118


class DraftBus(NamedTuple):
    """Serial line of a drafted robot."""

    protocol: float
    baud_rate: int
    port: str = ""
    """Port in the source; empty if it names none"""
    comment: str = ""
    return_delay_us: float | None = None


class JointDraft(NamedTuple):
    """Joint of a drafted robot; angles in degrees."""

    name: str
    id: int
    mark: Mark
    model: str = AUTO
    reference: float | None = None
    """Angle of the servo at the joint's zero, from raw 0; the middle of its travel by default"""
    direction: int = 1
    limits: tuple[float, float] | None = None
    velocity: float | None = None
    bus: str = "main"
    more: Sequence[tuple[int, int]] = ()
    """ID and direction of other servos that move the joint"""
    registers: Mapping[str, int] = {}
    continuous: bool = False
    limp: bool = False
    comment: str = ""


@dataclass
class RobotDraft:
    """Robot file that grows while a converter reads; `conversion` checks it and returns its text."""

    content: FileContent
    origin: str
    """Name of the format: `a configuration of pypot`"""
    name: str
    buses: dict[str, DraftBus] = field(default_factory=dict)
    joints: dict[str, JointDraft] = field(default_factory=dict)
    groups: dict[str, Sequence[str]] = field(default_factory=dict)
    controllers: list[str] = field(default_factory=list)
    """Lines of the section `controllers`, in addition to the broadcaster"""
    remarks: list[str] = field(default_factory=list)
    urdf: str = ""
    """Path of the URDF in the robot file"""
    rate: float | None = None
    """Loop rate in the source, Hz"""

    def add_joint(self, joint: JointDraft) -> None:
        """Add a joint. Raises InputError for a name or ID that is taken, or wrong values."""
        name = valid_name(joint.name)
        if name != joint.name:
            self.remarks.append(f"joint {joint.name} is {name} here: names have letters, digits and _")
        if name in self.joints:
            raise refused(joint.mark, f"joint {name} is defined twice", "rename one of them")
        used = {(one.bus, number): one.name for one in self.joints.values() for number in _ids(one)}
        for number in _ids(joint):
            if not 0 <= number <= 253:
                raise refused(joint.mark, f"ID {number} of {name} is not an ID of a servo", "correct it")
            if other := used.get((joint.bus, number)):
                raise refused(
                    joint.mark,
                    f"{name} and {other} both have ID {number}",
                    "give every servo its own ID, as its register has it",
                )
        self.joints[name] = self._fitted(joint._replace(name=name))

    def control_table(self, joint: JointDraft) -> ControlTable | None:
        """Return the control table of a joint's model; None for `auto`. Raises InputError."""
        if joint.model == AUTO:
            return None
        protocol = self.buses[joint.bus].protocol
        try:
            return find_table(joint.model, protocol)
        except LookupError:
            what = f"{joint.model!r} of {joint.name} is not a Dynamixel servo of Protocol {protocol}"
            raise refused(joint.mark, what, "correct it; `dxlrun models` lists the known models") from None

    def _fitted(self, joint: JointDraft) -> JointDraft:
        """Return a joint with its reference, and with limits inside the travel of its servo."""
        table = self.control_table(joint)
        step, first, last, reference = math.tau / 4096, 0, 4095, 180.0
        if table is not None:
            step, first, last = table.rad_per_tick, table.min_tick, table.max_tick
            reference = middle(table)
            joint = joint._replace(model=table.model)
        reference = reference if joint.reference is None else joint.reference
        joint = joint._replace(reference=reference)
        if joint.limits is None or joint.continuous:
            return joint._replace(limits=None)
        low, high = joint.limits
        if low >= high:
            what = f"the limits of {joint.name} are {low:g} and {high:g} deg, and leave it no way"
            raise refused(joint.mark, what, "write the lower one first")
        if max(abs(low), abs(high)) > SUSPICIOUS_DEG:
            what = f"the limits of {joint.name} are {low:g} and {high:g} deg, beyond any servo"
            raise refused(joint.mark, what, "check their unit")
        ends = sorted(joint.direction * (math.degrees(tick * step) - reference) for tick in (first, last))
        within = max(low, ends[0]), min(high, ends[1])
        beyond = within[0] > low + SLACK_DEG or within[1] < high - SLACK_DEG
        if beyond and high - low < 360 and self._counts_turns(joint, table):
            return joint._replace(limits=(low, high))
        if within[0] >= within[1]:
            what = (
                f"the limits of {joint.name}, {low:g} to {high:g} deg, are outside its servo's travel, "
                f"{ends[0]:.4g} to {ends[1]:.4g} deg"
            )
            raise refused(joint.mark, what, "check its offset, its direction and the unit")
        if beyond:
            self.remarks.append(
                f"limits of {joint.name}, {low:g} to {high:g} deg: its servo reaches only "
                f"{ends[0]:.4g} to {ends[1]:.4g} deg"
            )
        return joint._replace(limits=within)

    def _counts_turns(self, joint: JointDraft, table: ControlTable | None) -> bool:
        """Return True if limits of a joint may cross raw 0 of its servo; nearly all of Protocol 2.0 can."""
        return self.buses[joint.bus].protocol == 2.0 if table is None else can_count_turns(table)

    def conversion(self, urdf: str | None = None) -> Conversion:
        """Return the text of the robot file at a rate that the buses can keep, and the remarks.

        Raises InputError if there are no joints, or the robot file would be invalid.
        """
        if not self.joints:
            raise self.content.refusal("the file describes no servo", "give the file that lists the servos")
        for name, bus in self.buses.items():
            unnamed = any(joint.bus == name and joint.model == AUTO for joint in self.joints.values())
            if (
                unnamed
                and bus.protocol > 1
                and bus.baud_rate not in find_table(MOST_USED).baud_rates.values()
            ):
                what = f"the file names no models, and servos of the X series have no {bus.baud_rate:_} bit/s"
                raise self.content.refusal(what, "let `dxlrun scan PORT --output robot.yaml` read the models")
        budget = _compiled(self.content.path, self._text(1.0), urdf)
        possible = SHARE / budget
        rate: float = next((rate for rate in RATES if rate <= possible), 1)
        if self.rate is not None and self.rate <= possible * 1.9:
            rate = self.rate
        elif self.rate is not None:
            self.remarks.append(
                f"the rate of {self.rate:g} Hz: the buses have no time for it; `dxlrun check` shows why"
            )
        return Conversion(self._text(rate), tuple(self.remarks), urdf)

    def _text(self, rate: float) -> str:
        guessed_rate = "" if rate == self.rate else "  # guessed: what the buses can keep; Hz"
        lines = [
            *commented(f"{self.name}: imported from {self.content.path.name}, {self.origin}."),
            "#",
            *self._commands(),
            "#",
            "# Lines marked `guessed` are not in that file: check them before the robot moves.",
        ]
        if self.remarks:
            lines += ["# Not taken over:"]
            lines += [line for remark in self.remarks for line in commented(f"- {remark}")]
        lines += [f"name: {self.name}", "", "arguments:"]
        lines += [
            f'  {_argument(name, self.buses)}: {{default: sim, help: "serial port of the adapter, or sim"}}'
            for name in self.buses
        ]
        lines += ["", "buses:", *(line for name in self.buses for line in self._bus(name))]
        lines += ["", "loop:", f"  rate: {rate:g}{guessed_rate}", "", "joints:"]
        lines += [self._joint(joint) for joint in self.joints.values()]
        if self.groups:
            lines += ["", "groups:"]
            for name, joints in self.groups.items():
                lines += wrapped(f"  {name}: {{joints: [", joints, "]}")
        limp = any(joint.limp for joint in self.joints.values())
        lines += ["", "controllers:", "  joint_state_broadcaster: {type: joint_state_broadcaster}"]
        lines += self.controllers or [
            "  arm:  # guessed: one trajectory for all joints",
            "    type: joint_trajectory_controller",
            *["    active: false  # some of its joints are limp at the start"] * limp,
            *wrapped("    joints: [", list(self.joints), "]"),
        ]
        if self.urdf:
            lines += ["", f"model: {{urdf: {json.dumps(self.urdf)}}}"]
        return "\n".join(lines) + "\n"

    def _commands(self) -> Iterator[str]:
        command = f"#   dxlrun {self.name}.yaml"
        ports = [
            f" {_argument(name, self.buses)}:={bus.port or '/dev/ttyUSB0'}"
            for name, bus in self.buses.items()
        ]
        real = command + "".join(ports)
        yield f"{command:<{len(real)}}    simulated servos"
        yield f"{real}    the robot"

    def _bus(self, name: str) -> list[str]:
        bus = self.buses[name]
        delay, guessed = bus.return_delay_us, "latency"
        if delay is None:
            delay, guessed = 500, "latency and return_delay_time"
        comment = f"  # {bus.comment}" if bus.comment else ""
        return [
            f"  {name}:{comment}",
            f"    port: ${{{_argument(name, self.buses)}}}",
            f"    protocol: {bus.protocol}",
            f"    baud_rate: {bus.baud_rate:_}",
            "    adapter: {kind: ftdi}",
            f"    return_delay_time: {delay:g} us  # guessed: {guessed}",
        ]

    def _joint(self, joint: JointDraft) -> str:
        keys = [f"bus: {joint.bus}"]
        if joint.more:
            servos = [f"{{id: {joint.id}}}"]
            servos += [
                f"{{id: {number}, direction: {direction}}}"
                if direction != joint.direction
                else f"{{id: {number}}}"
                for number, direction in joint.more
            ]
            keys += [f"servos: [{', '.join(servos)}]"]
        else:
            keys += [f"id: {joint.id}"]
        keys += [f"model: {joint.model}", f"reference: {_number(joint.reference or 0.0)} deg"]
        keys += [f"direction: {joint.direction}"]
        limits = []
        if joint.limits is not None:
            low, high = math.ceil(joint.limits[0] * 100) / 100, math.floor(joint.limits[1] * 100) / 100
            limits += [f"position: [{_number(low)} deg, {_number(high)} deg]"]
        if joint.velocity is not None:
            limits += [f"velocity: {_number(math.floor(joint.velocity * 100) / 100)} deg/s"]
        keys += [f"limits: {{{', '.join(limits)}}}"] * bool(limits)
        keys += ["continuous: true"] * joint.continuous
        keys += ["torque: off"] * joint.limp
        if joint.registers:
            items = ", ".join(f"{item}: {value}" for item, value in joint.registers.items())
            keys += [f"registers: {{{items}}}"]
        comment = f"  # {joint.comment}" if joint.comment else ""
        return f"  {joint.name}: {{{', '.join(keys)}}}{comment}"


def middle(table: ControlTable) -> float:
    """Return the middle of a servo's travel from raw 0, deg, without the last half tick."""
    return round(math.degrees((table.min_tick + table.max_tick) / 2 * table.rad_per_tick))


def _ids(joint: JointDraft) -> list[int]:
    return [joint.id, *(number for number, _ in joint.more)]


def _argument(bus: str, buses: Iterable[str]) -> str:
    """Return the argument of the robot file for the port of a bus."""
    return "port" if len([*buses]) == 1 else f"{bus}_port"


def commented(text: str) -> list[str]:
    """Return a text as lines of a comment."""
    lines = textwrap.wrap(text, _WIDTH - 4, subsequent_indent="  " if text[:1] == "-" else "")
    return [f"# {line}" for line in lines]


def wrapped(start: str, items: Sequence[str], end: str) -> list[str]:
    """Return lines with a list in brackets, indented below its first item."""
    text = f"{start}{', '.join(items)}{end}"
    if len(text) <= _WIDTH:
        return [text]
    return textwrap.wrap(
        text, _WIDTH, initial_indent="", subsequent_indent=" " * len(start), break_long_words=False
    )


def _number(value: float) -> str:
    return f"{round(value, 3) + 0.0:.10g}"


def _compiled(source: Path, text: str, urdf: str | None) -> float:
    """Compile a robot file, and return the time that its slowest bus needs in a cycle, s.

    Raises InputError, about the source, if the robot file is invalid.
    """
    try:
        compiled = compile_texts({"robot.yaml": text}, {}, urdf)
    except InputError as error:
        if not error.problems:
            raise
        first = error.problems[0]
        raise InputError(
            [Problem(Mark(str(source)), f"its robot file would be invalid: {first.what}", first.fix)]
        ) from None
    return max((bus.budget.total_ns for bus in compiled.plan.buses), default=0) * 1e-9
