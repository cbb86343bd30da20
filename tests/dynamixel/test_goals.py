"""Which goals go out, and when; judged by the rules of one servo, in plain Python."""

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.kit.rigs import make_plan

import fuzz_kernel as fuzz
from dxlrun.dynamixel.servo.life import ServoEvent
from dxlwire.modes import Mode
from dxlwire.wire import protocol1, protocol2

REPEATED = 50
LEADS = {Mode.VELOCITY: 1, Mode.EFFORT: 2, Mode.PWM: 3}
ODD = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, 0.0, -0.0]) | st.floats(-10, 10)
DIALECTS = {1.0: protocol1, 2.0: protocol2}


class Writer:
    """The kernel, as it writes the goals of one bus."""

    def __init__(self, plan):
        self.plan, self.side = plan, fuzz.Side([plan])
        (self.servos,) = self.side.hardware._servos
        self.goals = self.side.goals

    def include(self, servos):
        for index, torqued in enumerate(self.servos.life.torqued.tolist()):
            if torqued != (index in servos):
                self.servos.life.on(index, ServoEvent.DOUBT if torqued else ServoEvent.TORQUE_ON)

    def write(self):
        """Send what is due; return the packets."""
        (line,) = self.side.lines.ports
        line.sent = []
        self.side.hardware.write_goals()
        return line.sent

    def sent(self):
        """Send what is due; return each servo's bytes of each packet, by ID."""
        return [records(packet, self.plan.protocol) for packet in self.write()]


def records(packet, protocol):
    """Take a sync write apart by ID; it must be as the dialect would have written it."""
    dialect = DIALECTS[protocol]
    size = 1 if protocol == 1.0 else 2
    body = packet[5:-1] if protocol == 1.0 else protocol2.unstuffed(packet[7:-2])[1:]
    address, length = (int.from_bytes(body[at : at + size], "little") for at in (0, size))
    body = body[2 * size :]
    assert len(body) % (length + 1) == 0
    found = {body[at]: body[at + 1 : at + 1 + length] for at in range(0, len(body), length + 1)}
    assert packet == dialect.sync_write(address, length, found)
    return found


def tick(cell, goal, ceiling):
    """Return the integer of a goal, as `GoalCell` says."""
    if cell.magnitude:
        if cell.interface == 1 and not (math.isnan(ceiling) or abs(goal) <= ceiling):
            goal = ceiling
        exact = abs(goal) / cell.unit
        if cell.low <= exact <= cell.high:
            return math.floor(exact + 1e-6) if cell.interface == 1 else round(exact)
        return cell.low if exact < cell.low else cell.high if exact > cell.high else cell.free
    exact = (cell.sign * goal + cell.offset) / cell.unit
    found = round(exact) if cell.low <= exact <= cell.high else cell.low if exact < cell.low else cell.high
    return 0x400 - found if cell.place.encoding == "sign_magnitude" and found < 0 else found


def block(cells, length, goals, row, ceiling):
    """Return a servo's bytes in a sync write."""
    found = bytearray(length)
    for cell in cells:
        at, size = cell.place.offset, cell.place.size
        value = tick(cell, goals[cell.interface][row], ceiling) & ((1 << 8 * size) - 1)
        found[at : at + size] = value.to_bytes(size, "little")
    return bytes(found)


@settings(max_examples=40, deadline=None)
@given(
    moves=st.lists(
        st.tuples(st.sets(st.integers(0, 7)), st.sets(st.integers(0, 7)), st.integers(1, 60)), max_size=6
    )
)
def test_a_goal_is_sent_when_it_changed_once_more_and_every_so_many_cycles(moves):
    writer = Writer(make_plan())
    goals, servos = writer.goals, writer.plan.servos
    goals.velocity[:] = goals.effort[:] = goals.pwm[:] = np.nan
    goals.position[:] = 0.1
    last, asked, chosen, cycle = [0] * 8, [2] * 8, set(range(8)), 0
    for moved, without, cycles in [(set(), set(), 3), *moves]:
        for servo in moved:
            goals.position[servo] += 0.05 if goals.position[servo] < 0.5 else -0.9
        now = set(range(8)) - without
        for servo in moved | (now - chosen):
            asked[servo] = 2
        chosen = now
        writer.include(chosen)
        for _ in range(cycles):
            cycle += 1
            wanted = {s for s in chosen if asked[s] or cycle - last[s] >= REPEATED}
            asked = [max(0, count - 1) for count in asked]
            for servo in wanted:
                last[servo] = cycle
            found = writer.sent()
            assert [set(one) for one in found] == ([{servos[s].servo_id for s in wanted}] if wanted else [])


KINDS = [("AX-12A", 1.0), ("MX-64", 1.0), ("XM430-W350", 2.0), ("XL-320", 2.0)]


@pytest.mark.parametrize("kind", KINDS, ids=str)
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_servo_with_torque_and_a_goal_in_its_mode_gets_that_and_no_other_does(kind, data):
    model, protocol = kind
    writer = Writer(make_plan((1, 2, 3), model=model, protocol=protocol))
    servos = writer.plan.servos
    modes = [
        data.draw(st.sampled_from([one.mode for one in servo.modes] + [Mode.UNKNOWN])) for servo in servos
    ]
    torqued = data.draw(st.sets(st.integers(0, 2)))
    writer.include(torqued)
    ceiling = data.draw(st.lists(st.just(np.nan) | ODD.map(abs), min_size=3, max_size=3))
    writer.goals.values[:] = data.draw(
        st.lists(st.lists(ODD, min_size=3, max_size=3), min_size=4, max_size=4)
    )
    writer.servos.life.ceiling[:] = ceiling
    for index, mode in enumerate(modes):
        writer.servos.goals.set_mode(index, mode)
    values = writer.goals.values.tolist()
    expected = []
    for one in writer.servos.goals.sync_writes:
        rows = [
            at
            for at, row in enumerate(one.rows)
            if one.members[at] in torqued and not math.isnan(values[one.lead][row])
        ]
        expected.append(
            {
                one.ids[at]: block(
                    one.cells[at], one.layout.length, values, one.rows[at], ceiling[one.members[at]]
                )
                for at in rows
            }
        )
    assert writer.sent() == [one for one in expected if one]
    assert {servo_id for one in expected for servo_id in one} == {
        servo.servo_id
        for index, (servo, mode) in enumerate(zip(servos, modes, strict=True))
        if index in torqued
        and mode is not Mode.UNKNOWN
        and not math.isnan(values[LEADS.get(mode, 0)][servo.row])
    }


@pytest.mark.parametrize("dialect", [protocol1, protocol2], ids=["protocol 1", "protocol 2"])
def test_goals_are_stuffed_and_sealed_as_the_e_manual_says(dialect):
    ids, model = range(1, 41), "AX-12A" if dialect is protocol1 else "XM430-W350"
    change = {"model": model, "protocol": dialect.PROTOCOL, "reference": 0.0}
    ticks = [100 + servo_id for servo_id in ids]
    if dialect is protocol2:  # in which 40 servos have a length of two bytes
        change |= {"continuous": True, "lower": -1000.0, "upper": 1000.0}
        # FF FF FD FF, and what is nearly so: FF 00 FD, FF FF 00, 00 FF FD
        ticks[:4] = [-131073, -196353, 65535, -131328]
    writer = Writer(make_plan(ids, **change))
    for index, servo in enumerate(writer.plan.servos):
        writer.servos.goals.set_mode(index, Mode.POSITION)
        writer.goals.position[index] = servo.direction * ticks[index] * servo.rad_per_tick
    (packet,) = writer.write()
    place = writer.plan.servos[0].mode_plan(Mode.POSITION).goals[0].position
    found = records(packet, dialect.PROTOCOL)
    raw = [found[one][place.offset : place.offset + place.size] for one in ids]
    assert [int.from_bytes(one, "little", signed=place.size > 2) for one in raw] == ticks
    assert dialect is protocol1 or b"\xff\xff\xfd\xfd\xff" in packet


@pytest.mark.parametrize(
    "case", [("AX-12A", 1.0, [50, 20]), ("XM430-W350", 2.0, [113, 37])], ids=["protocol 1", "protocol 2"]
)
def test_goals_beyond_one_sync_write_are_split_and_logged(case):
    model, protocol, counts = case
    plan = make_plan(range(sum(counts)), model=model, protocol=protocol)
    side = fuzz.Side([plan], memoryview(bytearray(2064)))  # a batch of the log that holds but one of them
    side.goals.values[:] = 0.0
    side.hardware.write_goals()
    (line,) = side.lines.ports
    side.packets.commit_packets()
    assert [packet.data for packet in side.log] == line.sent
    assert [len(records(packet, protocol)) for packet in line.sent] == counts
