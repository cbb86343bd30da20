"""The guardian makes a robot safe whose loop is gone: in one process; whole runs are in ends.txt."""

import os
from pathlib import Path

import msgspec
import pytest
from tests.kit.decoded import decode_packets
from tests.kit.live_run import ROBOT

from dxlrun.channels.event_records import Event, Severity
from dxlrun.channels.heartbeat import Heartbeat, Phase
from dxlrun.channels.logged_packets import PacketBatch
from dxlrun.channels.ring import Handover, Record, RecordKind, RingReader, RingWriter
from dxlrun.channels.shared_memory import mapped
from dxlrun.channels.tagged import decode
from dxlrun.plan.policy_plan import TORQUE_STAYS
from dxlrun.run import texts
from dxlrun.run.guardian import GuardianJob, SafeStop
from dxlrun.run.run_processes import create_memory, guardian_job
from dxlrun.testing import installed, plan_of, simulated_robot
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.exchange.bus_engine import Lines
from dxlwire.packets import PacketKind

LIGHTS = Path(__file__).parents[2] / "plugins/lights"
pytestmark = pytest.mark.usefixtures("no_memory_left")


@pytest.mark.parametrize(
    ("policy", "phase", "holds"),
    [
        ("on_fault", Phase.SETUP, False),
        ("on_fault", Phase.RUNNING, True),
        ("on_fault", Phase.STOPPING, False),
        ("on_exit", Phase.RUNNING, False),
    ],
)
def test_the_guardian_holds_only_a_robot_that_was_running_by_the_policy_for_faults(
    tmp_path, monkeypatch, policy, phase, holds
):
    """In a set-up, and while torque is switched off, some servos have torque and others have not."""
    robot = tmp_path / "holding.yaml"
    robot.write_text(ROBOT + f"policies: {{{policy}: hold}}\n")
    plan = plan_of(robot)
    memory = create_memory(plan)
    Heartbeat(memory.heartbeat).enter_phase(phase)
    limp: list[str] = []
    monkeypatch.setattr(SafeStop, "limp", lambda safe_stop, ports, how, text: limp.append(how) or [how])
    monkeypatch.setattr(SafeStop, "stand", lambda safe_stop, ports: ())
    said = SafeStop(guardian_job(plan, {}, memory, take_over=False)).apply_final_state(
        (), "it died", texts.loop_failed
    )
    assert bool(limp) is not holds
    assert ("torque stays on" in " ".join(said)) is holds


WHEELS = """\
name: wheels
loop: {rate: 50}
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 100 us}}
joints:
  left: {bus: main, id: 1, model: XM430-W350, reference: 0 deg, direction: 1, continuous: true}
  lift: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1}
devices: {board: {bus: main, id: 42, model: board.toml, states: [id], commands: [lamp]}}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [left]}
policies: {on_fault: hold}
"""
BOARD = """\
kind = "device"
model = "my-board"
protocol = 2.0
[items]
lamp = {address = 20, size = 1, access = "RW", maximum = 9, initial = 0, safe = 3}
"""


@pytest.fixture
def safe_stop(tmp_path, monkeypatch):
    """A robot whose loop dies in the middle of a run, and what makes its simulated servos safe."""
    (tmp_path / "board.toml").write_text(BOARD)
    (tmp_path / "wheels.yaml").write_text(WHEELS)
    robot = simulated_robot(tmp_path / "wheels.yaml", duration_s=0.4)
    hardware = robot.robot.hardware
    hardware.start()
    robot.record.goals.velocity[0] = 2.0
    for _ in range(3):
        hardware.read_states()
        hardware.write_goals()
        hardware.idle(robot.clock.wait_until(robot.clock.now_ns() + 20_000_000))
    memory = create_memory(robot.plan)
    Heartbeat(memory.heartbeat).enter_phase(Phase.RUNNING)
    safe_stop = SafeStop(guardian_job(robot.plan, {}, memory, take_over=False))
    safe_stop._clock = robot.clock  # type: ignore[assignment]  # the time of the simulated servos
    packets = PacketBatch(Handover(lambda kind, payload: None))
    lines = Lines(robot.plan.buses, VirtualPorts(robot.clock, robot.buses), robot.clock, packets)
    monkeypatch.setattr(safe_stop, "_take_over", lambda _: (lines, packets))
    return robot, safe_stop, memory


def records(ring: int, kind: RecordKind) -> list[bytes]:
    found = iter(RingReader(ring).read_record, None)
    return [one.payload for one in found if isinstance(one, Record) and one.kind == kind]


def test_a_guardian_that_leaves_torque_on_stops_what_is_led_by_a_velocity(safe_stop):
    robot, safe_stop, _ = safe_stop
    wheel = robot.buses[0].servo(1)
    assert wheel.registers["goal_velocity"] > 0
    said = safe_stop.apply_final_state((), "it died", texts.loop_failed)
    assert said == ["it died", TORQUE_STAYS, "left (ID 1 on bus main) was stopped: its goal is 0"]
    assert (wheel.registers["goal_velocity"], robot.buses[0].device(42).registers["lamp"]) == (0, 3)
    assert [servo.torque_on for servo in robot.buses[0].servos] == [True, True]


def test_guardian_makes_the_feature_of_a_package_safe(tmp_path, monkeypatch):
    with installed(LIGHTS):
        robot = simulated_robot(LIGHTS / "lights.yaml", duration_s=0.4)
        robot.robot.hardware.start()
        leds = [servo.registers for servo in robot.buses[0].servos]
        leds[0]["led"] = leds[1]["led"] = 1
        job = guardian_job(robot.plan, {}, create_memory(robot.plan), take_over=False)
        safe_stop = SafeStop(msgspec.json.decode(msgspec.json.encode(job), type=GuardianJob))
        packets = PacketBatch(Handover(lambda kind, payload: None))
        lines = Lines(robot.plan.buses, VirtualPorts(robot.clock, robot.buses), robot.clock, packets)
        monkeypatch.setattr(safe_stop, "_take_over", lambda _: (lines, packets))
        safe_stop.limp((), "it died", texts.loop_failed)
        assert [each["led"] for each in leds] == [0, 0]


@pytest.mark.parametrize("silent", [False, True])
def test_a_safe_stop_names_the_servos_that_did_not_confirm_torque_off(safe_stop, silent):
    robot, safe_stop, memory = safe_stop
    robot.buses[0].servo(2).silence(silent)
    _, result = safe_stop.limp((), "torque was cut on request", texts.run_cut)
    event = decode(records(memory.guardian, RecordKind.TAGGED)[-1])
    assert isinstance(event, Event)
    assert event.text == f"torque was cut on request; {result}"
    if silent:
        assert "not confirmed by lift (ID 2 on bus main): " in result
        assert event.severity == Severity.ERROR
    else:
        assert result == "torque off was confirmed by all 2 servos"
        assert event.severity == Severity.WARNING
    assert [servo.torque_on for servo in robot.buses[0].servos] == [False, silent]
    assert robot.buses[0].device(42).registers["lamp"] == 3, "the safe value of the board"


def test_what_the_loop_had_on_its_desk_when_it_died_comes_into_the_log(tmp_path):
    (tmp_path / "pair.yaml").write_text(ROBOT)
    plan = plan_of(tmp_path / "pair.yaml")
    memory = create_memory(plan)
    desk = PacketBatch(RingWriter(memory.packets), mapped(memory.desk))
    desk.packet(0, PacketKind.INSTRUCTION, 3, 1, 2, b"half a cycle")
    master, slave = os.openpty()
    SafeStop(guardian_job(plan, {}, memory, take_over=False))._take_over([slave])
    (batch,) = records(memory.guardian, RecordKind.PACKETS)
    (packet,) = decode_packets(batch)
    assert packet.data == b"half a cycle"
    os.close(master)
