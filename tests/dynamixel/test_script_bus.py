"""A script on simulated servos: what `Bus` sends, by the ledger, and what it refuses."""

import asyncio
import copy
import itertools
import pickle
import re
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from tests.kit.line_faults import corrupt_next, truncate_next

import dxlwire
from dxlrun.cli.tools import tool_log
from dxlrun.errors import InputError
from dxlrun.log.log_reader import read_log
from dxlsim import Ledger, SimulatedBus, VirtualPorts, bus_of_servos, serve_bus
from dxlwire import AsyncBus, Bus, PortError, ServoError, Session, line_plan
from dxlwire.bus import session
from dxlwire.clock import VirtualClock
from dxlwire.exceptions import NotCompiled
from dxlwire.packets import PacketKind

XM = "XM430-W350:1-3"
README = Path(dxlwire.__file__).with_name("README.md")
READ, WRITE, SYNC_WRITE = 0x02, 0x03, 0x83


class Script:
    """A bus of a script on simulated servos and virtual time."""

    def __init__(self, *servos, protocol=2.0):
        self.clock, self.ledger = VirtualClock(0), Ledger()
        simulated = bus_of_servos(servos, protocol=protocol, baud_rate=1_000_000)
        self.simulated = SimulatedBus(simulated, self.ledger, 0)
        ports = VirtualPorts(self.clock, [self.simulated])
        self.session = Session(ports, self.clock, line_plan("line", 1_000_000, protocol, 0), lambda: None)
        self.bus = Bus.on_session(self.session)

    def sent(self):
        """Return the instructions since the last call."""
        found = [entry.data for entry in self.ledger.entries if entry.direction == "in"]
        self.ledger.entries.clear()
        return found

    def let_pass(self, seconds):
        self.clock.wait_until(self.clock.now_ns() + round(seconds * 1e9))
        self.simulated.advance_to(self.clock.now_ns())


def written(packets, address):
    """Return the Protocol 2.0 writes to an address: ID and data."""
    found = [(one[4], one[10:-2]) for one in packets if one[7] == WRITE and one[8] == address]
    return [(servo_id, int.from_bytes(data, "little")) for servo_id, data in found]


@pytest.fixture
def script():
    return Script(XM)


def test_scan_finds_servos_of_both_protocols_with_their_models():
    assert Script("XL430-W250:7", "XM430-W350:1-2").bus.scan().models == (
        "XM430-W350",
        "XM430-W350",
        "XL430-W250",
    )
    old = Script("AX-12A:4", "MX-28:9", protocol=1.0)
    assert old.bus.scan(range(12)).ids == (4, 9)
    assert repr(old.bus.scan([4, 5])) == "ServoSet({4: 'AX-12A'})"
    assert len(Script(XM).bus.scan([77])) == 0


def test_servos_that_are_absent_or_of_another_model_are_refused(script):
    with pytest.raises(ServoError) as caught:
        script.bus.servos({1: "XM430-W350", 2: "XL430-W250", 9: "XM430-W350"})
    kinds = {servo_id: one.kind for servo_id, one in caught.value.failures.items()}
    assert kinds == {2: "wrong_model", 9: "no_reply"}
    other, absent = str(caught.value).splitlines()
    assert other == "ID 2 on line is XM430-W350, not XL430-W250"
    assert absent.endswith("did not answer the ping; find its ID and baud rate by `dxlrun scan PORT`")


def test_torque_goes_on_with_the_goal_at_the_present_position(script):
    servos = script.bus.scan()
    script.simulated.servos[0].turn_shaft(0.5, 1)
    script.let_pass(0.1)
    script.sent()
    servos[[1, 3]].torque = True
    sent = script.sent()
    position = servos.read("present_position", raw=True)
    assert written(sent, 116) == [(1, position[0]), (3, position[2])]
    assert [one[8] for one in sent if one[7] == WRITE] == [116, 64, 116, 64]  # goal first, for each servo
    assert servos.torque.tolist() == [True, False, True]
    servos.torque = True  # which leaves those alone that have torque
    assert written(script.sent(), 116) == [(2, position[1])]
    script.let_pass(1.0)
    assert servos.read("present_position", raw=True).tolist() == position.tolist()


def test_torque_of_a_servo_beyond_its_limits_stays_off(script):
    servos = script.bus.scan()
    servos[2].write("min_position_limit", 3.5)
    with pytest.raises(
        ServoError, match=r"ID 2 on line is at 3.142 rad, outside its limits 3.501 to 6.282 rad, so"
    ):
        servos.torque = True
    assert servos.torque.tolist() == [True, False, True]


def test_torque_goes_on_at_rest_in_a_mode_without_a_position_goal(script):
    servo = script.bus.servos({2: "XM430-W350"})
    servo.write("operating_mode", "velocity")
    servo.write("goal_velocity", 2.0)
    servo.torque = True
    assert servo.read("goal_velocity").tolist() == [0.0]
    assert servo.torque.tolist() == [True]


def test_eeprom_is_written_only_where_it_differs_and_without_torque(script):
    servos = script.bus.scan()
    script.sent()
    servos.write("operating_mode", ["position", "velocity", "position"])
    assert written(script.sent(), 11) == [(2, 1)]
    servos.torque = True
    with pytest.raises(ServoError, match="ID 1 on line has torque, so Operating Mode") as caught:
        servos.write("operating_mode", "extended_position")
    assert {one.kind for one in caught.value.failures.values()} == {"torque_on"}
    assert written(script.sent(), 11) == []


def test_each_servo_of_a_group_gets_another_id(script):
    servos = script.bus.scan()
    script.sent()
    servos.write("id", [4, 5, 6])
    assert written(script.sent(), 7) == [(1, 4), (2, 5), (3, 6)]


@pytest.mark.parametrize(
    ("item", "value", "words"),
    [
        ("goal_velocity", 25.0, r"Goal Velocity \(104\) of XM430-W350: 25 rad/s is outside -24.5"),
        ("goal_pwm", -1.1, "-1.1 is outside -1 to 1"),
        ("id", 9, "two servos of one line cannot have the same ID"),
        ("goal_position", float("nan"), "nan rad is outside"),
        ("goal_position", [1.0, 2.0], "2 values for 3 servos"),
        ("operating_mode", "wheel", "'wheel' is not a value"),
        ("led", "on", "the item takes a number"),
        ("led", {1: 1}, "the item takes a number"),
        ("present_position", 1.0, r"Present Position \(132\) of XM430-W350 is read-only"),
        ("torque_enable", 1, "use `servos.torque = True`"),
        ("goal_positon", 1.0, "has no item 'goal_positon'; did you mean goal_position"),
        (116, 1.0, r"has no item 116; did you mean goal_position\?"),  # Its address
        (9999, 1.0, "has no item 9999; `dxlrun models .*` lists the items"),
    ],
)
def test_wrong_values_are_refused_before_a_byte_is_sent(script, item, value, words):
    servos = script.bus.scan()
    script.sent()
    with pytest.raises((ValueError, LookupError), match=words):
        servos.write(item, value)
    assert script.sent() == []


def test_reads_are_repeated_and_writes_are_read_back(script):
    servos = script.bus.scan([2])
    script.sent()
    truncate_next(script.simulated, 2, 0)
    corrupt_next(script.simulated, 2)
    assert servos.read("present_temperature") > 20
    assert [one[7] for one in script.sent()] == [READ, READ, READ]
    truncate_next(script.simulated, 2, 0)  # executed, and its acknowledgement lost
    servos.write("goal_position", 3.0)
    assert [one[7] for one in script.sent()] == [WRITE, READ, READ]  # the item, and the Status Return Level
    script.simulated.servos[1].silence()
    with pytest.raises(ServoError) as caught:
        servos.write("goal_position", 3.1)
    assert str(caught.value) == "ID 2 on line did not answer the write of Goal Position (116)"
    assert [one[7] for one in script.sent()].count(WRITE) == 1


def test_refusal_of_a_servo_is_told(script):
    servos = script.bus.servos({1: "XM430-W350"})
    servos.write("max_position_limit", 3.0)
    with pytest.raises(
        ServoError, match=r"ID 1 on line refused the write of Goal Position \(116\)"
    ) as caught:
        servos.write("goal_position", 3.5)
    assert caught.value.failures[1].kind == "refused"


def test_servo_that_answers_no_read_is_told_from_a_silent_one_and_repaired(script):
    servos = script.bus.scan([1])
    servos.write("status_return_level", 0)
    with pytest.raises(
        ServoError, match=r"did not answer the read of LED \(65\), but answers a ping; write 2 to"
    ):
        servos.read("led")
    servos.write("status_return_level", 2)
    assert servos.read("status_return_level") == 2
    script.simulated.servos[0].silence()
    with pytest.raises(ServoError, match=r"did not answer the read of LED \(65\)$"):
        servos.read("led")
    old = Script("AX-12A:1", protocol=1.0)
    old.bus.scan([1]).write("status_return_level", 0)
    with pytest.raises(ServoError, match="did not answer the read of its model, but answers a ping"):
        old.bus.scan([1])


def test_refusal_because_of_the_watchdog_has_its_remedy(script):
    servos = script.bus.scan([1])
    servos.torque = True
    servos.write("bus_watchdog", 0.02)
    script.let_pass(0.1)
    with pytest.raises(ServoError, match="its Bus Watchdog has stopped it: write 0 to `bus_watchdog`"):
        servos.write("goal_position", 3.0)
    servos.write("bus_watchdog", 0)
    servos.write("goal_position", 3.0)


def test_reader_and_writer_have_si_units_for_each_servo():
    script = Script("XM430-W350:1", "XL430-W250:5", "XL320:3")
    servos = script.bus.scan()
    servos.torque = True
    read, write = servos.reader("present_position", "goal_position"), servos.writer("goal_position")
    assert (read.instructions, servos.ids) == ("fast sync read + read", (1, 3, 5))
    before = read()
    for _ in range(30):
        state = read()
        write(before.position + np.array([0.1, np.nan, -0.2]))
        script.let_pass(0.05)
    assert state.valid.all()
    assert (state.age < 0.01).all()
    assert state.position == pytest.approx(before.position + np.array([0.1, 0, -0.2]), abs=0.01)
    assert state.goal_position[1] == before.goal_position[1]
    assert state["present_position"] is not None
    raw = servos.reader("present_position", raw=True)()
    assert raw.position == pytest.approx(state.position / [0.00153398, 0.00511327, 0.00153398], abs=1)


def test_writer_sends_each_goal_in_each_call_within_the_range_of_the_item(script):
    servos = script.bus.scan()
    write = servos.writer("goal_position", "profile_velocity")
    script.sent()
    for _ in range(5):
        write(3.0, 1.0)
    sent = script.sent()
    assert sent == [sent[0]] * 5
    assert (sent[0][7], sent[0][8], sent[0][10]) == (SYNC_WRITE, 112, 8)  # the two items are one block
    write([3.0, 2.0, 1.0], [9e3, -1.0, 9e9])
    (packet,) = script.sent()
    assert [int.from_bytes(packet[at : at + 4], "little") for at in (13, 22, 31)] == [32767, 0, 32767]
    with pytest.raises(TypeError, match="takes 2 values"):
        write(1.0)
    with pytest.raises(ValueError, match="argument 1: 2 values for 3 servos"):
        write([1.0, 2.0], 1.0)
    with pytest.raises(ValueError, match="goal_position of ID 1 is '1'; give a number"):
        write("1", 1.0)
    for item, words in (
        ("operating_mode", "in the EEPROM"),
        ("present_load", "no item"),
        ("moving", "read-only"),
        ("torque_enable", "use `servos.torque = True`"),
    ):
        with pytest.raises((ValueError, LookupError), match=words):
            servos.writer(item)


@pytest.mark.parametrize(
    "items", [("goal_position", "profile_velocity"), ("profile_velocity", "goal_position")]
)
def test_servo_with_a_value_of_nan_gets_nothing(script, items):
    write = script.bus.scan().writer(*items)
    script.sent()
    write([np.nan, 3.0, 3.0], [2.0, 2.0, np.nan])  # a goal of NaN would be the end of the range
    (packet,) = script.sent()
    assert (packet[12], len(packet)) == (2, 12 + 9 + 2)
    for value, shown in (
        (None, "1 is None"),
        ([1.0, np.inf, 1.0], "2 is inf"),
        ([1, 1, None], "3 is None"),
    ):
        for values in ((value, 1.0), (1.0, value)):
            with pytest.raises(ValueError, match=f"{items[values.index(value)]} of ID {shown}"):
                write(*values)
    assert script.sent() == []


def test_goals_of_many_turns_are_sent_as_they_are(script):
    servos = script.bus.servos({1: "XM430-W350"})
    servos.write("operating_mode", "extended_position")
    servos.writer("goal_position")(20.0)
    assert servos.read("goal_position") == pytest.approx(20.0, abs=0.002)
    servos.write("goal_position", -20.0)
    assert servos.read("goal_position") == pytest.approx(-20.0, abs=0.002)
    old = Script("MX-28:1", protocol=1.0)
    servos = old.bus.scan([1])
    servos.write("cw_angle_limit", 4095, raw=True)
    servos.write("ccw_angle_limit", 4095, raw=True)
    servos.torque = True
    write, read = servos.writer("goal_position"), servos.reader("present_position", "goal_position")
    for _ in range(60):
        write(-7.0)
        old.let_pass(0.05)
    assert [*read().position, *read().goal_position] == pytest.approx([-7.0, -7.0], abs=0.01)


def test_torque_has_one_value_for_each_servo(script):
    servos = script.bus.scan()
    servos.torque = [True, False, True]
    before = servos.torque
    assert before.tolist() == [True, False, True]
    servos.torque = ~before
    assert servos.torque.tolist() == [False, True, False]
    for wrong in ("off", 2, [1, 0, 1]):
        with pytest.raises(ValueError, match="use True or False"):
            servos.torque = wrong
    with pytest.raises(ValueError, match="2 values for 3 servos"):
        servos.torque = [True, False]
    with pytest.raises(AttributeError):
        servos.torqe = False


def test_set_of_servos_is_a_mapping_of_ids_and_takes_numbers_of_numpy(script):
    servos = script.bus.scan()
    assert [servos[each].ids for each in servos] == [(1,), (2,), (3,)]
    assert (2 in servos, 7 in servos, servos[np.int64(3)].ids) == (True, False, (3,))
    servos.write("led", np.int64(1))
    servos.write("led", np.array(0))
    with pytest.raises(ValueError, match="is a list; give 'led' without brackets"):
        script.bus.scan().writer(["led"])
    with pytest.raises(ValueError, match="led is named twice"):
        servos.reader("led", "led")
    with pytest.raises(LookupError, match=r"no servo with ID 'led' here; there are \[1, 2, 3\]"):
        servos["led"]


def test_states_belong_to_the_caller(script):
    servos = script.bus.scan()
    read, first = servos.reader("present_position"), servos.reader("led", "present_position")()
    before = read()
    kept = before.position.copy()
    script.simulated.servos[1].turn_shaft(0.5, 1)
    script.simulated.servos[2].trigger_overload()
    script.let_pass(0.2)
    after = read()
    assert before.position.tolist() == first.position.tolist() == kept.tolist() != after.position.tolist()
    assert (before.alert.any(), after.alert.tolist()) == (False, [False, False, True])
    for array in (after.position, after.valid, after.alert):
        array[:] = 0
    assert (read().position > 0).all()
    last = read()
    assert (last.valid.all(), last.alert.tolist()) == (True, [False, False, True])
    script.simulated.servos[2].silence()
    assert (read().valid.tolist(), last.valid.all()) == ([True, True, False], True)


def test_states_are_copied_and_errors_pickled(script):
    state = copy.deepcopy(script.bus.scan().reader("present_position")())
    assert (state.position.shape, state.valid.all()) == ((3,), True)
    with pytest.raises(ServoError) as caught:
        script.bus.servos({9: "XM430-W350"})
    copied = pickle.loads(pickle.dumps(caught.value))  # noqa: S301  as pools of processes do
    assert (str(copied), copied.failures) == (str(caught.value), caught.value.failures)


def test_lost_servo_is_invalid_while_the_others_are_read(script):
    read = script.bus.scan().reader("present_position")
    for _ in range(4):
        assert read().valid.all()
    script.simulated.servos[1].silence()
    read()
    before = read()
    script.let_pass(0.1)
    state = read()
    assert state.valid.tolist() == [True, False, True]
    assert state.age[1] > before.age[1] + 0.1
    script.simulated.servos[1].silence(False)
    read()
    assert read().valid.all()


def test_first_reply_never_came():
    script = Script("XM430-W350:1-2")
    servos = script.bus.scan()
    script.simulated.servos[0].silence()
    state = servos.reader("present_position")()
    assert np.isnan([state.position[0], state.age[0]]).all()
    with pytest.raises(AttributeError, match="no item 'load'"):
        state.load  # noqa: B018  the access is what raises


def test_torque_stays_unless_the_bus_is_told(script):
    with script.bus as bus:
        bus.scan().torque = True
    assert all(servo.torque_on for servo in script.simulated.servos)
    script = Script(XM)
    with Bus.on_session(script.session, limp_at_exit=True) as bus:
        bus.scan().torque = True
    assert not any(servo.torque_on for servo in script.simulated.servos)


def test_all_others_are_limp_at_exit_when_one_is_silent(script):
    bus = Bus.on_session(script.session, limp_at_exit=True)
    for servo_id in (1, 2, 3):
        bus.servos({servo_id: "XM430-W350"}).torque = True
    script.simulated.servos[0].silence()
    with pytest.raises(ServoError, match="ID 1 on line did not answer the write of Torque Enable"):
        bus.close()
    assert [servo.torque_on for servo in script.simulated.servos] == [True, False, False]
    bus.close()


@pytest.mark.parametrize("call", ["reader", "read"])
def test_servos_are_limp_after_ctrl_c_in_the_middle_of_a_reply(call):
    pressed = []

    def beat():  # called while replies are awaited
        if pressed:
            pressed.clear()
            raise KeyboardInterrupt

    with serve_bus("XM430-W350:1-3") as served:
        opened = session.open_session(served.path, served.baud_rate, 2.0)
        opened.lines.beat = beat
        with pytest.raises(KeyboardInterrupt), Bus.on_session(opened, limp_at_exit=True) as bus:  # noqa: PT012
            servos = bus.servos(dict.fromkeys((1, 2, 3), "XM430-W350"))
            servos.torque = True
            read = servos.reader("present_position", "present_velocity")
            for _ in range(4):
                assert read().valid.all()
            pressed.append(True)
            if call == "reader":
                read()
            servos.read("led")
        assert not any(servo.torque for servo in served.snapshot_servos())
    sent = [entry.data for entry in served.ledger.entries if entry.direction == "in"]
    assert [one for one in written(sent, 64) if one[1] == 0] == [(1, 0), (2, 0), (3, 0)]  # none collided


def test_torque_off_is_sent_again_when_the_servo_has_not_executed_it(script):
    servos = script.bus.scan([2])
    servos.torque = True
    for _ in range(2):
        script.simulated.alter_next_instruction("lost", lambda packet: b"")
        script.simulated.alter_next_instruction("kept", bytes)
    servos.torque = False
    assert not script.simulated.servos[1].torque_on


def test_record_keeps_every_packet(script, tmp_path):
    path = tmp_path / "script.mcap"
    with script.bus as bus:
        bus.record(path)
        servos = bus.scan()
        read, write = servos.reader("present_position"), servos.writer("goal_position")
        for _ in range(20):
            write(read().position)
        with pytest.raises(ValueError, match="call `record` once"):
            bus.record(tmp_path / "other.mcap")
    recorded = read_log(path).packets
    for sent, direction in ((True, "in"), (False, "out")):
        kept = [bytes(one.data) for one in recorded if (one.kind == PacketKind.INSTRUCTION) == sent]
        there = [entry.data for entry in script.ledger.entries if entry.direction == direction]
        assert b"".join(kept) == b"".join(there)
    with pytest.raises(InputError, match=r"script\.mcap"):
        Script(XM).bus.record(path)


def test_recording_of_a_script_that_is_killed_is_read(script, tmp_path, monkeypatch):
    monkeypatch.setattr(tool_log, "CHUNK_NS", 0)
    path, copied = tmp_path / "script.mcap", tmp_path / "killed.mcap"
    script.bus.record(path)
    read = script.bus.scan().reader("present_position")
    for _ in range(20):
        read()
    copied.write_bytes(path.read_bytes())  # as the file is after SIGKILL
    script.bus.close()
    assert len(read_log(copied).packets) == len(read_log(path).packets) > 40


def test_asyncio_does_the_same_and_calls_take_turns():
    script = Script(XM)

    async def work():
        async with AsyncBus.on_session(script.session) as bus:
            servos = await bus.scan()
            await servos.write("operating_mode", "position")
            await servos.switch_torque(True)
            assert (await servos[[2]].torque()).tolist() == [True]
            read, write = servos.reader("present_position"), servos.writer("goal_position")
            states = await asyncio.gather(*(read() for _ in range(5)), servos.read("present_temperature"))
            await write(states[0].position)
            cancelled = asyncio.ensure_future(read())
            for _ in range(3):
                await asyncio.sleep(0)
            cancelled.cancel()
            assert (await servos.read("present_temperature")).all()
            assert (await read()).valid.all()
            with pytest.raises(ServoError):
                await bus.servos({9: "XM430-W350"})
            return states

    *states, temperatures = asyncio.run(work())
    assert all(state.valid.all() for state in states)
    assert (temperatures > 20).all()


def test_asyncio_makes_servos_limp_after_a_call_timed_out(script):
    async def work():
        async with AsyncBus.on_session(script.session, limp_at_exit=True) as bus:
            servos = await bus.scan()
            await servos.switch_torque([True, True, False])
            reading = asyncio.ensure_future(servos.reader("present_position")())
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            reading.cancel()
            await reading

    with pytest.raises(asyncio.CancelledError):
        asyncio.run(work())
    assert not any(servo.torque_on for servo in script.simulated.servos)


def test_threads_share_a_bus_and_the_event_loop_waits_for_real_lines():
    with serve_bus("XM430-W350:1-2") as served:
        with Bus(served.path, served.baud_rate) as bus:
            servos = bus.servos({1: "XM430-W350", 2: "XM430-W350"})
            read = servos.reader("present_position")
            valid = []
            threads = [threading.Thread(target=lambda: valid.extend(read().valid)) for _ in range(4)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert valid == [True] * 8
            with pytest.raises(PortError, match="is in use by this program itself; close the other one"):
                Bus(served.path)

        async def work():
            async with AsyncBus(served.path, served.baud_rate) as bus:
                servos = await bus.servos({1: "XM430-W350"})
                return (await servos.reader("present_position")()).valid.all()

        assert asyncio.run(work())
    with pytest.raises(ValueError, match=r"protocol 3 is unknown; use 1.0 or 2.0"):
        Bus("/dev/null", protocol=3)
    with pytest.raises(ValueError, match="baud rate '57600' is not an integer; write for example 57_600"):
        Bus("/dev/null", "57600")


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ([1, 2], "give each ID its model, such as {1: 'XM430-W350'}; `scan` finds both"),
        (1, "give each ID its model"),
        ({"1": "XM430-W350"}, "ID '1' does not exist; IDs are 0 to 252"),
        ({}, "name at least one servo"),
        ({254: "XM430-W350"}, "ID 254 does not exist; IDs are 0 to 252"),
        ({1: "SG90"}, "`dxlrun models` lists all"),
        ({1: "XL430-W25"}, "did you mean XL430-W250"),
        ({1: 1020}, "write XM430-W350, the name of this model number"),
    ],
)
def test_servos_without_ids_and_models_are_refused_before_a_byte_is_sent(script, named, words):
    script.sent()
    with pytest.raises((ValueError, LookupError), match=words):
        script.bus.servos(named)
    assert script.sent() == []


@pytest.mark.parametrize(
    ("servos", "protocol"), [(("XM430-W350:1-2", "XL430-W250:3"), 2.0), (("AX-12A:1-3",), 1.0)]
)
def test_without_the_kernel_the_sdk_does_the_same(monkeypatch, servos, protocol):
    def refuse(path=None):
        raise NotCompiled("it was not built")

    monkeypatch.setattr(session, "library", refuse)
    with serve_bus(*servos, protocol=protocol) as served:
        with Bus(served.path, served.baud_rate, protocol) as bus:
            found = bus.scan(range(6))
            assert (len(found), found[[2]].ids) == (3, (2,))
            found.torque = True
            read, write = found.reader("present_position", "goal_position"), found.writer("goal_position")
            before = read()
            write(before.position + np.array([0.1, np.nan, -3000.0]))
            state = read()
            assert state.valid.all()
            # The last goal is below the range of the item: -256 turns in extended position control
            assert state.goal_position[:2] == pytest.approx(
                before.position[:2] + np.array([0.1, 0]), abs=0.01
            )
            assert state.goal_position[2] == pytest.approx(0 if protocol == 1.0 else before.position[2])
            found.writer("goal_position", "led")(before.position, [np.nan, 1, 1])
            assert found.read("led").tolist() == [0, 1, 1]
            assert read().goal_position[0] == state.goal_position[0]
            served.inject("overload servo=3")
            served.inject("silence servo=2")
            state = read()
            assert state.valid.tolist() == [True, False, True]
            assert (before.alert.any(), state.alert.tolist()) == (False, [False, False, True])
            assert state.age[1] > state.age[2]
            with pytest.raises(ServoError, match=r"ID 2 on .* did not answer"):
                found.read("present_temperature")
            with pytest.raises(PortError, match="is in use"):
                Bus(served.path, served.baud_rate, protocol)

        async def work():
            async with AsyncBus(served.path, served.baud_rate, protocol) as bus:
                one = (await bus.scan([1]))[1]
                read, write = one.reader("present_position", raw=True), one.writer("goal_position", raw=True)
                await write((await read()).position)
                return await one.read("goal_position", raw=True)

        assert asyncio.run(work()) > 0


def test_examples_of_the_readme_run(capsys):
    examples = [
        one for one in re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL) if "Bus(" in one
    ]
    assert len(examples) == 2
    with serve_bus("XM430-W350:1-2") as served:
        for example in examples:
            exec(example.replace("/dev/ttyUSB0", served.path), {})  # noqa: S102  the README of this repository
        assert [servo.torque for servo in served.snapshot_servos()] == [True, True]
    assert "[3.2" in capsys.readouterr().out


def test_alerts_are_shown_with_the_states(script):
    read = script.bus.scan().reader("present_position")
    for _ in range(6):
        assert not read().alert.any()
    script.simulated.servos[1].trigger_overload()
    assert read().alert.tolist() == [False, True, False]
    for _ in range(6):
        found = read()  # by the kernel again
    assert found.alert.tolist() == [False, True, False]
    assert found.valid.all()
    script.simulated.servos[1].power_cycle()
    script.let_pass(2)
    assert not [read() for _ in range(4)][-1].alert.any()


def test_alerts_of_protocol_1_are_its_error_bits():
    script = Script("AX-12A:1-2", protocol=1.0)
    read = script.bus.scan([1, 2]).reader("present_position", "present_temperature")
    assert not read().alert.any()
    script.simulated.servos[0].trigger_overload()
    assert read().alert.tolist() == [True, False]


def test_a_servo_that_acknowledges_no_write_costs_its_timeout_once(script):
    servos = script.bus.scan([1])
    servos.write("status_return_level", 1)
    servos.write("led", 1)
    began_ns = script.clock.now_ns()
    script.sent()
    for value in (0, 1, 0):
        servos.write("led", value)
    assert script.clock.now_ns() - began_ns < 10_000_000
    assert [packet[7] for packet in script.sent()] == [WRITE, READ] * 3
    assert not script.simulated.servos[0].registers["led"]
    script.simulated.alter_next_instruction("lost", lambda packet: b"")
    with pytest.raises(ServoError, match="has not executed the write of LED"):
        servos.write("led", 1)
    servos.write("return_delay_time", 9, raw=True)
    assert script.simulated.servos[0].registers["return_delay_time"] == 9
    servos.write("status_return_level", 2)
    script.sent()
    servos.write("led", 1)
    assert [packet[7] for packet in script.sent()] == [WRITE]


def test_a_lost_line_is_opened_again_with_its_readers_and_writers(script):
    servos = script.bus.scan()
    servos.torque = True
    read, write = servos.reader("present_position"), servos.writer("goal_position")
    for _ in range(4):
        start = read().position
    script.bus.reopen()  # It is not lost
    script.simulated.unplug()
    for call in (read, lambda: write(start), lambda: servos.read("led"), script.bus.reopen):
        with pytest.raises(PortError, match="unplugged"):
            call()
    script.simulated.plug_in()
    with pytest.raises(PortError):
        read()  # Only `reopen` opens it
    script.bus.reopen()
    assert [read() for _ in range(4)][-1].valid.all()
    write(start + 0.1)
    script.let_pass(1)
    assert read().position == pytest.approx(start + 0.1, abs=0.02)
    script.bus.close()
    for call in (read, script.bus.reopen):
        with pytest.raises(PortError, match="is closed"):
            call()


@pytest.mark.parametrize("compiled", [True, False])
def test_a_replugged_adapter_is_opened_again(tmp_path, monkeypatch, compiled):
    monkeypatch.setattr(session, "_is_compiled", lambda: compiled)
    link = tmp_path / "adapter"
    with serve_bus("XM430-W350:1-2", link=link) as served:
        bus = Bus(str(link), served.baud_rate)
        servos = bus.scan([1, 2])
        read = servos.reader("present_position")
        assert read().valid.all()
    for call in (read, lambda: servos.read("led"), bus.reopen):
        with pytest.raises(PortError):
            call()
    with serve_bus("XM430-W350:1-2", link=link), bus:
        bus.reopen()
        assert [read() for _ in range(3)][-1].valid.all()
        assert servos.read("led").tolist() == [0, 0]


@pytest.mark.parametrize(("file", "step"), [("wire/receiver.py", 1), ("exchange/bus_engine.py", 13)])
def test_ctrl_c_in_any_line_of_the_exchange_leaves_the_next_call_right(file, step):
    path = str(Path(dxlwire.__file__).parent / file)
    for number in itertools.count():
        script = Script(XM)
        servos = script.bus.scan()
        read = servos.reader("present_position")
        position = read().position
        left = [number * step + 1]

        def trace(frame, event, argument, left=left):
            if frame.f_code.co_filename != path:
                return None
            left[0] -= event == "line"
            if not left[0]:
                raise KeyboardInterrupt
            return trace

        interrupted = False
        sys.settrace(trace)
        try:
            read()
            servos.read("led")
        except KeyboardInterrupt:
            interrupted = True
        finally:
            sys.settrace(None)
        servos[1].write("led", 1)
        assert servos.read("led").tolist() == [1, 0, 0], number
        assert [read() for _ in range(2)][-1].position == pytest.approx(position), number
        if not interrupted:
            assert number > 20
            return
