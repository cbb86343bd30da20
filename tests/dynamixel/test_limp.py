"""What the guardian does when the loop died, owed replies, and late, doubled and lost ones in pairs."""

import itertools
import math
import random
import re
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from tests.kit.campaigns import campaign
from tests.kit.line_faults import STALLED, delay_next, disturb_replies, truncate_next
from tests.kit.rigs import Rig, VirtualLine, every_servo, make_plan, make_rig, make_x, start_rig

from dxlrun.dynamixel.servo.item_access import access_servo
from dxlrun.dynamixel.servo.torque_off import LATE_NS, LONGER_NS, limp, stand
from dxlrun.dynamixel.tools.inspection import compare_servos, identify, inspect_buses
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.scanning import Search, find_servo, scan
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import ServoFault, StartUpError
from dxlrun_hand.servo_setup import bring
from dxlsim.bus.simulated_bus import PacketFault, SimulatedBus
from dxlsim.simulation_plan import ServoConfig
from dxlwire.bus_plan import BusPlan
from dxlwire.exchange.bus_engine import Lines
from dxlwire.exchange.owed import LEAST_WINDOW_NS, MOST_WINDOW_NS, SLOW_MEMORY_NS, OwedReplies
from dxlwire.plan.line import MOST_SPARE
from dxlwire.plan.retry import ReplyLateness, extend_timeouts, retry
from dxlwire.transaction import Program, Reply, Transaction
from dxlwire.wire import protocol2


@pytest.fixture
def rig():
    return start_rig()


def lose_readbacks(rig):
    """Let a servo acknowledge every write and answer no read."""
    rig.when(lambda data: (data[2], data[4]) == (6, 2), lambda: truncate_next(rig.buses[0], 6, 0))


@pytest.mark.parametrize(
    ("trick", "detail"),
    [
        # as when another program writes it again
        (lambda rig: rig.stick(6, "torque_enable", 1), "torque enable reads 1 after torque off was written"),
        (lose_readbacks, "torque off was acknowledged, but the read-back got no answer"),
    ],
)
def test_torque_off_counts_only_when_it_was_read_back(rig, trick, detail):
    trick(rig)
    (failed,) = [one for one in limp(rig.lines) if not one.confirmed]
    assert failed.servo_id == 6
    assert detail in str(failed)
    off = [packet for packet in rig.into_bus() if packet[2] == 6 and packet[4:7] == b"\x03\x18\x00"]
    assert len(off) == len(LONGER_NS), "torque off is tried again after the other servos"


def test_what_answers_late_is_heard_before_the_ports_are_closed():
    rig, asked = start_rig(make_plan((1,))), []

    def late():
        if not asked:  # the first read-back: given up before its answer comes
            asked.append(rig.clock.now_ns())
            delay_next(rig.buses[0], 1, LATE_NS)

    rig.when(lambda data: data[4] == 2, late)
    (outcome,) = limp(rig.lines)
    assert outcome.confirmed
    assert rig.packets.received() == rig.out_of_bus()
    assert rig.clock.now_ns() - asked[0] > LATE_NS


def test_it_works_after_a_half_sent_instruction_and_a_half_read_reply(rig):
    port = rig.ports.ports[0]
    port.write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(rig.clock.now_ns() + 650_000)
    port.write_packet(b"\xff\xff\xfe\x2c\x83\x1e\x04\x01")
    off_ns = []
    for servo in rig.buses[0].servos:
        servo.registers.watch_items(("torque_enable",), lambda: off_ns.append(rig.buses[0].now_ns))
    assert all(one.confirmed for one in limp(rig.lines))
    assert rig.torque() == [False] * 8
    assert len(set(off_ns[:8])) == 1, "the broadcast collided with the end of the reply"


def test_silent_servos_are_named_and_time_is_bounded(rig):
    for servo_id in (1, 3, 5, 6):
        rig.servo(servo_id).silence()
    start = rig.clock.now_ns()
    outcomes = limp(rig.lines, start + 50_000_000)
    assert rig.clock.now_ns() - start < 200_000_000
    assert [one.servo_id for one in outcomes if not one.confirmed] == [1, 3, 5, 6]
    assert "does not answer" in str(outcomes[0])
    assert rig.torque()[4:] == [False] * 4


def test_a_babbling_line_does_not_hold_it_up(rig):
    start = rig.clock.now_ns()
    for step in range(400):
        rig.buses[0].inject_noise(b"\xff\xff\x01", start + step * 100_000)
    assert all(one.confirmed for one in limp(rig.lines))
    first = next(e.t_ns for e in rig.ledger.entries if e.t_ns >= start and e.direction == "in")
    assert first - start < 1_000_000


def test_the_guardians_path_imports_no_numpy():
    code = "import sys, dxlrun.run.guardian; print('numpy' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def wheels(model="XM430-W350", protocol=2.0, *, ids=(1, 2), velocity=1.0):
    """Return wheels of which the first one turns."""
    ends = {"lower": -math.inf, "upper": math.inf, "reference": math.pi, "return_delay_ns": 0}
    plan = make_plan(ids, model=model, protocol=protocol, continuous=True, **ends)
    rig = start_rig(every_servo(plan, torque_on_return=True))
    rig.goals.velocity[:] = 0.0
    rig.goals.velocity[0] = velocity
    rig.cycles(20)
    return rig


def test_a_wheel_stands_before_silent_ones_are_awaited_for_long():
    rig = wheels("AX-12A", 1.0, ids=(1, 2, 3, 4))
    rig.goals.velocity[:] = 1.0
    rig.cycles(20)
    for servo_id in (1, 2, 3):
        rig.servo(servo_id).silence()
    begin_ns, stood_ns = rig.clock.now_ns(), []
    moving = rig.servo(4).registers
    moving.watch_items(("moving_speed",), lambda: stood_ns.append(rig.clock.now_ns()))
    said = stand(rig.lines)
    assert stood_ns[-1] - begin_ns < 500_000_000
    assert [text.split()[0] for text in said] == [f"main_{one}_joint" for one in (4, 1, 2, 3)]
    assert [" may keep moving: " in text for text in said] == [False, True, True, True]


@pytest.mark.parametrize("last_hand", [limp, stand])
def test_the_last_hand_waits_for_the_end_of_a_reply_that_is_on_its_way(rig, last_hand):
    rig.clock.wait_until(rig.clock.now_ns() + 5_000_000)
    begun_ns = rig.clock.now_ns()
    rig.ports.ports[0].write_packet(rig.plans[0].reads[0].packet)
    rig.clock.wait_until(begun_ns + 640_000)  # 80 us of instruction, 500 us of delay
    last_hand(rig.lines)
    notes = [entry.note for entry in rig.ledger.entries if entry.t_ns > begun_ns]
    assert [note for note in notes if note.startswith("collision")] == []


READ = 2  # Instruction of Protocol 1.0
MILLISECOND_NS = 1_000_000
PLAN = make_x((11,))
ONE = access_servo(PLAN, PLAN.servos[0])


def read_once(request: Transaction) -> Program[Reply]:
    return (yield request)


def delay_torque_reads(rig: Rig) -> Lines:
    """Send one read of Torque Enable of each length, whose replies come 40 ms late; return the lines."""
    lines, one = rig.lines, access_servo(rig.plans[0], rig.plans[0].servos[0])
    for length in range(1, 2 + MOST_SPARE):
        delay_next(rig.buses[0], 1, 40 * MILLISECOND_NS)
        lines.run_programs([read_once(one.line.read_range(1, one.servo.torque_address, length))])
    return lines


def test_old_reading_does_not_confirm_torque_off():
    rig = start_rig(make_plan((1,)))
    servo = rig.servo(1)
    servo.poke("torque_enable", 0)
    lines = delay_torque_reads(rig)
    rig.stick(1, "torque_enable", 1)
    servo.poke("torque_enable", 1)
    rig.when(lambda data: data[4] == READ, lambda: truncate_next(rig.buses[0], 1, 0))
    (outcome,) = limp(lines)
    assert not outcome.confirmed, "an old reply says 0, and the read-backs are lost"


def test_torque_off_is_confirmed_while_older_readings_are_owed():
    rig = start_rig(make_plan((1,)))
    lines = delay_torque_reads(rig)
    (outcome,) = limp(lines)
    assert outcome.confirmed
    assert not rig.servo(1).registers["torque_enable"]


READ_TORQUE, LIMP, TORQUE = ONE.reading(64, 1), ONE.writing(64, b"\0"), ONE.writing(64, b"\1")
ALL_LIMP = ONE.line.unanswered(protocol2.sync_write(64, 1, {ONE.servo.servo_id: b"\0"}))
MISS, WRITE = OwedReplies.add, OwedReplies.note_change


@pytest.fixture
def clock() -> SimpleNamespace:
    return SimpleNamespace(now_ns=0)


@pytest.fixture
def owed(clock: SimpleNamespace) -> OwedReplies:
    """Owed replies of one line with a clock that the test sets."""
    return OwedReplies(lambda: clock.now_ns)


@pytest.mark.parametrize(
    ("steps", "asked", "confuses"),
    [
        # a write that is retried keeps the readings after its first attempt
        ([(WRITE, LIMP, 1), (MISS, READ_TORQUE, 2), (WRITE, LIMP, 3)], READ_TORQUE, False),
        # one that is repeated later invalidates them
        (
            [(WRITE, LIMP, 1), (MISS, READ_TORQUE, LEAST_WINDOW_NS), (WRITE, LIMP, LEAST_WINDOW_NS + 1)],
            READ_TORQUE,
            True,
        ),
        # a reading from before a write does not answer the one after it
        ([(MISS, READ_TORQUE, 1), (WRITE, LIMP, 2), (MISS, READ_TORQUE, 3)], READ_TORQUE, True),
        ([(MISS, READ_TORQUE, 1), (WRITE, ALL_LIMP, 2)], READ_TORQUE, True),
        # a late acknowledgement counts for the repetition of its write, unless another came between
        ([(WRITE, LIMP, 1), (MISS, LIMP, 1), (WRITE, LIMP, 3)], LIMP, False),
        ([(WRITE, LIMP, 1), (MISS, LIMP, 1), (WRITE, TORQUE, 2), (WRITE, LIMP, 3)], LIMP, True),
    ],
)
def test_late_reply_is_taken_for_one_to_a_later_request_only_if_it_says_the_same(
    steps: list[tuple[Any, Transaction, int]],
    asked: Transaction,
    confuses: bool,
    owed: OwedReplies,
    clock: SimpleNamespace,
) -> None:
    for note, request, clock.now_ns in steps:
        note(owed, request, *([0] if note is MISS else []), clock.now_ns)
    clock.now_ns += 1
    assert owed.confuses(asked, asked.awaited[0], refusal=False, any_age=False) is confuses


def test_slow_reply_widens_the_window_for_a_minute(owed, clock):
    owed.add(READ_TORQUE, 0, 0)
    clock.now_ns = slow_ns = 700 * MILLISECOND_NS
    owed.charge_reply(11, 1, 0)
    assert owed.window_ns == slow_ns * 5 // 4
    clock.now_ns += SLOW_MEMORY_NS
    assert owed.window_ns == slow_ns * 5 // 4
    clock.now_ns += 1
    assert owed.window_ns == LEAST_WINDOW_NS
    for slow_ms in (740, 920, 1140, 1420):
        owed.add(READ_TORQUE, 0, clock.now_ns)
        clock.now_ns += slow_ms * MILLISECOND_NS
        owed.charge_reply(11, 1, 0)
    assert owed.window_ns == MOST_WINDOW_NS


@pytest.mark.parametrize("register", [64, 65])
def test_lost_reply_is_not_lateness_of_the_next_one(register):
    """Neither the repetition of the lost read nor a read of another register of as many bytes is late."""
    rig = start_rig(PLAN)
    times = ReplyLateness()

    def program() -> Program[Reply]:
        yield ONE.reading(64, 1)
        return (yield from retry(ONE.reading(register, 1)))

    truncate_next(rig.buses[0], 11, 0)
    (reply,) = rig.lines.run_programs([extend_timeouts(program(), times=times)])
    assert reply is not None
    assert reply.answered
    assert all(each < MILLISECOND_NS for each in times.late_ns)
    assert times.missing == 1


def test_a_bus_without_power_is_given_up_within_two_seconds():
    rig = start_rig(PLAN)
    rig.servo(11).silence()

    def program() -> Program[None]:
        for _ in range(30):
            yield from retry(ONE.reading(64, 1))

    begun_ns = rig.clock.now_ns()
    rig.lines.run_programs([extend_timeouts(program())])
    assert rig.clock.now_ns() - begun_ns < 2_000 * MILLISECOND_NS


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
Reporting = Callable[[float, Faults], tuple[set[str], int]]
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
    plan = plan_of(protocol, latency_ns=1_000_000)
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
    program: Reporting, protocol: float, amount: float, chance: random.Random
) -> None:
    right, replies = program(protocol, {})
    assert right
    assert replies
    for first, second in draw_pairs(replies, amount, chance):
        found, _ = program(protocol, {number: KINDS[kind] for number, kind in (first, second)})
        assert found <= right, (first, second)
