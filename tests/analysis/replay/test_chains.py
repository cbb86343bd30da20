"""A replay of chains has no difference, and names the reference that differs where there is one."""

from collections.abc import Mapping
from pathlib import Path

import pytest
from tests.kit.changed_logs import flip, plan
from tests.kit.virtual_run import Asked, VirtualRun, differing, replayed, switch

from dxlrun.errors import InputError, LogError
from dxlrun_analysis.replay import Setting, replay_log

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[3] / "robots"
BOTH = ("arm", "arm_pid")
ASKED: Asked = {
    40: [switch((), ["arm"])],
    60: [switch(["arm"])],
    80: [switch((), BOTH)],
    90: [switch(BOTH)],
    160: [switch(["arm"], ["arm"])],
}
MASKS: Mapping[int, int] = {39: 0b111, 40: 0b101, 60: 0b111, 80: 0b001, 140: 0b111, 160: 0b111}
"""Which of joint_state_broadcaster, arm and arm_pid are active, from a cycle on"""


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """The log of an arm whose trajectory commands the references of a PID controller, and is switched."""
    log = tmp_path_factory.mktemp("arm") / "run.mcap"
    lift = ROBOTS / "motions/effort_arm_lift.yaml"
    return VirtualRun(ROBOTS / "effort_arm.yaml", log, ASKED, play=[lift], duration_s=0.5).logged()


def test_a_chain_that_is_switched_is_replayed(arm):
    log = replayed(arm)
    assert log.header.references[:2] == ("arm_pid/shoulder/position", "arm_pid/elbow/position")
    assert {cycle: int(log.cycles["active"][cycle]) for cycle in MASKS} == MASKS


@pytest.mark.parametrize(
    "flipped", [(0, 20, "arm", "shoulder"), (1, 145, "arm", "elbow"), (1, 45, None, "elbow")]
)
def test_a_flipped_bit_of_a_reference_is_found_and_named(arm, changed, flipped):
    place, cycle, controller, joint = flipped
    both = flip("reference", cycle, place), flip("command_effort", cycle, place)
    report, first = differing(changed(arm, *both))
    assert report.different == 1
    assert (first.cycle, first.controller, first.joint) == (cycle, controller, joint)
    assert first.what == f"reference arm_pid/{joint}/position"
    (one,) = report.joints
    assert (one.joint, one.references, one.commands, one.goals) == (joint, 1, 1, 0)


def test_other_references_than_those_of_the_log_are_refused(arm, changed):
    with pytest.raises(InputError, match="arm_pid: the exported references differ"):
        replay_log(arm, [Setting.parse("arm_pid.reference=velocity")])
    other = plan(lambda content: content["loop"]["controllers"][2].update(reference=["velocity"]))
    with pytest.raises(LogError, match="the log is damaged: plan and cycles differ in references"):
        replay_log(changed(arm, other))
