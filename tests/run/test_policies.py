"""Ends of policies, by what servos were sent; their triggers: stories/policies.txt."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import force_setattr
from tests.kit.cases import read_head
from tests.kit.line_faults import truncate_next, watch_instructions
from tests.kit.virtual_run import VirtualRun, switch

from dxlrun.channels.answers import Code, Refusal
from dxlrun.errors import StartUpError
from dxlsim.wire.servo_packets import Instruction, InstructionPacket

ROBOT = read_head(Path(__file__).with_name("stories") / "policies.txt").partition("policies:")[0]
TICK = math.radians(300 / 1023)
HOME = round(math.radians(170) / TICK)  # of pan
POSE = "[{pose: home, speed: 60 deg/s}, limp]"
START_MS = 200
"""Time of a stop since the loop's first deadline, or more"""


class Three(VirtualRun):
    """The robot with policies."""

    def has_torque(self) -> set[bool]:
        """Return by what servos were sent which have torque."""
        sent = [self.sent(servo.servo_id, "torque_enable") for servo in self.servos.values()]
        return {bool(one and one[-1][1]) for one in sent}

    def sent_goals(self, joint: str) -> list[tuple[float, int]]:
        """Return the goals that a joint got after its torque: ms and ticks."""
        return self.sent(self.servos[joint].servo_id, "goal_position")[1:]


@pytest.fixture
def built(tmp_path: Path) -> Callable[..., Three]:
    """Build the robot with policies on virtual time."""

    def build(
        seconds: float = 60.0, more: str = "", change: tuple[str, str] = ("", ""), **policies: str
    ) -> Three:
        own = ", ".join(f"{name}: {policy}" for name, policy in (policies | {"exit_timeout": "4 s"}).items())
        return Three.of_text(tmp_path, f"{ROBOT.replace(*change)}{more}policies: {{{own}}}\n", seconds)

    return build


def test_controllers_are_deactivated_before_a_policy_moves_and_requests_are_refused(built, acts):
    active: list[int] = []
    acts["pair"] = lambda controller, time_ns: active.append(time_ns)
    run = built(on_exit=POSE)
    run.at(START_MS, run.stop.request)
    run.ask(START_MS + 100, switch(deactivate=["pair"]))
    masks = run.finish("stopped").cycles["active"].tolist()
    during = masks[len(active) :]
    assert len(during) > 10
    assert set(during) == {0}
    assert set(masks[: len(active)]) == {0b111}
    assert run.answer(1) == Refusal(Code.RUN_ENDING)


def test_steps_are_cut_short_when_the_time_for_them_is_over(built):
    run = built(on_exit="[{pose: home, speed: 30 deg/s}, hold]")
    run.at(START_MS, run.stop.request)
    force_setattr(run.plan.loop.policies, "limit_ns", 200_000_000)
    assert run.run().last == "hold"
    sent = run.sent_goals("pan")
    assert sent[-1][0] < START_MS + 400
    assert sent[0][1] < sent[-1][1] < HOME
    assert run.has_torque() == {True}


def test_periods_are_skipped_behind_the_end_of_the_motions_too(built):
    run = built(0.2, on_exit=POSE)
    hardware, clock = run.robot.hardware, run.clock
    read, woken = hardware.read_states, []

    def slow():
        woken.append(run.record.woken_ns)
        if len(woken) == 22:
            clock.wait_until(clock.now_ns() + 90_000_000)
        read()

    hardware.read_states = slow
    assert run.run().skipped == 4
    assert np.diff(woken[10:]).min() >= 20_000_000, "two cycles never follow each other in a burst"


def test_a_start_ends_when_a_servo_may_be_left_weak(built):
    run = built(0.1, on_fault="[{reduce_torque: 0.3, steps: 3, over: 300 ms}, hold]")
    run.servos["tilt"].poke("torque_limit", 307)

    def lose_limit(packet: InstructionPacket, _: int) -> None:
        if packet.servo_id == 7 and (packet.instruction, packet.parameters) == (
            Instruction.READ,
            b"\x22\x02",
        ):
            truncate_next(run.buses[0], 7, 0)

    watch_instructions(run.buses[0], lose_limit)
    said = "tilt (ID 7 on bus main) did not answer when its torque limit was read"
    with pytest.raises(StartUpError, match=re.escape(said)):
        run.run()
    assert run.has_torque() == {False}
