from __future__ import annotations

import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from dxlrun.channels.child_processes import spare_core
from dxlrun.run.loop_process import beside_simulation
from dxlrun.testing import plan_of


@pytest.mark.parametrize(
    ("taken", "core"), [((), 3), ((3,), 2), ((1, 2, 3), 0), ((0, 1, 2, 3), 3), ((77,), 3)]
)
def test_simulated_servos_stay_off_the_cores_of_the_loop_where_they_can(monkeypatch, taken, core):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    assert spare_core(taken) == core


@pytest.mark.parametrize(
    ("port", "policy", "cores", "allowed", "stays"),
    [
        ("sim", "fifo", (), {0, 1, 2, 3}, (0, 1, 2)),
        ("sim", "fifo", (1,), {0, 1, 2, 3}, (1,)),
        ("sim", "fifo", (), {0}, ()),
        ("sim", "other", (), {0, 1}, ()),
        ("/dev/ttyUSB0", "fifo", (), {0, 1}, ()),
    ],
)
def test_a_loop_in_real_time_stays_off_the_core_of_simulated_servos(  # noqa: PLR0917  fixtures
    monkeypatch, port, policy, cores, allowed, stays
):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: allowed)
    plan = plan_of(Path(__file__).parents[2] / "robots" / "diff_drive.yaml")
    scheduler = replace(plan.loop.scheduler, policy=policy, cores=cores)
    buses = tuple(replace(bus, port=port) for bus in plan.buses)
    plan = replace(plan, buses=buses, loop=replace(plan.loop, scheduler=scheduler))
    assert beside_simulation(plan) == replace(scheduler, cores=stays)
