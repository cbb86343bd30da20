"""The search for the highest rate that a robot keeps, on virtual time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from dxlrun.bench.case import BUS, Case
from dxlrun.bench.rate import Run, bench_rate, to_json
from dxlrun.compile.plan import AdapterPlan, Plan
from dxlrun.description import Description, read_robot
from dxlrun.errors import ProcessFault
from dxlrun.run.virtual_run import VirtualRobot


@pytest.fixture
def robot(tmp_path: Path) -> Description:
    path = tmp_path / "two.yaml"
    path.write_text(Case(1.0, 2).robot_file())
    return read_robot(path, {})


@pytest.fixture
def run_with(tmp_path: Path) -> Callable[..., Run]:
    """Run on virtual time, with an adapter that is slower than the robot file says."""
    logs = iter(range(100))

    def run_with(latency_ms: float = 0.0) -> Run:
        def run(plan: Plan) -> Path:
            adapter = AdapterPlan(latency_timer_ns=round(latency_ms * 1e6))
            told = replace(plan, simulation=replace(plan.simulation, adapters={BUS: adapter}))
            path = tmp_path / f"{next(logs)}.mcap"
            VirtualRobot(told, log=path).run()
            return path

        return run

    return run_with


def test_a_robot_whose_buses_are_all_that_takes_time_keeps_what_they_allow(
    robot: Description, run_with: Callable[..., Run]
) -> None:
    found = bench_rate(robot, 0.2, run_with())
    assert found.kept_hz is not None
    assert found.kept_hz == int(0.98 * found.computed_hz)
    (one,) = found.tries
    assert (one.overruns, one.kept) == (0, True)
    assert one.cycles == pytest.approx(0.2 * found.kept_hz, abs=2)


def test_a_slower_adapter_brings_the_rate_down_to_what_nearly_all_cycles_keep(
    robot: Description, run_with: Callable[..., Run]
) -> None:
    tried: list[float] = []
    found = bench_rate(robot, 0.5, run_with(latency_ms=4), tried.append)
    assert tried == [one.rate_hz for one in found.tries]
    first, *_, last = found.tries
    assert first.overruns > 0
    assert not first.kept
    assert last.kept
    assert found.kept_hz == last.rate_hz < first.rate_hz
    # two reads a cycle wait up to 4 ms each
    assert 100 < last.rate_hz < 250
    assert b'"kept_hz"' in to_json(found)


def test_a_run_without_a_cycle_is_an_error_with_a_hint(
    robot: Description, run_with: Callable[..., Run]
) -> None:
    run = run_with()

    def none(plan: Plan) -> Path:
        return run(replace(plan, loop=replace(plan.loop, end_ns=0)))

    with pytest.raises(ProcessFault, match="ran no cycle"):
        bench_rate(robot, 0.2, none)
