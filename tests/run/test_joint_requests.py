"""Torque and reboots in whole runs on virtual time: what the servos had; replays have no difference."""

from __future__ import annotations

import numpy as np
import pytest
from tests.kit.answers import result_of
from tests.kit.sampled_run import MS, SampledRun, texts, torque_of
from tests.kit.stories import ask, send, switch, torque
from tests.kit.totals import totals_of

from dxlrun.channels.answers import Code, Refusal
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun_analysis.joints.goal_tracking import tracking
from dxlrun_analysis.verdict import judge_run

ROBOT = """\
name: arm
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, return_delay_time: 0 us}
loop: {rate: 100}
joints:
  shoulder: {bus: main, id: 1, model: XM430-W350, reference: 180 deg, direction: 1}
  elbow: {bus: main, id: 2, model: XM430-W350, reference: 180 deg, direction: 1, torque: on}
  wrist: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: -1}
controllers:
  arm: {type: joint_group_position_controller, joints: [shoulder, elbow]}
  hand: {type: joint_group_position_controller, joints: [wrist]}
"""
LIMP = ROBOT.replace("torque: on", "torque: off").replace(
    "[shoulder, elbow]}", "[shoulder, elbow], active: false}"
)


@pytest.fixture
def start(tmp_path):
    return lambda text=ROBOT, seconds=2.0: SampledRun(tmp_path, text, seconds)


def reboot(joint: str, *, release: bool = True) -> CommandMessage:
    return ask("reboot", {"joints": [joint], "release": release})


def refusal(run: SampledRun, number: int) -> str:
    answer = run.answer(number)
    assert isinstance(answer, Refusal)
    return answer.text


@pytest.mark.parametrize(
    "policy",
    ["hold", "[{pose: home, speed: 90 deg/s}, hold]", "[{pose: home, speed: 60 deg/s}, limp]"],
)
def test_a_requested_reboot_is_no_lost_servo(start, policy):
    home = "poses: {home: {wrist: 0 deg}}\n"
    run = start(f"{ROBOT}{home}policies: {{exit_timeout: 6 s, on_lost_servo: {policy}}}\n", 1.5)
    run.ask(400, reboot("wrist"))
    log = run.run()
    assert run.is_done()
    assert torque_of(log, "wrist")[-1] is Torque.ON
    assert len(log.cycles) >= 148


def test_a_joint_that_starts_limp_never_has_torque_until_it_is_asked_for(start):
    run = start(LIMP)
    registers = run.servos["elbow"].registers
    given: list[int] = []
    registers.watch_items(("torque_enable",), lambda: given.append(int(registers["torque_enable"])))
    refused = run.ask(500, switch(["arm"]))
    on, again = run.ask(1000, torque(["elbow"], on=True)), run.ask(1400, switch(["arm"]))
    before: list[int] = []
    run.at(990, lambda: before.append(sum(given)))
    log = run.run()
    assert before == [0]
    assert 1 in given
    said = "elbow (ID 2 on bus main) is limp; switch torque on with `dxlrun torque on elbow`"
    assert refusal(run, refused) == said
    assert run.is_done(on, again)
    assert torque_of(log, "elbow")[0] is Torque.RELEASED
    assert torque_of(log, "elbow")[-1] is Torque.ON
    assert not registers["torque_enable"]  # on_exit


def test_a_pose_at_the_end_does_not_wait_for_limp_joints(start):
    poses = "poses: {home: {elbow: 20 deg, wrist: 5 deg}}\n"
    policy = "policies: {exit_timeout: 8 s, on_exit: [{pose: home, speed: 90 deg/s}, limp]}\n"
    log = start(LIMP + poses + policy, 0.5).run()
    assert log.cycles["woken_ns"][-1] - log.cycles["woken_ns"][0] < 1200 * MS
    assert not [text for text in texts(log, EventCode.POLICY) if "ends early" in text]


def test_check_shows_it(tmp_path, dxlrun):
    file = tmp_path / "arm.yaml"
    file.write_text(LIMP)
    said = dxlrun("check", file, "--json")
    assert said.code == 0
    assert [row["mode"] for row in result_of(said.out)["joints"]] == [
        "position",
        "position, limp",
        "position",
    ]


@pytest.mark.parametrize("requested", [True, False])
def test_a_requested_reboot_is_no_fault_of_the_run(start, requested):
    """One that nothing requested counts: its invalid states too."""
    run = start(seconds=1.5)
    if requested:
        run.ask(400, reboot("wrist"))
    else:
        run.at(400, run.servos["wrist"].reboot)
    log = run.run()
    away = int(np.count_nonzero(~log.cycles["valid"][:, 2]))
    assert away > 10
    totals = totals_of(run.path)
    verdict = judge_run(totals)
    assert run.robot.result is not None
    assert run.robot.result.invalid == totals.invalid == tuple(joint.invalid for joint in tracking(log))
    if requested:
        assert (verdict.good, totals.invalid[2] <= 2) == (True, True), verdict
        assert Torque.LOST not in torque_of(log, "wrist")
    else:
        assert (verdict.good, totals.invalid[2]) == (False, away)
        assert "wrist" in verdict.sentences[0]


PLAYER = ROBOT.replace(
    "arm: {type: joint_group_position_controller, joints: [shoulder, elbow]}",
    "arm: {type: keyframe_player, joints: [shoulder, elbow], partial: true, motions: {nod: {steps: ["
    "{time: 300 ms, pose: {shoulder: 20 deg, elbow: 20 deg}}]}}}",
)


def test_a_player_goes_on_without_a_released_joint_and_begins_without_it(start):
    run = start(PLAYER, 3.0)
    off = run.ask(200, torque(["elbow"], on=False))
    run.ask(500, send("arm", "play", 0.0, 1.0, 1.0))
    run.ask(1500, switch(deactivate=["arm"]))
    again = run.ask(1700, switch(["arm"]))
    both = run.ask(2000, torque(["shoulder"], on=False))
    log = run.run()
    assert run.is_done(off, again)
    assert run.answer(both) == Refusal(
        Code.JOINT_COMMANDED, {"joint": ("shoulder",), "controller": ("arm",)}
    ), "it has no other joint"
    degrees = np.degrees(log.cycles["position"][-1, :2])
    assert degrees == pytest.approx([20, 0], abs=0.5)
    assert run.servos["elbow"].registers["goal_position"] == 2048, "it got no goal"
    assert texts(log, EventCode.GOAL_ENDED) == ["goal 1 reached: played nod, without elbow (no torque)"]
    assert torque_of(log, "elbow")[-1] is Torque.RELEASED
