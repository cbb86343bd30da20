"""`sensors:` of a robot file: what is wrong is one sentence at its place."""

from __future__ import annotations

import pytest

from dxlrun.features.sensors.plan import decode_sensors
from dxlrun.testing import plan_of

IMU = "  imu: {type: simulated_imu, link: tip}"
WRONG = {
    "{type: simulated_im, link: tip}": (
        "11:15: no plug-in offers the sensor type simulated_im of imu; did you mean simulated_imu?"
    ),
    "{type: simulated_imu, link: nose}": (
        "11:36: link nose of imu is not in the URDF; known: boom, ground, mast, tip"
    ),
    "{type: simulated_imu, link: tip, rate: 0}": "11:47: sensors.imu.rate is 0, but must be at least 0.001",
    "{type: simulated_imu, link: tip, timeout: 5}": "11:50: sensors.imu.timeout: 5 has no unit",
    "{type: simulated_imu, link: tip, on_lost: limp}": "11:50: sensors.imu.on_lost is the text 'limp'",
    "{type: simulated_imu}": "11:3: sensors.imu has no link",
    "{type: simulated_imu, link: tip, lnik: tip}": (
        "11:41: sensors.imu has an unknown key 'lnik'; did you mean link?"
    ),
    "{type: simulated_imu, link: tip, gyroscope: {noise_density: -1}}": (
        "11:68: sensors.imu.gyroscope.noise_density is -1, but must be at least 0"
    ),
    "{type: simulated_imu, link: tip, gyroscope: {bias: [1 deg, 0 deg/s, 0 deg/s]}}": (
        "11:60: sensors.imu.gyroscope.bias[0]: "
    ),
    "{type: simulated_imu, link: tip, rate: 10, timeout: 100 ms}": (
        "11:60: imu delivers a sample every 100 ms, but counts as lost after 100 ms without one"
    ),
    "{type: serial_imu, port: /dev/imu, scale: {angular_velocty: 0.0174533}}": (
        "11:50: sensors.imu.scale: no column belongs to angular_velocty; "
        "the groups are angular_velocity, linear_acceleration"
    ),
    "{type: serial_imu, port: /dev/imu, columns: []}": "11:52: sensors.imu.columns has too few",
    "{type: serial_imu, port: /dev/imu, columns: ['-']}": (
        "11:52: sensors.imu.columns: no column is a state; name at least one"
    ),
    "{type: serial_imu, port: /dev/imu, columns: [age]}": (
        "11:52: sensors.imu.columns: 'age' is not a valid state; write a name such as angular_velocity.x"
    ),
    "{type: serial_imu, port: /dev/imu, columns: [a, a]}": (
        "11:52: sensors.imu.columns: a occurs twice; name each state once"
    ),
}


@pytest.mark.parametrize(("entry", "sentence"), WRONG.items())
def test_each_mistake_is_one_sentence_at_its_place(refusals, entry, sentence):
    found = refusals((IMU, f"  imu: {entry}"))
    assert len(found) == 1
    assert found[0].startswith(f"crane.yaml:{sentence}"), found[0]


def test_a_sensor_that_is_refused_is_not_missed_by_what_reads_it_too(refusals):
    reader = "controllers:\n  imu_of: {type: imu_sensor_broadcaster, sensor: imu, frame: tip}\n"
    (sentence,) = refusals(("controllers:\n", reader), (IMU, "  imu: {type: simulated_im, link: tip}"))
    assert "no plug-in offers the sensor type simulated_im" in sentence


def test_a_sensor_has_a_name_of_its_own(refusals):
    (sentence,) = refusals(("  imu: {type", "  turn: {type"))
    assert sentence.startswith("crane.yaml:11:3: turn is already the name of a joint with states")


def test_a_simulated_sensor_needs_a_urdf_and_simulated_servos(refusals):
    assert refusals(("model: {urdf: crane.urdf}\n", "")) == [
        "crane.yaml:11:3: imu senses the motion of link tip, but the robot file has no URDF; "
        "write `model: {urdf: ...}`"
    ]
    (sentence,) = refusals(("port: sim", "port: /dev/ttyUSB0"))
    assert sentence.startswith(
        "crane.yaml:11:3: imu senses the simulated body, but bus main has a real port; write a `type`"
    )


def test_rate_and_timeout_have_defaults_by_the_loop_and_by_the_rate(crane):
    def of(entry: str) -> tuple[int, int]:
        (plan,) = decode_sensors(plan_of(crane((IMU, f"  imu: {entry}"))).feature_plans["sensors"])
        return plan.period_ns, plan.timeout_ns

    assert of("{type: simulated_imu, link: tip}") == (10_000_000, 50_000_000)
    assert of("{type: simulated_imu, link: tip, rate: 1000}") == (1_000_000, 50_000_000)
    assert of("{type: simulated_imu, link: tip, rate: 10}") == (100_000_000, 500_000_000)
    assert of("{type: simulated_imu, link: tip, timeout: 20 ms}") == (10_000_000, 20_000_000)
