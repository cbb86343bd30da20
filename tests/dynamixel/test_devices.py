"""Devices in the exchange, and parts of features on a bus; the simulated ledger judges."""

import math
import struct
from importlib import import_module
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import change_replies, truncate_next
from tests.kit.plans import make_plan
from tests.kit.rigs import Rig, make_rig, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.dynamixel.bus_part import SafeEnd
from dxlrun.errors import StartUpError
from dxlrun.features.devices.plan import DeviceCommand
from dxlrun.features.feature import Feature
from dxlsim.bus.simulated_bus import PacketFault
from dxlwire.bus_plan import DevicePlan
from dxlwire.control_table.device_table import read_device_table
from dxlwire.plan.device_reads import device_blocks
from dxlwire.plan.line import Line
from dxlwire.wire import protocol1, protocol2

TABLE = """
kind = "device"
model = "XL430-W250"
model_number = 1060
protocol = 2.0
capabilities = {capabilities}
fast_sync_read_firmware = 45
cyclic = []
[items]
model_number = {{address = 0, size = 2, access = "R", area = "EEPROM"}}
led = {{address = 65, size = 1, access = "RW", maximum = 1, safe = 0}}
pwm = {{address = 100, size = 2, access = "RW", encoding = "twos_complement", minimum = -885, maximum = 885}}
warm = {{address = 104, size = 4, access = "R", encoding = "float32"}}
rate = {{address = 108, size = 4, access = "R", tick = "2 deg", offset = "10 deg"}}
speed = {{address = 112, size = 4, access = "R"}}
"""
ALL = '["bulk_read", "fast_sync_read", "sync_read"]'
NONE = "[]"
SERVOS = (1, 2, 3)


def devices(*wanted, first=101, capabilities=ALL):
    """Return devices, each by its items, as `bus_plan` takes them."""
    table = read_device_table(TABLE.format(capabilities=capabilities))
    line = Line(1_000_000, 0, 500_000, protocol2)
    found, column = [], 0
    for index, names in enumerate(wanted):
        blocks = device_blocks(line, table, {name: table.items[name] for name in names}, count(column))
        column += len(names)
        plan = DevicePlan(f"device_{index}", first + index, table.model, 1060, index, blocks)
        found.append((plan, table))
    return found


def commands_of_first(*names):
    """Return the plan of the commands of the first device."""
    items = read_device_table(TABLE.format(capabilities=ALL)).items
    own = [DeviceCommand.build(name, items[name], place) for place, name in enumerate(names)]
    return msgspec.json.encode({"device_0": own})


def started(*wanted, period_ns=20_000_000, fast=True, commands=(), **change):
    given = devices(*wanted, **change)
    plan = make_plan(SERVOS, protocol=2.0, model="XM430-W350", devices=given, fast=fast)
    rig = make_rig(plan, commands=commands_of_first(*commands))
    rig.period_ns = period_ns
    rig.hardware.start()
    rig.packets.list.clear()
    return rig


def device(rig, index=0):
    return rig.buses[0].servos[len(SERVOS) + index]


def poke(rig, name, number, index=0):
    device(rig, index).registers[name] = number


def cycle_valid(rig, count=1):
    """Run cycles in which every servo is valid."""
    for _ in range(count):
        rig.cycle()
        assert rig.states.valid.all()


@pytest.mark.parametrize("capabilities", [ALL, '["bulk_read"]', '["sync_read"]', NONE])
def test_states_come_in_si_units_with_the_servos_in_every_way_of_reading(capabilities):
    rig = started(("warm", "rate"), ("pwm",), ("speed",), capabilities=capabilities)
    poke(rig, "profile_acceleration", 7)
    poke(rig, "goal_velocity", int.from_bytes(struct.pack("<f", -0.25), "little") - (1 << 32))
    poke(rig, "goal_pwm", -3, 1)
    poke(rig, "profile_velocity", 12345, 2)
    rig.cycles(5)
    expected = [-0.25, math.radians(24), -3.0, 12345.0]
    np.testing.assert_allclose(rig.sources.values, expected, rtol=1e-12)
    assert rig.sources.valid.all()
    assert rig.states.valid.all()
    assert (rig.sources.age_ns >= 0).all()
    assert (rig.sources.age_ns < 3_000_000).all()
    assert rig.events.of(EventCode.READ_LOST) == []
    # one instruction where the devices can be asked with the servos, and one more for each that cannot
    groups = {ALL: 1, '["bulk_read"]': 2, '["sync_read"]': 4, NONE: 4}[capabilities]
    assert len(rig.plans[0].groups) == groups


def test_a_device_of_two_blocks_is_valid_when_both_came():
    rig = started(("led", "speed"), ("led", "speed"))
    (plan,) = rig.plans
    assert [len(one.blocks) for one in plan.devices] == [2, 2]
    assert len(plan.groups) == 2
    assert all(len({plan.members[index].servo_id for index in group}) == len(group) for group in plan.groups)
    poke(rig, "led", 1)
    poke(rig, "profile_velocity", 77, 1)
    rig.cycles(4)
    assert rig.sources.values.tolist() == [1, 0, 0, 77]
    assert rig.sources.valid.tolist() == [True, True]
    assert (rig.sources.age_ns > 100_000).all(), "the age is the older block's"


@pytest.mark.parametrize(("fast", "capabilities"), [(True, ALL), (False, ALL), (True, NONE)])
def test_a_lost_device_costs_the_servos_nothing(fast, capabilities):
    period_ns = 5_000_000 if capabilities == ALL and fast else 10_000_000
    wanted = ("speed",), ("speed",), ("speed",), ("speed",)
    rig = started(*wanted, fast=fast, capabilities=capabilities, period_ns=period_ns)
    rig.cycles(20)
    ages, latest = [], []
    for cycle in range(260 if period_ns == 5_000_000 else 150):
        if cycle in {10, 100}:
            device(rig, 2).silence(cycle == 10)
        began = rig.clock.now_ns()
        rig.hardware.read_states()
        latest.append(rig.clock.now_ns() - began)
        rig.goals.position[:] += 0.001 * (-1) ** cycle
        rig.hardware.write_goals()
        rig.hardware.idle(began + period_ns)
        assert rig.clock.now_ns() <= began + period_ns
        rig.clock.wait_until(began + period_ns)
        assert rig.states.valid.all()
        assert rig.hardware._servos[0].life.torqued.all()
        assert rig.sources.valid[[0, 1, 3]].all() or cycle in {10, 11, 12, 13}
        ages.append(int(rig.sources.age_ns[2]))
    assert max(latest) < period_ns - 1_000_000
    # away from the second cycle on: the reads are as short as without it
    assert max(latest[12:100]) <= max(latest[:10])
    assert ages[99] > 89 * period_ns
    assert ages[-1] < 3_000_000
    assert rig.sources.valid[2]
    assert rig.events.sources(EventCode.READ_LOST) == ["device_2"]
    (lost,), (back,) = rig.events.of(EventCode.DEVICE_LOST), rig.events.of(EventCode.DEVICE_BACK)
    assert lost[1].startswith("device_2 (ID 103 on bus main) missed ")
    assert back == ("device_2", "device_2 (ID 103 on bus main) is back, and is read again")
    assert rig.events.of(EventCode.SERVO_LOST) == []


@pytest.mark.parametrize("fast", [True, False])
def test_a_device_that_answers_only_alone_is_read_alone(monkeypatch, fast):
    rig = started(("speed",), ("speed",), fast=fast)
    device(rig).line.group_reads = 0
    for cycle in range(30):
        poke(rig, "profile_velocity", cycle)
        cycle_valid(rig)
    assert rig.sources.valid.all()
    assert rig.sources.values[0] == 29
    ((source, text),) = rig.events.of(EventCode.SETUP)[-1:]
    assert source == "device_0"
    assert text.endswith("does not answer combined reads; it is read alone from now on")
    assert len(rig.events.of(EventCode.READ_LOST)) <= 2  # its silence may silence the one behind it once


def test_a_silent_device_is_probed_by_requests_whose_replies_differ():
    """A late reply to one is not taken for the reply to the next."""
    rig = started(("speed",))
    device(rig).silence()
    rig.cycle()
    before = len(rig.into_bus())
    rig.cycles(20)
    probes = [packet for packet in rig.into_bus()[before:] if packet[4] == 101]
    assert len(probes) > 3
    assert all(one != after for one, after in pairwise(probes))


def test_a_device_without_one_of_its_states_stays_lost():
    rig = started(("led", "speed"), capabilities=NONE)
    speed = len(protocol2.status_packet(101, 0, bytes(4)))
    cut = PacketFault("lost", lambda reply: b"" if len(reply) == speed else reply)
    change_replies(rig.buses[0], lambda servo_id, _: cut if servo_id == 101 else None)
    cycle_valid(rig, 40)
    ((_, text),) = rig.events.of(EventCode.DEVICE_LOST)
    assert "missed" in text
    assert len(rig.events.of(EventCode.READ_LOST)) == 1


def test_a_device_is_inspected_where_its_line_was_lost_while_it_was_probed():
    rig = started(("speed",))
    truncate_next(rig.buses[0], 101, 0)

    def replace_adapter_and_device():
        rig.buses[0].unplug()
        rig.buses[0].plug_in()
        poke(rig, "model_number", 5)

    rig.when(lambda data: data[4] == 101, replace_adapter_and_device)
    rig.cycles(100)
    assert rig.states.valid.all()
    assert not rig.sources.valid[0]
    ((_, text),) = rig.events.of(EventCode.DEVICE_LOST)
    assert "has model number 5" in text


def test_a_device_that_answers_only_between_the_cycles_is_asked_seldom(monkeypatch):
    rig = started(("speed",), capabilities=NONE)
    rig.hardware._kernel.plan = lambda *_: False  # the parser shows when it reads
    receives = device(rig).receives
    reads = rig.hardware._servos[0].reads
    device(rig).line.asks = 1
    monkeypatch.setattr(device(rig), "receives", lambda now_ns: not reads.begun and receives(now_ns))
    cycle_valid(rig, 120)
    (lost, *_) = rig.events.of(EventCode.DEVICE_LOST)
    assert "answers single reads, but not those of the cycles" in lost[1]
    assert len(rig.events.of(EventCode.DEVICE_LOST)) <= 3


def test_a_number_that_is_none_is_not_believed():
    rig = started(("warm",))
    poke(rig, "goal_velocity", 0)
    rig.cycles(4)
    assert rig.sources.values.tolist() == [0.0]
    poke(rig, "goal_velocity", 0x7FC00000)
    for _ in range(3):
        rig.cycle()
        assert rig.sources.values.tolist() == [0.0]
        assert not rig.sources.valid[0]
    assert rig.sources.age_ns[0] > 40_000_000
    (event,) = rig.events.of(EventCode.IMPLAUSIBLE)
    assert event == (
        "device_0",
        "device_0 (ID 101 on bus main) sent non-finite values (warm): values discarded",
    )
    assert rig.states.valid.all()


def test_a_command_is_written_when_it_changes_and_now_and_then_and_ends_safe():
    rig = started(("speed",), commands=("pwm", "led"))

    def writes():
        return [packet[8:-2] for packet in rig.into_bus() if packet[4] == 101 and packet[7] == 0x03]

    rig.cycles(60)
    assert writes() == []  # NaN: as it is
    rig.device_commands[:] = -885.0, 1.0
    rig.cycles(20)
    assert writes() == [b"\x64\0" + struct.pack("<h", -885), b"\x41\0\x01"]
    rig.cycles(40)
    assert len(writes()) == 4
    device(rig).cut_power(rig.clock.now_ns() + 30_000_000)
    rig.cycles(6)
    assert device(rig).registers["led"] == 1  # it has it again
    rig.device_commands[:] = math.nan  # its controller left, failed, or its stream ended
    device(rig).silence()
    rig.cycle()
    device(rig).silence(on=False)
    rig.cycles(100)
    assert device(rig).registers["led"] == 0
    assert device(rig).registers["goal_pwm"] == 0x10000 - 885  # has no safe value: as it is
    poke(rig, "led", 1)
    rig.hardware.stop()
    assert device(rig).registers["led"] == 0


def test_a_command_without_an_acknowledgement_is_written_again_at_once():
    rig = started(("speed",), commands=("led",))
    writes = []

    def lose_first_reply():
        writes.append(rig.clock.now_ns())
        if len(writes) == 1:
            truncate_next(rig.buses[0], 101, 0)

    rig.when(lambda data: data[4] == 101 and data[7] == 0x03, lose_first_reply)
    rig.device_commands[:] = 1.0
    rig.cycles(10)
    assert len(writes) == 2


def test_an_item_that_counts_downward_has_its_range():
    item = msgspec.structs.replace(read_device_table(TABLE.format(capabilities=ALL)).items["pwm"], scale=-0.5)
    command = DeviceCommand.build("pwm", item, 0)
    assert (command.lowest, command.highest) == (-442.5, 442.5)


@pytest.mark.parametrize("silent", [False, True])
def test_release_disarms_watchdogs_before_they_can_wait_for_a_device(silent):
    """An owed acknowledgement, or silence, of the device must not outlast the watchdogs, 200 ms."""
    given = devices(("pwm",))
    plan = make_plan(SERVOS, protocol=2.0, model="XM430-W350", devices=given)
    rig = make_rig(replace(plan, watchdog_ticks=10), commands=commands_of_first("led"))
    rig.hardware.start()
    rig.cycles(5)
    (bus,) = rig.hardware._lines.buses
    bus.owed.add(Line(1_000_000, 0, 500_000, protocol2).write_range(101, 65, b"\1"), 0, rig.clock.now_ns())
    if silent:
        device(rig).silence()
    before_ns = rig.clock.now_ns()
    rig.hardware.leave_torque_on()
    assert rig.clock.now_ns() - before_ns < 100_000_000
    rig.wait(1_000_000_000)
    assert rig.registers("bus_watchdog")[: len(SERVOS)] == [0] * len(SERVOS)
    assert rig.torque()[: len(SERVOS)] == [True] * len(SERVOS)


def test_a_safe_value_that_is_refused_keeps_no_other_from_being_written(monkeypatch):
    table = TABLE.replace("maximum = 1, safe = 0", "maximum = 3, safe = 2")
    monkeypatch.setitem(globals(), "TABLE", table.replace("maximum = 885", "maximum = 885, safe = 7"))
    rig = started(("speed",), commands=("led", "pwm"))
    rig.hardware.stop()
    assert device(rig).registers["goal_pwm"] == 7
    assert rig.events.texts(EventCode.SHUTDOWN_FAILED) == [
        "device_0 (ID 101 on bus main) did not confirm that led is 2, its safe value"
    ]


def test_a_device_of_another_model_or_none_at_all_ends_the_start_with_a_sentence():
    given = devices(("speed",), ("speed",))
    plan = make_plan(SERVOS, protocol=2.0, model="XM430-W350", devices=given)
    wrong = tuple(replace(one, model_number=65_000, model="generic") for one in plan.devices)
    rig = make_rig(plan)
    rig.buses[0].servos[-1].silence()
    rig.hardware._lines.buses[0].plan = replace(plan, devices=wrong)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert str(caught.value).splitlines() == [
        "device_0 (ID 101 on bus main) has model number 1060 (XL430-W250), not 65000 (generic): "
        "correct `model` or the ID",
        "device_1 (ID 102 on bus main) does not answer: check its ID and baud rate (1000000 bit/s)",
    ]


def test_protocol_1_reads_each_device_by_itself_and_keeps_the_chain_of_servos():
    table = read_device_table(
        'kind = "device"\nmodel = "AX-12A"\nmodel_number = 12\nprotocol = 1.0\ncapabilities = []\n'
        "[items]\nvoltage = {address = 42, size = 1, access = 'R', tick = '1/10 V'}\n"
    )
    blocks = device_blocks(
        Line(1_000_000, 0, 500_000, protocol1), table, {"voltage": table.items["voltage"]}, [0]
    )
    plan = DevicePlan("board", 200, "AX-12A", 12, 0, blocks)
    rig = start_rig(make_plan((1, 2), devices=[(plan, table)], models=["MX-28", "MX-28"]))
    rig.cycles(4)
    assert rig.plans[0].groups == ((0, 1), (2,))
    assert rig.sources.values.tolist() == [pytest.approx(12.0)]
    rig.buses[0].servos[-1].silence()
    cycle_valid(rig, 50)
    assert not rig.sources.valid[0]
    assert rig.events.of(EventCode.DEVICE_LOST)


NOTED = Feature("noted", "noted_feature")
RUNTIME = """
from dxlrun.tooling.features import BusStage
calls = []
class Part:
    def judge_replies(self, now_ns): pass
    def recover_line(self): calls.append("line")
    def recover_servo(self, servo): calls.append(servo)
    def schedule_idle_work(self, time_ns): calls.append(f"{time_ns} ns")
STAGE = BusStage(lambda context: Part())
"""
SAFE = """
from dxlrun.tooling.features import SafeStage
STAGE = SafeStage(lambda lines, plan: (f"{len(lines.plans)} lines, {plan.decode()}",))
"""


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Calls that a feature `noted` got; rigs have it as their only one."""
    package = tmp_path / "noted_feature"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "runtime.py").write_text(RUNTIME)
    (package / "safe.py").write_text(SAFE)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("tests.kit.rigs.FEATURES", (NOTED,))
    made: list[Any] = import_module("noted_feature.runtime").calls
    made.clear()
    return made


def recovered(calls: list[Any]) -> list[Any]:
    return [call for call in calls if call == "line" or isinstance(call, int)]


def noted_rig() -> Rig:
    return start_rig(make_plan((1, 2), model="XL430-W250", protocol=2.0))


def test_part_gets_time_of_the_cycle_in_idle_time(calls):
    rig = noted_rig()
    for time_ns in (0, 20):
        rig.hardware.read_states()
        rig.hardware.write_goals()
        rig.hardware.idle(rig.clock.now_ns() + 10_000_000, time_ns)
    assert calls == ["0 ns", "20 ns"]


def test_part_recovers_servo_that_rebooted(calls):
    rig = noted_rig()
    rig.cycles(10)
    assert recovered(calls) == []
    rig.buses[0].servo(2).cut_power(rig.clock.now_ns() + 300_000_000)
    rig.cycles(200)
    assert rig.states.valid.all()
    assert recovered(calls) == [1]


def test_part_recovers_line_then_each_of_its_servos(calls):
    rig = noted_rig()
    rig.buses[0].unplug()
    rig.cycles(3)
    rig.buses[0].plug_in()
    rig.cycles(100)
    assert rig.states.valid.all()
    assert recovered(calls)[0] == "line"
    assert sorted(recovered(calls)[1:]) == [0, 1]


def test_safe_stage_gets_plan_of_its_feature(calls):
    end = SafeEnd.import_stages((NOTED,), {"noted": b"left and right", "devices": b"others"})
    assert end.make_safe(noted_rig().hardware._lines) == ("1 lines, left and right",)
    assert SafeEnd.import_stages((NOTED,), {}).make_safe(noted_rig().hardware._lines) == ("1 lines, ",)


@pytest.mark.parametrize(
    ("name", "call", "raised"),
    [("failing", "plan[0]", "IndexError: index out of range"), ("exiting", "exit(3)", "SystemExit: 3")],
)
def test_feature_that_fails_at_the_end_leaves_the_others_safe(name, call, raised, tmp_path, calls):
    failing = tmp_path / f"{name}_feature"
    failing.mkdir()
    (failing / "__init__.py").touch()
    (failing / "safe.py").write_text(
        f"from dxlrun.tooling.features import SafeStage\nSTAGE = SafeStage(lambda lines, plan: {call})\n"
    )
    end = SafeEnd.import_stages((Feature(name, f"{name}_feature", f"{name} 1.0"), NOTED), {})
    assert end.make_safe(noted_rig().hardware._lines) == (
        f"section {name} failed to set its safe state ({raised}); report it to the author of {name} 1.0",
        "1 lines, ",
    )
