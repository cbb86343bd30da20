import pytest
from tests.kit.rigs import make_x, start_rig

from dxlrun.channels.event_records import EventCode
from dxlwire.modes import Mode


@pytest.fixture
def started():
    return start_rig(make_x((11, 12)))


def keep(answers):
    """Keep what went wrong with each register."""
    return lambda problem, found: answers.append(problem)


def gain_of(rig, index):
    registers = rig.buses[0].servos[index].registers
    return registers.table.items["position_p_gain"].decode(registers.read_bytes(84, 2))


def test_a_gain_is_changed_between_cycles_read_back_and_reported(started):
    answers, before = [], len(started.into_bus())
    started.hardware.write_register(1, "position_p_gain", 900, keep(answers))
    assert answers == []
    started.cycles(3)
    assert answers == [""]
    assert (gain_of(started, 0), gain_of(started, 1)) == (800, 900)
    assert started.events.of(EventCode.REGISTER_WRITTEN) == [
        ("arm_12_joint", "Position P Gain (84) was changed from 800 to 900")
    ]
    assert started.writes(before) == [(12, 84, b"\x84\x03")]
    assert started.states.valid.all()
    assert started.torque() == [True, True]


def test_what_a_servo_has_already_is_not_written(started):
    answers, before = [], len(started.into_bus())
    started.hardware.write_register(0, "position_p_gain", 800, keep(answers))
    started.cycle()
    assert answers == [""]
    assert started.writes(before) == []


def test_a_servo_that_refuses_is_reported_and_keeps_what_it_had(started):
    answers = []
    started.hardware.write_register(0, "velocity_p_gain", 20_000, keep(answers))
    started.cycles(3)
    (answer,) = answers
    assert answer.startswith("arm_11_joint (ID 11 on bus arm) refuses Velocity P Gain (78) = 20000: ")
    assert started.events.of(EventCode.REGISTER_DIFFERS) == [("arm_11_joint", answer)]


def test_a_servo_that_is_silent_is_reported(started):
    answers = []
    started.servo(11).silence()
    started.hardware.write_register(0, "position_p_gain", 900, keep(answers))
    started.cycles(20)
    assert answers == ["arm_11_joint (ID 11 on bus arm) did not answer when Position P Gain (84) was read"]


def test_a_servo_that_is_silent_for_a_moment_gets_its_register(started):
    answers = []
    servo = started.servo(11)
    servo.silence()
    started.buses[0].at(started.clock.now_ns() + 130_000_000, lambda: servo.silence(False))
    started.hardware.write_register(0, "position_p_gain", 900, keep(answers))
    started.cycles(80)
    assert answers == [""]
    assert gain_of(started, 0) == 900


@pytest.mark.parametrize("item", ["temperature_limit", "present_position", "nonsense"])
def test_nothing_else_than_ram_is_written_whatever_comes_out_of_the_mailbox(started, item):
    answers = []
    started.hardware.write_register(0, item, 60, keep(answers))
    assert answers == [f"arm_11_joint has no writable RAM register {item}"]


def test_many_requests_are_done_in_their_order_and_no_cycle_is_late(started):
    answers = []
    for value in (500, 600, 700):
        for row in (0, 1):
            started.hardware.write_register(
                row, "position_p_gain", value, lambda why, _, at=(row, value): answers.append((*at, why))
            )
    for _ in range(6):
        started.cycle()  # asserts that it ends in its period
    assert answers == [(row, value, "") for value in (500, 600, 700) for row in (0, 1)]
    assert (gain_of(started, 0), gain_of(started, 1)) == (700, 700)


def test_what_was_set_in_the_run_is_set_again_after_a_reset(started):
    answers = []
    started.hardware.write_register(1, "position_p_gain", 900, keep(answers))
    started.cycles(3)
    with started.away(12, 5) as servo:
        servo.power_cycle()
        assert gain_of(started, 1) == 800
    assert gain_of(started, 1) == 900
    assert (
        started.events.texts(EventCode.REGISTER_WRITTEN)
        == ["Position P Gain (84) was changed from 800 to 900"] * 2
    )


@pytest.mark.parametrize("requested", ["before it was away", "while it was away"])
def test_a_servo_comes_back_into_the_mode_that_was_requested_last(started, requested):
    if requested.startswith("before"):
        started.set_modes(Mode.VELOCITY, Mode.UNKNOWN)
        started.cycles(20)
        assert started.states.mode.tolist() == [Mode.VELOCITY, Mode.POSITION]
    before = len(started.into_bus())
    with started.away(11, 5, 20):
        if requested.startswith("while"):
            started.set_modes(Mode.VELOCITY, Mode.UNKNOWN)
            started.cycles(20)
    assert started.states.mode.tolist() == [Mode.VELOCITY, Mode.POSITION]
    assert started.servo(11).registers["operating_mode"] == 1
    assert started.torque() == [True, True]
    modes = [write for write in started.writes(before) if write[1] == 11]
    assert len(modes) == requested.startswith("while")
