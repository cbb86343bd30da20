from contextlib import suppress

import pytest
from msgspec.structs import replace
from tests.kit.rigs import make_plan, make_rig, make_x

from dxlrun.channels.event_records import EventCode
from dxlrun.compile.joints.register_values import UnfitRegister
from dxlrun.dynamixel.findings import Findings
from dxlrun.dynamixel.servo.item_access import access_servo, first_reach
from dxlrun.dynamixel.servo.offline import rejoin
from dxlrun.dynamixel.servo.registers import read_registers, write_registers
from dxlrun.errors import StartUpError
from dxlrun.features.registers.settings import declarable, register_value
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import all_tables, find_table
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketLog


def register(table, name, value):
    item = table.items[name]
    return RegisterValue(item.address, item.size, value, name, item.area == "EEPROM")


def declared(plan, index=0, **values):
    """Return the plan with registers of one servo declared, EEPROM first."""
    servo = plan.servos[index]
    table = find_table(servo.model, plan.protocol)
    wanted = sorted((register(table, *one) for one in values.items()), key=lambda one: not one.eeprom)
    servos = list(plan.servos)
    servos[index] = replace(servo, settings=tuple(wanted))
    return replace(plan, servos=tuple(servos))


def bench(plan, **change):
    """Build a rig and a bus of ours on it; gives the rig and what runs a program there."""
    rig = make_rig(plan, **change)
    lines = Lines([plan], rig.ports, rig.clock, PacketLog())

    def execute(program):
        (result,) = lines.run_programs([program])
        return result

    return rig, execute


def settled(execute, plan):
    """Settle the declared registers of the first servo; return what was found."""
    found = Findings()
    execute(write_registers(first_reach(plan, plan.servos[0]), plan.servos[0].settings, found))
    return found


def rejoined(execute, plan, torque):
    """Take the first servo back; return whether it has torque, and what was found."""
    found, servo = Findings(), plan.servos[0]
    one = access_servo(plan, servo)
    return execute(rejoin(one, found, servo.start_mode, servo.settings, torque=torque)), found


def written(found):
    return [text for _, text in found.texts(EventCode.REGISTER_WRITTEN)]


def held(rig, name, index=0):
    item = rig.buses[0].servos[index].registers.table.items[name]
    return item.decode(rig.buses[0].servos[index].registers.read_bytes(item.address, item.size))


def test_only_what_differs_is_written_and_it_is_read_back():
    plan = declared(make_x((11, 12)), return_delay_time=250, position_p_gain=900, position_d_gain=0)
    rig, execute = bench(plan)
    rig.servo(11).poke("return_delay_time", 0)
    found = settled(execute, plan)
    assert found.problems == []
    assert written(found) == [
        "Return Delay Time (9) was changed from 0 to 250",
        "Position P Gain (84) was changed from 800 to 900",
    ]
    assert len(rig.writes()) == 2
    assert (held(rig, "return_delay_time"), held(rig, "position_p_gain")) == (250, 900)
    assert written(settled(execute, plan)) == []
    assert len(rig.writes()) == 2


def test_comparing_writes_nothing():
    plan = declared(make_x((11, 12)), position_p_gain=900, position_d_gain=0)
    rig, execute = bench(plan)
    found = execute(read_registers(first_reach(plan, plan.servos[0]), plan.servos[0].settings))
    assert found == {"position_p_gain": 800, "position_d_gain": 0}
    assert rig.writes() == []


def test_no_eeprom_is_written_while_a_servo_holds_torque():
    plan = declared(make_x((11, 12)), return_delay_time=250, position_p_gain=900)
    rig, execute = bench(plan)
    rig.servo(11).poke("return_delay_time", 0)
    rig.servo(11).poke("torque_enable", 1)
    (problem,) = settled(execute, plan).problems
    assert "holds torque, so Return Delay Time (9) in its EEPROM was not written" in problem
    assert rig.writes() == []


def test_no_eeprom_is_written_where_torque_cannot_be_read():
    plan = declared(make_x((11, 12)), return_delay_time=250)
    rig, execute = bench(plan)
    servo, line = rig.servo(11), rig.ports.ports[0]
    servo.poke("return_delay_time", 0)
    write, torque = line.write_packet, next(access_servo(plan, plan.servos[0]).read_torque()).packet

    def listen(data):
        servo.silence(bytes(data) == torque)
        write(data)

    line.write_packet = listen
    (problem,) = settled(execute, plan).problems
    assert "did not answer when its torque was read, so Return Delay Time (9) was not written" in problem
    assert rig.writes() == []


def test_a_servo_that_was_reset_gets_its_registers_and_its_torque_again():
    plan = declared(make_x((11, 12)), position_p_gain=900)
    rig, execute = bench(plan)
    settled(execute, plan)
    rig.servo(11).power_cycle()
    rig.clock.wait_until(rig.clock.now_ns() + 2_000_000_000)
    assert held(rig, "position_p_gain") == 800
    torqued, found = rejoined(execute, plan, torque=True)
    assert (found.problems, torqued) == ([], True)
    text = "Position P Gain (84) was changed from 800 to 900"
    assert found.texts(EventCode.REGISTER_WRITTEN) == [("arm_11_joint", text)]
    assert rig.torque() == [True, False]
    assert (
        abs(
            rig.servo(11).registers["goal_position"] * plan.servos[0].rad_per_tick - rig.servo(11).shaft_angle
        )
        < 0.002
    )


def test_a_limp_servo_that_may_not_have_torque_gets_no_goal():
    plan = make_plan((1, 3))
    rig, execute = bench(plan)
    torqued, found = rejoined(execute, plan, torque=False)
    assert (found.problems, torqued) == ([], False)
    assert rig.writes() == []
    rig.servo(1).poke("torque_enable", 1)
    torqued, _ = rejoined(execute, plan, torque=False)
    assert torqued
    assert rig.writes() == []  # it holds what it held


def test_a_servo_that_is_not_in_order_is_not_written_to():
    plan = declared(make_x((11, 12)), position_p_gain=900)
    rig, execute = bench(plan)
    rig.servo(11).poke("homing_offset", 5)
    torqued, found = rejoined(execute, plan, torque=True)
    assert (len(found.problems), torqued) == (1, False)
    assert rig.writes() == []


def test_a_factory_return_delay_is_mended_before_anybody_gets_torque():
    plan = declared(make_x((11, 12)), 1, return_delay_time=0, position_p_gain=850)
    rig = make_rig(plan)
    rig.servo(12).poke("return_delay_time", 250)
    rig.hardware.start()
    assert rig.events.of(EventCode.REGISTER_WRITTEN) == [
        ("arm_12_joint", "Return Delay Time (9) was changed from 250 to 0"),
        ("arm_12_joint", "Position P Gain (84) was changed from 800 to 850"),
    ]
    assert rig.events.of(EventCode.REGISTER_DIFFERS) == []
    assert (held(rig, "return_delay_time", 1), held(rig, "position_p_gain", 1)) == (0, 850)
    addresses = [address for _, address, _ in rig.writes()]
    assert addresses[:2] == [9, 84]
    assert set(addresses[2:]) == {plan.servos[0].goal.address, plan.servos[0].torque_address}
    assert rig.torque() == [True, True]


def test_a_servo_that_refuses_a_register_gets_no_torque():
    plan = declared(make_x((11, 12)), 1, position_p_gain=850)
    plan = declared(plan, 0, velocity_p_gain=1 << 15)  # beyond what the manual allows
    rig = make_rig(plan)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    (problem,) = str(caught.value).splitlines()
    assert problem.startswith("arm_11_joint (ID 11 on bus arm) refuses Velocity P Gain (78) = 32768: ")
    assert rig.torque() == [False, False]
    assert held(rig, "position_p_gain", 1) == 850


def test_a_servo_that_acknowledges_a_register_and_keeps_the_old_value_gets_no_torque():
    rig = make_rig(declared(make_x((11, 12)), 0, position_p_gain=850))
    rig.stick(11, "position_p_gain", 800)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    told = "arm_11_joint (ID 11 on bus arm) has Position P Gain (84) = 800 after 850 was written"
    assert str(caught.value).splitlines() == [told]
    assert rig.torque() == [False, False]
    assert rig.events.texts(EventCode.REGISTER_WRITTEN) == []


def test_a_difference_that_the_start_mends_does_not_forbid_it():
    plan = declared(make_plan((1, 3)), 1, status_return_level=2, return_delay_time=0)
    rig = make_rig(plan)
    rig.servo(3).poke("status_return_level", 1)
    rig.hardware.start()
    assert (held(rig, "status_return_level", 1), held(rig, "return_delay_time", 1)) == (2, 0)
    assert rig.events.texts(EventCode.REGISTER_WRITTEN) == [
        "Status Return Level (16) was changed from 1 to 2",
        "Return Delay Time (5) was changed from 250 to 0",
    ]
    eeprom = [address for _, address, _ in rig.writes() if address < 24]
    assert eeprom == [16, 5]  # each once, though the first was not acknowledged


def test_nothing_is_written_to_anybody_while_one_servo_is_not_what_the_file_says():
    rig = make_rig(declared(make_x((11, 12)), 0, position_p_gain=900))
    rig.servo(12).poke("model_number", 29)
    with pytest.raises(StartUpError, match="is model number 29"):
        rig.hardware.start()
    assert rig.writes() == []


def others(table):
    """Return for each declarable item of a model a value that it has not at first, where there is one."""
    for name in declarable(table):
        item = table.items[name]
        for value in (item.maximum, item.minimum, (item.minimum + item.maximum) // 2):
            with suppress(UnfitRegister):
                if value != item.initial:
                    yield register_value(table, name, value)
                    break


@pytest.mark.parametrize("protocol", [1.0, 2.0])
def test_whatever_may_be_declared_of_any_model_is_written_once_and_then_there(protocol):
    for table in [table for table in all_tables() if table.protocol == protocol]:
        plan = make_plan((5,), protocol=protocol, model=table.model, reference=1.5, lower=-0.1, upper=0.1)
        wanted = sorted(others(table), key=lambda one: not one.eeprom)
        plan = replace(plan, servos=(replace(plan.servos[0], settings=tuple(wanted)),))
        rig, execute = bench(plan, position=1.5)
        found = settled(execute, plan)
        assert found.problems == []
        assert len(written(found)) == len(rig.writes()) > 5, table.model
        assert written(settled(execute, plan)) == []
        memory = rig.buses[0].servos[0].registers
        assert all(memory.read_bytes(one.address, one.size) == one.data for one in wanted)
