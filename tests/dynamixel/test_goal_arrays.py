"""Which goals go out, and when: what changed, once more, and now and then what stays."""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.kit.rigs import make_plan

from dxlrun.channels.cycle import Commands
from dxlrun.description.modes import Mode
from dxlrun.dynamixel.exchange.goals import REPEATED, GoalArrays
from dxlrun.dynamixel.wire import protocol1, protocol2

PLAN8 = make_plan()

MODES = [Mode.POSITION, Mode.VELOCITY, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION]
ODD = st.sampled_from([np.nan, np.inf, -np.inf, 1e300, -1e300, 0.0, -0.0]) | st.floats(-10, 10)


def records(packet, protocol):
    """Take the parameters of a sync write apart by ID; its checksum must be right."""
    if protocol == 1.0:
        assert packet == packet[:-1] + bytes((protocol1.checksum(packet[2:-1]),))
        length, body = packet[6], packet[7:-1]
    else:
        assert packet == packet[:-2] + protocol2.crc(packet[:-2]).to_bytes(2, "little")
        length, body = packet[10], protocol2.unstuffed(packet[7:-2])[5:]
    assert len(body) % (length + 1) == 0
    return {body[at]: body[at + 1 : at + 1 + length] for at in range(0, len(body), length + 1)}


@settings(max_examples=40, deadline=None)
@given(
    moves=st.lists(
        st.tuples(st.sets(st.integers(0, 7)), st.sets(st.integers(0, 7)), st.integers(1, 60)), max_size=6
    )
)
def test_a_goal_is_sent_when_it_changed_once_more_and_every_so_many_cycles(moves):
    arrays, goals = GoalArrays(PLAN8), Commands.empty(8)
    goals.position[:] = 0.1
    last, asked, chosen, cycle = [0] * 8, [2] * 8, set(range(8)), 0
    for moved, without, cycles in [(set(), set(), 3), *moves]:
        for servo in moved:
            goals.position[servo] += 0.05 if goals.position[servo] < 0.5 else -0.9
        now = set(range(8)) - without
        for servo in moved | (now - chosen):
            asked[servo] = 2
        chosen = now
        included = np.array([servo in chosen for servo in range(8)])
        for _ in range(cycles):
            cycle += 1
            wanted = {s for s in chosen if asked[s] or cycle - last[s] >= REPEATED}
            asked = [max(0, count - 1) for count in asked]
            for servo in wanted:
                last[servo] = cycle
            packets = list(arrays.packets(goals, included))
            sent = {key for packet in packets for key in records(packet, 1.0)}
            assert sent == {PLAN8.servos[servo].servo_id for servo in wanted}
            assert len(packets) == bool(wanted)


@pytest.mark.parametrize("kind", [("AX-12A", 1.0), ("MX-64", 1.0), ("XM430-W350", 2.0)])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=st.lists(st.lists(ODD, min_size=3, max_size=3), min_size=4, max_size=4),
    modes=st.lists(st.sampled_from(MODES), min_size=3, max_size=3),
    ceiling=st.none() | st.lists(ODD.map(abs), min_size=3, max_size=3),
)
def test_whoever_has_a_goal_in_its_mode_gets_it_and_nobody_else(kind, values, modes, ceiling):
    model, protocol = kind
    plan = make_plan((1, 2, 3), model=model, protocol=protocol)
    arrays, goals = GoalArrays(plan), Commands(np.array(values))
    has = [{one.mode for one in servo.modes} for servo in plan.servos]
    modes = [mode if mode in own else Mode.UNKNOWN for mode, own in zip(modes, has, strict=True)]
    for index, mode in enumerate(modes):
        arrays.set_mode(index, mode)
    most = None if ceiling is None else np.array(ceiling)
    found = [set(records(each, protocol)) for each in arrays.packets(goals, np.ones(3, dtype=bool), most)]
    leads = {Mode.VELOCITY: goals.velocity, Mode.EFFORT: goals.effort, Mode.PWM: goals.pwm}
    assert set().union(*found) == {
        servo.servo_id
        for servo, mode in zip(plan.servos, modes, strict=True)
        if mode is not Mode.UNKNOWN and not np.isnan(leads.get(mode, goals.position)[servo.row])
    }
