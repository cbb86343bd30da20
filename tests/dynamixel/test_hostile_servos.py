"""Servos that answer with checksummed nonsense: nothing is raised, and the truth is known soon after.

Each test is 7 s of a robot at 50 Hz; CI runs one of each robot, `pytest --campaign=release FILE` 200.
"""

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.campaigns import campaign
from tests.kit.rigs import make_plan, start_rig

from dxlwire.modes import Mode
from dxlwire.plan.mode_plan import in_mode
from dxlwire.wire.dialect import dialect_of

ROBOTS = {
    "x": ("XM430-W350", 2.0, {}, "position_p_gain", (1, 2, 3, 4, 5)),
    "x_fast": ("XM430-W350", 2.0, {"fast": True}, "velocity_i_gain", (1, 2, 3, 4, 5)),
    "mx": ("MX-64", 1.0, {}, "p_gain", (1, 2, 3)),
    "ax": ("AX-12A", 1.0, {}, "cw_compliance_slope", (1, 2, 4)),
}
SLOW = ("present_temperature", "present_voltage", "present_input_voltage")
SYNC_WRITE = 0x83


class Liars:
    """Lets servos answer with other packets than their own, every checksum right."""

    def __init__(self, rig, chance):
        self._rig = rig
        self._chance = chance
        self._dialect = dialect_of(rig.plans[0].protocol)
        self._write = rig.ports.ports[0].write_packet
        self._often = chance.choice((0.1, 0.2, 0.4))
        rig.ports.ports[0].write_packet = self.write

    def write(self, data):
        packet, chance = bytes(data), self._chance
        two = self._dialect.PROTOCOL == 2.0
        instruction, servo_id = (packet[7], packet[4]) if two else (packet[4], packet[2])
        if instruction != SYNC_WRITE and chance.random() < self._often:
            liar = chance.choice((1, 2, 3)) if servo_id == 254 else servo_id
            self._rig.buses[0].alter_next(liar, "a lie", self._lie)
        self._write(data)

    def _lie(self, reply):
        """Return another ID, error or length, or other data; sometimes two packets."""
        chance, packets = self._chance, b""
        for _ in range(chance.choice((1, 1, 2))):
            length = max(0, len(reply) - self._dialect.OVERHEAD + chance.choice((0, 0, 0, 1, -1, 40, -40)))
            data = bytes(chance.choice((0, 1, 0xFD, 0xFF, chance.randrange(256))) for _ in range(length))
            servo_id = chance.choice((1, 2, 3, 0, 0xFD, 0xFE))
            error = chance.choice((0, 0, 0x80, 0xFF, chance.randrange(256)))
            packets += self._dialect.status_packet(servo_id, error, data)
        return packets

    def end(self):
        self._rig.ports.ports[0].write_packet = self._write


def robot(name):
    model, protocol, change, *_ = ROBOTS[name]
    middle = {} if model == "AX-12A" else {"reference": np.pi}
    plan = make_plan((1, 2, 3), model=model, protocol=protocol, return_delay_ns=0, **middle, **change)
    servos = tuple(replace(servo, torque_on_return=True, slow=SLOW) for servo in plan.servos)
    ticks = 10 if protocol == 2.0 else 0
    return start_rig(replace(plan, servos=servos, slow_period_ns=300_000_000, watchdog_ticks=ticks))


def act(rig, chance, name):
    """Wish for a mode or a register now and then."""
    *_, item, modes = ROBOTS[name]
    if chance.random() < 0.1:
        wanted = np.zeros(3, np.uint8)
        wanted[chance.randrange(3)] = chance.choice(modes)
        rig.hardware.set_modes(wanted)
    if chance.random() < 0.1:
        value = chance.choice((8, 16, 32))
        rig.hardware.write_register(chance.randrange(3), item, value, lambda *_: None)


def cycle(rig):
    """Run one cycle with goals of nothing: every joint stands."""
    for array in rig.goals.values:
        array[rig.states.mode == Mode.UNKNOWN] = np.nan
    for mode, array in ((2, rig.goals.velocity), (3, rig.goals.effort), (4, rig.goals.pwm)):
        array[rig.states.mode == mode] = 0.0
    start = rig.clock.now_ns()
    rig.hardware.read_states()
    rig.hardware.write_goals()
    rig.hardware.idle(start + rig.period_ns)
    rig.clock.wait_until(max(start + rig.period_ns, rig.clock.now_ns()))


@campaign(ci=1, night=40, release=200)
@pytest.mark.parametrize("name", ROBOTS)
def test_wrong_replies_raise_nothing_and_modes_and_torque_are_known_soon_after(name, number, chance):
    rig = robot(name)
    liars = Liars(rig, chance)
    for _ in range(150):
        act(rig, chance, name)
        cycle(rig)
    liars.end()
    for _ in range(200):  # a lost servo is probed once a second, and waits for the replies that it owes
        cycle(rig)
    torqued = rig.hardware._servos[0].life.torqued
    for servo in rig.plans[0].servos:
        registers, row = rig.servo(servo.servo_id).registers, servo.row
        mode = Mode(int(rig.states.mode[row]))
        if not rig.states.valid[row]:
            continue
        found = {value.name: registers[value.name] for each in servo.modes for value in each.operating}
        if mode is not Mode.UNKNOWN:
            assert in_mode(servo.mode_plan(mode), found), (servo.joint, mode, found)
        if torqued[row]:
            assert registers["torque_enable"] == 1, f"{servo.joint} gets goals without torque"
    assert rig.states.valid.all(), "\n".join(f"{e[3]}" for e in rig.events.list[-30:])
