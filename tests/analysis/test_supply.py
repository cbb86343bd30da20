"""Voltages that fall: of all servos of a bus, of one by itself, and ones that only differ."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dxlrun_analysis.joints.health import Extremes, ServoHealth

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


def health_of(
    volts: Floats, errors: int | list[int] = 0, heat: float = 30.0, model: str = "XM430-W350"
) -> ServoHealth:
    kinds = [(name, np.float64, COUNT) for name in ("temperature", "voltage", "effort")]
    cycles = np.zeros(len(TIME), [("read_ns", np.int64), *kinds, ("hardware_error", np.uint8, COUNT)])
    cycles["read_ns"] = 10**9 + (TIME * 1e9).astype(np.int64)
    cycles["temperature"], cycles["voltage"], cycles["effort"] = 30.0, read(volts), LOADS
    cycles["temperature"][500:, 1] = heat
    cycles["hardware_error"][500:] = errors if isinstance(errors, list) else [0, errors, 0, 0]
    health = ServoHealth()
    names = tuple(f"j{joint}" for joint in range(COUNT))
    for begin in range(0, len(TIME), 300):
        part: Any = SimpleNamespace(
            metadata={},
            cycles=cycles[begin : begin + 300],
            joints=names,
            attachments={"plan.json": json.dumps(PLAN).replace("XM430-W350", model).encode()},
        )
        health.add_slice(part)
    return health


def findings(
    volts: Floats, errors: int | list[int] = 0, heat: float = 30.0, model: str = "XM430-W350"
) -> list[tuple[str, str, str]]:
    found = health_of(volts, errors, heat, model).findings([])
    return [(one.code, one.subject, one.sentence) for one in found]


def volts(joint: int | None = None, fall: Floats | float = 0.0) -> Floats:
    """12 V, and of one joint or of all less."""
    found = np.full((len(TIME), COUNT), 12.0)
    if joint is None:
        return found - np.broadcast_to(np.reshape(fall, (-1, 1)), found.shape)
    found[:, joint] -= fall
    return found


RISES = -np.minimum(5.0, TIME)
RUNS_DOWN = np.linspace(0, 2.0, len(TIME)) + 0.5 * LOADS.sum(axis=1)
DIP = np.where((TIME > 6.4) & (TIME < 8.9), 5.0, 0.0)  # at a time of more load, but only once
SUPPLIES: dict[str, tuple[Floats, int | list[int], str, str]] = {
    "sags with the load of all": (volts(None, 1.2 * LOADS.sum(axis=1)), 0, "main", "it falls under load"),
    "runs down": (volts(None, RUNS_DOWN), 0, "main", "was 9.1 V at its lowest (19.6 s of the run)"),
    "and says so": (volts(None, RUNS_DOWN), 0, "main", "it fell during the run"),
    "creeps up": (volts(None, RISES), [1, 1, 1, 1], "main", "and 17.0 V at most; an input voltage error was"),
    "too high": (volts(None, -5.0), [1, 1, 1, 1], "main", "17.0 V at most"),
    "too low": (volts(None, 4.0), [1, 1, 1, 0], "main", "was 8.0 V at its lowest (0.0 s of the run)"),
    "with its limits": (volts(None, 4.0), [1, 1, 1, 0], "main", "9.5 to 16.0 V are allowed."),
    "one sags": (volts(2, 2.5 * LOADS[:, 2]), 0, "j2", "was 10.0 V at its lowest (6.4 s of the run)"),
    "one is low": (
        volts(2, np.where(TIME > 3.0, 2.0, 0.0)),
        0,
        "j2",
        "while the other servos of bus main had 12.0 V",
    ),
    "one was low once": (
        volts(2, np.where((TIME > 9) & (TIME < 14), 1.5, 0.0)),
        0,
        "j2",
        "was 10.5 V at its lowest (9.4 s",
    ),
    "one reports a dip": (volts(1, DIP), 1, "j1", "was 7.0 V at its lowest (7.2 s"),
    "one sags and reports": (
        volts(1, 5 * LOADS[:, 1]),
        1,
        "j1",
        "while the other servos of bus main had 12.0 V",
    ),
    "one reports and reads well": (volts(), 1, "j1", "12.0 V at most; an input voltage error was reported"),
}
"""Voltages, hardware errors, what is accused, and words of what is said of it."""


@pytest.mark.parametrize("case", SUPPLIES)
def test_supply_is_told_once_with_its_lowest_voltage_and_when(case: str) -> None:
    volts, errors, accused, words = SUPPLIES[case]
    ((code, subject, sentence),) = findings(volts, errors)
    assert (code, subject) == ("supply", accused)
    assert words in sentence


def test_one_servo_that_measures_too_much_is_not_the_supply() -> None:
    assert findings(volts(2, -5.0)) == []
    assert findings(volts(None, -4.0)) == []


@pytest.mark.parametrize(
    "innocent",
    [
        volts(),
        volts(2, 0.6),  # it measures less, always
        volts(2, np.where(np.sin(TIME) > 0, 0.6, 0.8)),  # and wavers
        volts(2, 0.3 * LOADS[:, 2]),
        volts(None, np.linspace(0, 1.2, len(TIME))),
        volts(2, np.where((TIME > 9) & (TIME < 9.5), 1.5, 0.0)),  # read once
        volts(2, 2.5 * LOADS[:, 2]) + volts(3, 2.5 * LOADS[:, 2]) - 12.0,  # of some it is not known why
    ],
    ids=["none", "measures less", "wavers", "little", "battery", "once", "two"],
)
def test_voltages_that_differ_accuse_nothing(innocent: Floats) -> None:
    assert findings(innocent) == []


@pytest.mark.parametrize(
    ("heat", "words"),
    [
        (200.0, "impossible temperatures, from 30 to 200 deg C"),
        (75.0, "was hot, at 75 deg C with a limit of 80 deg C"),
    ],
)
def test_temperature_near_its_limit_or_beyond_sense_is_told(heat: float, words: str) -> None:
    ((code, subject, sentence),) = findings(volts(), heat=heat)
    assert (code, subject, words in sentence) == ("servo_error", "j1", True)


ERRORS = {  # e-Manual, Shutdown of each model, and Error Code (153) of the Y series
    "XM430-W350": (12.0, {0x01: "input voltage error", 0x04: "overheating", 0x20: "overload", 0x10: None}),
    "XL-320": (7.5, {0x01: "overload", 0x02: "overheating", 0x04: "input voltage error"}),
    "YM070-210-M001": (
        24.0,
        {2: "input voltage error", 3: "overheating", 4: "overheating", 5: "overload", 13: None},
    ),
}


@pytest.mark.parametrize("model", ERRORS)
def test_a_hardware_error_is_what_the_model_means_by_it(model: str) -> None:
    supply, expected = ERRORS[model]
    for value, words in expected.items():
        told = findings(volts(None, 12.0 - supply), errors=value, model=model)
        assert [one[1] for one in told] == ["j1"] * (words is not None), value
        assert all(one[0] == ("supply" if "voltage" in words else "servo_error") for one in told if words)
        assert all(words in one[2] for one in told if words)


def test_extremes_are_the_highest_temperature_and_the_lowest_voltage_of_each_joint() -> None:
    never_read = volts(1, DIP)
    never_read[:, 3] = np.nan
    assert health_of(never_read, heat=55.0).extremes() == (
        Extremes("j0", 30.0, 12.0),
        Extremes("j1", 55.0, 7.0),
        Extremes("j2", 30.0, 12.0),
        Extremes("j3", 30.0, None),
    )


def test_log_without_cycles_has_no_extremes() -> None:
    assert ServoHealth().extremes() == ()
