"""Values of devices that jump and come back at once, and values that only change."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dxlrun_analysis.conduct.spikes import Spikes
from dxlrun_analysis.finding import Rank

Floats = npt.NDArray[np.floating[Any]]
COUNT = 900
RANDOM = np.random.default_rng(3)
TREMBLES = 4.0 + 0.02 * RANDOM.normal(size=COUNT)
OTHER = 5.0 + 0.02 * RANDOM.normal(size=COUNT)
SOME = np.arange(COUNT) % 17 == 5  # 53 samples, one by one
BURSTS = np.where(np.arange(COUNT) % 60 < 15, RANDOM.uniform(-8.0, 8.0, COUNT), 0.0)


def findings(values: Floats, other: Floats = OTHER, name: str = "foot", slices: int = 170) -> list[Any]:
    cycles = np.zeros(COUNT, [("source_valid", np.bool_, 1), ("source_state", np.float64, 2)])
    cycles["source_valid"] = True
    cycles["source_state"] = np.stack([values, other], axis=1)
    spikes, layout = Spikes(), SimpleNamespace(source_slice=lambda name: slice(0, 2))
    plan = {"buses": [{"name": "main", "devices": [{"name": name, "servo_id": 101}]}]}
    for begin in range(0, COUNT, slices):
        part: Any = SimpleNamespace(
            cycles=cycles[begin : begin + slices],
            header=SimpleNamespace(sources={"foot": ("heel", "toe")}, layout=layout),
            attachments={"plan.json": json.dumps(plan).encode()},
            metadata={},
        )
        spikes.take(part)
    return list(spikes.findings())


def test_a_value_that_jumps_and_comes_back_is_told_with_its_share_and_size() -> None:
    (finding,) = findings(np.where(SOME, 3 * TREMBLES, TREMBLES))
    assert (finding.code, finding.subject, finding.rank) == ("device_jumps", "foot", Rank.REMARK)
    assert "Device foot (ID 101 on bus main) has values that jump: heel 53 times (5.9%" in finding.sentence
    assert ", by up to 8." in finding.sentence


@pytest.mark.parametrize("slices", [1, 100, COUNT])
def test_it_does_not_depend_on_how_the_log_is_cut(slices: int) -> None:
    values = np.where(SOME | np.roll(SOME, 1), 3 * TREMBLES, TREMBLES)
    assert findings(values, slices=slices) == findings(values)
    assert "heel 106 times" in findings(values)[0].sentence


@pytest.mark.parametrize(
    ("values", "other"),
    [
        (TREMBLES, OTHER),
        (SOME.astype(np.float64), OTHER),
        (np.where(SOME, 300.0, RANDOM.integers(0, 4, COUNT)), OTHER),
        (TREMBLES + BURSTS, OTHER),
        (TREMBLES + 8.0 * (np.arange(COUNT) // 30 % 2), OTHER),
        (TREMBLES + 8.0 * (np.arange(COUNT) // 3 % 10 == 0), OTHER),
        (np.where(SOME, 3 * TREMBLES, TREMBLES), np.where(SOME, 3 * OTHER, OTHER)),
        (np.where(SOME & (np.arange(COUNT) < 150), 3 * TREMBLES, TREMBLES), OTHER),
        (np.sin(np.arange(COUNT) * 0.9), OTHER),
    ],
    ids=["noise", "a button", "few values", "bursts", "steps", "pulses", "impacts", "seldom", "fast"],
)
def test_what_has_a_reason_is_not_told(values: Floats, other: Floats) -> None:
    assert findings(values, other) == []


def test_a_sensor_or_a_robot_without_that_device_is_not_looked_at() -> None:
    assert findings(np.where(SOME, 3 * TREMBLES, TREMBLES), name="another") == []
