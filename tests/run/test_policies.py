"""Ends of policies that no text brings about, by what servos were sent; others: stories/policies.txt."""

import re
from pathlib import Path

import pytest
from msgspec.structs import force_setattr
from tests.kit.cases import read_head
from tests.kit.line_faults import truncate_next, watch_instructions
from tests.kit.virtual_run import VirtualRun

from dxlrun.errors import StartUpError
from dxlsim.wire.servo_packets import Instruction, InstructionPacket

ROBOT = read_head(Path(__file__).with_name("stories") / "policies.txt").replace("on_exit: limp", "POLICY")
HOME = round(170 / 300 * 1023)  # of pan
START_MS = 200
"""Time of a stop since the loop's first deadline, or more"""


def torque(run: VirtualRun) -> set[bool]:
    """Return by what servos were sent which have torque."""
    sent = [run.sent(servo.servo_id, "torque_enable") for servo in run.servos.values()]
    return {bool(one and one[-1][1]) for one in sent}


def test_steps_are_cut_short_when_the_time_for_them_is_over(tmp_path):
    text = ROBOT.replace("POLICY", "on_exit: [{pose: home, speed: 30 deg/s}, hold]")
    run = VirtualRun.of_text(tmp_path, text, 60.0)
    run.at(START_MS, run.stop.request)
    force_setattr(run.plan.loop.policies, "limit_ns", 200_000_000)
    assert run.run().last == "hold"
    _, *sent = run.sent(3, "goal_position")  # the first is that of its torque
    assert sent[-1][0] < START_MS + 400
    assert sent[0][1] < sent[-1][1] < HOME
    assert torque(run) == {True}


def test_a_start_ends_when_a_servo_may_be_left_weak(tmp_path):
    text = ROBOT.replace("POLICY", "on_fault: [{reduce_torque: 0.3, steps: 3, over: 300 ms}, hold]")
    run = VirtualRun.of_text(tmp_path, text, 0.1)
    run.servos["tilt"].poke("torque_limit", 307)

    def lose_limit(packet: InstructionPacket, _: int) -> None:
        read = (7, Instruction.READ, b"\x22\x02")
        if (packet.servo_id, packet.instruction, packet.parameters) == read:
            truncate_next(run.buses[0], 7, 0)

    watch_instructions(run.buses[0], lose_limit)
    said = "tilt (ID 7 on bus main) did not answer when its torque limit was read"
    with pytest.raises(StartUpError, match=re.escape(said)):
        run.run()
    assert torque(run) == {False}
