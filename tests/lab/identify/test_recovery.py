"""`dxlrun identify` finds the constants of simulated motors, whose intervals hold as often as they claim."""

import numpy as np
import pytest
from tests.kit.campaigns import campaign

from dxlrun.description.joints.motor_file import motor_text, read_motor
from dxlrun_lab.identify.result import IdentifiedServo, KnownLoad, identified
from dxlsim.motion.motor import Motor

pytestmark = pytest.mark.long

GRAVITY, INERTIA = 0.3, 0.005
LOAD = KnownLoad(INERTIA, GRAVITY)


def true_figures(motor: Motor) -> dict[str, float]:
    constant = motor.damping * motor.voltage / motor.stall_torque
    return {
        "torque_constant": constant,
        "resistance": constant * motor.voltage / motor.stall_torque,
        "inertia": motor.inertia,
        "friction": motor.friction,
        "load_friction": motor.load_friction,
        "stall_torque": motor.stall_torque,
        "load_gravity_angle": np.radians(20.0),
        "torque_per_measured_ampere": motor.torque_per_ampere,
    }


def check_constants(found: IdentifiedServo, motor: Motor, within: float) -> None:
    true = true_figures(motor)
    wrong = {
        value.name: (value.value, true[value.name])
        for value in found.values
        if value.name in true
        and value.half is not None
        and value.value != pytest.approx(true[value.name], rel=within)
    }
    assert not wrong


@campaign(ci=0, night=1, release=1)
def test_an_mx_64_without_a_current_by_a_known_weight(mx64):
    found = mx64.identified(mx64.noisy(1), LOAD)
    assert (found.scale, found.friction_model) == ("load", "m3")
    check_constants(found, mx64.servo.built_in, 0.05)
    gain = next(value for value in found.values if value.name == "position_gain")
    assert gain.value == pytest.approx(0.158, rel=0.02)
    delay = next(value for value in found.values if value.name == "delay")
    assert delay.value == pytest.approx(0.3e-3, abs=0.7e-3)  # without a response delay: the bus, and the grid
    assert found.motor.load.gravity == GRAVITY
    assert found.held_out_rms < 1.3 * found.position_rms < 0.004


def test_an_xl330_by_its_current_alone_and_a_servo_simulated_from_its_motor_file(
    xl330, fitted_xl330, record, tmp_path
):
    found = identified(*fitted_xl330, KnownLoad(INERTIA), "test")
    assert (found.scale, found.friction_model) == ("current", "m3")
    check_constants(found, xl330.servo.built_in, 0.05)
    assert found.motor.load.gravity == pytest.approx(GRAVITY, rel=0.05)
    path, other = tmp_path / "elbow.motor.yaml", tmp_path / "other.yaml"
    path.write_text(motor_text(found.motor, found.uncertainty))
    read = read_motor(path)
    assert read.motor.torque_constant == pytest.approx(found.motor.torque_constant, rel=1e-5)
    assert read.uncertainty["inertia"] == pytest.approx(found.uncertainty["inertia"], rel=1e-5)
    inertia = f"inertia: {found.motor.inertia:.6g}"
    assert inertia in path.read_text()
    other.write_text(path.read_text().replace(inertia, "inertia: 0.006"))
    same, apart = (
        record("XL330-M288", 2.0, motor=f"motor: {file}").cycles["position"] - xl330.cycles["position"]
        for file in (path, other)
    )
    assert np.sqrt(np.mean(np.square(same))) < 0.006
    assert np.sqrt(np.mean(np.square(apart))) > 0.02


@campaign(ci=0, night=1, release=1)
@pytest.mark.parametrize(
    ("model", "protocol", "rate"),
    [("MX-64", 1.0, 200), ("MX-106", 1.0, 320), ("XL330-M288", 2.0, 100), ("XM430-W350", 2.0, 250)],
)
def test_sixty_noisy_seconds_of_each_model(record, model, protocol, rate):
    run = record(model, protocol, seconds=60.0, rate=rate)
    check_constants(run.identified(run.noisy(3), LOAD), run.servo.built_in, 0.05)


@campaign(ci=0, night=8, release=40)
def test_intervals_have_the_true_value_as_often_as_they_claim(mx64, xl330, amount):
    inside = {}
    for seed in range(int(amount)):
        for run in (mx64, xl330):
            found = run.identified(run.noisy(100 + seed, position_ticks=3.0, effort=0.05), LOAD)
            true = true_figures(run.servo.built_in)
            for value in found.values:
                if value.name in true and value.half is not None:
                    inside.setdefault(value.name, []).append(
                        abs(value.value - true[value.name]) <= value.half
                    )
    counts = {name: (sum(each), len(each)) for name, each in inside.items()}
    print(counts)
    total = sum(many for many, _ in counts.values()) / sum(of for _, of in counts.values())
    assert 0.9 <= total <= 1.0
