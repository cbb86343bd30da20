"""Runs on virtual time: progress, two of one seed, and every model of a servo."""

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from dxlrun.errors import InputError
from dxlrun.log.ledger_file import open_ledger
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of, simulated_robot
from dxlsim.bus.ledger import read_ledger
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import AdapterConfig
from dxlwire.control_table import find_table, model_names

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
TORSO = ROBOTS / "bioloid_torso.yaml"


def test_virtual_time_refuses_a_real_port():
    plan = plan_of(TORSO, arguments={"port": "/dev/ttyUSB0"}, duration_s=1.0)
    with pytest.raises(InputError, match="port:=sim"):
        VirtualRobot(plan)


def test_the_progress_of_a_run_on_virtual_time_has_the_skipped_periods():
    robot = simulated_robot(TORSO, duration_s=0.4)
    seen: list[tuple[int, int]] = []

    def fall_behind(cycles, skipped):
        seen.append((cycles, skipped))
        if cycles == 5:
            robot.clock.wait_until(robot.clock.now_ns() + 70_000_000)

    robot.sinks.progress = fall_behind
    result = robot.run()
    assert result.skipped == 3
    assert seen[4:6] == [(5, 0), (6, 3)]
    assert seen[-1] == (result.cycles, 3)


STARTED_NS = 1_000_000_000
"""The start-up is over: a fault in it ends the run before it has begun."""


@pytest.fixture(scope="module")
def plan():
    """The thesis' arms behind an adapter that waits 1 ms and hands bytes over in random pieces."""
    plan = plan_of(TORSO, play=[ROBOTS / "motions/three_parts.yaml"], duration_s=5)
    adapters = {"main": AdapterConfig(latency_timer_ns=1_000_000, split="random")}
    return replace(plan, simulation=replace(plan.simulation, adapters=adapters))


def run(plan: Plan, directory: Path, seed: int) -> tuple[Path, Path]:
    """Run in a storm of faults; return log and ledger."""
    directory.mkdir()
    log, ledger = directory / "run.mcap", directory / "run.ledger.jsonl"
    robot = VirtualRobot(plan, log=log, ledger=open_ledger(ledger))
    storm = parse_fault("storm faults=8 within=2s")
    FaultScript([storm], seed).attach(robot.buses, start_ns=STARTED_NS)
    robot.run()
    return log, ledger


def test_two_runs_with_one_seed_are_the_same_to_the_bit_and_another_seed_is_another_run(plan, tmp_path):
    once, again, other = (
        run(plan, tmp_path / name, seed) for name, seed in (("once", 7), ("again", 7), ("other", 8))
    )
    for first, second in zip(once, again, strict=True):
        assert first.read_bytes() == second.read_bytes()
    assert other[0].read_bytes() != once[0].read_bytes()
    assert any("fault: " in entry.note for entry in read_ledger(once[1]))


MODEL_ROBOT = """\
name: one
buses:
  main: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, adapter: {{latency: 0 ms}}}}
loop: {{rate: 50}}
joints:
  elbow:
    bus: main
    id: 1
    model: "{model}"
    reference: {reference:.12f} rad
    direction: 1
    limits: {{position: [{lower:.12f} rad, {upper:.12f} rad]}}
controllers:
  states: {{type: joint_state_broadcaster}}
"""


@pytest.mark.parametrize(
    ("model", "protocol"), [(name, protocol) for protocol in (1.0, 2.0) for name in model_names(protocol)]
)
def test_a_servo_of_every_model_runs(tmp_path, model, protocol):
    table = find_table(model, protocol)
    ends = [table.min_tick, table.max_tick]
    # some come with position limits that are narrower than their travel, which the robot file has to follow
    for index, (name, tighter) in enumerate((("min_position_limit", max), ("max_position_limit", min))):
        item = table.items.get(name)
        if item is not None and item.initial is not None:
            ends[index] = tighter(ends[index], item.initial)
    lower, upper = (end * table.rad_per_tick for end in ends)
    middle = (lower + upper) / 2
    path = tmp_path / "one.yaml"
    path.write_text(
        MODEL_ROBOT.format(
            protocol=protocol, model=model, reference=middle, lower=lower - middle, upper=upper - middle
        )
    )
    robot = simulated_robot(path, duration_s=0.1)
    result = robot.run()
    assert (result.reason, result.detail) == ("ended", "")
    states = robot.record.states
    assert states.valid.all()
    assert math.isfinite(states.position[0])
