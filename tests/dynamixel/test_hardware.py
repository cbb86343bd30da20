import numpy as np
import pytest
from tests.kit.rigs import make_plan, make_rig, position_tick, start_rig

from dxlrun.channels.events import EventCode
from dxlrun.dynamixel.wire import protocol1
from dxlrun.errors import StartUpError
from dxlrun.simulation import ServoConfig


def torque_on_packets(packets):
    """Return the packets that would switch torque on: a goal or torque enable written."""
    found = []
    for packet in packets:
        kind, address = packet[4], packet[5:6]
        if kind in (3, 4) and (address in (b"\x1e", b"\x20") or (address == b"\x18" and packet[6])):
            found.append(packet)
        if kind == 0x83:
            found.append(packet)
    return found


def position_replies(rig, cycle_start):
    """Return raw position by ID, as the servos sent it since `cycle_start` (ledger)."""
    found = {}
    for entry in rig.ledger.entries:
        if entry.direction == "out" and entry.t_ns >= cycle_start and len(entry.data) == 12:
            found[entry.data[2]] = int.from_bytes(entry.data[5:7], "little")
    return found


@pytest.fixture
def started():
    return start_rig()


def test_start_holds_every_servo_where_it_stands(started):
    assert started.torque() == [True] * 8
    assert started.states.valid.all()
    assert not np.isnan(started.goals.position).any()
    assert np.isnan(started.goals.velocity).all()
    assert started.goals.position == pytest.approx(started.states.position, abs=1e-9)
    before = [servo.position for servo in started.buses[0].servos]
    started.cycles(10)
    assert [servo.position for servo in started.buses[0].servos] == pytest.approx(before, abs=0.006)
    assert len(started.events.of(EventCode.SETUP)) == 8
    assert len(started.events.of(EventCode.TORQUE_ON)) == 1
    assert started.events.of(EventCode.REGISTER_DIFFERS) == []


def test_a_cycle_is_eight_reads_and_one_sync_write(started):
    count = len(started.into_bus())
    started.goals.position[:] = np.linspace(-0.5, 0.5, 8)
    started.goals.velocity[:] = 1.0
    start = started.clock.now_ns()
    started.cycle()
    expected = [read.packet for read in started.plans[0].reads]
    goals = {
        servo.servo_id: position_tick(servo, started.goals.position[servo.row]).to_bytes(2, "little")
        + b"\x56\x00"
        for servo in started.plans[0].servos
    }
    assert started.into_bus()[count:] == [*expected, protocol1.sync_write(30, 4, goals)]
    sent = position_replies(started, start)
    shown = [servo.joint_position(sent[servo.servo_id]) for servo in started.plans[0].servos]
    assert started.states.position == pytest.approx(shown, abs=1e-12)


def test_the_exchange_takes_what_the_budget_says():
    rig = start_rig()
    rig.cycle()
    start = rig.clock.now_ns()
    rig.hardware.read()
    budget = rig.plans[0].budget
    assert rig.clock.now_ns() - start == budget.total_ns - 480_000


def test_goals_move_the_servos(started):
    started.goals.position[:] = 0.3
    started.cycles(60)
    assert started.states.position == pytest.approx(0.3, abs=0.01)
    assert started.events.of(EventCode.READ_LOST) == []


def test_what_is_recorded_is_what_the_ledger_has(started):
    started.goals.position[:] = 0.2
    started.buses[0].inject_noise(b"\x12\xff\xff\x03noise\xff", started.clock.now_ns() + 100_000)
    started.buses[0].corrupt_next(5)
    started.cycles(5)
    started.hardware.stop()
    started.hardware.idle(started.clock.now_ns() + 10_000_000)
    assert started.packets.sent() == started.into_bus()
    assert started.packets.received() == started.out_of_bus()
    assert started.events.of(EventCode.BUS_NOISE) != []


def test_a_silent_servo_is_invalid_and_ages_and_the_others_go_on(started):
    started.cycle()
    silent = started.states.position[2]
    others = started.states.position.copy()
    started.buses[0].servo(5).silence()
    started.goals.position[:] += 0.2
    started.cycles(10)
    assert started.states.valid.tolist() == [True, True, False, True, True, True, True, True]
    assert started.states.position[2] == silent
    assert started.states.age_ns[2] > 10 * started.period_ns
    assert (started.states.age_ns[started.states.valid] < started.period_ns).all()
    moved = np.delete(started.states.position - others, 2)
    assert (moved > 0.1).all()
    assert [source for source, _ in started.events.of(EventCode.READ_LOST)] == ["main_5_joint"]


def test_a_silent_servo_gets_no_goal_until_its_torque_was_read(started):
    started.restless = 0.006
    servo = started.buses[0].servo(5)
    servo.silence()
    before = len(started.into_bus())
    started.cycle()
    started.cycle()
    servo.silence(False)
    started.cycles(4)
    sent = started.into_bus()[before:]
    named = [5 in packet[7:-1:5] for packet in sent if packet[4] == 0x83]
    probes = [packet for packet in sent if packet == started.plans[0].torque_reads[2].packet]
    assert named == [False, False, False, True, True, True]
    assert len(probes) == 1
    (event,) = started.events.of(EventCode.READ_BACK)
    assert "2 replies" in event[1]


def test_a_servo_whose_torque_fits_no_gap_gets_its_goals_back_all_the_same():
    rig = start_rig(make_plan((1, 2), latency_ns=19_000_000))
    rig.restless = 0.006
    rig.buses[0].servo(2).silence()
    before = len(rig.into_bus())
    rig.cycle(idle=False)
    rig.buses[0].servo(2).silence(False)
    rig.cycles(60)
    sent = rig.into_bus()[before:]
    named = [2 in packet[7:-1:5] for packet in sent if packet[4] == 0x83]
    assert not any(named[:40])
    assert all(named[-5:])
    assert sent.count(rig.plans[0].torque_reads[1].packet) == 1
    ((source, text),) = rig.events.of(EventCode.OVERRUN)
    assert source == "main_2_joint"
    assert "waits for idle time" in text


def test_a_servo_that_was_lost_goes_slowly_to_a_goal_that_went_on(started):
    started.restless = 0.006
    servo = started.buses[0].servo(5)
    servo.silence()
    for _ in range(20):
        started.goals.position[2] += 0.05  # each step is small, and the servo sees none of them
        started.cycle()
    servo.silence(False)
    for _ in range(80):
        started.cycle()
        if started.states.valid[2]:
            break
    before = len(started.into_bus())
    standing = servo.position
    started.cycles(20)
    writes = [packet for packet in started.into_bus()[before:] if packet[4] == 0x83]
    speeds = [dict(zip(p[7:-1:5], p[10:-1:5], strict=True)) for p in writes]  # all fit the low byte
    assert {one[5] for one in speeds if 5 in one} == {129}  # 1.5 rad/s, and never 0, which is the maximum
    assert {one[3] for one in speeds} == {0}
    assert 0.3 < abs(servo.position - standing) < 1.5 * 20 * 0.02
    started.cycles(40)
    last = [packet for packet in started.into_bus() if packet[4] == 0x83][-1]
    assert dict(zip(last[7:-1:5], last[10:-1:5], strict=True))[5] == 0
    assert started.states.position[2] == pytest.approx(started.goals.position[2], abs=0.01)


def test_a_servo_that_was_reset_stays_out_and_gets_no_torque(started):
    servo = started.buses[0].servo(5)
    servo.silence()
    started.cycle()
    servo.reset()
    servo.silence(False)
    started.cycles(10)
    assert started.torque() == [True, True, False, True, True, True, True, True]
    assert started.states.valid.all()
    assert [source for source, _ in started.events.of(EventCode.SERVO_LIMP)] == ["main_5_joint"]


def test_a_corrupted_reply_is_not_a_value(started):
    started.cycle()
    held = started.states.position[4]
    started.buses[0].corrupt_next(2, index=5, flip=0x40)
    started.cycle()
    assert not started.states.valid[4]
    assert started.states.position[4] == held
    (event,) = started.events.of(EventCode.READ_LOST)
    assert "garbled" in event[1]
    started.cycle()
    assert started.states.valid.all()


@pytest.mark.parametrize(
    "late_ms", [12.5, 19.55, 19.65, 19.75, 14.0, 20.2, 20.7, 21.5, 27.0, 33.3, 40.5, 41.0]
)
def test_a_late_reply_is_never_taken_as_current(started, late_ms):
    started.goals.position[:] = 0.8  # far enough to move in every cycle
    started.goals.velocity[:] = 1.0
    started.cycle()
    started.buses[0].delay_next(1, int(late_ms * 1e6))
    late = 0
    for _ in range(6):
        start = started.clock.now_ns()
        started.cycle()
        late += not started.states.valid[0]
        for servo in started.plans[0].servos:
            if started.states.valid[servo.row]:
                asked, length = [
                    (entry.t_ns, entry.data[6])
                    for entry in started.ledger.entries
                    if entry.direction == "in" and entry.data[2:6] == bytes((servo.servo_id, 4, 2, 36))
                ][-1]
                replies = [
                    entry.data
                    for entry in started.ledger.entries
                    if entry.direction == "out"
                    and asked < entry.t_ns < asked + 3_000_000
                    and entry.data[2] == servo.servo_id
                    and len(entry.data) == 6 + length
                    and "collision" not in entry.note
                ]
                newest = servo.joint_position(int.from_bytes(replies[-1][5:7], "little"))
                assert started.states.position[servo.row] == newest
                assert start <= asked
    assert late >= 1
    assert started.packets.received() == started.out_of_bus()


def test_a_changed_error_byte_is_told_in_the_manuals_words(started):
    started.cycle()
    started.buses[0].servo(6).set_temperature(85.0)
    started.cycle()
    started.cycle()
    (event,) = started.events.of(EventCode.SERVO_ERROR)
    assert event[0] == "main_6_joint"
    assert "overheating" in event[1]
    assert "ID 6 on bus main" in event[1]
    assert started.states.valid[3]


def test_nan_goals_are_not_sent(started):
    started.goals.position[3] = np.nan
    started.cycle()
    last = [packet for packet in started.into_bus() if packet[4] == 0x83][-1]
    assert list(last[7:-1:5]) == [1, 3, 5, 2, 4, 20, 21]


def test_nothing_gives_torque_without_start():
    rig = make_rig()
    rig.goals.position[:] = 0.0
    rig.cycles(5)
    assert torque_on_packets(rig.into_bus()) == []
    assert rig.torque() == [False] * 8


def test_a_servo_that_is_reset_while_the_others_get_torque_ends_the_start():
    """It answers again before the first cycle, so no reply is missing; its next goal would be torque on."""
    rig = make_rig()
    reset = []

    def brown_out():
        if not reset and sum(rig.torque()) == 4:
            reset.append(1)
            rig.buses[0].servo(1).reset()

    for step in range(4000):
        rig.buses[0].at(rig.clock.now_ns() + step * 100_000, brown_out)
    with pytest.raises(StartUpError, match=r"main_1_joint \(ID 1 on bus main\) lost its torque again"):
        rig.hardware.start()
    assert reset == [1]
    assert rig.torque() == [False] * 8
    assert [packet for packet in rig.into_bus() if packet[4] == 0x83] == []


def test_a_line_that_goes_between_read_and_write_is_named_and_the_others_get_their_goals():
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.hardware.read()
    rig.ports.ports[0].unplug()
    rig.hardware.write()
    ((source, text),) = rig.events.of(EventCode.PORT_LOST)
    assert source == "left"
    assert text.startswith("bus left on sim: ")
    assert rig.into_bus(1)[-1][4] == 0x83


@pytest.mark.parametrize(("back_after_ns", "limp"), [(150_000_000, True), (400_000_000, False)])
def test_an_adapter_that_is_back_soon_after_the_end_finds_torque_off_sent(back_after_ns, limp):
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.cycle()
    bus = rig.buses[0]
    bus.unplug()
    bus.at(rig.clock.now_ns() + back_after_ns, bus.plug_in)
    before = rig.clock.now_ns()
    failures = rig.hardware.stop()
    assert rig.torque(1) == [False, False]  # nobody waited for the line that was gone
    assert rig.torque(0) == [not limp] * 2
    assert bool(failures) == (not limp)
    assert rig.clock.now_ns() - before < 500_000_000


def test_two_buses_are_read_side_by_side():
    rig = start_rig(make_plan((1, 2), name="left"), make_plan((1, 7), name="right", first_row=2))
    rig.goals.position[:] = [0.1, 0.2, 0.3, 0.4]
    start = rig.clock.now_ns()
    rig.hardware.read()
    assert rig.clock.now_ns() - start == 2 * 700_000
    rig.cycles(60)
    assert rig.states.position == pytest.approx([0.1, 0.2, 0.3, 0.4], abs=0.01)
    rig.buses[1].servo(7).silence()
    rig.cycle()
    assert rig.states.valid.tolist() == [True, True, True, False]
    rig.hardware.stop()
    for bus in (0, 1):
        assert rig.packets.sent(bus) == rig.into_bus(bus)
        assert rig.packets.received(bus) == rig.out_of_bus(bus)


def test_all_servos_silent_at_once_costs_less_than_the_guardians_patience(started):
    started.cycle()
    for servo in started.buses[0].servos:
        servo.silence()
    start = started.clock.now_ns()
    started.hardware.read()
    assert started.clock.now_ns() - start < 30_000_000
    start = started.clock.now_ns()
    started.hardware.read()
    assert started.clock.now_ns() - start < 20_000_000
    assert not started.states.valid.any()


def test_the_heart_beats_while_the_robot_is_set_up_and_read(started):
    started.cycle()
    gaps = np.diff(started.beats)
    assert gaps.max() <= 20_000_000  # the pause between two groups
    assert started.beats[-1] > started.clock.now_ns() - 2 * started.period_ns


def test_stop_limps_everybody(started):
    started.cycle()
    assert started.hardware.stop() == ()
    assert started.torque() == [False] * 8
    assert len(started.events.of(EventCode.TORQUE_OFF)) == 1
    count = len(torque_on_packets(started.into_bus()))
    started.cycle()
    assert len(torque_on_packets(started.into_bus())) == count


def test_extra_servos_on_the_line_are_left_alone():
    rig = start_rig(extra=(ServoConfig(99, "AX-12A", 1.0),))
    rig.cycle()
    assert rig.torque() == [True] * 8 + [False]
