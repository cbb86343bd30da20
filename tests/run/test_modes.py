"""Runs of both protocols whose controllers change the modes of their servos: wire, log and joints."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pytest
from tests.kit.sampled_run import SampledRun, changes_of, texts
from tests.kit.stories import send, switch
from tests.kit.wire import BROADCAST, SYNC_WRITE, WRITE, instructions, writes

from dxlrun.channels.commands import CommandMessage
from dxlrun.channels.event_records import EventCode
from dxlrun.log.log_reader import Log
from dxlwire.bus_plan import BusPlan
from dxlwire.modes import Mode

CART = """\
name: cart
buses:
  wheels: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {latency: 1 ms}}
  arm: {port: sim, protocol: 1.0, baud_rate: 1_000_000, return_delay_time: 0 us, adapter: {latency: 1 ms}}
loop: {rate: 50}
joints:
  left: {bus: wheels, id: 1, model: AX-12A, reference: 150 deg, direction: 1, continuous: true}
  right: {bus: wheels, id: 2, model: AX-12A, reference: 150 deg, direction: -1, continuous: true}
  lift: {bus: arm, id: 1, model: MX-64, reference: 180 deg, direction: 1}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [left, right]}
  power: {type: joint_group_pwm_controller, joints: [left, right], active: false}
  lift: {type: joint_group_position_controller, joints: [lift]}
  push: {type: joint_group_effort_controller, joints: [lift], active: false}
  spin: {type: joint_group_velocity_controller, joints: [lift], active: false}
"""
ARM = """\
name: wheels
buses:
  main: {port: sim, protocol: 2.0, baud_rate: 1_000_000, adapter: {latency: 1 ms}}
loop: {rate: 100}
joints:
  left: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1, continuous: true}
  right: {bus: main, id: 2, model: XL430-W250, reference: 180 deg, direction: -1, continuous: true}
  arm: {bus: main, id: 3, model: XM430-W350, reference: 180 deg, direction: 1, limits: {effort: 1 A}}
controllers:
  drive: {type: joint_group_velocity_controller, joints: [left, right]}
  arm: {type: joint_group_position_controller, joints: [arm]}
  pull: {type: joint_group_effort_controller, joints: [arm], active: false}
  push: {type: joint_group_pwm_controller, joints: [arm], active: false}
  grip: {type: joint_group_poseffort_controller, joints: [arm], active: false}
  turn: {type: joint_group_position_controller, joints: [left, right], active: false}
policies: {on_exit: hold}
"""


class Case(NamedTuple):
    """A robot with what its clients ask by ms; addresses of torque and of what selects a mode."""

    text: str
    asks: Mapping[int, Sequence[CommandMessage]]
    torque: int
    modes: frozenset[int]
    ends_with: int
    """Torque at the end."""


CASES = {
    1: Case(
        CART,
        {
            100: [send("drive", "velocities", 2.0, 2.0), send("lift", "positions", 0.3)],
            1200: [switch(["push"], ["lift"]), switch(["power"], ["drive"])],
            1600: [send("push", "efforts", 0.02), send("power", "pwm", 0.2, -0.2)],
            1800: [switch(["spin"], ["push"])],
            2000: [send("spin", "velocities", 0.5)],
            2600: [switch(["lift"], ["spin"])],
        },
        24,
        frozenset({6, 8, 70}),
        0,
    ),
    2: Case(
        ARM,
        {
            50: [send("drive", "velocities", 3.0, -2.0), send("arm", "positions", 0.4)],
            1200: [switch(["pull"], ["arm"])],
            1700: [send("pull", "efforts", -0.05)],
            1800: [switch(["push"], ["pull"])],
            2300: [send("push", "pwm", 0.3), switch(["turn"], ["drive"])],
            2500: [switch(["grip"], ["push"])],
            3000: [send("grip", "poseffort", 0.2, 0.3), send("turn", "positions", 12.0, -9.0)],
        },
        64,
        frozenset({11}),
        1,
    ),
}


@pytest.fixture(scope="module", params=CASES)
def ran(request, tmp_path_factory) -> tuple[int, SampledRun, Log]:
    case = CASES[request.param]
    run = SampledRun(tmp_path_factory.mktemp("modes"), case.text, 6.0)
    for ms, commands in case.asks.items():
        run.ask(ms, *commands)
    log = run.run()
    assert run.is_done()
    return request.param, run, log


def said_to(run: SampledRun, bus: BusPlan, servo_id: int) -> Iterator[tuple[int, int, bytes]]:
    """Yield what was written to a servo: instruction, first address, data."""
    for sent in instructions([one for one in run.robot.ledger.entries if one.bus == bus.name], bus):
        for one, address, data in writes(sent, bus.protocol):
            if one in {servo_id, BROADCAST}:
                yield sent.instruction, address, data


def test_what_selects_a_mode_is_written_without_torque_and_no_goal_comes_meanwhile(ran):
    protocol, run, _ = ran
    case = CASES[protocol]
    assert run.plan.buses
    for bus in run.plan.buses:
        for servo in bus.servos:
            torque, changed = 0, 0
            for instruction, address, data in said_to(run, bus, servo.servo_id):
                if instruction == WRITE and address == case.torque:
                    torque = data[0]
                elif instruction == WRITE and address in case.modes:
                    assert torque == 0
                    changed += 1
                elif instruction == SYNC_WRITE:
                    assert torque == 1
            assert changed > 0
            assert torque == case.ends_with


@pytest.mark.parametrize("ran", [1], indirect=True)
def test_each_mode_of_protocol_1_is_followed_on_the_wire_by_its_own_goals(ran):
    _, run, _ = ran
    sent = {
        servo.joint: [at for kind, at, _ in said_to(run, bus, servo.servo_id) if kind == SYNC_WRITE]
        for bus in run.plan.buses
        for servo in bus.servos
    }
    assert [*changes_of(sent["lift"])] == [30, 71, 32, 30]
    assert {*sent["left"], *sent["right"]} == {32}


def test_the_log_has_the_modes_and_the_joints_follow(ran):
    protocol, _, log = ran
    cycles = log.cycles
    changes = [mode for mode in changes_of(cycles["mode"][:, 2].tolist()) if mode]
    if protocol == 1:
        assert changes == [Mode.POSITION, Mode.EFFORT, Mode.VELOCITY, Mode.POSITION]
        assert cycles["velocity"][55, :2] == pytest.approx([2.0, 2.0], rel=0.1)
        assert cycles["velocity"][120, 2] == pytest.approx(0.5, rel=0.1)
        assert set(cycles["mode"][[10, 100], 0].tolist()) == {Mode.VELOCITY, Mode.PWM}
        assert cycles["velocity"][128, :2] == pytest.approx([0.2 * 6.178, -0.2 * 6.178], rel=0.1)
        return
    wanted = [Mode.POSITION, Mode.EFFORT, Mode.PWM, Mode.EFFORT_POSITION]
    assert [*changes_of(changes)] == [*wanted, Mode.POSITION]
    assert cycles["velocity"][225, :2] == pytest.approx([3.0, -2.0], abs=0.1)
    assert cycles["position"][110, 2] == pytest.approx(0.4, abs=0.02)
    assert cycles["position"][-1] == pytest.approx([12.0, -9.0, 0.2], abs=0.05)
    assert np.nanmin(cycles["goal_effort"][:, 2]) == -0.05
    assert np.nanmax(cycles["goal_pwm"][:, 2]) == 0.3
    assert cycles["goal_effort"][500, 2] == 0.3
    assert cycles["velocity"][-1, :2] == pytest.approx([0.0, 0.0], abs=0.05), "held at the end"
    waits = [one for one in log.events if one.text == "waits for the mode changes of its joints"]
    assert [one.source for one in waits] == ["pull", "push", "turn", "grip"]
    assert texts(log, EventCode.MODE)


def test_no_joint_has_a_goal_while_its_mode_changes_nor_jumps_after_it(ran):
    """A position mode begins where the joint is, within what it turned since the last read."""
    cycles = ran[2].cycles
    changing = cycles["mode"] == Mode.UNKNOWN
    for name in ("position", "velocity", "effort", "pwm"):
        assert np.isnan(cycles[f"goal_{name}"][changing]).all()
    assert 0 < changing.any(axis=1).sum() < 100
    led = np.isin(cycles["mode"], (Mode.POSITION, Mode.EFFORT_POSITION))
    begins = led & ~np.vstack([led[:1], led[:-1]])
    assert begins.sum() == (1 if ran[0] == 1 else 4)
    assert np.abs(cycles["goal_position"] - cycles["position"])[begins] == pytest.approx(0.0, abs=1e-9)
