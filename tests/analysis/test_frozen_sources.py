"""Sources that hang, and sources that only stay as they are."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.kit.made_logs import loop_of

from dxlrun.plan.loop_plan import SourcePlan
from dxlrun_analysis.conduct.frozen_sources import FrozenSources
from dxlrun_analysis.finding import Rank

Floats = npt.NDArray[np.floating[Any]]
TIME = np.arange(600) * 0.01  # 6 s
EACH = TIME[:, None]
NOISE = np.random.default_rng(1).normal(size=600)
MOVES, RESTS = np.sin(TIME), np.zeros(600)
HANGS = np.where(TIME < 2.0, NOISE, NOISE[199])
CELLS: Floats = 40.0 + np.random.default_rng(2).integers(-4, 5, size=(600, 3))
"""Forces that tremble by some steps."""


def findings(
    values: Floats, joint: Floats = MOVES, name: str = "gyro", kind: str = "sensor", valid: Any = True
) -> list[Any]:
    values = values if values.ndim > 1 else np.stack([values, values], axis=1)
    states = tuple("xyz"[: values.shape[1]])
    kinds = [("position", np.float64, 1), ("source_valid", np.bool_, 1)]
    cycles = np.zeros(len(TIME), [("read_ns", np.int64), *kinds, ("source_state", np.float64, len(states))])
    cycles["read_ns"] = 10**9 + np.rint(TIME * 1e9).astype(np.int64)
    cycles["source_valid"][:, 0], cycles["position"][:, 0] = valid, joint
    cycles["source_state"] = values
    sensors, layout = FrozenSources(), SimpleNamespace(source_slice=lambda name: slice(0, len(states)))
    plan = {"loop": loop_of(sources=(SourcePlan(name, kind, states),))}
    if kind == "device":
        plan["buses"] = [{"name": "main", "devices": [{"name": name, "servo_id": 101}]}]
    for begin in range(0, len(TIME), 170):
        part: Any = SimpleNamespace(
            cycles=cycles[begin : begin + 170],
            header=SimpleNamespace(sources={"gyro": states}, layout=layout),
            attachments={"plan.json": json.dumps(plan).encode()},
            metadata={},
        )
        sensors.add_slice(part)
    return list(sensors.findings())


def still(from_s: float, *cells: int, at: float = 41.0) -> Floats:
    """Cells of which some stand still from a time on."""
    found = np.array(CELLS, np.float64)
    found[np.ix_(from_s <= TIME, cells)] = at
    return found


def test_sensor_whose_values_stay_while_joints_move_hangs():
    (finding,) = findings(HANGS)
    assert (finding.code, finding.subject, finding.rank) == ("frozen", "gyro", Rank.SERVO_CAUSE)
    assert "for 4.0 s while joints moved, starting at 2.0 s" in finding.sentence


@pytest.mark.parametrize("joint", [MOVES, RESTS], ids=["joints move", "at rest"])
@pytest.mark.parametrize(("from_s", "seconds"), [(1.0, 5.0), (4.0, 2.0)])
def test_device_whose_trembling_values_stand_still_hangs(joint, from_s, seconds):
    (finding,) = findings(still(from_s, 0, 1, 2), joint, kind="device")
    assert (finding.code, finding.subject, finding.rank) == ("frozen", "gyro", Rank.SERVO_CAUSE)
    assert "Device gyro (ID 101 on bus main) is frozen: x, y, z stayed identical" in finding.sentence
    assert f"for {seconds:.1f} s, starting at {from_s:.1f} s" in finding.sentence


def test_one_value_that_stands_still_beside_others_is_named_alone():
    (finding,) = findings(still(3.0, 1), RESTS, kind="device")
    assert (finding.code, finding.rank) == ("frozen", Rank.CAUSE)
    assert "is frozen: y stayed identical for 3.0 s" in finding.sentence
    assert "its other values changed" in finding.sentence


@pytest.mark.parametrize(("kind", "values"), [("sensor", NOISE[:, None]), ("device", CELLS)])
def test_source_that_was_lost_meanwhile_did_not_hang(kind, values):
    gone = np.where((EACH > 2.0) & (EACH < 5.0), values[200], values)
    assert findings(gone, kind=kind)
    assert not findings(gone, kind=kind, valid=(TIME <= 2.0) | (TIME >= 5.0))


STOPS = np.where(TIME < 2.0, MOVES, MOVES[199])
TWO_STEPS = np.where(EACH < 3.0, np.random.default_rng(3).integers(12, 14, size=(600, 3)), 12.0)
WALKS = np.round(40 + 9 * np.sin(EACH * np.array([9.0, 10.0, 11.0])))
REASONS: dict[str, tuple[Any, ...]] = {
    "a sensor that measures": (NOISE,),
    "a switch": (np.where(TIME % 3 < 1.5, 0.0, 1.0),),
    "a sensor that never changed": (RESTS,),
    "rested before": (np.where(TIME < 0.5, 0.0, HANGS),),
    "joints at rest": (HANGS, STOPS),
    "no sensor": (HANGS, MOVES, "another"),
    "a device that trembles": (CELLS, MOVES, "gyro", "device"),
    "in the air": (still(3.0, 0, 1, 2, at=0.0), MOVES, "gyro", "device"),
    "one in the air": (still(3.0, 1, at=0.0), MOVES, "gyro", "device"),
    "at its end": (still(3.0, 0, 1, 2, at=60.0), MOVES, "gyro", "device"),
    "stands on it": (
        np.where(EACH < 3.0, CELLS, 41.0),
        np.where(TIME < 3.0, MOVES, MOVES[299]),
        "gyro",
        "device",
    ),
    "two steps": (TWO_STEPS, MOVES, "gyro", "device"),
    "follows the walk": (np.where(EACH < 3.0, WALKS, WALKS[299]), MOVES, "gyro", "device"),
    "buttons": (np.where(EACH % 3 < 1.5, 0.0, np.ones(3)), MOVES, "gyro", "device"),
    "a model number": (np.full((600, 3), 29.0), MOVES, "gyro", "device"),
    "half a second": (still(5.5, 0, 1, 2), MOVES, "gyro", "device"),
}


@pytest.mark.parametrize("case", REASONS)
def test_source_that_stays_for_a_reason_does_not_hang(case):
    assert findings(*REASONS[case]) == []
