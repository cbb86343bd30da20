"""A robot with boards on its bus: simulated from its plan, read, commanded, and with a table of its own."""

from __future__ import annotations

import math

import pytest
from fastcrc import crc16
from tests.kit.line_faults import other_host

from dxlrun.cli import main
from dxlrun.cli.sim import sim
from dxlrun.errors import InputError
from dxlrun.run.simulation_front import SimulationResult
from dxlrun.testing import simulated_robot
from dxlsim.messages import SimulationMessage
from dxlsim.simulation_plan import SimulationConfig

BOARD = """\
kind = "device"
model = "my-board"
model_number = 60_123
protocol = 2.0
capabilities = ["sync_read"]
cyclic = ["force"]

[items]
lamp = {address = 20, size = 1, access = "RW", maximum = 1, initial = 0, safe = 0}
force = {address = 30, size = 2, encoding = "twos_complement", tick = "-10 mN", offset = "1 N"}
start = {address = 32, size = 1, bit = 2, state = "button.start"}
stop = {address = 32, size = 1, bit = 5, state = "button.stop"}
"""
ROBOT = """\
name: with_boards
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 100}
joints:
  neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}
devices:
  imu: {bus: main, id: 241, model: bitbots-imu}
  core: {bus: main, id: 42, model: bitbots-core}
  cr: {bus: main, id: 200, model: OpenCR, simulation: {values: {button.user: 1}}}
  mine:
    bus: main
    id: 7
    model: boards/mine.toml
    states: {toe: force, go: start, halt: stop}
    simulation: {values: {toe: -3.5, halt: 1}}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""


@pytest.fixture
def robot(tmp_path):
    (tmp_path / "boards").mkdir()
    (tmp_path / "boards" / "mine.toml").write_text(BOARD)
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
    assert run.plan.included["boards/mine.toml"] == BOARD
    assert run.events.errors == ()


def test_a_board_that_waits_in_a_chain_is_read_alone_and_asked_again_at_the_start(robot):
    """Judged by the ledger; another program has left the board waiting for a servo that is not there."""
    run = simulated_robot(robot, duration_s=1.0)
    (bus,) = run.buses
    chain = bytes.fromhex("fffffd00fe0d00920984000400c81f000100")
    other_host(bus, chain + crc16.umts(chain).to_bytes(2, "little"), bus.now_ns, received=False)
    run.run()
    assert run.events.errors == ()
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
    path = tmp_path / "nodding.yaml"
    path.write_text(ON_A_LINK)
    run = simulated_robot(path, duration_s=0.8)
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


TWICE = "bit 2 of address 32 is defined twice; correct the file"
NO_URDF = "imu is on link head, but the robot file has no URDF"


@pytest.mark.parametrize(
    ("text", "before", "after", "sentence"),
    [
        (ROBOT, "boards/mine", "boards/yours", "boards/yours.toml of mine cannot be read: No such file"),
        (ROBOT, "toe: -3.5", "heel: -3.5", "mine has no state heel"),
        (ROBOT, "halt: 1}}", "halt: 1}, noise: {toe: -1}}", "the noise of toe is negative; write a standard"),
        (ROBOT, "toe: -3.5", "toe: heavy", "'heavy' is not a number; write a number in SI units"),
        (
            ROBOT,
            "protocol: 2.0, baud",
            "protocol: 1.0, baud",
            "my-board of mine speaks Protocol 2.0, bus main",
        ),
        (ROBOT, "boards/mine", "boards/twice", TWICE),
        (ON_A_LINK, "link: head", "link: haed", "link haed of imu is not in the URDF; did you mean head"),
        (ON_A_LINK, "model: {urdf: nodding.urdf}\n", "", NO_URDF),
    ],
)
def test_a_mistake_of_a_board_is_named(robot, text, before, after, sentence):
    assert before in text
    (robot.parent / "nodding.urdf").write_text(URDF)
    (robot.parent / "boards" / "twice.toml").write_text(BOARD.replace("bit = 5", "bit = 2"))
    robot.write_text(text.replace(before, after, 1))
    with pytest.raises(InputError) as error:
        simulated_robot(robot)
    assert sentence in str(error.value)
    assert f"{robot.name}:" in str(error.value)
