import math
import re

import numpy as np
import pytest
from msgspec.structs import replace
from tests.kit.line_faults import delay_next
from tests.kit.rigs import (
    X_IDS,
    goal_block,
    make_plan,
    make_rig,
    make_x,
    position_tick,
    speed_tick,
    start_rig,
)

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import StartUpError
from dxlwire.bus_plan import RegisterValue
from dxlwire.control_table import all_tables
from dxlwire.wire import protocol2


@pytest.fixture
def started():
    return start_rig(make_x())


def test_a_cycle_is_one_sync_read_and_one_sync_write(started):
    count = len(started.into_bus())
    started.goals.position[:] = np.linspace(-0.5, 0.5, 8)
    started.goals.velocity[:] = 1.0
    started.cycle()
    goals = {
        servo.servo_id: goal_block(
            servo, position_tick(servo, started.goals.position[servo.row]), speed_tick(servo, 1.0)
        )
        for servo in started.plans[0].servos
    }
    assert started.into_bus()[count:] == [
        protocol2.sync_read(126, 10, X_IDS),
        protocol2.sync_write(112, 8, goals),
    ]


def test_the_exchange_takes_what_protocol_md_has(started):
    start = started.clock.now_ns()
    started.hardware.read_states()
    assert started.clock.now_ns() - start == 220_000 + 8 * 210_000


@pytest.mark.parametrize("others_answer", [False, True])
def test_a_silent_servo_costs_the_others_one_cycle_at_most(started, others_answer):
    started.buses[0].absent = "slot" if others_answer else "silent"
    started.cycle()
    started.servo(13).silence()
    started.cycle()
    assert started.states.valid.tolist() == [row < 2 or (others_answer and row > 2) for row in range(8)]
    started.cycle()
    assert started.states.valid.tolist() == [row != 2 for row in range(8)]
    start = started.clock.now_ns()
    started.hardware.read_states()
    assert started.clock.now_ns() - start < 5_000_000
    started.cycle()
    started.servo(13).silence(False)
    started.cycles(20)
    assert started.states.valid.all()
    lost = set(started.events.sources(EventCode.READ_LOST))
    assert "arm_13_joint" in lost
    assert len(lost) == (1 if others_answer else 6)
    started.restless = 0.002
    started.cycles(10)  # a servo that missed a turn is asked for its torque before it gets goals again
    goals = [packet for packet in started.into_bus() if packet[7] == 0x83][-1]
    assert list(goals[12:-2:9]) == list(X_IDS)


def test_an_overload_cuts_the_torque_and_the_servo_gets_no_more_goals(started):
    started.restless = 0.002
    started.cycle()
    started.servo(14).trigger_overload()
    started.cycles(6)
    assert started.torque()[3] is False
    assert any("overload error" in text for _, text in started.events.of(EventCode.SERVO_ERROR))
    assert started.events.sources(EventCode.SERVO_LIMP) == ["arm_14_joint"]
    goals = [packet for packet in started.into_bus() if packet[7] == 0x83][-1]
    assert list(goals[12:-2:9]) == [servo_id for servo_id in X_IDS if servo_id != 14]


WITH_STARTUP = [table.model for table in all_tables() if "startup_configuration" in table.items]


@pytest.mark.parametrize("model", WITH_STARTUP)
def test_no_model_starts_that_would_switch_its_torque_on_by_itself(model):
    rig = make_rig(
        make_plan((5,), protocol=2.0, model=model, reference=1.5, lower=-0.1, upper=0.1), position=1.5
    )
    rig.servo(5).poke("startup_configuration", 1)
    with pytest.raises(
        StartUpError, match=r"Startup Configuration \(\d+\) = 1, and this value switches its torque"
    ):
        rig.hardware.start()
    assert rig.torque() == [False]


def test_all_x_servos_but_the_xl_320_have_a_startup_configuration():
    x = [table.model for table in all_tables() if table.protocol == 2.0 and re.match(r"2?X", table.model)]
    assert set(x) - set(WITH_STARTUP) == {"XL-320"}


def test_older_firmware_is_not_asked_for_what_it_does_not_have():
    rig = start_rig(make_x((11,)), firmware=44)
    assert rig.torque() == [True]
    starts = {int.from_bytes(packet[8:10], "little") for packet in rig.into_bus() if packet[7] == 0x02}
    assert 9 in starts
    assert 60 not in starts


def test_a_declared_register_that_older_firmware_does_not_have_is_refused():
    plan = make_x((11, 12))
    wanted = RegisterValue(60, 1, 0, "startup_configuration", True)
    servos = tuple(replace(servo, settings=(wanted,)) for servo in plan.servos)
    rig = make_rig(replace(plan, servos=servos), firmware=44)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert [packet for packet in rig.into_bus() if packet[7] not in (1, 2)] == []
    assert str(caught.value).splitlines()[1] == (
        "arm_12_joint (ID 12 on bus arm) has firmware 44, but `registers` in the robot file has Startup "
        "Configuration (60), available from firmware 45: remove it, or update the servo"
    )


def test_an_overload_behind_a_standing_alert_is_reported(started):
    started.cycle()
    servo = started.servo(14)
    servo.poke("hardware_error_status", 0x01)
    started.cycles(5)
    servo.trigger_overload()
    started.cycles(120)
    assert started.torque()[3] is False
    told = started.events.texts(EventCode.SERVO_ERROR)
    assert len(told) == 3  # the alert, the first error, and once the second
    assert "overload error" in told[2]
    assert started.events.sources(EventCode.SERVO_LIMP) == ["arm_14_joint"]


def test_joint_position_of_an_x():
    servo = make_x((11,)).servos[0]
    assert servo.joint_position(2048) == pytest.approx(0.0, abs=0.002)


def test_an_alert_is_read_once_and_reported_in_the_manuals_words(started):
    started.cycle()
    begun = len(started.into_bus())
    started.servo(14).poke("hardware_error_status", 0x20)
    started.cycles(4)
    told = [text for source, text in started.events.of(EventCode.SERVO_ERROR) if source == "arm_14_joint"]
    assert len(told) == 2
    assert "alert" in told[0]
    assert "Hardware Error Status (70) = 32: overload error" in told[1]
    assert started.states.valid.all()
    assert started.into_bus()[begun:].count(protocol2.read_range(14, 70, 1)) == 1


def test_a_hardware_error_that_comes_back_is_reported_again(started):
    started.cycle()
    shown = []
    for error in (0x20, 0, 0x20):
        started.servo(14).poke("hardware_error_status", error)
        started.cycles(4)
        shown.append(int(started.states.hardware_error[3]))
    assert shown == [0x20, 0, 0x20]
    told = [text for text in started.events.texts(EventCode.SERVO_ERROR) if "overload error" in text]
    assert len(told) == 2


@pytest.mark.parametrize("late_ms", [20.1, 20.3, 20.6, 20.9, 40.3, 40.6])
def test_late_replies_of_three_silent_servos_are_never_taken_as_current(late_ms):
    """Three losses of one group in one cycle: the next request must still differ from the one before."""
    rig = start_rig(make_x((11, 12, 13)))
    servos = rig.buses[0].servos
    for servo in servos:
        servo.silence()
    rig.cycle()
    for servo in servos:
        servo.silence(False)
        delay_next(rig.buses[0], servo.servo_id, int(late_ms * 1e6))
    rig.cycle()
    for servo in servos:
        servo.silence()
    sent = len(rig.out_of_bus())
    for _ in range(2):  # no servo answers what is asked now: what arrives is old
        rig.cycle()
        assert not rig.states.valid.any()
    assert len(rig.out_of_bus()) > sent or late_ms > 40  # by then they are lost, and none is asked
    for servo in servos:
        servo.silence(False)
    rig.cycles(20)
    assert rig.states.valid.all()
    assert rig.packets.received() == rig.out_of_bus()


def test_servos_of_several_layouts_share_a_bus():
    rig = make_rig(
        make_plan(
            (1, 2, 3, 4),
            protocol=2.0,
            models=["XM430-W350", "XL-320", "XM430-W350", "XL-320"],
            reference=math.radians(150),
            lower=-2.0,
            upper=2.0,
        )
    )
    assert rig.plans[0].groups == ((0, 2), (1, 3))
    rig.hardware.start()
    rig.goals.position[:] = [0.3, -0.3, 0.2, -0.2]
    rig.cycles(80)
    errors = np.abs(rig.states.position - [0.3, -0.3, 0.2, -0.2])
    assert (errors < [0.01, 0.07, 0.01, 0.07]).all()  # an XL-320 may rest as far from its goal as 3.3 degrees
    assert rig.events.of(EventCode.READ_LOST) == []
    assert rig.hardware.stop() == ()
    assert rig.torque() == [False] * 4
    # no servo was told to write at the address where the other model has its torque enable
    assert [packet for packet in rig.into_bus() if packet[4] == 254 and packet[7] == 3] == []
