"""Torque and reboots in whole runs on virtual time: what the servos had; replays have no difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.kit.answers import result_of
from tests.kit.line_faults import turn_by_hand
from tests.kit.totals import totals_of

from dxlrun.channels.answers import Answer, Code, Completion, Refusal
from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.cycle import Torque
from dxlrun.channels.event_records import EventCode
from dxlrun.errors import InputError
from dxlrun.log.log_reader import Log, read_log
from dxlrun.testing import VirtualRobot, simulated_robot
from dxlrun_analysis.joints.goal_tracking import tracking
from dxlrun_analysis.replay import replay_log
from dxlrun_analysis.verdict import judge_run
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript

MS = 1_000_000
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


class Run:
    """A run in which a client asks at times, and faults happen."""

    def __init__(self, directory: Path, text: str = ROBOT, duration_s: float = 2.0) -> None:
        file, self.path = directory / "arm.yaml", directory / "run.mcap"
        file.write_text(text)
        self.robot: VirtualRobot = simulated_robot(file, duration_s=duration_s, log=self.path)
        self.asked = 0

    def at(self, ms: int, do: Callable[[], object]) -> None:
        self.robot.buses[0].at(ms * MS, do)

    def ask(self, ms: int, kind: str, **data: object) -> int:
        self.asked += 1
        command = CommandMessage(self.asked, "", kind, msgspec.json.encode(data) if data else b"", "anna")
        self.at(ms, lambda: self.robot.inbox.waiting.append(command))
        return self.asked

    def run(self) -> Log:
        self.robot.run()
        report = replay_log(self.path)
        assert (report.different, report.first, report.fault, report.remarks) == (0, None, "", ())
        log = read_log(self.path)
        assert report.compared == len(log.cycles)
        return log

    def answer(self, number: int) -> Answer:
        return self.robot.inbox.answers[number]

    def torque(self, log: Log, joint: int) -> list[Torque]:
        """Return what a joint's torque was, each once in order."""
        shown = log.cycles["torque"][:, joint].tolist()
        return [Torque(one) for index, one in enumerate(shown) if not index or shown[index - 1] != one]


@pytest.fixture
def run(tmp_path):
    return lambda *given, **more: Run(tmp_path, *given, **more)


def test_a_joint_is_led_by_hand_and_holds_where_it_was_put(run):
    one = run()
    servo = one.robot.buses[0].servo(2)
    off = one.ask(400, "torque", joints=["elbow"], on=False, release=True)
    one.at(700, lambda: turn_by_hand(servo, 2.5))
    on = one.ask(1000, "torque", joints=["elbow"], on=True)
    back = one.ask(1300, "switch", activate=["arm"], deactivate=[])
    log = one.run()
    assert all(isinstance(one.answer(number), Completion) for number in (off, on, back))
    shown = one.torque(log, 1)
    assert [torque for torque in shown if torque not in (Torque.OFF, Torque.DOUBT)] == [
        Torque.ON, Torque.RELEASED, Torque.GIVEN, Torque.ON,
    ]  # fmt: skip
    assert one.torque(log, 0) == one.torque(log, 2) == [Torque.ON]
    position, goal = log.cycles["position"][:, 1], log.cycles["goal_position"][:, 1]
    put = 2.5 - np.pi
    late = log.cycles["woken_ns"] > log.cycles["woken_ns"][0] + 900 * MS
    assert np.abs(position[late] - put).max() < 0.01
    assert np.abs(goal[late] - put).max() < 0.01


def test_a_tripped_servo_is_rebooted_and_gets_torque_in_the_run(run):
    one = run(duration_s=3.0)
    servo = one.robot.buses[0].servo(2)
    one.at(400, servo.trigger_overload)
    refused = one.ask(700, "torque", joints=["elbow"], on=True)
    commanded = one.ask(750, "reboot", joints=["elbow"])
    reboot = one.ask(800, "reboot", joints=["elbow"], release=True)
    on = one.ask(1900, "torque", joints=["elbow"], on=True)
    switch = one.ask(2200, "switch", activate=["arm"], deactivate=[])
    log = one.run()
    assert isinstance(one.answer(refused), Refusal)
    assert "dxlrun reboot elbow" in one.answer(refused).text  # type: ignore[union-attr]  # a refusal
    assert one.answer(commanded).text == "elbow is commanded by arm; deactivate arm first, or add --release"  # type: ignore[union-attr]  # a refusal
    assert [isinstance(one.answer(number), Completion) for number in (reboot, on, switch)] == [True] * 3
    assert one.torque(log, 1)[-1] is Torque.ON
    assert Torque.REBOOTING in one.torque(log, 1)
    assert one.torque(log, 0) == [Torque.ON]
    assert not [event for event in log.events if event.name == "servo_lost"]


@pytest.mark.parametrize("policy", ["hold", "stop", "[{pose: home, speed: 60 deg/s}, limp]"])
def test_a_requested_reboot_is_no_lost_servo(run, policy):
    end = policy if policy != "stop" else "[{pose: home, speed: 90 deg/s}, hold]"
    text = (
        f"{ROBOT}poses: {{home: {{wrist: 0 deg}}}}\npolicies: {{exit_timeout: 6 s, on_lost_servo: {end}}}\n"
    )
    one = run(text, duration_s=1.5)
    reboot = one.ask(400, "reboot", joints=["wrist"], release=True)
    log = one.run()
    assert isinstance(one.answer(reboot), Completion)
    assert one.torque(log, 2)[-1] is Torque.ON
    assert len(log.cycles) >= 148


def test_a_joint_that_starts_limp_never_has_torque_until_it_is_asked_for(run):
    one = run(LIMP)
    given: list[int] = []
    registers = one.robot.buses[0].servo(2).registers
    registers.watch_items(("torque_enable",), lambda: given.append(int(registers["torque_enable"])))
    switch = one.ask(500, "switch", activate=["arm"], deactivate=[])
    on = one.ask(1000, "torque", joints=["elbow"], on=True)
    again = one.ask(1400, "switch", activate=["arm"], deactivate=[])
    at: list[int] = []
    one.at(990, lambda: at.append(sum(given)))
    log = one.run()
    assert at == [0]
    assert 1 in given
    refused = "elbow (ID 2 on bus main) is limp; switch torque on with `dxlrun torque on elbow`"
    assert one.answer(switch).text == refused  # type: ignore[union-attr]
    assert isinstance(one.answer(on), Completion)
    assert isinstance(one.answer(again), Completion)
    assert one.torque(log, 1)[0] is Torque.RELEASED
    assert one.torque(log, 1)[-1] is Torque.ON
    assert not registers["torque_enable"]  # on_exit


def test_a_pose_at_the_end_does_not_wait_for_limp_joints(run):
    text = f"{LIMP}poses: {{home: {{elbow: 20 deg, wrist: 5 deg}}}}\n"
    policy = "policies: {exit_timeout: 8 s, on_exit: [{pose: home, speed: 90 deg/s}, limp]}\n"
    one = run(text + policy, duration_s=0.5)
    log = one.run()
    ended = (log.cycles["woken_ns"][-1] - log.cycles["woken_ns"][0]) / 1e9
    assert ended < 1.2
    assert not [event for event in log.events if event.name == "policy" and "ends early" in event.text]


ACTIVE = LIMP.replace(", active: false", "")
WRONG = [
    (ACTIVE, "10:3", "controller arm is active from the start, but torque is off for elbow"),
    (ROBOT.replace("torque: on", "torque: maybe"), "7:90", "torque is on or off"),
    (ROBOT.replace("torque: on", "torque: 1"), "7:90", "torque is on or off"),
]


@pytest.mark.parametrize(("text", "place", "sentence"), WRONG)
def test_what_cannot_be_limp_is_an_error_at_its_place(tmp_path, text, place, sentence):
    with pytest.raises(InputError, match="torque") as error:
        Run(tmp_path, text)
    (problem,) = error.value.problems
    assert sentence in str(problem)
    assert f"arm.yaml:{place}" in str(problem)


def test_check_shows_it(tmp_path, capsys):
    from dxlrun.cli import main

    file = tmp_path / "arm.yaml"
    file.write_text(LIMP)
    assert main(["check", str(file), "--json"]) == 0
    found = result_of(capsys.readouterr().out)
    assert [row["mode"] for row in found["joints"]] == ["position", "position, limp", "position"]


def asked_by_many(one: Run, times: Sequence[int]) -> list[int]:
    joints = ["shoulder", "elbow", "wrist"]
    return [
        one.ask(ms, "torque", joints=joints, on=bool(index % 2), release=True)
        for index, ms in enumerate(times)
    ]


def test_all_joints_off_and_on_again_and_again(run):
    one = run(duration_s=3.0)
    numbers = asked_by_many(one, (400, 420, 430, 900, 1500, 1510, 1520, 2300))
    log = one.run()
    # only a newer request makes an older one fail
    assert isinstance(one.answer(numbers[-1]), Completion)
    assert isinstance(one.answer(numbers[3]), Completion)
    assert all(one.torque(log, row)[-1] is Torque.ON for row in range(3))


@pytest.mark.parametrize("requested", [True, False])
def test_a_requested_reboot_is_no_fault_of_the_run(run, requested):
    """One that nothing requested counts: its invalid states too."""
    one = run(duration_s=1.5)
    if requested:
        one.ask(400, "reboot", joints=["wrist"], release=True)
    else:
        one.at(400, one.robot.buses[0].servo(3).reboot)
    log = one.run()
    away = int(np.count_nonzero(~log.cycles["valid"][:, 2]))
    assert away > 10
    totals = totals_of(one.path)
    verdict = judge_run(totals)
    result = one.robot.result
    assert result is not None
    assert result.invalid == totals.invalid == tuple(joint.invalid for joint in tracking(log))
    if requested:
        assert (verdict.good, totals.invalid[2] <= 2) == (True, True), verdict
        assert Torque.LOST not in one.torque(log, 2)
    else:
        assert totals.invalid[2] == away
        assert not verdict.good
        assert "wrist" in verdict.sentences[0]


def test_a_reboot_that_never_ends_is_a_loss(run):
    one = run(duration_s=5.0)
    script = FaultScript([parse_fault("silence servo=3 at=410ms for=10s")])
    script.attach(one.robot.buses)
    reboot = one.ask(400, "reboot", joints=["wrist"], release=True)
    log = one.run()
    answer = one.answer(reboot)
    assert isinstance(answer, Refusal)
    assert answer.text.startswith("wrist (ID 3 on bus main) did not answer within 3 s after its reboot")
    assert one.torque(log, 2)[:3] == [Torque.ON, Torque.REBOOTING, Torque.LOST]
    totals = totals_of(one.path)
    assert 140 < totals.invalid[2] < 180  # of the end, not of the three seconds before
    assert not judge_run(totals).good


def test_joint_holds_where_it_is_when_torque_is_requested_under_an_active_controller(run):
    """A servo that rebooted is turned by hand and gets torque: the old command does not move it."""
    one = run(duration_s=2.5)
    bus = one.robot.buses[0]
    servo = bus.servo(2)
    one.at(400, servo.reboot)
    one.at(1200, lambda: turn_by_hand(servo, 2.5))
    on = one.ask(1400, "torque", joints=["elbow"], on=True)
    log = one.run()
    assert isinstance(one.answer(on), Completion)
    assert one.torque(log, 1)[-1] is Torque.ON
    arm = [name for name, *_ in [(plan.name,) for plan in log.controllers]].index("arm")
    assert (log.cycles["active"] >> np.uint64(arm) & np.uint64(1)).all()
    given = log.cycles["torque"][:, 1] == Torque.ON
    late = given & (log.cycles["cycle"] > 100)
    first = int(np.flatnonzero(late)[0])
    for shown in ("goal_position", "position"):
        assert np.abs(log.cycles[shown][first:, 1] - (2.5 - np.pi)).max() < 0.005


PLAYER = ROBOT.replace(
    "arm: {type: joint_group_position_controller, joints: [shoulder, elbow]}",
    "arm: {type: keyframe_player, joints: [shoulder, elbow], partial: true, motions: {nod: {steps: ["
    "{time: 300 ms, pose: {shoulder: 20 deg, elbow: 20 deg}}]}}}",
)


def test_a_player_goes_on_without_a_released_joint_and_begins_without_it(run):
    one = run(PLAYER, duration_s=3.0)
    off = one.ask(200, "torque", joints=["elbow"], on=False)
    nod = CommandMessage(90, "arm", "play", np.array([0.0, 1.0, 1.0]).tobytes(), "anna")
    one.at(500, lambda: one.robot.inbox.waiting.append(nod))
    one.ask(1500, "switch", activate=[], deactivate=["arm"])
    again = one.ask(1700, "switch", activate=["arm"], deactivate=[])
    both = one.ask(2000, "torque", joints=["shoulder"], on=False)
    log = one.run()
    assert isinstance(one.answer(off), Completion)
    assert isinstance(one.answer(again), Completion)
    assert one.answer(both) == Refusal(
        Code.JOINT_COMMANDED, {"joint": ("shoulder",), "controller": ("arm",)}
    ), "it has no other joint"
    shoulder, elbow = np.degrees(log.cycles["position"][-1, :2])
    assert (shoulder, elbow) == (pytest.approx(20, abs=0.5), pytest.approx(0, abs=0.5))
    assert one.robot.buses[0].servo(2).registers["goal_position"] == 2048, "it got no goal"
    ended = [event.text for event in log.events if event.code == EventCode.GOAL_ENDED]
    assert ended == ["goal 1 reached: played nod, without elbow (no torque)"]
    assert one.torque(log, 1)[-1] is Torque.RELEASED
