from __future__ import annotations

import os

import pytest

from dxlrun.process import spare_core


@pytest.mark.parametrize(
    ("taken", "core"), [((), 3), ((3,), 2), ((1, 2, 3), 0), ((0, 1, 2, 3), 3), ((77,), 3)]
)
def test_simulated_servos_stay_off_the_cores_of_the_loop_where_they_can(monkeypatch, taken, core):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    assert spare_core(taken) == core
