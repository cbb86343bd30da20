"""Policies of lost servos for groups, and the Bus Watchdog, in a run on virtual time."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.kit.robots import robot_text

from dxlrun.channels.event_records import EventCode
from dxlrun.testing import read_log, simulated_robot

ROBOT = robot_text("watchdog")


@pytest.mark.parametrize(
    ("word", "ended", "torque", "back"),
    [
        ("hold", "ended", [True, True, True], [", with its torque and its goal as before"]),
        ("limp", "ended", [False, False, True], [" and limp: it gets no goals"]),
        ("stop", "fault", None, []),
    ],
)
def test_group_has_its_own_policy_for_a_lost_servo(
    here: None, word: str, ended: str, torque: list[bool] | None, back: list[str]
) -> None:
    path = Path("two.yaml")
    groups = f"groups: {{pair: {{joints: [pan, tilt], on_lost_servo: {word}}}}}"
    path.write_text(ROBOT.replace("exit_timeout: 2 s", f"exit_timeout: 2 s, {groups}"))
    robot = simulated_robot(path, duration_s=1.8, log=Path("run.mcap"))
    servos = robot.buses[0].servos
    seen: list[list[bool]] = []
    robot.buses[0].at(300_000_000, servos[1].silence)
    robot.buses[0].at(600_000_000, lambda: servos[1].silence(False))
    robot.buses[0].at(1_700_000_000, lambda: seen.append([servo.torque_on for servo in servos]))
    assert robot.run().reason == ended
    assert seen == ([] if torque is None else [torque])
    events = read_log(Path("run.mcap")).events
    assert "tilt" in {event.source for event in events if event.code == EventCode.SERVO_LOST}
    said = [event.text for event in events if event.code == EventCode.SERVO_BACK]
    assert [text.rpartition(" is back")[2] for text in said] == back


def test_rate_at_which_the_watchdog_would_stop_the_servos_is_refused(here: None) -> None:
    path = Path("two.yaml")
    path.write_text(ROBOT)
    steering = simulated_robot(path, duration_s=0.1).robot.loop.steering
    assert steering.change_rate(10).text == "the Bus Watchdog needs at least 15 Hz"
    assert steering.change_rate(50) is None
