"""How well simulated servos follow the thesis' motion with a feed-forward and without.

    python bench/feed_forward.py [--seconds 12]

Prints RMS and greatest error (read minus desired, at the time of the reading), the lag with which the motion
fits best, and the RMS error that is left of a motion that is later by that lag: what is no lag. Virtual time,
the same on every machine. The MX-64 is that of robots/single_joint_feed_forward.yaml, with its load;
`without` is the same chain with scale 0, which sends the positions that the trajectory has.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dxlrun import MotorLoad, MotorModel
from dxlrun.description.joints.motor_file import motor_text, read_motor
from dxlrun.testing import Log, read_log, simulated_robot

ROBOTS = Path(__file__).parents[1] / "robots"
MOTION = ROBOTS / "motions/single_joint_tracking.yaml"
MX64 = read_motor(ROBOTS / "motors/MX-64.motor.yaml").motor
XM430 = MotorModel(
    "XM430-W350", 12.0, 1.783, 5.217, 0.01256, 0.0764, 0.0758, 0.0007, load=MotorLoad(0.01, 0.6, 0.0)
)
"""Stall torque and current are the manual's, inertia and friction scaled from the MX-64 as simulated."""
BEGUN_S, LEFT_OUT_S = 1.0, 0.5
POSITIONS = """\
name: positions
buses: {{main: {{port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us}}}}
loop: {{rate: 320}}
joints:
  joint: {{bus: main, id: 1, model: MX-64, reference: 180 deg, direction: -1, motor: known.yaml,
          simulation: {{motor: true.yaml}}}}
controllers:
  ff: {{type: feed_forward, joints: [joint], scale: {scale}, voltage_filter: 500 ms}}
  posvel_trajectory:
    {{type: joint_trajectory_controller, joints: [joint], command_interface: posvel, into: ff}}
"""
EFFORTS = """\
name: efforts
buses: {{main: {{port: sim, protocol: 2.0, baud_rate: 3_000_000, return_delay_time: 0 us}}}}
loop: {{rate: 320}}
joints:
  joint: {{bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: -1, motor: known.yaml}}
controllers:
  pid:
    {{type: pid_controller, joints: [joint], command_interface: {interface}, gains: {gains}}}
  ff:
    {{type: feed_forward, joints: [joint], command_interface: {interface}, scale: {scale},
     pass_on: true, into: pid}}
  posvel_trajectory:
    {{type: joint_trajectory_controller, joints: [joint], command_interface: posvel, into: ff}}
"""
ALONE = """\
name: alone
buses: {main: {port: sim, protocol: 2.0, baud_rate: 3_000_000, return_delay_time: 0 us}}
loop: {rate: 320}
joints:
  joint: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: -1, motor: known.yaml}
controllers:
  ff: {type: feed_forward, joints: [joint], command_interface: effort}
  posvel_trajectory: {type: joint_trajectory_controller, joints: [joint], command_interface: posvel, into: ff}
"""
GAINS = {"effort": "{p: 6.0, d: 0.15}", "pwm": "{p: 2.0, d: 0.05}"}


@dataclass(frozen=True)
class Tracking:
    """How a run followed the motion."""

    rms: float
    """rad"""
    worst: float
    """rad"""
    lag_s: float
    """By how much later the motion fits best"""
    rms_after_lag: float
    """rad, of the motion that is later by that"""


def desired(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return equation 5.1 of the thesis, rad."""
    return 0.5 * (np.sin(2 * t) - np.sin(4 * t))


def tracking(log: Log) -> Tracking:
    """Return how a run followed the motion; the first moments, in which it gets going, are left out."""
    cycles = log.cycles
    read_ns = cycles["read_ns"] - cycles["age_ns"][:, 0] - cycles["scheduled_ns"][0]
    t = read_ns * 1e-9 - BEGUN_S
    there = t > LEFT_OUT_S
    t, position = t[there], cycles["position"][there, 0]

    def rms(lag: float) -> float:
        return float(np.sqrt(np.mean((position - desired(t - lag)) ** 2)))

    lag = min(np.arange(-0.02, 0.12, 0.0005).tolist(), key=rms)
    return Tracking(rms(0.0), float(np.abs(position - desired(t)).max()), lag, rms(lag))


def tracked(
    folder: Path,
    text: str,
    known: MotorModel,
    true: MotorModel | None = None,
    *,
    volts: float = 12.0,
    seconds: float,
) -> tuple[Tracking, Log]:
    """Play the motion on a robot whose controllers know one motor while its servo has another one."""
    for name, motor in (("known.yaml", known), ("true.yaml", true or known)):
        (folder / name).write_text(motor_text(motor, {}))
    robot, path = folder / "robot.yaml", folder / "run.mcap"
    robot.write_text(text)
    path.unlink(missing_ok=True)
    run = simulated_robot(robot, play=[MOTION], duration_s=seconds, log=path)
    run.buses[0].servo(1).set_voltage(volts)
    result = run.run()
    if (result.reason, result.detail, run.failures) != ("ended", "", ()):
        raise RuntimeError(f"the run failed: {result}, {run.failures}")
    log = read_log(path)
    return tracking(log), log


def wrong(motor: MotorModel, by: float) -> MotorModel:
    """Return a motor of which each figure is wrong by the same part, so that all duties are."""
    return replace(
        motor,
        torque_constant=motor.torque_constant * by,
        resistance=motor.resistance / by,
        inertia=motor.inertia * by,
        friction=motor.friction * by,
        position_gain=(motor.position_gain or 0.0) / by,
        load=MotorLoad(motor.load.inertia * by, motor.load.gravity * by, motor.load.gravity_angle),
    )


def rows(folder: Path, seconds: float) -> Iterator[tuple[str, Tracking]]:
    """Measure, and yield each row of the table."""
    without, with_it = POSITIONS.format(scale=0), POSITIONS.format(scale=1)
    yield "MX-64, positions, without", tracked(folder, without, MX64, seconds=seconds)[0]
    yield "MX-64, positions, with", tracked(folder, with_it, MX64, seconds=seconds)[0]
    for by in (0.8, 1.2):
        found, _ = tracked(folder, with_it, wrong(MX64, by), MX64, seconds=seconds)
        yield f"with a motor file that is wrong by {by - 1:+.0%}", found
    yield "11 V, without", tracked(folder, without, MX64, volts=11.0, seconds=seconds)[0]
    yield "11 V, with", tracked(folder, with_it, MX64, volts=11.0, seconds=seconds)[0]
    for interface, gains in GAINS.items():
        for scale, name in enumerate(("without", "with")):
            text = EFFORTS.format(interface=interface, gains=gains, scale=scale)
            yield f"XM430, PID by {interface}, {name}", tracked(folder, text, XM430, seconds=seconds)[0]
    yield "XM430, effort alone, no feedback", tracked(folder, ALONE, XM430, seconds=seconds)[0]


def main() -> None:
    """Measure, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=12.0)
    options = parser.parse_args()
    print(f"{'':42} {'RMS':>10} {'worst':>10} {'lag':>9} {'RMS beside the lag':>20}")
    with tempfile.TemporaryDirectory() as directory:
        for name, found in rows(Path(directory), options.seconds):
            print(
                f"{name:42} {found.rms * 1e3:5.1f} mrad {found.worst * 1e3:5.1f} mrad "
                f"{found.lag_s * 1e3:6.1f} ms {found.rms_after_lag * 1e3:15.1f} mrad"
            )


if __name__ == "__main__":
    main()
