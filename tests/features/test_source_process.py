"""Processes of features beside the loop, and features in the plan of a log of an earlier version."""

from __future__ import annotations

import base64
import json
from pathlib import Path

from dxlrun.control.sampled_sources import planned_processes
from dxlrun.features.sensors.plan import decode_sensors
from dxlrun.plan.policy_plan import HOLD, LIMP
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.testing import plan_of

ROBOT = Path(__file__).parents[2] / "robots/bioloid_torso_imu.yaml"


def test_plan_has_a_process_for_each_sensor():
    plan = plan_of(ROBOT, arguments={"port": "sim"})
    (planned,) = planned_processes(plan.loop)
    assert (planned.feature.name, planned.index, planned.process.kind) == ("sensors", 0, "sensor")
    assert planned.process.values == len(plan.loop.source_states[planned.process.source])


def test_sensors_and_policies_of_a_log_of_an_earlier_version_are_those_of_features():
    plan = plan_of(ROBOT, arguments={"port": "sim"})
    tree = json.loads(to_json(plan))
    loop = tree["loop"]
    loop["sensors"] = json.loads(base64.b64decode(loop.pop("feature_plans").pop("sensors")))
    hold, limp = loop["policies"].pop("of_features")["on_lost_servo"], loop["policies"]["on_exit"]
    group = {"name": "arm", "rows": [0, 2], "on_lost_servo": "limp"}
    loop["policies"] |= {"on_lost_servo": limp, "on_stale_command": hold, "groups": [group]}
    found = from_json(json.dumps(tree).encode())
    assert decode_sensors(found.feature_plans["sensors"]) == decode_sensors(plan.feature_plans["sensors"])
    assert found.loop.policies.of_features == {"on_lost_servo": LIMP, "on_stale_command": HOLD}
    assert json.loads(found.feature_plans["on_lost_servo"]) == [group]
