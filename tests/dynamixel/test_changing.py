"""What `dxlrun servo` does to one servo, on virtual time, judged by the simulated servo and the ledger."""

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


class Rig:
    """One servo to deal with, and perhaps others beside it."""

    def __init__(self, model="XM430-W350", protocol=2.0, others=(), cannot=()):
        servos = (ServoConfig(1, model, 2.0), *(ServoConfig(each, model, 1.5) for each in others))
        self.line = VirtualLine(*servos, protocol=protocol, cannot=cannot)
        self.tool = ToolLine(self.line)
        (found,) = find_servo(self.tool, 1, Search((protocol,), (RATE,)))
        self.one = OneServo(self.tool, found)
        self.start = len(self.line.ledger.entries)

    @property
    def servo(self):
        self.line.bus.advance_to(self.line.clock.now_ns())
        return self.line.bus.servos[0]

    def wait(self, seconds=1.0):
        self.line.clock.wait_until(self.line.clock.now_ns() + round(seconds * 1e9))

    def refused(self, change, said):
        """Make a change that is refused, with these words."""
        with pytest.raises(ServoFault, match=said):
            change(self.one)

    def instructions(self):
        """Return what was sent since: 2 is read, 3 write, 6 factory reset, 8 reboot."""
        sent = [e.data for e in self.line.ledger.entries[self.start :] if e.direction == "in"]
        return [data[7] if data[2] == 0xFD else data[4] for data in sent]


def lose_the_write(rig):
    """Lose the instruction behind a read of Torque Enable and three pings for another servo: the write."""
    rig.line.bus.after(4, lambda: rig.line.bus.alter_next_instruction("lost", lambda data: b""))


def test_a_change_of_the_address_that_did_not_happen_is_noticed():
    rig = Rig()
    lose_the_write(rig)
    rig.refused(
        lambda one: one.change_id(5),
        r"still answers under its old ID after ID \(7\) = 5 was written",
    )
    lose_the_write(rig)
    rig.refused(
        lambda one: one.change_rate(1_000_000),
        r"still answers at 57600 bit/s after Baud Rate \(8\) = 3 was written",
    )
    assert rig.one.read_items(["id", "baud_rate"]) == {"id": 1, "baud_rate": 1}


def test_another_servo_at_the_new_address_is_not_taken_for_it():
    rig = Rig()
    other = rig.line.bus.add_servo(ServoConfig(5, "XL430-W250", 1.0))
    other.silence()

    def swap():
        other.silence(False)
        rig.line.bus.servos[0].silence()

    rig.line.bus.after(5, swap)
    rig.refused(lambda one: one.change_id(5), "has model number 1060, not 1020")


PROTOCOLS = [("AX-12A", 1.0), ("MX-64", 1.0), ("XM430-W350", 2.0), ("XL-320", 2.0)]


@pytest.mark.parametrize(("model", "protocol"), PROTOCOLS)
def test_a_servo_gets_another_id_and_is_looked_for_there(model, protocol):
    rig = Rig(model, protocol)
    assert rig.one.change_id(42) == "has ID 42 (before: 1)"
    assert rig.servo.registers["id"] == 42
    assert rig.one.read_items(["id"]) == {"id": 42}
    assert rig.instructions().count(3) == 1  # EEPROM wears


def test_an_id_that_somebody_has_is_not_given():
    rig = Rig(others=(2,))
    rig.refused(lambda one: one.change_id(2), "another servo has ID 2 at 57600 bit/s; nothing was changed")
    assert 3 not in rig.instructions()


def test_a_lost_acknowledgement_of_an_id_decides_nothing():
    rig = Rig()
    rig.servo.poke("status_return_level", 1)
    assert rig.one.change_id(5) == "has ID 5 (before: 1)"


@pytest.mark.parametrize(("model", "protocol"), PROTOCOLS)
def test_every_rate_of_the_table_can_be_set(model, protocol):
    rig = Rig(model, protocol)
    before = RATE
    for rate in rig.one.table.baud_rates.values():
        assert rig.one.change_rate(rate) == f"runs at {rate} bit/s (before: {before})"
        assert rig.servo.baud_rate == pytest.approx(rate, rel=0.03)
        before = rig.one.baud_rate
        assert before == rate


def test_a_rate_is_not_given_that_the_adapter_or_the_model_does_not_have_or_somebody_listens_at():
    rig = Rig(others=(2,), cannot=(4_500_000,))
    rig.line.bus.servos[1].poke("baud_rate", 3)
    rig.line.bus.servos[1].poke("id", 1)
    rig.refused(lambda one: one.change_rate(4_500_000), "cannot run at 4500000 bit/s; nothing was changed")
    with pytest.raises(InputError, match="has no baud rate of 12345 bit/s; give one of 9600, "):
        rig.one.change_rate(12_345)
    rig.refused(lambda one: one.change_rate(1_000_000), "another servo has ID 1 at 1000000 bit/s")
    assert 3 not in rig.instructions()
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
    ],
)
def test_what_a_servo_cannot_do_is_refused_and_nothing_is_written(model, poked, change, said):
    rig = Rig(model, 1.0 if model == "AX-12A" else 2.0)
    for name, value in poked.items():
        rig.servo.poke(name, value)
    rig.refused(change, said)
    assert 3 not in rig.instructions()


@pytest.mark.parametrize(
    "change",
    [
        lambda one: one.change_id(7),
        lambda one: one.change_rate(1_000_000),
        lambda one: one.factory_reset(Reset.ALL),
        lambda one: one.write_registers([one.register("return_delay_time", 0)]),
        OneServo.back_up,
    ],
)
def test_nothing_in_the_eeprom_changes_while_the_servo_holds_torque(change):
    rig = Rig()
    rig.servo.poke("torque_enable", 1)
    rig.refused(change, "dxlrun servo /dev/ttyVirtual 1 torque off")
    assert set(rig.instructions()) == {2}


def test_a_register_is_written_only_where_it_differs():
    rig = Rig()
    wanted = [rig.one.register("return_delay_time", 0), rig.one.register("position_p_gain", 800)]
    assert rig.one.write_registers(wanted) == ("Return Delay Time (9) was changed from 250 to 0",)
    assert rig.servo.registers["return_delay_time"] == 0
    assert rig.instructions().count(3) == 1


def test_a_reboot_is_waited_for():
    rig = Rig()
    rig.servo.boot_ns = 1_500_000_000
    rig.servo.poke("position_p_gain", 3)
    assert rig.one.reboot() == "rebooted, and is limp"
    assert rig.servo.registers["position_p_gain"] == 800


def test_a_servo_that_does_not_come_back_is_missed():
    rig = Rig()
    rig.servo.boot_ns = 60_000_000_000
    rig.refused(OneServo.reboot, "has not answered for 5 s; find it with `dxlrun scan")


def test_a_reboot_that_did_not_happen_is_noticed():
    rig = Rig()
    rig.wait(9)
    rig.line.bus.advance_to(rig.line.clock.now_ns())
    rig.line.bus.after(1, lambda: rig.line.bus.alter_next_instruction("lost", lambda data: b""))
    rig.refused(OneServo.reboot, "did not reboot: its Realtime Tick is")


@pytest.mark.parametrize(
    ("keep", "address"),
    [
        (Reset.ALL, (1, 57_600)),
        (Reset.KEEP_ID, (9, 57_600)),
        (Reset.KEEP_ID_AND_BAUD_RATE, (9, 1_000_000)),
    ],
)
def test_a_factory_reset_keeps_what_it_shall(keep, address):
    rig = Rig()
    rig.one.write_registers([rig.one.register("return_delay_time", 7)])
    rig.one.change_id(9)
    rig.one.change_rate(1_000_000)
    said = rig.one.factory_reset(keep)
    assert said == f"has the factory values, ID {address[0]} at {address[1]} bit/s"
    assert (rig.servo.registers["id"], rig.servo.baud_rate) == address
    assert rig.servo.registers["return_delay_time"] == 250


def test_a_factory_reset_of_protocol_1_keeps_nothing():
    rig = Rig("AX-12A", 1.0)
    rig.one.change_id(9)
    assert rig.one.factory_reset(Reset.ALL) == "has the factory values, ID 1 at 1000000 bit/s"


def test_a_factory_reset_beside_a_servo_as_shipped_is_refused():
    rig = Rig(others=(2,))
    rig.one.change_id(9)
    rig.line.bus.servos[1].poke("id", 1)
    rig.refused(lambda one: one.factory_reset(Reset.ALL), "another servo has ID 1")
    assert 6 not in rig.instructions()


def test_a_servo_keeps_and_takes_back_its_own_backup():
    rig = Rig()
    rig.one.write_registers([rig.one.register("return_delay_time", 7)])
    assert rig.one.back_up() == "stored its control table in its internal backup"
    rig.one.write_registers([rig.one.register("return_delay_time", 9)])
    rig.one.take_back()
    assert rig.servo.registers["return_delay_time"] == 7


@pytest.mark.parametrize(("model", "protocol"), PROTOCOLS)
def test_torque_comes_where_the_servo_stands(model, protocol):
    rig = Rig(model, protocol)
    before = rig.servo.shaft_angle
    assert "holds torque in position mode at its present tick" in rig.one.torque(True)[0]
    rig.wait()
    assert rig.servo.torque_on
    assert rig.servo.shaft_angle == pytest.approx(before, abs=0.01)
    assert rig.one.torque(True) == ("holds torque, as before",)
    assert rig.one.torque(False) == ("is limp",)
    assert not rig.servo.torque_on


WHEEL = {"cw_angle_limit": 0, "ccw_angle_limit": 0}  # of Protocol 1.0


@pytest.mark.parametrize(
    ("registers", "mode"),
    [
        ({"operating_mode": 1}, "velocity"),
        ({"operating_mode": 4}, "position"),
        ({"operating_mode": 16}, "pwm"),
        ({"operating_mode": 0}, "effort"),
        ({"operating_mode": 5}, "effort-position"),
        (WHEEL, "velocity"),
    ],
)
def test_torque_comes_in_every_mode_and_moves_nothing(registers, mode):
    rig = Rig(*PROTOCOLS[0]) if registers is WHEEL else Rig()
    for name, value in registers.items():
        rig.one.write_registers([rig.one.register(name, value)])
    before = rig.servo.shaft_angle
    assert f"holds torque in {mode} mode" in rig.one.torque(True)[0]
    rig.wait()
    assert rig.servo.torque_on
    assert rig.servo.shaft_angle == pytest.approx(before, abs=0.01)


def test_the_led_blinks_and_is_left_as_it_was():
    rig = Rig()
    rig.servo.poke("led", 1)
    assert rig.one.blink(2) == "blinked 2 times"
    assert rig.servo.registers["led"] == 1
    assert rig.instructions().count(3) == 4


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_the_backup_of_every_model_fits_that_model_and_heals_it(tmp_path, protocol):
    for table in all_tables():
        if table.protocol != protocol or RATE not in table.baud_rates.values() or table.firmware:
            continue
        rig = Rig(table.model, protocol)
        names = [name for name in table.items if not name.startswith("indirect_")]
        assert list(rig.one.read_items(names, refused=True)) == names, "all of it can be read"
        values = rig.one.read_items(servo_backup.kept_items(table), refused=True)
        path = tmp_path / f"{table.model}.json"
        servo_backup.write_backup(path, servo_backup.stamped(table, 1, (1, RATE), values))
        wanted = servo_backup.registers_to_restore(path, servo_backup.read_backup(path), table)
        assert not rig.one.differences(wanted)
        changed = [each for each in wanted if each.name in ("return_delay_time", "position_p_gain", "punch")]
        assert changed
        for each in changed:
            rig.servo.poke(each.name, 3)
        rig.one.write_registers(wanted)
        assert rig.instructions().count(3) == len(changed)
        assert all(rig.servo.registers[each.name] == each.value for each in changed)


TRIPPED = "cleared Bus Watchdog (98) = 255 (tripped): it had stopped the servo"
STOOD = "holds torque in position mode at its present tick 1304"


def trip(rig, torque):
    """Leave the servo as a killed run does: stopped by its Bus Watchdog, with a goal elsewhere."""
    rig.servo.poke("goal_position", 3000)
    rig.servo.poke("bus_watchdog", -1)
    rig.servo.poke("torque_enable", torque)


@pytest.mark.parametrize("torque", [0, 1])
def test_torque_on_clears_a_tripped_bus_watchdog_and_holds_where_the_servo_stands(torque):
    rig = Rig()
    trip(rig, torque)
    assert rig.one.torque(True) == (TRIPPED, STOOD)
    rig.wait()
    assert rig.servo.torque_on
    assert rig.servo.registers["bus_watchdog"] == 0
    assert rig.servo.shaft_angle == pytest.approx(2.0, abs=0.002)


def test_torque_on_clears_a_bus_watchdog_that_would_trip():
    rig = Rig()
    rig.servo.poke("bus_watchdog", 10)
    armed = "cleared Bus Watchdog (98) = 10: it would have stopped the servo after 200 ms without"
    done = rig.one.torque(True)
    assert done == (f"{armed} an instruction", STOOD)
    rig.servo.poke("bus_watchdog", 10)
    assert rig.one.torque(True) == (f"{armed} an instruction", "holds torque, as before")
    rig.wait()
    assert rig.servo.registers["bus_watchdog"] == 0


@pytest.mark.parametrize("torque", [0, 1])
def test_a_goal_that_is_written_clears_a_tripped_bus_watchdog(torque):
    rig = Rig()
    trip(rig, torque)
    done = rig.one.write_registers([rig.one.register("goal_position", 1500)])
    assert done[0] == TRIPPED
    assert done[-1].endswith(" to 1500")
    assert (STOOD in done) == bool(torque)
    assert (rig.servo.registers["bus_watchdog"], rig.servo.registers["goal_position"]) == (0, 1500)


@pytest.mark.parametrize("torque", [0, 1])
def test_a_goal_that_is_set_already_clears_a_tripped_bus_watchdog_too(torque):
    rig, already = Rig(), "Goal Position (116) is 3000 already"
    trip(rig, torque)
    asked = VerbCall(("goal_position", "3000"), None, yes=False)
    done = VERBS["set"].do(rig.one, asked)
    moved = [STOOD, "Goal Position (116) was changed from 1304 to 3000"]
    assert [*done] == [already, TRIPPED, *(moved if torque else [])]
    assert (rig.servo.registers["bus_watchdog"], rig.servo.registers["goal_position"]) == (0, 3000)
    rig.wait(6)
    assert rig.servo.shaft_angle == pytest.approx(
        3000 * rig.one.table.rad_per_tick if torque else 2.0, abs=0.01
    )
    again = VerbCall(("goal_position", "3000"), None, yes=False)
    assert [*VERBS["set"].do(rig.one, again)] == [already]


def test_a_bus_watchdog_that_is_armed_stays_where_only_a_goal_is_written():
    rig = Rig()
    rig.servo.poke("bus_watchdog", 10)
    assert len(rig.one.write_registers([rig.one.register("goal_position", 1500)])) == 1
    assert rig.servo.registers["bus_watchdog"] == 10


def test_other_registers_leave_a_tripped_bus_watchdog_and_a_register_of_it_is_shown_as_tripped():
    rig = Rig()
    trip(rig, 0)
    done = rig.one.write_registers([rig.one.register("position_p_gain", 500)])
    assert done == ("Position P Gain (84) was changed from 800 to 500",)
    assert rig.one.torque(False) == ("is limp, as before",)
    assert rig.servo.registers["bus_watchdog"] == 255


@pytest.mark.parametrize("ticks", [0, 100])
@pytest.mark.parametrize("torque", [0, 1])
def test_a_servo_whose_tripped_bus_watchdog_is_written_stays_where_it_stands(torque, ticks):
    rig = Rig()
    trip(rig, torque)
    done = rig.one.write_registers([rig.one.register("bus_watchdog", ticks)])
    armed = ("Bus Watchdog (98) was changed from 0 to 100",) if ticks else ()
    assert done == ((TRIPPED, STOOD) if torque else (TRIPPED,)) + armed
    rig.wait()
    assert rig.servo.shaft_angle == pytest.approx(2.0, abs=0.002)


def test_a_bus_watchdog_that_cannot_be_cleared_is_named_and_gets_no_torque():
    rig = Rig()
    trip(rig, 0)
    rig.servo.registers.watch_items(("bus_watchdog",), lambda: rig.servo.poke("bus_watchdog", -1))
    with pytest.raises(ServoFault, match=r"has Bus Watchdog \(98\) = 255 after 0 was written"):
        rig.one.torque(True)
    assert not rig.servo.torque_on


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
    assert all(value in (None, right) for value, right in zip(shown, true * 3, strict=True)), shown
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
def test_what_is_read_is_never_the_reply_to_an_earlier_request(at, late_ms, copies):
    """Replies of equal length that come late, or several times; a status does not carry what it answers."""
    rig = Rig()
    bus = rig.line.bus

    def disturb():
        bus.alter_next(1, "disturbed", lambda data: data, delay_ns=late_ms * 1_000_000, copies=copies)

    if at:
        bus.after(at, disturb)
    else:
        disturb()
    found = {}
    for name in (*TRUE, *TRUE):
        try:
            found = rig.one.read_items([name])
        except ServoFault:  # said, and nothing is shown
            continue
        assert found == {name: TRUE[name]}
    assert rig.one.read_items(list(TRUE)) == TRUE
