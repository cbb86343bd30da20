"""Voltages that fall: of all servos of a bus, of one by itself, and ones that only differ."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dxlrun_analysis.joints.trends import Trends

Floats = npt.NDArray[np.float64]
COUNT = 4
TIME = np.arange(1000) * 0.02  # 20 s
LOADS = np.array([0.4 * (1 + np.sin(0.9 * TIME + joint)) for joint in range(COUNT)]).T
PLAN = {
    "buses": [
        {
            "name": "main",
            "protocol": 2.0,
            "servos": [
                {"joint": f"j{i}", "servo_id": i, "row": i, "model": "XM430-W350"} for i in range(COUNT)
            ],
        }
    ]
}


def read(volts: Floats) -> Floats:
    """Voltages as they are read: of each servo once a second, in steps of 0.1 V; NaN before."""
    held = np.full_like(volts, np.nan)
    for joint in range(COUNT):
        for begin in range(10 * joint, len(TIME), 50):
            held[begin:, joint] = np.round(volts[begin, joint], 1)
    return held


def findings(
    volts: Floats, errors: int | list[int] = 0, heat: float = 30.0, model: str = "XM430-W350"
) -> list[tuple[str, str, str]]:
    kinds = [(name, np.float64, COUNT) for name in ("temperature", "voltage", "effort")]
    cycles = np.zeros(len(TIME), [("read_ns", np.int64), *kinds, ("hardware_error", np.uint8, COUNT)])
    cycles["read_ns"] = 10**9 + (TIME * 1e9).astype(np.int64)
    cycles["temperature"], cycles["voltage"], cycles["effort"] = 30.0, read(volts), LOADS
    cycles["temperature"][500:, 1] = heat
    cycles["hardware_error"][500:] = errors if isinstance(errors, list) else [0, errors, 0, 0]
    trends = Trends()
    names = tuple(f"j{joint}" for joint in range(COUNT))
    for begin in range(0, len(TIME), 300):
        part: Any = SimpleNamespace(
            metadata={},
            cycles=cycles[begin : begin + 300],
            joints=names,
            attachments={"plan.json": json.dumps(PLAN).replace("XM430-W350", model).encode()},
        )
        trends.take(part)
    return [(one.code, one.subject, one.sentence) for one in trends.findings([])]


def volts(joint: int | None = None, fall: Floats | float = 0.0) -> Floats:
    """12 V, and of one joint or of all less."""
    found = np.full((len(TIME), COUNT), 12.0)
    if joint is None:
        return found - np.broadcast_to(np.reshape(fall, (-1, 1)), found.shape)
    found[:, joint] -= fall
    return found


def test_a_supply_that_falls_with_the_load_of_all_is_that_of_the_bus() -> None:
    ((code, subject, sentence),) = findings(volts(None, 1.2 * LOADS.sum(axis=1)))
    assert (code, subject) == ("sagging_supply", "main")
    assert "from 12.0 V" in sentence or "from 11." in sentence


@pytest.mark.parametrize(
    "rises", [np.minimum(5.0, TIME), np.full(len(TIME), 5.0)], ids=["creeps up", "all of it"]
)
def test_a_supply_above_the_limit_of_its_servos_does_not_run_down(rises: Floats) -> None:
    ((code, subject, sentence),) = findings(volts(None, -rises), errors=[1, 1, 1, 1])
    assert (code, subject) == ("overvoltage", "main")
    assert "up to 17.0 V, and its servos may have 16.0 V" in sentence


def test_one_servo_that_measures_too_much_is_not_the_supply() -> None:
    assert findings(volts(2, -5.0)) == []
    assert findings(volts(None, -4.0)) == []


def test_a_supply_that_falls_with_the_load_of_one_servo_is_its_own() -> None:
    ((code, subject, sentence),) = findings(volts(2, 2.5 * LOADS[:, 2]))
    assert (code, subject) == ("own_supply", "j2")
    assert "falls with its load to" in sentence
    assert "stay at 12.0 V" in sentence


def test_one_that_is_low_for_most_of_the_run_does_not_measure_less() -> None:
    ((code, subject, sentence),) = findings(volts(2, np.where(TIME > 3.0, 2.0, 0.0)))
    assert (code, subject) == ("own_supply", "j2")
    assert "to 10.0 V" in sentence


def test_one_that_falls_at_another_time_is_told_without_the_load() -> None:
    ((code, subject, sentence),) = findings(volts(2, np.where((TIME > 9) & (TIME < 14), 1.5, 0.0)))
    assert (code, subject) == ("own_supply", "j2")
    assert "with its load" not in sentence


def test_what_a_servo_reported_is_told_once() -> None:
    fall = np.where((TIME > 6.4) & (TIME < 8.9), 5.0, 0.0)  # at a time of more load, but only once
    assert [one[:2] for one in findings(volts(1, fall), errors=1)] == [("undervoltage", "j1")]
    assert [one[:2] for one in findings(volts(1, 5 * LOADS[:, 1]), errors=1)] == [("own_supply", "j1")]


@pytest.mark.parametrize(
    "innocent",
    [
        volts(),
        volts(2, 0.6),  # it measures less, always
        volts(2, np.where(np.sin(TIME) > 0, 0.6, 0.8)),  # and wavers
        volts(2, 0.3 * LOADS[:, 2]),
        volts(None, np.linspace(0, 0.2, len(TIME))),
        volts(2, np.where((TIME > 9) & (TIME < 9.5), 1.5, 0.0)),  # read once
        volts(2, 2.5 * LOADS[:, 2]) + volts(3, 2.5 * LOADS[:, 2]) - 12.0,  # of some it is not known why
    ],
    ids=["none", "measures less", "wavers", "little", "battery", "once", "two"],
)
def test_voltages_that_differ_accuse_nothing(innocent: Floats) -> None:
    assert findings(innocent) == []


def test_a_battery_that_gets_empty_does_not_sag_under_load() -> None:
    assert findings(volts(None, np.linspace(0, 1.2, len(TIME)))) == []
    fall = np.linspace(0, 2.0, len(TIME)) + 0.5 * LOADS.sum(axis=1)
    ((code, _, sentence),) = findings(volts(None, fall))
    assert (code, "runs down in the run" in sentence) == ("sagging_supply", True)


def test_a_voltage_that_most_servos_report_is_that_of_their_bus() -> None:
    ((code, subject, sentence),) = findings(volts(None, 4.0), errors=[1, 1, 1, 0])
    assert (code, subject) == ("undervoltage", "main")
    assert "The voltage of bus main is out of its limits of 9.5 to 16.0 V: 8.0 V." in sentence


def test_a_reported_voltage_error_without_a_reading_beyond_the_limits_names_no_contradiction() -> None:
    ((code, subject, sentence),) = findings(volts(), errors=[0, 1, 0, 0])
    assert (code, subject) == ("undervoltage", "j1")
    assert "out of its limits" not in sentence
    assert "is within the limits of 9.5 to 16.0 V: 12.0 V. A dip or a peak between" in sentence


@pytest.mark.parametrize(("heat", "code"), [(200.0, "temperature_sensor"), (75.0, "hot_joint")])
def test_a_temperature_that_no_servo_has_is_its_sensors(heat: float, code: str) -> None:
    ((found, subject, _),) = findings(volts(), heat=heat)
    assert (found, subject) == (code, "j1")


ERRORS = {  # e-Manual, Shutdown of each model, and Error Code (153) of the Y series
    "XM430-W350": (12.0, {0x01: "undervoltage", 0x04: "hot_joint", 0x20: "overload", 0x10: None}),
    "XL-320": (7.5, {0x01: "overload", 0x02: "hot_joint", 0x04: "undervoltage"}),
    "YM070-210-M001": (24.0, {2: "undervoltage", 3: "hot_joint", 4: "hot_joint", 5: "overload", 13: None}),
}


@pytest.mark.parametrize("model", ERRORS)
def test_a_hardware_error_is_what_the_model_means_by_it(model: str) -> None:
    supply, expected = ERRORS[model]
    for value, code in expected.items():
        told = [one[:2] for one in findings(volts(None, 12.0 - supply), errors=value, model=model)]
        assert told == ([] if code is None else [(code, "j1")]), value
