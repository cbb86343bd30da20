"""A joint that is pressed against a limit: how many events the gate has for it."""

from __future__ import annotations

from pathlib import Path

from tests.kit.clients import Ask, steered

from dxlrun.channels.event_records import EventCode

ROBOT = """\
name: k
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {kind: direct}, return_delay_time: 0 us}
loop: {rate: 50}
joints:
  g:
    {bus: main, id: 6, model: XM430-W350, reference: 180 deg, direction: 1,
     limits: {position: [-170 deg, 170 deg], velocity: 4 rad/s}}
controllers:
  arm: {type: joint_group_effort_controller, joints: [g]}
"""


def test_an_effort_that_presses_a_joint_against_its_limit_has_one_event_and_one_at_its_end(
    tmp_path: Path,
) -> None:
    robot = tmp_path / "robot.yaml"
    robot.write_text(ROBOT)
    asks = [Ask(0.5, "arm", "efforts", {"efforts": [0.2]}), Ask(8.0, "arm", "efforts", {"efforts": [-0.05]})]
    log = steered(tmp_path, robot, 11.0, asks).log
    texts = [
        event.text
        for event in log.events
        if event.code == EventCode.GATE and "at the position limit" in event.text
    ]
    assert len(texts) == 2
    assert texts[0] == "g, controller arm: goal stopped at the position limit"
    assert texts[1].startswith("g: goal stopped at the position limit; this ended after ")
