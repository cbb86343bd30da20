"""What ends an experiment early, on virtual time: one sentence, the run as it was, the rest kept."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.kit.campaigns import campaign

from dxlrun.channels.commands import LOOP, CommandMessage
from dxlrun.errors import DxlrunError, Refused
from dxlrun.tooling.live import RunGone
from dxlrun_lab.guided import experiment
from dxlrun_lab.guided.choice import situation_of
from dxlrun_lab.guided.experiment import ExperimentJoint, perform_experiment
from dxlrun_lab.guided.rig import RunningController
from dxlrun_lab.guided.segment import Guard, Segment
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript


def happen(rig: Any, fault: str) -> None:
    """Let a fault happen now."""
    script = FaultScript(())
    script.attach(rig.robot.link.simulated.buses)
    script.add(parse_fault(fault), rig.robot.link.simulated.clock.now_ns())


def in_half_a_second(rig: Any, act: Callable[[], object]) -> None:
    rig.robot.link.simulated.buses[0].at(rig.robot.link.simulated.clock.now_ns() + 500_000_000, act)


def test_a_servo_that_is_lost_ends_it_and_what_was_measured_is_kept(stage):
    """The runtime holds controllers of lost joints, so the player itself cannot end its goal."""
    rig = stage.rig(stage.arm)

    def segments(joint):
        yield stage.sine(joint, 400)
        in_half_a_second(rig, lambda: happen(rig, "silence servo=2 for=3s"))
        yield stage.sine(joint, 400, 3.0)
        raise AssertionError("nothing follows")

    _, done = stage.perform(rig, "elbow", segments)
    assert done.why in (
        "joint elbow (ID 2 on bus main) is lost",
        "joint elbow has not answered for 100 ms",
    )
    assert [part.whole for part in done.recorded] == [True, False]
    last = done.recorded[1]
    assert 150 < np.count_nonzero(last.valid[:, 0]) < 250, "until it was lost"
    assert not last.valid[-1, 0]


def test_a_servo_that_gets_hot_ends_it(stage):
    rig = stage.rig(stage.arm)

    def segments(joint):
        happen(rig, "overheat servo=2 celsius=75")
        yield stage.sine(joint, 400, 5.0)

    _, done = stage.perform(rig, "elbow", segments)
    assert done.why == "joint elbow has 75 deg C, more than 70"
    assert np.nanmax(done.recorded[0].of_joints("temperature")) == 75
    assert len(done.recorded[0]) < 5 * 400


def test_a_joint_whose_torque_is_switched_off_ends_it(stage):
    rig = stage.rig(stage.arm)

    def off():
        data = msgspec.json.encode({"joints": ["elbow"], "on": False, "release": True})
        rig.robot.link.gateways_link._mailbox.post_command(
            CommandMessage(1_000_000, LOOP, "torque", data, "a person")
        )

    def segments(joint):
        in_half_a_second(rig, off)
        yield stage.sine(joint, 400, 3.0)

    plays = stage.Plays(segments)
    done = perform_experiment(rig, plays, situation_of(rig, ["elbow"], {}))
    assert done.why == "experiment_position was deactivated"
    assert [part.whole for part in done.recorded] == [False]
    # its controllers cannot be active without torque, and that is said
    assert len(done.not_restored) == 1
    assert "elbow" in done.not_restored[0]
    assert not [one for one in rig.controllers() if one.name.startswith("experiment")]


def test_what_cannot_be_put_back_keeps_nothing_else_from_it():
    """One joint has no torque any more: the other's controller is activated, and all players are unloaded."""
    calls = []

    class Rig:
        rate = 50.0

        def controllers(self):
            players = [RunningController("experiment_position", True, ("a", "b"))]
            players += [RunningController("experiment_pwm", False, ("a", "b"))]
            mine = [RunningController(f"arm_{joint}", not calls, (joint,)) for joint in "ab"]
            return (*players, *mine)

        def switch(self, activate, deactivate):
            calls.append(("switch", *activate, *(f"-{name}" for name in deactivate)))
            if "arm_a" in activate:
                raise Refused("joint a has no torque", code="no_torque")

        def unload_controller(self, name):
            calls.append(("unload", name))
            if name == "experiment_position":
                raise Refused("the robot is busy", code="busy")

    situation = type("Situation", (), {"names": ("a", "b")})()
    rig = Rig()
    stage = experiment._Stage(rig, situation, lambda: None)
    stage._players |= {("position", Guard()): "experiment_position", ("pwm", Guard()): "experiment_pwm"}
    calls.append(("the experiment",))
    assert stage.restore() == ("joint a has no torque", "the robot is busy")
    assert calls[1:] == [
        ("switch", "arm_a", "arm_b", "-experiment_position"),
        ("switch", "-experiment_position"),
        ("switch", "arm_a"),
        ("switch", "arm_b"),
        ("unload", "experiment_position"),
        ("unload", "experiment_pwm"),
    ]


def test_a_run_that_ends_in_the_middle_ends_it(stage):
    rig = stage.rig(stage.arm)

    def segments(joint):
        yield stage.sine(joint, 400)
        in_half_a_second(rig, rig.robot.link.simulated.stop.request)
        yield stage.sine(joint, 400, 3.0)

    done = perform_experiment(rig, stage.Plays(segments), situation_of(rig, ["elbow"], {}))
    assert done.why == "the run ended"
    assert done.not_restored == ("the run of effort_arm ended, so the run was not restored",)
    assert [part.outcome for part in done.recorded] == ["reached", "aborted"]
    assert len(done.recorded[1]) == pytest.approx(200, abs=15)
    with pytest.raises(RunGone):
        rig.change_rate(100)


def test_a_procedure_that_fails_leaves_the_run_as_it_was(stage):
    rig = stage.rig(stage.arm)

    def gives_up(joint):
        yield stage.sine(joint, 200, loop_rate=200, interface="position")
        raise DxlrunError("no two responses are alike")

    _, done = stage.perform(rig, "elbow", gives_up)
    assert (done.why, len(done.recorded)) == ("no two responses are alike", 1)

    def breaks(joint):
        yield stage.sine(joint, 200, loop_rate=200)
        raise ZeroDivisionError

    before = stage.state(rig)
    with pytest.raises(ZeroDivisionError):
        perform_experiment(rig, stage.Plays(breaks), situation_of(rig, ["elbow"], {}))
    assert stage.state(rig) == before


def test_an_abort_before_the_first_segment_moves_nothing(stage):
    places = []
    rig = stage.rig(stage.arm)
    rig.robot.link.each_cycle = lambda cycle: places.append(
        float(rig.robot.link.simulated.record.goals.position[1])
    )

    def far(joint):
        yield Segment("far", 0.01, {joint.name: np.full(10, joint.upper)})

    _, done = stage.perform(rig, "elbow", far, lambda: "aborted by a key")
    assert (done.why, done.recorded, set(places)) == ("aborted by a key", (), set())


def test_what_is_only_looked_at_takes_no_cycle_and_a_run_that_ended_is_an_error(stage):
    rig = stage.rig(stage.arm)
    link = rig.robot.link
    cycles = link.simulated.cycles
    assert rig.rate == 400
    assert rig.joints()
    assert link.simulated.cycles == cycles
    rig.robot.rate(200)
    assert link.simulated.cycles == cycles + 1
    link.simulated.stop.request()
    while link.alive:
        link.run_cycle()
    assert rig.joints()
    with pytest.raises(RunGone, match="the run of effort_arm ended"):
        rig.robot.rate(400)


def test_an_abort_in_a_motion_cancels_its_goal(stage):
    """So that the joints come to rest before the player leaves."""
    rig = stage.rig(stage.arm)
    at_s = rig.now_s + 1.5

    def abort():
        return "aborted by a key" if rig.now_s >= at_s else None

    _, done = stage.perform(rig, "elbow", lambda joint: iter([stage.sine(joint, 400, 10.0)]), abort)
    assert done.why == "aborted by a key"
    assert [goal.status for goal in rig.robot.goals()] == ["cancelled"]


def many(stage: Any, rng: random.Random) -> Any:
    """Return segments in random order: each interface, rates, approaches."""

    def segments(joint: ExperimentJoint) -> Iterator[Segment]:
        def rows(value: float) -> dict[str, np.ndarray]:
            return {joint.name: np.full(120, value)}

        parts = [
            stage.sine(joint, 400),
            stage.sine(joint, 200, loop_rate=200),
            Segment("up", 1 / 400, rows(joint.inner[1])),
            Segment("down", 1 / 400, rows(joint.inner[0]), interface="posvel", speeds=rows(1.0)),
            Segment("push", 1 / 400, rows(0.05), interface="effort", loop_rate=100),
            Segment("turn", 1 / 400, rows(0.3), interface="velocity"),
            Segment("voltage", 1 / 400, rows(0.05), interface="pwm", begin={joint.name: joint.middle}),
        ]
        rng.shuffle(parts)
        yield from parts

    return segments


@campaign(ci=3, night=40, release=200)
def test_an_abort_at_any_time_leaves_the_run_as_it_was(stage, number, chance):
    """On the way to a start, in a segment, while modes change or a player is loaded."""
    rig = stage.rig(stage.arm)
    begin_s = rig.now_s
    at_s = begin_s + chance.uniform(0.0, 9.0)
    lost_s = begin_s + chance.uniform(0.0, 9.0)
    loses = number % 3 == 2  # a servo, which is back before all is restored
    print(f"aborted after {at_s - begin_s} s, lost after {lost_s - begin_s if loses else None} s")
    if loses:
        rig.robot.link.simulated.buses[0].at(
            round(lost_s * 1e9), lambda: happen(rig, "silence servo=2 for=200ms")
        )

    def abort():
        return "aborted by a key" if rig.now_s >= at_s else None

    _, done = stage.perform(rig, "elbow", many(stage, chance), abort)
    assert done.why == "" or done.why.startswith(("aborted by a key", "joint elbow "))
    assert all(part.whole for part in done.recorded[:-1])
    assert not rig.robot.link.simulated.robot.loop.steering.inbox.drain_commands()
    limit_s = rig.now_s + 1.0
    while rig.now_s < limit_s:
        rig.robot.link.run_cycle()
    assert abs(rig.robot.link.simulated.record.states.velocity[1]) < 0.05, "the controllers of before hold it"
