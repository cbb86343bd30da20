"""Boards and devices on the buses of a robot: the log is the ledger, and what they measure."""

import math
from typing import Any

import numpy as np
import pytest
from fastcrc import crc16
from tests.kit.cases import read_head
from tests.kit.judges import log_has_every_byte, uncaused, unnoticed
from tests.kit.line_faults import other_host
from tests.kit.robots import CASES
from tests.kit.virtual_run import VirtualRun, source_states

from dxlrun import Controller, Interfaces, ParametersModel
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.cli import main
from dxlrun.cli.sim import sim
from dxlrun.compile import robot_compiler
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.run import virtual_run
from dxlrun.run.simulation_front import SimulationResult
from dxlrun.testing import simulated_robot
from dxlrun_analysis.replay import log_replay
from dxlrun_analysis.report import analyze_log
from dxlsim.messages import SimulationMessage
from dxlsim.simulation_plan import SimulationConfig

HEAD = """\
name: dozen
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 250}
devices:
  imu: {bus: main, id: 241, model: OpenCR, states: [gyro_x, gyro_y, gyro_z, acc_x, acc_y, acc_z]}
  foot: {bus: main, id: 101, model: generic, states: {force.x: register_1, force.y: register_5}}
  board:
    bus: main
    id: 42
    model: generic
    states: {voltage: register_2, lamp: led}
    commands: {lamp: led, level: register_8}
  core: {bus: main, id: 43, model: bitbots-core}
controllers:
  states: {type: joint_state_broadcaster}
  blinker: {type: blinker, joints: [JOINTS]}
joints:
"""
JOINTS = [f"joint_{number}" for number in range(1, 13)]
PERIOD_NS = 4_000_000


class BlinkerParameters(ParametersModel):
    joints: tuple[str, ...]


class Blinker(Controller[BlinkerParameters]):
    """Swings its joints, and lights the lamp every half second, brighter than it can."""

    Parameters = BlinkerParameters

    @classmethod
    def interfaces(cls, parameters: BlinkerParameters, joints: Any) -> Interfaces:
        return Interfaces(
            parameters.joints,
            ("position",),
            reads=("foot/force.y", "imu/age"),
            device_commands=("board/lamp", "board/level"),
        )

    def update(self, time_ns: int, period_ns: int) -> None:
        seconds = time_ns * 1e-9
        self.context.commands.position[:] = 0.3 * math.sin(3 * seconds)
        self.context.device_commands[:] = 1 + seconds * 2 // 1 % 2, self.context.reads[0]


@pytest.fixture
def dozen(tmp_path, monkeypatch):
    """Build the robot on virtual time, with a log."""
    offers = {**load_plugins().controllers, "blinker": Offer("blinker", Blinker, "elsewhere 2.1")}
    for room in (robot_compiler, virtual_run, log_replay):
        monkeypatch.setattr(room, "load_plugins", lambda *_, **__: PlugIns(offers, {}))

    def build(duration_s):
        lines = [
            f"  {name}: {{bus: main, id: {number}, model: XL430-W250, reference: 180 deg, direction: 1}}"
            for number, name in enumerate(JOINTS, 1)
        ]
        text = HEAD.replace("JOINTS", ", ".join(JOINTS)) + "\n".join(lines) + "\n"
        return VirtualRun.of_text(tmp_path, text, duration_s)

    return build


def test_the_log_is_the_ledger_and_a_lost_device_costs_the_servos_nothing(dozen):
    run = dozen(1.3)
    run.fault("silence servo=101 at=300ms for=150ms", "silence servo=43 at=320ms")
    log = run.finish()
    log_has_every_byte(log, run.ledger.entries)
    assert unnoticed(log, run.ledger.entries) == []
    assert uncaused(log, run.ledger.entries) == []
    cycles, layout = log.cycles, run.record.layout
    # the servos: every reply, every goal, every period
    assert cycles["valid"].all()
    assert (cycles["torque"] == Torque.ON).all()
    assert run.skipped == 0
    assert len(cycles) == 325
    longest = (cycles["read_ns"] - cycles["woken_ns"]).max()
    assert longest < PERIOD_NS - 500_000
    # the devices
    valid = dict(zip(layout.sources, cycles["source_valid"].T, strict=True))
    age_ns = dict(zip(layout.sources, cycles["source_age_ns"].T, strict=True))
    assert valid["board"].all()
    assert np.count_nonzero(~valid["imu"]) <= 1
    assert 150e6 / PERIOD_NS <= np.count_nonzero(~valid["foot"]) <= 1.2e9 / PERIOD_NS
    lost = np.flatnonzero(~valid["core"])
    assert (np.diff(lost) == 1).all()
    assert lost[-1] == len(cycles) - 1
    assert (np.abs(np.diff(age_ns["core"][lost]) - PERIOD_NS) < 1_500_000).all()
    codes = [(EventCode(event.code), event.source) for event in log.events]
    assert {source for code, source in codes if code == EventCode.DEVICE_LOST} == {"foot", "core"}
    assert [source for code, source in codes if code == EventCode.DEVICE_BACK] == ["foot"]
    assert EventCode.SERVO_LOST not in {code for code, _ in codes}
    assert ("board", "clamped to its range 0..1") in {
        (event.source, event.text.rpartition(" is ")[2]) for event in log.events
    }
    assert np.nanmax(cycles["device_command"][:, 0]) == 1.0
    # the analysis
    found = analyze_log(log.path)
    (missing,) = (one for one in found.verdict.sentences if one.startswith("Replies are missing: "))
    assert "device 101 (foot) " in missing
    assert missing.endswith(" of 16 servos and devices answered every time.")
    servos = {servo.joint: servo for servo in found.totals.servos}
    assert servos["foot"].device
    assert servos["foot"].lost > 0
    assert servos["joint_1"].lost == 0


def test_what_devices_measure_and_are_told_is_what_the_bus_has(dozen):
    run = dozen(0.3)
    foot = run.buses[0].device(101)
    foot.registers["register_5"] = 77
    log = run.finish()
    values = {name: rows[-1] for name, rows in source_states(log).items()}
    assert values["foot/force.y"] == 77
    assert values["imu/linear_acceleration.z"] == pytest.approx(9.80665)
    assert values["board/lamp"] == 1
    assert run.buses[0].device(42).registers["register_8"] == 77
    assert run.buses[0].device(42).registers["led"] == 0  # its safe value, at the end
    assert log.cycles[-1]["device_command"].tolist() == [1.0, 77.0]


ROBOT, _, BOARD = read_head(CASES / "boards.txt").partition("---- mine.toml\n")


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "mine.toml").write_text(BOARD)
    path = tmp_path / "robot.yaml"
    path.write_text(ROBOT)
    return path


def test_boards_are_read_in_si_units(robot):
    run = simulated_robot(robot, duration_s=0.2)
    run.run()
    names = [f"{one}/{state}" for one, states in run.plan.loop.source_states.items() for state in states]
    values = dict(zip(names, run.record.sources.values.tolist(), strict=True))
    assert run.record.sources.valid.all()
    assert values["imu/linear_acceleration.z"] == pytest.approx(9.80665)
    assert values["imu/orientation.w"] == 1.0
    assert values["core/voltage"] == pytest.approx(11.1, abs=0.02)
    assert values["core/current"] == pytest.approx(0.0, abs=0.05)
    assert values["cr/linear_acceleration.z"] == pytest.approx(9.80665)
    assert [values[f"cr/button.{each}"] for each in ("mode", "start", "user", "reset")] == [0, 0, 1, 0]
    assert (values["mine/toe"], values["mine/go"], values["mine/halt"]) == (pytest.approx(-3.5), 0, 1)
    assert run.plan.included["mine.toml"] == BOARD
    assert run.events.named == ()


def test_a_board_that_waits_in_a_chain_is_read_alone_and_asked_again_at_the_start(robot):
    """Judged by the ledger; another program has left the board waiting for a servo that is not there."""
    run = simulated_robot(robot, duration_s=1.0)
    (bus,) = run.buses
    chain = bytes.fromhex("fffffd00fe0d00920984000400c81f000100")
    other_host(bus, chain + crc16.umts(chain).to_bytes(2, "little"), bus.now_ns, received=False)
    run.run()
    assert run.events.named == ()
    assert run.record.sources.valid.all()
    notes = [entry.note for entry in bus.ledger.entries]
    assert "device 200: ignores instructions until 9 has replied" in notes
    sent = [entry.data for entry in bus.ledger.entries if entry.direction == "in"]
    assert sum(data[4:8] == b"\xc8\x07\x00\x02" for data in sent) > 90, "reads of its own"
    assert not [data for data in sent if data[7] in (0x82, 0x8A, 0x92, 0x9A) and b"\xc8" in data[8:-2]]


def test_boards_on_two_lines_are_told_apart(robot):
    line = "  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}\n"
    text = ROBOT.replace("loop:", line.replace("main", "side") + "loop:", 1)
    robot.write_text(text.replace("core: {bus: main", "core: {bus: side"))
    run = simulated_robot(robot, duration_s=0.2)
    run.run()
    layout = run.record.layout
    values = dict(zip(layout.source_states, run.record.sources.values.tolist(), strict=True))
    assert run.record.sources.valid.all()
    assert values["core/voltage"] == pytest.approx(12.0, abs=0.02)
    assert values["imu/orientation.w"] == 1.0


URDF = """\
<robot name="nodding">
  <link name="base"/><link name="head"/>
  <joint name="neck" type="revolute">
    <parent link="base"/><child link="head"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="1" velocity="6"/>
  </joint>
</robot>
"""
ON_A_LINK = """\
name: nodding
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 100}
model: {urdf: nodding.urdf}
joints:
  neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}
devices:
  imu: {bus: main, id: 241, model: bitbots-imu, simulation: {link: head}}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""


def test_an_imu_on_a_link_feels_how_the_link_is_and_turns(tmp_path):
    """About y by q: gravity in the link's axes is (-g sin q, 0, g cos q), the rate is dq about y."""
    (tmp_path / "nodding.urdf").write_text(URDF)
    run = VirtualRun.of_text(tmp_path, ON_A_LINK, 0.8)
    bus = run.buses[0]
    seen: list[tuple[float, float, float, float]] = []

    def look():
        bus.advance_to(bus.now_ns)
        imu = bus.device(241)
        imu.world.update()
        servo = bus.servo(1)
        seen.append((servo.shaft_angle - math.pi, servo.velocity, *imu.world.linear_acceleration[::2]))
        assert imu.world.angular_velocity == pytest.approx((0, servo.velocity, 0), abs=1e-9)
        assert imu.world.orientation[1] == pytest.approx(math.sin(seen[-1][0] / 2), abs=1e-9)

    for at_ns in range(50_000_000, 800_000_000, 10_000_000):
        bus.at(at_ns, look)
        if at_ns >= 100_000_000:  # 30 deg, also where the loop has just sent its own goal again
            bus.at(at_ns, lambda: bus.servo(1).poke("goal_position", 2048 + 341))
    run.run()
    assert max(abs(rate) for _, rate, _, _ in seen) > 0.5, "it was seen while it turned"
    angle, _, x, z = seen[-1]
    assert angle == pytest.approx(math.radians(30), abs=0.02)
    assert (x, z) == pytest.approx((-9.80665 * math.sin(angle), 9.80665 * math.cos(angle)), abs=0.05)


def test_dxlrun_sim_has_the_bodies_that_its_devices_are_on(tmp_path, monkeypatch):
    (tmp_path / "nodding.urdf").write_text(URDF)
    (tmp_path / "nodding.yaml").write_text(ON_A_LINK)
    served: list[SimulationConfig] = []
    monkeypatch.setattr(
        sim,
        "_serve",
        lambda job, *_, **__: served.append(job.config) or SimulationResult(1.0, SimulationMessage(), ()),
    )
    assert main(["sim", str(tmp_path / "nodding.yaml")]) == 0
    assert served[0].sensed is not None
