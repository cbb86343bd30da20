"""The dead-man's switch and the banks on virtual time: what is released first, what ends in order."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.virtual_run import DrivenRobot
from tests.kit.wire import changes

from dxlrun import InputError, RemoteRobot
from dxlrun_teleop.bank import banks_of
from dxlrun_teleop.drive import Drive
from dxlrun_teleop.source import InputState, Press

ROBOT = """\
name: arm
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 0 ms}}}
loop: {rate: 100}
joint_defaults:
  {bus: main, model: XL430-W250, reference: 180 deg, direction: 1, limits: {position: [-30 deg, 30 deg]}}
groups: {both: {joints: [wrist, elbow]}}
joints: {elbow: {id: 1}, wrist: {id: 2}}
controllers:
  arm: {type: joint_group_position_controller, joints: [elbow]}
  hand: {type: joint_group_position_controller, joints: [wrist]}
  spare: {type: joint_group_position_controller, joints: [elbow], active: false}
policies: {on_stale_command: limp}  # a stream that is not ended in order ends the run
"""
GOAL_POSITION, TICKS = 116, 4096 / 360
FREE, HELD = InputState((0.0,), False), InputState((1.0,), True)
BACK = InputState((-1.0,), True)
NEXT = InputState((1.0,), True, frozenset({Press.NEXT}))


def driven(
    directory: Path,
    *script: tuple[float, InputState],
    targets: tuple[str, ...] = (),
    factor: float = 1.0,
    text: str = ROBOT,
) -> DrivenRobot:
    """Run; of the script each counts from its time, s, on."""
    path = directory / "arm.yaml"
    path.write_text(text)
    run, once = DrivenRobot(path, script[-1][0] + 0.5, {}), [at for at, given in script if given.presses]

    def begin(client: RemoteRobot) -> Callable[[float], object]:
        drive = Drive(client, banks_of(client, targets, 1), factor)

        def step(now: float) -> None:
            at, given = [(0.0, FREE), *(each for each in script if each[0] <= now)][-1]
            if at in once:
                once.remove(at)
            elif given.presses:
                given = InputState(given.axes, given.enabled)
            drive.apply_input(given, now)

        return step

    run.run(begin)
    return run


def moves(run: DrivenRobot) -> dict[int, list[tuple[float, int]]]:
    """Return by servo what its goal was changed to, without its first one."""
    assert run.virtual.result is not None
    assert run.virtual.result.reason == "ended"
    found = changes(run.virtual.ledger.entries, run.virtual.plan, GOAL_POSITION)
    return {servo: goals[1:] for servo, goals in found.items() if goals[1:]}


def test_what_is_held_from_the_start_moves_nothing_before_it_was_released(tmp_path):
    found = moves(driven(tmp_path, (0.0, HELD), (0.8, FREE), (1.0, HELD), (1.5, FREE)))
    assert {*found} == {1}
    assert min(at for at, _ in found[1]) > 1.0


def test_another_bank_holds_and_moves_only_when_the_switch_was_released(tmp_path):
    found = moves(driven(tmp_path, (0.5, HELD), (1.0, NEXT), (1.5, FREE), (1.6, HELD), (2.0, FREE)))
    assert max(at for at, _ in found[1]) < 1.25
    assert min(at for at, _ in found[2]) > 1.6


def test_a_joint_stops_at_its_limit(tmp_path):
    found = moves(driven(tmp_path, (0.5, HELD), (2.0, FREE), targets=("wrist",), factor=4.0))
    assert {*found} == {2}
    assert found[2][-1][1] == pytest.approx(2048 + 30 * TICKS, abs=1)


@pytest.mark.parametrize("then", [FREE, BACK], ids=["stops", "turns back"])
def test_a_joint_that_is_as_fast_as_it_may_be_heeds_the_switch_at_once(tmp_path, then):
    slow = ROBOT.replace("limits: {", "limits: {velocity: 0.4 rad/s, ")
    goals = moves(driven(tmp_path, (0.5, HELD), (1.0, then), (1.5, FREE), factor=4.0, text=slow))[1]
    last_s, _ = max(goals, key=lambda goal: goal[then is BACK])
    assert 0.9 < last_s < 1.25 - 0.1 * (then is BACK)


def test_targets_choose_joints_in_their_order_and_what_no_controller_takes_is_refused(tmp_path):
    path = tmp_path / "arm.yaml"
    path.write_text(ROBOT)
    run = DrivenRobot(path, 0.1, {})

    def begin(client: RemoteRobot) -> Callable[[float], object]:
        named = {
            words: [(bank.controller, *(bank.slots[at].name for at in bank.driven)) for bank in found]
            for words in ((), ("both",), ("hand", "elbow"))
            for found in [banks_of(client, words, 8)]
        }
        arm, hand = ("arm", "elbow"), ("hand", "wrist")
        assert named == {(): [arm, hand], ("both",): [hand, arm], ("hand", "elbow"): [hand, arm]}
        for wrong in ("spare", "knee"):
            with pytest.raises(InputError, match=f"no active controller of driven accepts .* for {wrong}; "):
                banks_of(client, (wrong,), 8)
        (slot,) = banks_of(client, ("elbow",), 8)[0].slots
        assert (slot.lower, slot.upper) == pytest.approx((-math.pi / 6, math.pi / 6))
        return lambda now: None

    run.run(begin)
