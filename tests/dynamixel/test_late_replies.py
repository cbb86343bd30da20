"""Replies that are late, doubled or lost, in pairs: no tool and no event reports a value that was not read.

Each program is run without a fault first, on a servo whose registers have distinct values. With faults it may
report less, and silence as silence, but nothing else. CI runs 40 pairs of each program. The full campaign has
every pair of kinds, and of requests up to eight apart:

    pytest --campaign=release tests/dynamixel/test_late_replies.py
"""

from __future__ import annotations

import itertools
import math
import random
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import pytest
from tests.kit.campaigns import campaign
from tests.kit.line_faults import STALLED, disturb_replies
from tests.kit.rigs import VirtualLine, make_plan, make_rig, start_rig

from dxlrun.dynamixel.tools.inspection import compare_servos, identify, inspect_buses
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.scanning import Search, find_servo, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault, StartUpError
from dxlrun_hand.servo_setup import bring
from dxlsim.bus.simulated_bus import PacketFault, SimulatedBus
from dxlsim.simulation_plan import ServoConfig
from dxlwire.bus_plan import BusPlan
from dxlwire.control_table import find_table
from dxlwire.plan.planning import Wiring, bus_plan

EVERY_PAIR = 1_000_000  # more than there are
FARTHEST = 8  # Requests between two faults: later, the first one is over
KINDS = {
    "lost": PacketFault("lost", lambda _: b""),
    "doubled": PacketFault("doubled", bytes, copies=2),
    **{f"{late} ms": PacketFault("late", bytes, late * 1_000_000) for late in (15, 260, 430, 600)},
    **{f"stall of {late} ms": PacketFault(STALLED, bytes, late * 1_000_000) for late in (90, 300)},
}
MODELS = {1.0: "MX-28", 2.0: "XM430-W350"}
COMMON = {"return_delay_time": 111, "temperature_limit": 71}
ODD = {
    1.0: COMMON
    | {"cw_angle_limit": 2040, "ccw_angle_limit": 2060, "multi_turn_offset": 77, "resolution_divider": 3},
    2.0: COMMON
    | {"drive_mode": 4, "homing_offset": 77, "min_position_limit": 2040, "max_position_limit": 2060}
    | {"startup_configuration": 3, "profile_acceleration": 55, "velocity_limit": 210, "position_p_gain": 640},
}
"""Settings that a start reports, each with a value of its own."""
SILENT = re.compile(
    r"(did|does|do) not (answer|confirm|acknowledge|belong)|no longer answers|answers only|garbled|missed|"
    r"two-servos-have-one-id$|none of the|is probed once a second|answers again$|"
    r"(reply was|replies in a row were) lost"
)

TORQUE_OFF = {"hardware: torque is off on the servo", "torque was switched off again on every servo"}
Faults = Mapping[int, PacketFault]
Program = Callable[[float, Faults], tuple[set[str], int]]
"""Runs something on a servo of a protocol whose replies have faults; returns what it reported, each value by
itself, and how many replies the servo sent."""


def reported(sentences: Iterable[str]) -> set[str]:
    """Return the parts of sentences that report something else than silence."""
    parts = {part.strip() for one in sentences for line in one.splitlines() for part in line.split("; ")}
    return {part for part in parts if not SILENT.search(part)}


def plan_of(protocol: float, **change: object) -> BusPlan:
    middle = {"reference": math.pi, "lower": -1.5, "upper": 1.5}
    return make_plan((1,), protocol=protocol, model=MODELS[protocol], return_delay_ns=0, **middle, **change)


def make_odd(bus: SimulatedBus, protocol: float) -> None:
    for name, value in ODD[protocol].items():
        bus.servo(1).poke(name, value)


def texts(events: Sequence[tuple[object, ...]]) -> list[str]:
    return [f"{source}: {text}" for _, _, source, text in events]


def refused_start(protocol: float, faults: Faults) -> tuple[set[str], int]:
    rig = make_rig(plan_of(protocol))
    make_odd(rig.buses[0], protocol)
    replies = disturb_replies(rig.buses[0], 1, faults)
    with pytest.raises(StartUpError) as refusal:
        rig.hardware.start()
    return reported([*refusal.value.sentences, *texts(rig.events.list)]), replies()


def start(protocol: float, faults: Faults) -> tuple[set[str], int]:
    rig = make_rig(plan_of(protocol))
    for name, value in COMMON.items():
        rig.buses[0].servo(1).poke(name, value)
    replies = disturb_replies(rig.buses[0], 1, faults)
    sentences: Sequence[str] = ()
    try:
        rig.hardware.start()
    except StartUpError as error:
        sentences = error.sentences
    found = reported([*sentences, *texts(rig.events.list)])
    if any(text in TORQUE_OFF for text in found):  # after a start that failed: judged by the servo
        assert not rig.servo(1).registers["torque_enable"]
    return found - TORQUE_OFF, replies()


def look_again(protocol: float, faults: Faults) -> tuple[set[str], int]:
    """Inspect a servo in idle time that was lost, and has odd settings when it is back."""
    rig = start_rig(plan_of(protocol))
    rig.cycles(3)
    servo = rig.servo(1)
    servo.silence()
    rig.cycles(6)
    if protocol == 2.0:  # a servo with torque takes no other settings, but a hand may
        rig.servo(1).poke("torque_enable", 0)
    make_odd(rig.buses[0], protocol)
    servo.silence(False)
    before = len(rig.events.list)
    replies = disturb_replies(rig.buses[0], 1, faults)
    rig.cycles(120)
    found = {re.sub(r"^.*is not ready: ", "", text) for text in texts(rig.events.list[before:])}
    return reported(found), replies()


def inspect_online(protocol: float, faults: Faults) -> tuple[set[str], int]:
    plan, (line, _) = plan_of(protocol), tool_of(protocol)
    replies = disturb_replies(line.bus, 1, faults)
    identities = identify([plan], ["main_1_joint"], opened=lambda _: line).values()
    found = {f"{one.joint} {one.model}: {one.problem}" for one in identities}
    looked = inspect_buses([plan], opened=lambda _: line)
    rows = {f"{row.item} {row.found}" for row in looked.registers if row.found is not None}
    return reported([*found, *rows, *looked.problems, *looked.remarks]), replies()


def tool_of(protocol: float) -> tuple[VirtualLine, ToolLine]:
    line = VirtualLine(ServoConfig(1, MODELS[protocol], 2.0, 0), protocol=protocol, rate=1_000_000)
    line.most_latency_ns = 1_000_000
    make_odd(line.bus, protocol)
    return line, ToolLine(line)


def servo(protocol: float, faults: Faults) -> tuple[set[str], int]:
    """Read, write, and switch torque as `dxlrun servo` does."""
    line, tool = tool_of(protocol)
    (found,) = find_servo(tool, 1, Search((protocol,), (1_000_000,)))
    one = OneServo(tool, found)
    replies = disturb_replies(line.bus, 1, faults)
    said: list[str] = []

    def read(*names: str) -> list[str]:
        return [f"{name} {value}" for name, value in one.read_items(list(names)).items()]

    singles = "temperature_limit", "return_delay_time", "id", "led", "torque_enable"
    acts: list[Callable[[], Iterable[str]]] = [
        *(partial(read, name) for name in singles),
        lambda: read(*ODD[protocol]),
        lambda: one.write_registers([one.register("temperature_limit", 65)]),
        lambda: one.torque(True),
        lambda: one.torque(False),
    ]
    for act in acts:
        try:
            said += act()
        except ServoFault as error:
            said += error.sentences
    return reported(said), replies()


def scan_line(protocol: float, faults: Faults) -> tuple[set[str], int]:
    line, tool = tool_of(protocol)
    replies = disturb_replies(line.bus, 1, faults)
    said: list[str] = []
    for found in scan(tool, Search((protocol,), (1_000_000,), (1, 2))).servos:
        values = found.position, found.return_delay, found.lowest, found.highest
        if found.model_number >= 0:
            said.append(f"{found.servo_id} {found.model} {found.model_number} {found.firmware}")
        names = ("position", "return_delay", "lowest", "highest")
        said += [f"{name} {value}" for name, value in zip(names, values, strict=True) if value is not None]
        said += found.remarks
    return reported(said), replies()


def set_up(protocol: float, faults: Faults) -> tuple[set[str], int]:
    """Give a servo what a robot file has for it, and read it back, as `dxlrun setup` does."""
    line, tool = tool_of(protocol)
    table = find_table(MODELS[protocol], protocol)
    wiring = Wiring("elbow", 0, 1, table, math.pi, 1, -1.5, 1.5)
    plan = bus_plan(
        name="main",
        port=line.name,
        baud_rate=1_000_000,
        latency_ns=1_000_000,
        return_delay_ns=0,
        joints=[wiring],
        protocol=protocol,
    )
    (found,) = find_servo(tool, 1, Search((protocol,), (1_000_000,)))
    replies = disturb_replies(line.bus, 1, faults)
    said: list[str] = []
    try:
        said += bring(OneServo(tool, found), plan, plan.servos[0])
    except ServoFault as error:
        said += error.sentences
    survey = compare_servos(tool, plan, plan.servos)
    said += [*survey.problems, *(text for _, text in survey.describe_deviations())]
    return reported(said), replies()


PROGRAMS = [refused_start, start, look_again, inspect_online, servo, scan_line, set_up]


def draw_pairs(
    replies: int, amount: float, chance: random.Random
) -> list[tuple[tuple[int, str], tuple[int, str]]]:
    """Return so many pairs of faults, or all that there are."""
    every = [
        ((first, one), (second, other))
        for first in range(replies)
        for second in range(first + 1, min(first + 1 + FARTHEST, replies + 3))
        for one, other in itertools.product(KINDS, KINDS)
    ]
    return every if amount >= len(every) else chance.sample(every, int(amount))


@campaign(ci=15, night=400, release=EVERY_PAIR)
@pytest.mark.parametrize("protocol", MODELS)
@pytest.mark.parametrize("program", PROGRAMS)
def test_late_doubled_and_lost_replies_change_no_reported_value(
    program: Program, protocol: float, amount: float, chance: random.Random
) -> None:
    right, replies = program(protocol, {})
    assert right
    assert replies
    for first, second in draw_pairs(replies, amount, chance):
        found, _ = program(protocol, {number: KINDS[kind] for number, kind in (first, second)})
        assert found <= right, (first, second)
