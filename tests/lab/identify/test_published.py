r"""Motors of a published identification: Rhoban BAM (Apache-2.0), Duclusaud et al., arXiv 2410.08650.

Its parameters are facts; what a motor with them does is worked out here, from BAM's equations. Its recordings
of a real XL330-M288 (a weight of 0.49 kg at 0.1 m, 6 s each) are not in this repository:

    git clone https://github.com/Rhoban/bam; git -C bam checkout af22604
    DXLRUN_BAM_RECORDINGS=bam/bam/data.bak/raw \
        python -m pytest tests/lab/identify/test_published.py -q
"""

import dataclasses
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from dxlrun.channels.cycle import CycleLayout, Torque
from dxlrun_lab.identify.excitation import Room, excitation
from dxlrun_lab.identify.fit import fit_run
from dxlrun_lab.identify.joint_recording import measured
from dxlrun_lab.identify.known_servo import Servo
from dxlrun_lab.identify.result import IdentifiedServo, KnownLoad, identified
from dxlwire.control_table import find_table
from dxlwire.modes import Mode

pytestmark = pytest.mark.long

RECORDINGS = os.getenv("DXLRUN_BAM_RECORDINGS", "")
TICK = math.tau / 4096
MASS, LENGTH, G = 0.49, 0.1, 9.80665


KT, RESISTANCE, ARMATURE, BASE, VISCOUS = 1.6225, 3.9494, 0.011951, 0.09039, 0.011692
"""Parameters of bam/params/mx64, M1, kept to four digits."""


def cycles_of(columns: dict[str, NDArray[np.float64]], time_s: NDArray[np.float64]) -> NDArray[np.void]:
    cycles = np.zeros(len(time_s), CycleLayout(["elbow"], []).dtype)
    nanoseconds = ((time_s + 1.0) * 1e9).astype(np.int64)
    cycles["woken_ns"] = cycles["read_ns"] = cycles["written_ns"] = nanoseconds
    cycles["valid"], cycles["mode"], cycles["torque"] = True, Mode.POSITION, Torque.ON
    cycles["goal_velocity"] = np.nan
    for name, values in columns.items():
        cycles[name][:, 0] = values
    return cycles


def moved(goals: NDArray[np.float64], rate: int) -> NDArray[np.void]:
    """Return what an MX-64 at P gain 32 and 12 V does with a weight, in steps of 0.2 ms, read in ticks."""
    dt, inertia = 2e-4, ARMATURE + MASS * LENGTH**2
    q = w = duty = 0.0
    rows = []
    for goal in goals.tolist():
        rows.append((round(q / TICK) * TICK, duty))
        sent = round(goal / TICK) * TICK
        for _ in range(round(1 / rate / dt)):
            duty = max(-1.0, min(1.0, 0.158 * 32 * (sent - q)))
            torque = KT * (duty * 12.0 - KT * w) / RESISTANCE
            weight = -MASS * G * LENGTH * math.sin(q)
            most = BASE + VISCOUS * abs(w)
            stop = inertia / dt * w + torque + weight
            w += (torque + weight - math.copysign(min(abs(stop), most), stop)) / inertia * dt
            q += w * dt
    position, duties = np.array(rows).T
    time_s = np.arange(len(goals)) / rate
    voltage = np.full(len(goals), 12.0)
    return cycles_of(
        {"position": position, "effort": duties, "goal_position": goals, "voltage": voltage}, time_s
    )


def result_of(cycles: NDArray[np.void], servo: Servo) -> IdentifiedServo:
    run = measured(cycles, 0, servo)
    return identified(run, fit_run(run), KnownLoad(MASS * LENGTH**2, MASS * G * LENGTH), "test")


def test_an_mx_64_with_published_parameters():
    """M1, whose friction does not grow with the load: the simulated servos of other tests have M3."""
    rate = 200
    parts = excitation(Room(-0.6, 0.6), 14.0, 1 / rate, start=0.0)
    cycles = moved(np.concatenate([part.goals for part in parts]), rate)
    found = result_of(cycles, Servo("elbow", find_table("MX-64", 1.0), math.pi, 1))
    assert (found.scale, found.friction_model) == ("load", "m1")
    assert found.motor.load.gravity == pytest.approx(MASS * G * LENGTH)
    damping = KT**2 / RESISTANCE
    # viscous friction is in it, as no current is measured
    constant = KT * (1 + VISCOUS / damping)
    assert found.motor.torque_constant == pytest.approx(constant, rel=0.02)
    assert found.motor.torque_constant / found.motor.resistance == pytest.approx(KT / RESISTANCE, rel=0.03)
    assert found.motor.inertia == pytest.approx(ARMATURE, rel=0.05)
    assert found.motor.friction == pytest.approx(BASE, rel=0.05)
    assert found.motor.position_gain == pytest.approx(0.158, rel=0.03)


def recording(files: Sequence[Path], p_gain: int) -> NDArray[np.void]:
    """Return the recordings at a P gain one after the other; the servo's PWM is its effort."""
    parts, start_s = [], 0.0
    for data in (json.loads(file.read_text()) for file in files):
        if data["kp"] != p_gain:
            continue
        entries: list[dict[str, Any]] = data["entries"]
        column = {key: np.array([float(entry[key]) for entry in entries]) for key in entries[0]}
        pwm = np.where(column["load"] > 32767, column["load"] - 65536, column["load"])
        columns = {
            "position": column["position"],
            "effort": pwm / 885,
            "goal_position": column["goal_position"],
            "voltage": column["input_volts"],
        }
        cycles = cycles_of(columns, start_s + column["timestamp"])
        cycles["torque"][:, 0] = np.where(column["torque_enable"] > 0, Torque.ON, Torque.OFF)
        parts.append(cycles)
        start_s += float(column["timestamp"][-1]) + 2.0
    return np.concatenate(parts)


@pytest.mark.skipif(not RECORDINGS, reason="DXLRUN_BAM_RECORDINGS names no folder of recordings")
@pytest.mark.parametrize("p_gain", [100, 200, 400])
def test_the_recordings_of_a_real_xl330(p_gain):
    table = dataclasses.replace(find_table("XL330-M288", 2.0), effort_unit="1")
    servo = Servo("elbow", table, 0.0, 1, {"position_p_gain": p_gain})
    found = result_of(recording(sorted(Path(RECORDINGS).glob("*.json")), p_gain), servo)
    half = found.uncertainty
    # KP / 256, which BAM found on an oscilloscope
    assert found.motor.position_gain == pytest.approx(4096 / math.tau / 256 / 885, rel=0.02)
    # params/xl330 of the same commit: M1, M2 and M6 disagree by more than any interval
    published = [(0.32321, 4.76365), (0.30007, 3.42235), (0.30361, 2.44495)]
    ratios = [kt / resistance for kt, resistance in published]
    ratio = found.motor.torque_constant / found.motor.resistance
    width = ratio * math.hypot(
        half["torque_constant"] / found.motor.torque_constant, half["resistance"] / found.motor.resistance
    )
    assert min(ratios) - width <= ratio <= max(ratios) + width
    assert found.motor.inertia == pytest.approx(0.00185, abs=half["inertia"] + 0.0006)  # 0.00164 to 0.00206
    assert found.position_rms < 0.04
