"""Two runs on virtual time with one seed are one, faults and split replies too, and told as they were."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace
from tests.kit.judges import log_has_every_byte

from dxlrun.log.ledger_file import open_ledger
from dxlrun.log.log_reader import read_log
from dxlrun.plan.robot_plan import Plan
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun.testing import plan_of
from dxlsim.bus.ledger import read_ledger
from dxlsim.faults.fault import parse_fault
from dxlsim.faults.script import FaultScript
from dxlsim.simulation_plan import AdapterConfig

pytestmark = pytest.mark.long

ROBOTS = Path(__file__).parents[2] / "robots"
TORSO = ROBOTS / "bioloid_torso.yaml"
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


@pytest.mark.parametrize("seed", [1, 3])
def test_the_log_has_a_storm_as_the_bus_saw_it(plan, tmp_path, seed):
    log, ledger = run(plan, tmp_path / "run", seed)

    entries = read_ledger(ledger)
    log_has_every_byte(read_log(log), entries)
    assert any("fault: " in entry.note for entry in entries)
