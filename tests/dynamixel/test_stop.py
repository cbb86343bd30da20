"""Torque off on the ways out on which something else is wrong too."""

import pytest
from tests.kit.line_faults import corrupt_next, truncate_next
from tests.kit.rigs import make_plan, make_rig, start_rig

from dxlrun.channels.event_records import EventCode
from dxlrun.errors import StartUpError
from dxlwire.wire import protocol1


@pytest.fixture
def started():
    return start_rig()


def test_an_unplugged_adapter_is_reported_once_costs_its_own_servos_only_and_stop_still_speaks():
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.ports.ports[0].unplug()
    for _ in range(10):
        rig.cycle()
        assert rig.states.valid.tolist() == [False, False, True, True]
    (lost,) = rig.events.of(EventCode.PORT_LOST)
    assert lost[1].startswith("bus left on sim")
    failures = rig.hardware.stop()
    assert len(failures) == 2
    assert all("bus left" in failure for failure in failures)
    assert rig.torque(1) == [False, False]


def test_a_line_that_went_and_came_back_is_limp_at_the_end(started):
    (bus,) = started.buses
    bus.unplug()
    started.cycle()
    bus.plug_in()  # and stop comes before another gap
    assert started.hardware.stop() == ()
    assert started.torque() == [False] * 8


def test_stop_with_a_silent_servo_limps_the_others_and_names_it(started):
    started.servo(4).silence()
    start = started.clock.now_ns()
    (failure,) = started.hardware.stop()
    assert "ID 4 on bus main" in failure
    assert "does not answer" in failure
    assert started.torque() == [servo.servo_id == 4 for servo in started.buses[0].servos]
    last = protocol1.write_range(21, 24, b"\0")
    off_ns = next(e.t_ns for e in started.ledger.entries if e.t_ns >= start and e.data == last)
    assert off_ns - start < 50_000_000  # the servos behind it do not wait for it
    assert started.clock.now_ns() - start < 400_000_000
    assert len(started.events.of(EventCode.SHUTDOWN_FAILED)) == 1


def test_stop_in_noise_tries_again(started):
    for servo in started.plans[0].servos:
        corrupt_next(started.buses[0], servo.servo_id)
        truncate_next(started.buses[0], servo.servo_id, 3)
    assert started.hardware.stop() == ()
    assert started.torque() == [False] * 8


def test_a_start_that_fails_says_whose_torque_was_not_confirmed_off(monkeypatch):
    """A servo that falls silent once it has torque: it is not called limp."""
    rig = make_rig()
    emit = rig.events.emit_event

    def unplug(source, event):
        if event.code is EventCode.TORQUE_ON:
            rig.servo(4).silence()
        emit(source, event)

    monkeypatch.setattr(rig.events, "emit_event", unplug)
    with pytest.raises(StartUpError) as caught:
        rig.hardware.start()
    assert len(caught.value.sentences) == 2
    assert (
        "ID 4 on bus main): torque off was sent, but the servo does not answer" in caught.value.sentences[1]
    )
    assert rig.torque() == [servo.servo_id == 4 for servo in rig.buses[0].servos]
