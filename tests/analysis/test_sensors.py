"""Sensors that hang, and sensors that only stay as they are."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.kit.made_logs import loop_of

from dxlrun.plan.loop_plan import SensorPlan
from dxlrun_analysis.conduct.sensors import Sensors
from dxlrun_analysis.finding import Rank

Floats = npt.NDArray[np.float64]
TIME = np.arange(600) * 0.01
"""6 s"""
NOISE = np.random.default_rng(1).normal(size=600)
MOVES = np.sin(TIME)
HANGS = np.where(TIME < 2.0, NOISE, NOISE[199])


def findings(values: Floats, joint: Floats = MOVES, name: str = "gyro") -> list[Any]:
    kinds = [("position", np.float64, 1), ("source_valid", np.bool_, 1), ("source_state", np.float64, 2)]
    cycles = np.zeros(len(TIME), [("read_ns", np.int64), *kinds])
    cycles["read_ns"], cycles["source_valid"] = 10**9 + np.rint(TIME * 1e9).astype(np.int64), True
    cycles["position"][:, 0], cycles["source_state"][:, 0] = joint, values
    sensors, layout = Sensors(), SimpleNamespace(source_slice=lambda name: slice(0, 2))
    plan = {"loop": loop_of(sensors=(SensorPlan(name, "", "", "{}", ("x", "y"), 1, 1),))}
    for begin in range(0, len(TIME), 170):
        part: Any = SimpleNamespace(
            cycles=cycles[begin : begin + 170],
            header=SimpleNamespace(sources={"gyro": ("x", "y")}, layout=layout),
            attachments={"plan.json": json.dumps(plan).encode()},
            metadata={},
        )
        sensors.take(part)
    return list(sensors.findings())


def test_a_sensor_whose_values_stay_while_joints_move_hangs() -> None:
    (finding,) = findings(HANGS)
    assert (finding.code, finding.subject, finding.rank) == ("sensor_hangs", "gyro", Rank.SERVO_CAUSE)
    assert "for 4.0 s while joints moved, from 2.0 s" in finding.sentence


@pytest.mark.parametrize(
    ("values", "joint", "name"),
    [
        (NOISE, MOVES, "gyro"),
        (np.where(TIME % 3 < 1.5, 0.0, 1.0), MOVES, "gyro"),
        (np.zeros(600), MOVES, "gyro"),
        (np.where(TIME < 0.5, 0.0, HANGS), MOVES, "gyro"),
        (HANGS, np.where(TIME < 2.0, MOVES, MOVES[199]), "gyro"),
        (HANGS, MOVES, "another"),
    ],
    ids=["measures", "a switch", "never changed", "rested before", "at rest", "no sensor"],
)
def test_one_that_has_a_reason_does_not(values: Floats, joint: Floats, name: str) -> None:
    assert findings(values, joint, name) == []
