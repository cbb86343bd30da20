"""A small robot's records, made as the loop makes them, runs of a whole robot, and a foreign decoder."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from dxlrun.channels.cycle import CycleLayout, CycleRecord
from dxlrun.log import schemas
from dxlrun.log.log_writer import LogWriter
from dxlrun.log.schemas import LoggedController, LogHeader
from dxlrun.plan.recording_plan import RecordingPlan
from dxlrun.testing import VirtualRobot, plan_of

PERIOD_NS = 20_000_000
JOINTS = ("left_elbow_joint", "head_pitch_joint", "head_yaw_joint")
ROBOTS = Path(__file__).parents[2] / "robots"


@pytest.fixture
def header():
    return LogHeader(
        robot="torso",
        joints=JOINTS,
        buses=("main", "second"),
        controllers=(
            LoggedController("joint_state_broadcaster", JOINTS[1:], ("/joint_states",)),
            LoggedController("head", JOINTS[1:], ()),
        ),
        period_ns=PERIOD_NS,
        epoch_offset_ns=1_700_000_000_123_456_789,
        attachments={"robot.yaml": b"name: torso\n", "plan.json": b"{}"},
        metadata={"versions": {"dxlrun": "0.1.0"}},
    )


@pytest.fixture
def layout(header):
    return CycleLayout(header.joints, [controller.name for controller in header.controllers])


@pytest.fixture
def cycle(layout):
    """Return the bytes of cycle `number`: published in even ones, joint 1 invalid in every third."""
    record = CycleRecord(layout)

    def make(number: int) -> bytes:
        start = 1_000_000_000 + number * PERIOD_NS
        record.cycle, record.scheduled_ns, record.woken_ns = number, start, start + 60_000
        record.read_ns, record.updated_ns = start + 5_000_000, start + 5_100_000
        record.written_ns, record.period_ns = start + 5_400_000, PERIOD_NS
        record.active, record.published = 0b11, int(number % 2 == 0)
        record.states.position[:] = np.array([0.1, 0.2, 0.3]) + number
        record.states.velocity[:] = [1.0, 2.0, 3.0]
        record.states.effort[:] = [-0.5, 0.0, 0.5]
        record.valid[:] = [True, number % 3 != 0, True]
        record.age_ns[:] = 1000 * number
        record.goals.position[:] = [0.0, 0.25, -0.0]
        record.goals.velocity[:] = [np.nan, 1.5, 2.5]
        record.clamped[:] = [0, 2, 4]
        record.controller_ns[:] = [40_000, 50_000]
        return bytes(record.raw)

    return make


@pytest.fixture
def path(tmp_path):
    return tmp_path / "run.mcap"


@pytest.fixture
def log(path, header):
    return LogWriter(path, header)


@pytest.fixture(scope="session")
def torso(tmp_path_factory):
    """A folder with logs of the torso, whose head moves, for 2.5 s: `whole.mcap`, and `parts` of 1 s."""
    folder = tmp_path_factory.mktemp("torso")
    motion = ROBOTS / "motions/three_parts.yaml"
    plan = plan_of(ROBOTS / "bioloid_torso.yaml", duration_s=2.5, play=[motion])
    VirtualRobot(plan, log=folder / "whole.mcap").run()
    VirtualRobot(replace(plan, recording=RecordingPlan(split_ns=1_000_000_000)), log=folder / "parts").run()
    return folder


@pytest.fixture(scope="session")
def typestore():
    """Rosbags with our messages; the standard ones are its own, so that our texts are judged."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    for message in (schemas.CYCLE, schemas.BUS_PACKETS, schemas.EVENT, schemas.COMMAND):
        store.register(get_types_from_msg(message.text, message.name))
    return store
