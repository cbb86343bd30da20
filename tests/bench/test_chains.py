"""The benchmark of chains: what it measures moves; how fast it is decides nothing here."""

from __future__ import annotations

import numpy as np

import chains


def test_the_chain_that_is_measured_moves_from_top_to_bottom() -> None:
    manager, record = chains.manager(chains.plan(), chains.NAMES)
    assert manager.active == chains.NAMES
    seen = []
    for cycle in range(60):
        record.wake(cycle, 0, 1 + cycle, chains.PERIOD_NS)
        manager.begin()
        assert manager.update(cycle, cycle * chains.PERIOD_NS * 10) is None
        seen.append((record.reference.copy(), record.commands.effort.copy()))
    names = record.layout.references
    for wanted in ("middle/{}/position", "bottom/{}/velocity"):
        places = [names.index(wanted.format(joint)) for joint in record.layout.joints]
        assert (seen[-1][0][places] != seen[-2][0][places]).all()
        assert np.isfinite(seen[-1][0][places]).all()
    assert np.isfinite(seen[-1][1]).all()
    assert (seen[-1][1] != seen[-2][1]).all()


def test_the_costs_are_those_of_all_five_managers() -> None:
    cost = chains.measure(20)
    assert 0 < cost.none < min(cost.alone) < cost.sum
    assert cost.ratio > 0
