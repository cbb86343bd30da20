"""Processes of features beside the loop, in a plan and in the plan of a log of an earlier version."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from dxlrun.control.source_process import planned_processes
from dxlrun.features.sensors.plan import decode_sensors
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.testing import plan_of

ROBOT = Path(__file__).parents[2] / "robots/bioloid_torso_imu.yaml"


def test_plan_has_a_process_for_each_sensor() -> None:
    plan = plan_of(ROBOT, arguments={"port": "sim"})
    (planned,) = planned_processes(plan.loop)
    assert (planned.feature.name, planned.index, planned.process.kind) == ("sensors", 0, "sensor")
    assert planned.process.values == len(plan.loop.source_states[planned.process.source])


def test_sensors_of_a_log_of_an_earlier_version_are_those_of_the_feature() -> None:
    plan = plan_of(ROBOT, arguments={"port": "sim"})
    tree = json.loads(to_json(plan))
    sensors = json.loads(base64.b64decode(tree["loop"]["feature_plans"].pop("sensors")))
    old = json.dumps(tree | {"loop": tree["loop"] | {"sensors": sensors}}, separators=(",", ":"))
    found = from_json(old.encode())
    assert decode_sensors(found.feature_plans["sensors"]) == decode_sensors(plan.feature_plans["sensors"])
