"""Servo tool on one line: what `dxlrun servo` does to one servo, judged by the servo and the ledger."""

from functools import partial

import pytest
from tests.kit.line_faults import delay_next
from tests.kit.rigs import VirtualLine

from dxlrun.cli.tools.servo import VERBS, VerbCall
from dxlrun.dynamixel.tools import servo_backup
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.scanning import Search, find_servo
from dxlrun.dynamixel.tools.tool_line import ToolLine
from dxlrun.errors import InputError, ServoFault
from dxlsim.simulation_plan import ServoConfig
from dxlwire.control_table import all_tables
from dxlwire.wire.protocol2 import Reset

RATE = 57_600
WRITE, FACTORY_RESET = 3, 6
PROTOCOLS = pytest.mark.parametrize(
    ("model", "protocol"), [("AX-12A", 1.0), ("MX-64", 1.0), ("XM430-W350", 2.0), ("XL-320", 2.0)]
)
TORQUE = pytest.mark.parametrize("torque", [0, 1])


class Rig:
    """One servo to deal with, and perhaps others on its line."""

    def __init__(self, model="XM430-W350", protocol=2.0, others=(), cannot=()):
        servos = (ServoConfig(1, model, 2.0), *(ServoConfig(each, model, 1.5) for each in others))
        self.line = VirtualLine(*servos, protocol=protocol, cannot=cannot)
        (found,) = find_servo(tool := ToolLine(self.line), 1, Search((protocol,), (RATE,)))
        self.one = OneServo(tool, found)
        self.start = len(self.line.heard)

    @property
    def servo(self):
        self.line.bus.advance_to(self.line.clock.now_ns())
        return self.line.bus.servos[0]

    @property
    def registers(self):
        return self.servo.registers

    def wait(self, seconds=1.0):
        self.line.clock.wait_until(self.line.clock.now_ns() + round(seconds * 1e9))

    def write(self, **registers):
        return self.one.write_registers([self.one.register(*each) for each in registers.items()])

    def poke(self, **registers):
        for name, value in registers.items():
            self.servo.poke(name, value)

    def count(self, instruction):
        """Return how many of an instruction were sent since."""
        sent = self.line.heard[self.start :]
        return [data[7] if data[2] == 0xFD else data[4] for data in sent].count(instruction)

    def refused(self, change, said):
        """Make a change that is refused with these words."""
        with pytest.raises(ServoFault, match=said):
            change(self.one)

    def lose_instruction(self, number):
        """Lose the instruction behind so many."""
        self.line.bus.after(number, partial(self.line.bus.alter_next_instruction, "lost", lambda _: b""))

    def stays(self, angle=2.0, within=0.002):
        """Wait, and check that the servo is where it was."""
        self.wait()
        assert self.servo.shaft_angle == pytest.approx(angle, abs=within)


@pytest.fixture
def rig():
    return Rig()


def test_a_change_of_the_address_that_did_not_happen_is_noticed(rig):
    # the write follows a read of Torque Enable and three pings for another servo
    for change, said in (
        (lambda one: one.change_id(5), r"its old ID after ID \(7\) = 5 was written"),
        (lambda one: one.change_rate(1_000_000), r"at 57600 bit/s after Baud Rate \(8\) = 3 was written"),
    ):
        rig.lose_instruction(4)
        rig.refused(change, f"still answers .*{said}")
    assert rig.one.read_items(["id", "baud_rate"]) == {"id": 1, "baud_rate": 1}


def test_another_servo_at_the_new_address_is_not_taken_for_it(rig):
    other = rig.line.bus.add_servo(ServoConfig(5, "XL430-W250", 1.0))
    other.silence()

    def swap():
        other.silence(False)
        rig.line.bus.servos[0].silence()

    rig.line.bus.after(5, swap)
    rig.refused(lambda one: one.change_id(5), "has model number 1060, not 1020")


@PROTOCOLS
def test_a_servo_gets_another_id_and_is_looked_for_there(model, protocol):
    rig = Rig(model, protocol)
    assert rig.one.change_id(42) == "has ID 42 (before: 1)"
    assert rig.registers["id"] == 42
    assert rig.one.read_items(["id"]) == {"id": 42}
    assert rig.count(WRITE) == 1  # EEPROM wears


def test_a_lost_acknowledgement_of_an_id_decides_nothing(rig):
    rig.poke(status_return_level=1)
    assert rig.one.change_id(5) == "has ID 5 (before: 1)"


@PROTOCOLS
def test_every_rate_of_the_table_can_be_set(model, protocol):
    rig = Rig(model, protocol)
    before = RATE
    assert rig.one.table.baud_rates
    for rate in rig.one.table.baud_rates.values():
        assert rig.one.change_rate(rate) == f"runs at {rate} bit/s (before: {before})"
        assert rig.servo.baud_rate == pytest.approx(rate, rel=0.03)
        before = rig.one.baud_rate
        assert before == rate


def test_an_address_is_not_given_that_another_servo_has_or_that_the_adapter_or_the_model_lacks():
    rig = Rig(others=(2,), cannot=(4_500_000,))
    rig.refused(lambda one: one.change_id(2), "another servo has ID 2 at 57600 bit/s; nothing was changed")
    rig.line.bus.servos[1].poke("baud_rate", 3)
    rig.line.bus.servos[1].poke("id", 1)
    rig.refused(lambda one: one.change_rate(4_500_000), "cannot run at 4500000 bit/s; nothing was changed")
    with pytest.raises(InputError, match="has no baud rate of 12345 bit/s; give one of 9600, "):
        rig.one.change_rate(12_345)
    rig.refused(lambda one: one.change_rate(1_000_000), "another servo has ID 1 at 1000000 bit/s")
    assert rig.count(WRITE) == 0
    assert rig.one.read_items(["id"]) == {"id": 1}  # and it is still talked to at its own


def test_two_servos_of_one_id_are_not_dealt_with():
    with pytest.raises(ServoFault, match="sends garbled replies now and then: do two servos have this ID"):
        Rig(others=(1,))


@pytest.mark.parametrize(
    ("model", "poked", "change", "said"),
    [
        ("AX-12A", {"lock": 1}, lambda one: one.change_id(7), r"has Lock \(47\) = 1"),
        ("AX-12A", {}, OneServo.reboot, "has no reboot"),
        ("AX-12A", {}, OneServo.back_up, "no internal backup"),
        ("XM430-W350", {}, OneServo.take_back, "refuses the restoring: result fail"),
        ("XW540-T260", {}, lambda one: one.blink(1), "no switchable LED"),
        *(
            ("XM430-W350", {"torque_enable": 1}, change, "dxlrun servo /dev/ttyVirtual 1 torque off")
            for change in (
                lambda one: one.change_id(7),
                lambda one: one.change_rate(1_000_000),
                lambda one: one.factory_reset(Reset.ALL),
                lambda one: one.write_registers([one.register("return_delay_time", 0)]),
                OneServo.back_up,
            )
        ),
    ],
)
def test_what_a_servo_cannot_do_or_not_with_torque_is_refused_and_nothing_is_written(
    model, poked, change, said
):
    rig = Rig(model, 1.0 if model == "AX-12A" else 2.0)
    rig.poke(**poked)
    rig.refused(change, said)
    assert (rig.count(WRITE), rig.count(FACTORY_RESET), rig.count(0x20)) == (
        0,
        0,
        change == OneServo.take_back,
    )


def test_a_register_is_written_only_where_it_differs(rig):
    said = rig.write(return_delay_time=0, position_p_gain=800)
    assert said == ("Return Delay Time (9) was changed from 250 to 0",)
    assert rig.registers["return_delay_time"] == 0
    assert rig.count(WRITE) == 1


def test_a_reboot_is_waited_for(rig):
    rig.servo.boot_ns = 1_500_000_000
    rig.poke(position_p_gain=3)
    assert rig.one.reboot() == "rebooted, and is limp"
    assert rig.registers["position_p_gain"] == 800


def test_a_servo_that_does_not_come_back_is_missed(rig):
    rig.servo.boot_ns = 60_000_000_000
    rig.refused(OneServo.reboot, "has not answered for 5 s; find it with `dxlrun scan")


def test_a_reboot_that_did_not_happen_is_noticed(rig):
    rig.wait(9)
    rig.line.bus.advance_to(rig.line.clock.now_ns())
    rig.lose_instruction(1)
    rig.refused(OneServo.reboot, "did not reboot: its Realtime Tick is")


@pytest.mark.parametrize(
    ("model", "keep", "address"),
    [
        ("XM430-W350", Reset.ALL, (1, 57_600)),
        ("XM430-W350", Reset.KEEP_ID, (9, 57_600)),
        ("XM430-W350", Reset.KEEP_ID_AND_BAUD_RATE, (9, 1_000_000)),
        ("AX-12A", Reset.ALL, (1, 1_000_000)),  # Protocol 1.0 keeps nothing
    ],
)
def test_a_factory_reset_keeps_what_it_shall(model, keep, address):
    rig = Rig(model, 1.0 if model == "AX-12A" else 2.0)
    rig.write(return_delay_time=7)
    rig.one.change_id(9)
    rig.one.change_rate(1_000_000)
    said = rig.one.factory_reset(keep)
    assert said == f"has the factory values, ID {address[0]} at {address[1]} bit/s"
    assert (rig.registers["id"], rig.servo.baud_rate) == address
    assert rig.registers["return_delay_time"] == 250


def test_a_factory_reset_beside_a_servo_as_shipped_is_refused():
    rig = Rig(others=(2,))
    rig.one.change_id(9)
    rig.line.bus.servos[1].poke("id", 1)
    rig.refused(lambda one: one.factory_reset(Reset.ALL), "another servo has ID 1")
    assert rig.count(FACTORY_RESET) == 0


def test_a_servo_keeps_and_takes_back_its_own_backup(rig):
    rig.write(return_delay_time=7)
    assert rig.one.back_up() == "stored its control table in its internal backup"
    rig.write(return_delay_time=9)
    rig.one.take_back()
    assert rig.registers["return_delay_time"] == 7


@PROTOCOLS
def test_torque_comes_where_the_servo_stands(model, protocol):
    rig = Rig(model, protocol)
    assert "holds torque in position mode at its present tick" in rig.one.torque(True)[0]
    rig.stays(within=0.01)
    assert rig.servo.torque_on
    assert rig.one.torque(True) == ("holds torque, as before",)
    assert rig.one.torque(False) == ("is limp",)
    assert not rig.servo.torque_on


@pytest.mark.parametrize(
    ("model", "registers", "mode"),
    [
        ("XM430-W350", {"operating_mode": 1}, "velocity"),
        ("XM430-W350", {"operating_mode": 4}, "position"),
        ("XM430-W350", {"operating_mode": 16}, "pwm"),
        ("XM430-W350", {"operating_mode": 0}, "effort"),
        ("XM430-W350", {"operating_mode": 5}, "effort-position"),
        ("AX-12A", {"cw_angle_limit": 0, "ccw_angle_limit": 0}, "velocity"),
    ],
)
def test_torque_comes_in_every_mode_and_moves_nothing(model, registers, mode):
    rig = Rig(model, 1.0 if model == "AX-12A" else 2.0)
    for name, value in registers.items():
        rig.write(**{name: value})
    assert f"holds torque in {mode} mode" in rig.one.torque(True)[0]
    rig.stays(within=0.01)
    assert rig.servo.torque_on


def test_the_led_blinks_and_is_left_as_it_was(rig):
    rig.poke(led=1)
    assert rig.one.blink(2) == "blinked 2 times"
    assert rig.registers["led"] == 1
    assert rig.count(WRITE) == 4


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_the_backup_of_every_model_fits_that_model_and_heals_it(tmp_path, protocol):
    tables = [table for table in all_tables() if table.protocol == protocol and not table.firmware]
    layouts = {
        tuple((item.name, item.address, item.initial) for item in table.items.values()): table
        for table in tables
        if RATE in table.baud_rates.values()
    }
    assert layouts
    for table in layouts.values():
        rig = Rig(table.model, protocol)
        names = [name for name in table.items if not name.startswith("indirect_")]
        assert list(rig.one.read_items(names, refused=True)) == names, "all of it can be read"
        values = rig.one.read_items(servo_backup.kept_items(table), refused=True)
        path = tmp_path / f"{table.model}.json"
        servo_backup.write_backup(path, servo_backup.stamped(table, 1, (1, RATE), values))
        wanted = servo_backup.registers_to_restore(path, servo_backup.read_backup(path), table)
        assert not rig.one.differences(wanted)
        changed = [each for each in wanted if each.name in {"return_delay_time", "position_p_gain", "punch"}]
        assert changed
        rig.poke(**{each.name: 3 for each in changed})
        rig.one.write_registers(wanted)
        assert rig.count(WRITE) == len(changed)
        assert all(rig.registers[each.name] == each.value for each in changed)


# The Bus Watchdog

TRIPPED = "cleared Bus Watchdog (98) = 255 (tripped): it had stopped the servo"
ARMED = "cleared Bus Watchdog (98) = 10: it would have stopped the servo after 200 ms without an instruction"
STOOD = "holds torque in position mode at its present tick 1304"


def tripped(torque):
    """Return a servo as a killed run leaves it: stopped by its Bus Watchdog, with a goal elsewhere."""
    rig = Rig()
    rig.poke(goal_position=3000, bus_watchdog=-1, torque_enable=torque)
    return rig


@TORQUE
def test_torque_on_clears_a_tripped_bus_watchdog_and_holds_where_the_servo_stands(torque):
    rig = tripped(torque)
    assert rig.one.torque(True) == (TRIPPED, STOOD)
    rig.stays()
    assert rig.servo.torque_on
    assert rig.registers["bus_watchdog"] == 0


def test_torque_on_clears_a_bus_watchdog_that_would_trip(rig):
    for held in (STOOD, "holds torque, as before"):
        rig.poke(bus_watchdog=10)
        assert rig.one.torque(True) == (ARMED, held)
    rig.wait()
    assert rig.registers["bus_watchdog"] == 0


@TORQUE
def test_a_goal_that_is_written_clears_a_tripped_bus_watchdog(torque):
    rig = tripped(torque)
    done = rig.write(goal_position=1500)
    assert done[0] == TRIPPED
    assert done[-1].endswith(" to 1500")
    assert (STOOD in done) == bool(torque)
    assert (rig.registers["bus_watchdog"], rig.registers["goal_position"]) == (0, 1500)


@TORQUE
def test_a_goal_that_is_set_already_clears_a_tripped_bus_watchdog_too(torque):
    rig, already = tripped(torque), "Goal Position (116) is 3000 already"
    asked = VerbCall(("goal_position", "3000"), None, yes=False)
    moved = [STOOD, "Goal Position (116) was changed from 1304 to 3000"]
    assert [*VERBS["set"].do(rig.one, asked)] == [already, TRIPPED, *(moved if torque else [])]
    assert (rig.registers["bus_watchdog"], rig.registers["goal_position"]) == (0, 3000)
    rig.wait(5)
    rig.stays(3000 * rig.one.table.rad_per_tick if torque else 2.0, within=0.01)
    assert [*VERBS["set"].do(rig.one, asked)] == [already]


def test_a_bus_watchdog_that_is_armed_stays_where_only_a_goal_is_written(rig):
    rig.poke(bus_watchdog=10)
    assert len(rig.write(goal_position=1500)) == 1
    assert rig.registers["bus_watchdog"] == 10


def test_other_registers_leave_a_tripped_bus_watchdog():
    rig = tripped(0)
    assert rig.write(position_p_gain=500) == ("Position P Gain (84) was changed from 800 to 500",)
    assert rig.one.torque(False) == ("is limp, as before",)
    assert rig.registers["bus_watchdog"] == 255


@TORQUE
@pytest.mark.parametrize(
    ("ticks", "armed"), [(0, ()), (100, ("Bus Watchdog (98) was changed from 0 to 100",))]
)
def test_a_servo_whose_tripped_bus_watchdog_is_written_stays_where_it_stands(torque, ticks, armed):
    rig = tripped(torque)
    assert rig.write(bus_watchdog=ticks) == ((TRIPPED, STOOD) if torque else (TRIPPED,)) + armed
    rig.stays()


def test_a_bus_watchdog_that_cannot_be_cleared_is_named_and_gets_no_torque():
    rig = tripped(0)
    rig.registers.watch_items(("bus_watchdog",), partial(rig.poke, bus_watchdog=-1))
    rig.refused(lambda one: one.torque(True), r"has Bus Watchdog \(98\) = 255 after 0 was written")
    assert not rig.servo.torque_on


# Late replies


@pytest.mark.parametrize(
    ("model", "protocol", "limit"),
    [("XM430-W350", 2.0, "max_position_limit"), ("AX-12A", 1.0, "ccw_angle_limit")],
)
@pytest.mark.parametrize("late_ms", [200, 270, 300, 400, 520])
def test_a_value_that_comes_late_is_not_shown_for_the_next_register(model, protocol, limit, late_ms):
    """The host stalls again and again: what it then hears was asked before."""
    rig = Rig(model, protocol)
    names = [limit, "present_position"]  # of one length
    true = [rig.one.read_items([name])[name] for name in names]
    assert true[0] != true[1]
    for _ in range(40):
        delay_next(rig.line.bus, 1, late_ms * 1_000_000)
    shown = []
    for name in names * 3:
        try:
            shown.append(rig.one.read_items([name])[name])
        except ServoFault:
            shown.append(None)
    assert all(value in {None, right} for value, right in zip(shown, true * 3, strict=True)), shown
    assert None not in shown or late_ms > 250
    assert rig.one.found.garbled is False


TRUE = {"id": 1, "operating_mode": 3, "temperature_limit": 80, "shutdown": 52, "led": 0}


@pytest.mark.parametrize("at", [0, 1, 3])
@pytest.mark.parametrize(
    ("late_ms", "copies"),
    # a burst of copies behind the timeout of a tool and its drain, 0.75 s, may meet a later request
    [
        *((late, copies) for late in (0, 20, 250, 600) for copies in (1, 2, 5, 40)),
        (900, 1),
        (900, 2),
        (1500, 2),
    ],
)
def test_what_is_read_is_never_the_reply_to_an_earlier_request(rig, at, late_ms, copies):
    """Replies of equal length that come late, or several times; a status does not carry what it answers."""
    disturb = partial(
        rig.line.bus.alter_next, 1, "disturbed", bytes, delay_ns=late_ms * 1_000_000, copies=copies
    )
    if at:
        rig.line.bus.after(at, disturb)
    else:
        disturb()
    found = {}
    for name in (*TRUE, *TRUE):
        try:
            found = rig.one.read_items([name])
        except ServoFault:  # said, and nothing is shown
            continue
        assert found == {name: TRUE[name]}
    assert found
    assert rig.one.read_items(list(TRUE)) == TRUE
