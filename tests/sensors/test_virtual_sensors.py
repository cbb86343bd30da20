"""Sensors on a simulated body: judged by MuJoCo's own sensors, in virtual runs and their replays."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from tests.kit.bodies import Turned, bodies_of
from tests.kit.virtual_run import VirtualRun, send, source_states

from dxlrun.channels import slot
from dxlrun.channels.slot import SlotReader, SlotWriter
from dxlrun.control.sampled_sources import SampledSource
from dxlrun.errors import InputError, PlugInError, PortError
from dxlrun.features.sensors.events import SensorEvent
from dxlrun.features.sensors.plan import decode_sensors
from dxlrun.log.log_reader import Log, read_log
from dxlrun.run import virtual_run
from dxlrun.run.source_process import RemoteBody
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of
from dxlrun_analysis.replay import replay_log
from dxlsim.motion.body import SensedBody, ShaftPublisher, SimulatedBody
from dxlsim.motion.control_law import LIMP
from dxlsim.motion.link_motion import Shafts
from dxlsim.motion.mechanics import STEP_NS, Mechanics
from dxlsim.motion.motor import Motor
from dxlsim.simulation_plan import NO_LOAD, Mechanism, MechanismServo

TORSO = (Path(__file__).parents[2] / "robots/urdf/bioloid_torso.urdf").read_text()
LINK = (
    '<link name="{}"><inertial><origin xyz="0.1 0 0.02"/><mass value="0.3"/>'
    '<inertia ixx="1e-3" iyy="2e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
LIMIT = '<limit lower="-3" upper="3" effort="1" velocity="1"/>'
CRANE = f"""<robot name="crane">
  <link name="ground"/> {"".join(LINK.format(name) for name in ("mast", "trolley", "hook", "tip"))}
  <joint name="turn" type="continuous"><parent link="ground"/><child link="mast"/>
    <origin xyz="0 0.1 1" rpy="0.1 -0.2 0.3"/><axis xyz="0 0 1"/></joint>
  <joint name="slide" type="prismatic"><parent link="mast"/><child link="trolley"/>
    <origin xyz="0.2 0 0" rpy="0 0.5 0"/><axis xyz="1 0 0"/>{LIMIT}</joint>
  <joint name="swing" type="revolute"><parent link="trolley"/><child link="hook"/>
    <origin xyz="0 0 -0.1"/><axis xyz="0 0.6 0.8"/>{LIMIT}</joint>
  <joint name="plate" type="fixed"><parent link="hook"/><child link="tip"/>
    <origin xyz="0.05 0.02 -0.3" rpy="1 2 3"/></joint>
</robot>"""
G = 9.81
ROTOR = Motor(stall_torque=1.0, damping=0.01, torque_per_ampere=1.0, voltage=12.0, inertia=0.01)


def body_of(urdf: str, names: list[str]) -> SimulatedBody:
    """Return a body whose shafts are the joints of these names themselves."""
    return SimulatedBody(bodies_of(urdf, [Turned(name, 0.0, 1.0) for name in names]))


@pytest.mark.parametrize("urdf", [TORSO, CRANE], ids=["torso", "crane"])
def test_pose_rate_and_acceleration_are_what_mujocos_sensors_measure(urdf):
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = False
    spec.compiler.discardvisual = True
    spec.compiler.boundmass = spec.compiler.boundinertia = 1e-6
    kinds = {
        "rate": mujoco.mjtSensor.mjSENS_GYRO,
        "force": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
        "at": mujoco.mjtSensor.mjSENS_FRAMEPOS,
        "turn": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
        "speed": mujoco.mjtSensor.mjSENS_FRAMELINVEL,
    }
    links = [each.name for each in spec.bodies if each.name != "world"]
    for each in spec.bodies:
        if each.name != "world":
            each.add_site(name=each.name)
            for kind, number in kinds.items():
                site = mujoco.mjtObj.mjOBJ_SITE
                spec.add_sensor(name=f"{kind} {each.name}", type=number, objtype=site, objname=each.name)
    model = spec.compile()
    data = mujoco.MjData(model)
    names = [model.joint(index).name for index in range(model.njnt)]
    body = body_of(urdf, names)
    generator = np.random.default_rng(3)
    for _ in range(10):
        data.qpos[:] = generator.uniform(-1, 1, model.nq)
        data.qvel[:] = generator.uniform(-3, 3, model.nv)
        data.qfrc_applied[:] = generator.uniform(-2, 2, model.nv)
        mujoco.mj_forward(model, data)
        body.set_shafts(Shafts(0, data.qpos.copy(), data.qvel.copy(), data.qacc.copy()))
        assert links
        for link in links:
            motion = body.motion(link)
            sensed = {kind: data.sensor(f"{kind} {link}").data for kind in kinds}
            assert motion.position == pytest.approx(sensed["at"], abs=1e-9)
            assert motion.linear_velocity == pytest.approx(sensed["speed"], abs=1e-9)
            w, *xyz = sensed["turn"] * (-1 if sensed["turn"][0] < 0 else 1)
            assert motion.orientation == pytest.approx([*xyz, w], abs=1e-9)
            assert motion.angular_velocity == pytest.approx(sensed["rate"], abs=1e-9)
            up = data.site(link).xmat.reshape(3, 3).T @ (0.0, 0.0, G)
            scale = max(1.0, np.abs(data.qacc).max())
            assert motion.linear_acceleration + up == pytest.approx(sensed["force"], abs=1e-8 * scale)


def test_gears_references_couplings_and_mimic_joints_move_links():
    urdf = CRANE.replace(
        '<axis xyz="0 0.6 0.8"/>',
        '<axis xyz="0 0.6 0.8"/><mimic joint="turn" multiplier="-0.5" offset="0.2"/>',
    )
    turn = Turned("turn", 0.4, -0.25)
    pair = (MechanismServo(1, 0.1, 0.01), MechanismServo(2, 0.2, -0.01))
    coupling = Mechanism(pair, ("slide",), ((0.5, 0.5),), (NO_LOAD,), ("prismatic",))
    geared = SimulatedBody(bodies_of(urdf, (turn, None, None), (coupling,)))
    shafts = [np.array(each) for each in ([1.2, 3.0, -2.0], [1.0, 2.0, 0.5], [0.3, 0.2, 0.1])]
    geared.set_shafts(Shafts(0, *shafts))
    plain = body_of(CRANE, ["turn", "slide", "swing"])
    states = []
    for order, (a, b, c) in enumerate(shafts):
        q = -0.25 * (a - (0.4 if order == 0 else 0.0))
        x = 0.5 * (0.01 * (b - (0.1 if order == 0 else 0.0)) - 0.01 * (c - (0.2 if order == 0 else 0.0)))
        states.append(np.array([q, x, -0.5 * q + (0.2 if order == 0 else 0.0)]))
    plain.set_shafts(Shafts(0, *states))
    for name in ("position", "orientation", "angular_velocity", "linear_acceleration", "linear_velocity"):
        expected = getattr(plain.motion("tip"), name)
        assert getattr(geared.motion("tip"), name) == pytest.approx(expected, abs=1e-12)


def test_the_body_in_another_process_moves_as_in_this_one():
    mechanics = Mechanics(0)
    for angle in (0.1, 0.2, -0.3):
        mechanics.add_servo(ROTOR, NO_LOAD, angle)
    sensed = bodies_of(CRANE, [Turned(name, 0.0, 1.0) for name in ("turn", "slide", "swing")])
    memory = slot.private(9)
    shown = ShaftPublisher(mechanics, SlotWriter(memory))
    remote = RemoteBody(sensed, SlotReader(memory))
    here = SensedBody(sensed, mechanics, lambda: mechanics.grid_ns)
    for index in range(3):
        command = LIMP._replace(limit=1.0, torque_limit=1.0, bias=0.2 * (index + 1))
        mechanics.command_servo(index, command)
    for ms in range(2, 60, 6):
        mechanics.step_to(ms * 1_000_000)
        shown.write_shafts()
        remote.now_ns = lambda: mechanics.grid_ns
        for name in ("position", "orientation", "linear_velocity", "angular_velocity", "linear_acceleration"):
            expected = getattr(here.motion("tip"), name)
            assert getattr(remote.motion("tip"), name) == pytest.approx(expected, abs=1e-12)
    assert np.abs(remote.motion("tip").angular_velocity).max() > 0.1


def test_accelerations_are_those_of_the_last_step_and_nothing_at_rest():
    mechanics = Mechanics(0)
    mechanics.add_servo(ROTOR, NO_LOAD, 0.0)
    sensed = bodies_of(CRANE, [Turned("turn", 0.0, 1.0)])
    here = SensedBody(sensed, mechanics, lambda: mechanics.grid_ns)
    mechanics.command_servo(0, LIMP._replace(limit=1.0, torque_limit=1.0, bias=0.5))
    before = 0.0
    for step in range(1, 20):
        mechanics.step_to(step * STEP_NS)
        velocity = mechanics.plant.velocity.item(0)
        assert mechanics.acceleration.item(0) == pytest.approx((velocity - before) * 1e9 / STEP_NS)
        before = velocity
    # the trolley is 0.2 m from the axis: what pulls it along is the acceleration, what pulls it in the rate
    motion = here.motion("trolley")
    size = 0.2 * math.hypot(mechanics.acceleration.item(0), velocity**2)
    assert np.linalg.norm(motion.linear_acceleration) == pytest.approx(size)
    assert size > 1.0
    mechanics.move_shaft(0, 0.0)
    mechanics.command_servo(0, LIMP)
    mechanics.step_to(1_000 * STEP_NS)
    assert mechanics.still
    assert here.motion("trolley").linear_acceleration.tolist() == [0.0] * 3


IMU = "{type: simulated_imu, link: tip}"


def run(path: Path, log: Path, positions: tuple[float, float], seconds: float = 2.0) -> Log:
    asked = {0: [send("arm", "position", *positions)]}
    return read_log(VirtualRun(path, log, asked, duration_s=seconds).ended())


@pytest.mark.parametrize(
    ("entry", "period_ms", "timeout_ms"),
    [("", 10, 50), (", rate: 1000", 1, 50), (", rate: 10", 100, 500), (", timeout: 20 ms", 10, 20)],
)
def test_rate_and_timeout_have_defaults_by_the_loop_and_by_the_rate(crane, entry, period_ms, timeout_ms):
    (plan,) = decode_sensors(plan_of(crane(("link: tip}", f"link: tip{entry}}}"))).feature_plans["sensors"])
    assert (plan.period_ns, plan.timeout_ns) == (period_ms * 1_000_000, timeout_ms * 1_000_000)
    assert plan.noisy == ()


@pytest.mark.parametrize("physics", ["independent", "mujoco"])
def test_at_rest_gravity_shows_how_the_link_is_turned(crane, tmp_path, physics):
    if physics == "mujoco":
        pytest.importorskip("mujoco")
    turned, lifted = 0.5, 0.7
    path = crane(("model: {urdf", f"simulation: {{physics: {physics}}}\nmodel: {{urdf"))
    log = run(path, tmp_path / "run.mcap", (turned, lifted))
    found = source_states(log)
    position = log.cycles["position"][-1]
    assert position == pytest.approx([turned, lifted], abs=0.02)
    # the boom rises by the angle of lift; the tip's x is the boom's y, its y against the boom's x
    force = [found[f"imu/linear_acceleration.{axis}"][-1] for axis in "xyz"]
    expected = [0.0, -G * math.sin(position[1]), G * math.cos(position[1])]
    assert force == pytest.approx(expected, abs=G * math.radians(0.5))
    rates = [found[f"imu/angular_velocity.{axis}"] for axis in "xyz"]
    assert [abs(each[-1]) for each in rates] == pytest.approx([0.0] * 3, abs=1e-3)
    if physics == "independent":  # it does bring the same sample, without being accused
        assert (rates[2][-9:] == rates[2][-1]).all()
    assert [event.text for event in log.events if event.source == "imu"] == []
    # what it turned on its way is what the gyroscope summed up: about the mast's axis and the lift's
    dt = np.diff(log.cycles["woken_ns"], prepend=log.cycles["woken_ns"][0]) * 1e-9
    angle = log.cycles["position"][:, 1]
    about_lift = -float((rates[0] * dt).sum())
    about_mast = float(((rates[2] * np.cos(angle) - rates[1] * np.sin(angle)) * dt).sum())
    assert about_lift == pytest.approx(lifted, abs=math.radians(1))
    assert about_mast == pytest.approx(turned, abs=math.radians(1))


def test_values_are_valid_in_every_cycle_and_their_age_is_that_of_the_last_sample(crane, tmp_path):
    path = crane((IMU, "{type: simulated_imu, link: tip, rate: 40}"))
    log = run(path, tmp_path / "run.mcap", (0.1, 0.1), 0.5)
    assert log.cycles["source_valid"].all()
    ages = log.cycles["source_age_ns"][:, 0]
    since = log.cycles["read_ns"] % 25_000_000
    assert ages.tolist() == since.tolist()
    assert not [event for event in log.events if event.code in (SensorEvent.SENSOR, SensorEvent.SENSOR_LOST)]


def test_noise_has_the_density_that_was_asked_for_and_bias_stays(crane, tmp_path):
    entry = (
        "{type: simulated_imu, link: mast, seed: 4, magnetometer: {},"
        " gyroscope: {noise_density: 2e-3, bias: [1 deg/s, 0 deg/s, 0 deg/s]},"
        " accelerometer: {noise_density: 0.01, bias: [0 m/s^2, 0.2 m/s^2, 0 m/s^2]}}"
    )
    log = run(crane((IMU, entry)), tmp_path / "run.mcap", (0.0, 0.0), 4.0)
    found = {name.removeprefix("imu/"): values[50:] for name, values in source_states(log).items()}
    rate, force = 2e-3 * math.sqrt(100), 0.01 * math.sqrt(100)
    means = {"angular_velocity.x": math.radians(1), "linear_acceleration.y": 0.2, "linear_acceleration.z": G}
    for name, values in found.items():
        if name.startswith("magnetic"):
            continue
        deviation = rate if name.startswith("angular") else force
        assert values.std() == pytest.approx(deviation, rel=0.15)
        assert values.mean() == pytest.approx(
            means.get(name, 0.0), abs=5 * deviation / math.sqrt(len(values))
        )
    assert found["magnetic_field.y"][-1] == pytest.approx(2.0e-5)


def test_a_sensor_of_the_real_world_is_refused_on_virtual_time(crane):
    path = crane((IMU, "{type: serial_imu, port: /dev/ttyACM7}"))
    with pytest.raises(
        InputError, match=r"virtual time needs simulated sensors, but imu \(serial_imu\) is real"
    ):
        VirtualRobot(plan_of(path))


def change_reads(robot, monkeypatch, change):
    """Let a function change what the IMU reads: from now and the time of a sample, ns, and its values."""
    read = robot.drivers["imu"].read

    def changed(values):
        t_ns = read(values)
        return change(robot.clock.now_ns(), t_ns, values)

    monkeypatch.setattr(robot.drivers["imu"], "read", changed)


def silent(now_ns, t_ns, values):
    """Bring nothing for half a second."""
    return None if 1_500_000_000 <= now_ns < 2_000_000_000 else t_ns


def stuck():
    """Return what brings the sample of a time again and again from then on, with new times."""
    kept = []

    def change(now_ns, t_ns, values):
        if t_ns >= 1_500_000_000:
            kept.append(values.copy())
            values[:] = kept[0]
        return t_ns

    return change


NOISY = "gyroscope: {noise_density: 1.0e-4}, accelerometer: {noise_density: 2.0e-3}"
LOST = {
    "silent": r"sensor imu delivered no sample for (8\d|90) ms",  # in the first such cycle
    "stuck": r"sensor imu has returned the same sample for 2\d\d ms; check its cable and its driver",
}


@pytest.mark.parametrize("kind", LOST)
@pytest.mark.parametrize("on_lost", ["continue", "stop"])
def test_a_sensor_that_stops_ends_the_run_where_it_shall_and_a_replay_too(
    crane, tmp_path, monkeypatch, kind, on_lost
):
    filter_first = "  tilt: {type: imu_sensor_broadcaster, sensor: imu}\n  arm: {type"
    entry = f"{{type: simulated_imu, link: tip, timeout: 80 ms, on_lost: {on_lost}, {NOISY}}}"
    log = tmp_path / "run.mcap"
    robot = VirtualRun(crane(("  arm: {type", filter_first), (IMU, entry)), log, duration_s=3.0)
    change_reads(robot, monkeypatch, silent if kind == "silent" else stuck())
    result = robot.run()
    found = read_log(log)
    (first, *later) = [(event.name, event.text) for event in found.events if event.source == "imu"]
    assert first[0] == "sensor_lost"
    assert re.fullmatch(LOST[kind], first[1])
    ages, valid = found.cycles["source_age_ns"][:, 0], found.cycles["source_valid"][:, 0]
    if kind == "silent":
        assert (valid == (ages <= 80_000_000)).all()
    back = [("sensor_back", "sensor imu delivers samples again")]
    assert later == (back if (kind, on_lost) == ("silent", "continue") else [])
    if on_lost == "continue":
        assert (result.reason, bool(valid[-1])) == ("ended", kind == "silent")
    else:
        assert (result.reason, bool(valid[-1])) == ("fault", False)
        assert "sensor imu delivered nothing for 80 ms; on_fault: " in result.detail
        last_s = found.cycles["woken_ns"][-1] * 1e-9
        assert last_s == pytest.approx(
            1.5 + {"silent": 0.08, "stuck": 0.2}[kind], abs=0.02 + 0.1 * (kind == "stuck")
        )
        assert not robot.failures
    report = replay_log(log)
    assert report.same, report
    assert report.compared == len(found.cycles)


def test_a_sensor_that_never_brought_a_sample_ends_the_run_too(crane, monkeypatch):
    entry = "{type: simulated_imu, link: tip, timeout: 80 ms, on_lost: stop}"
    robot = VirtualRun(crane((IMU, entry)), duration_s=1.0)
    monkeypatch.setattr(robot.drivers["imu"], "read", lambda values: None)
    result = robot.run()
    assert (result.reason, result.cycles) == ("fault", 10)  # the one at 90 ms is the last
    assert "sensor imu delivered nothing for 80 ms; on_fault: " in result.detail


def test_a_driver_that_raises_is_an_event_and_is_opened_again(crane, tmp_path, monkeypatch):
    log = tmp_path / "run.mcap"
    robot = VirtualRun(crane(), log, duration_s=3.0)
    sensor, closed = robot.drivers["imu"], []
    read = sensor.read

    def fail_once(values: np.ndarray) -> int | None:
        if not closed and robot.clock.now_ns() > 1_500_000_000:
            raise OSError(5, "Input/output error")
        return read(values)

    monkeypatch.setattr(sensor, "read", fail_once)
    monkeypatch.setattr(sensor, "close", lambda: closed.append(robot.clock.now_ns()))
    assert robot.run().reason == "ended"
    texts = [event.text for event in read_log(log).events if event.source == "imu"]
    assert texts == [
        "sensor imu: Input/output error",
        "sensor imu has failed; its values are not valid",
        "sensor imu: is open again",
        "sensor imu delivers samples again",
    ]
    assert len(closed) == 2  # then, and at the end


def test_a_value_that_its_driver_leaves_out_is_not_that_of_the_sample_before(crane, monkeypatch):
    robot = VirtualRun(crane(), duration_s=1.0)
    set_values = iter([slice(None)])  # all in the first sample, then the first one only

    def read(values: np.ndarray) -> int:
        values[next(set_values, slice(1))] = 1.0
        return robot.clock.now_ns()

    monkeypatch.setattr(robot.drivers["imu"], "read", read)
    robot.run()
    assert not robot.record.sources.valid.any()


@pytest.mark.parametrize("part", ["source", "controller"])
def test_source_is_closed_when_a_later_part_cannot_start(crane, monkeypatch, part):
    opened: list[SampledSource] = []

    def open_first(source: SampledSource) -> None:
        if part == "source" and opened:
            raise OSError("the second device is not there")
        opened.append(source)
        source.is_open = True

    def fail(*_: object, **__: object) -> None:
        raise PlugInError("the controller cannot be configured")

    monkeypatch.setattr(SampledSource, "open_first", open_first)
    if part == "controller":
        monkeypatch.setattr(virtual_run, "assemble", fail)
    plan = plan_of(crane((f"imu: {IMU}", f"imu: {IMU}\n  other: {IMU}")))
    with pytest.raises((PortError, PlugInError), match=r"the second device|the controller"):
        VirtualRobot(plan)
    assert opened
    assert not any(source.is_open for source in opened)
