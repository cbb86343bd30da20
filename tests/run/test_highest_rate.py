"""The search for the highest rate that a robot keeps, on virtual time."""

import pytest
from msgspec.structs import replace

from dxlrun.description.reading import read_robot
from dxlrun.errors import ProcessFault
from dxlrun.output.json import json_text
from dxlrun.run.virtual_run import VirtualRobot
from dxlrun_lab.highest_rate import highest_rate
from dxlsim.simulation_plan import AdapterConfig

ROBOT = """
name: two
buses:
  main: {port: sim, protocol: 1.0, baud_rate: 1000000, adapter: {latency: 0 ms}, return_delay_time: 0 us}
loop: {rate: 10}
joints:
  joint_1:
    {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: [-90 deg, 90 deg]}}
  joint_2:
    {bus: main, id: 2, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: [-90 deg, 90 deg]}}
controllers: {joint_state_broadcaster: {type: joint_state_broadcaster, rate: 10}}
"""


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "two.yaml"
    path.write_text(ROBOT)
    return read_robot(path, {})


@pytest.fixture
def run_with(tmp_path):
    """Run on virtual time, with an adapter that is slower than the robot file says."""
    logs = iter(range(100))

    def run_with(latency_ms=0.0):
        def run(plan):
            adapter = AdapterConfig(latency_timer_ns=round(latency_ms * 1e6))
            told = replace(plan, simulation=replace(plan.simulation, adapters={"main": adapter}))
            path = tmp_path / f"{next(logs)}.mcap"
            VirtualRobot(told, log=path).run()
            return path

        return run

    return run_with


def test_a_robot_whose_buses_are_all_that_takes_time_keeps_what_they_allow(robot, run_with):
    found = highest_rate(robot, 0.2, run_with())
    assert found.kept_hz is not None
    assert found.kept_hz == int(0.98 * found.computed_hz)
    (one,) = found.tries
    assert (one.overruns, one.kept) == (0, True)
    assert one.cycles == pytest.approx(0.2 * found.kept_hz, abs=2)


def test_a_slower_adapter_brings_the_rate_down_to_what_nearly_all_cycles_keep(robot, run_with):
    tried: list[float] = []
    found = highest_rate(robot, 0.5, run_with(latency_ms=4), tried.append)
    assert tried == [one.rate_hz for one in found.tries]
    first, *_, last = found.tries
    assert first.overruns > 0
    assert not first.kept
    assert last.kept
    assert found.kept_hz == last.rate_hz < first.rate_hz
    # two reads a cycle wait up to 4 ms each
    assert 100 < last.rate_hz < 250
    assert '"kept_hz"' in json_text(found)


def test_a_run_without_a_cycle_is_an_error_with_a_hint(robot, run_with):
    run = run_with()

    def none(plan):
        return run(replace(plan, loop=replace(plan.loop, end_ns=0)))

    with pytest.raises(ProcessFault, match="ran no cycle"):
        highest_rate(robot, 0.2, none)
