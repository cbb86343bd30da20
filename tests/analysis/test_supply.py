"""Voltages that fall: of all servos of a bus, of one by itself, and ones that only differ; and heat."""

import json
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from dxlrun_analysis.joints.health import Extremes, ServoHealth

Floats = npt.NDArray[np.float64]
COUNT = 4
NAMES = tuple(f"j{joint}" for joint in range(COUNT))
TIME = np.arange(1000) * 0.02  # 20 s
LOADS = np.array([0.4 * (1 + np.sin(0.9 * TIME + joint)) for joint in range(COUNT)]).T


class Found(NamedTuple):
    code: str
    subject: str
    sentence: str


def health_of(
    volts: Floats, errors: int | list[int] = 0, heat: float = 30.0, model: str = "XM430-W350"
) -> ServoHealth:
    """Count cycles in which each servo was read once a second, in steps of 0.1 V; NaN before."""
    kinds = [(name, np.float64, COUNT) for name in ("temperature", "voltage", "effort")]
    cycles = np.zeros(len(TIME), [("read_ns", np.int64), *kinds, ("hardware_error", np.uint8, COUNT)])
    cycles["read_ns"] = 10**9 + (TIME * 1e9).astype(np.int64)
    cycles["temperature"], cycles["voltage"], cycles["effort"] = 30.0, np.nan, LOADS
    for joint in range(COUNT):
        for begin in range(10 * joint, len(TIME), 50):
            cycles["voltage"][begin:, joint] = np.round(volts[begin, joint], 1)
    cycles["temperature"][500:, 1] = heat
    cycles["hardware_error"][500:] = errors if isinstance(errors, list) else [0, errors, 0, 0]
    servos = [{"joint": name, "servo_id": i, "row": i, "model": model} for i, name in enumerate(NAMES)]
    plan = json.dumps({"buses": [{"name": "main", "protocol": 2.0, "servos": servos}]}).encode()
    health, log = ServoHealth(), {"metadata": {}, "joints": NAMES, "attachments": {"plan.json": plan}}
    for slice_of in np.split(cycles, range(10, len(TIME), 10)):  # new voltages are in first cycles
        part: Any = SimpleNamespace(cycles=slice_of, **log)
        health.add_slice(part)
    return health


def findings(*run: Any, **more: Any) -> list[Found]:
    return [Found(one.code, one.subject, one.sentence) for one in health_of(*run, **more).findings([])]


def volts(joint: int | None = None, fall: Floats | float = 0.0) -> Floats:
    """12 V, and of one joint or of all less."""
    found = np.full((len(TIME), COUNT), 12.0)
    rows = slice(None) if joint is None else slice(joint, joint + 1)
    found[:, rows] -= np.reshape(fall, (-1, 1))
    return found


def between(begin_s: float, end_s: float, fall: float) -> Floats:
    return np.where((begin_s < TIME) & (end_s > TIME), fall, 0.0)


RUNS_DOWN = volts(None, np.linspace(0, 2.0, len(TIME)) + 0.5 * LOADS.sum(axis=1))
LOW, OTHERS = volts(None, 4.0), "while the other servos of bus main had 12.0 V"
CREEPS = volts(None, -np.minimum(5.0, TIME))
DIP = volts(1, between(6.4, 8.9, 5.0))  # at a time of more load, but only once
SUPPLIES: dict[str, tuple[Floats, int | list[int], str, str]] = {
    "sags with the load of all": (volts(None, 1.2 * LOADS.sum(axis=1)), 0, "main", "it falls under load"),
    "runs down": (RUNS_DOWN, 0, "main", "was 9.1 V at its lowest (19.6 s of the run)"),
    "and says so": (RUNS_DOWN, 0, "main", "it fell during the run"),
    "creeps up": (CREEPS, [1, 1, 1, 1], "main", "and 17.0 V at most; an input voltage error was"),
    "too high": (volts(None, -5.0), [1, 1, 1, 1], "main", "17.0 V at most"),
    "too low": (LOW, [1, 1, 1, 0], "main", "was 8.0 V at its lowest (0.0 s of the run)"),
    "with its limits": (LOW, [1, 1, 1, 0], "main", "9.5 to 16.0 V are allowed."),
    "one sags": (volts(2, 2.5 * LOADS[:, 2]), 0, "j2", "was 10.0 V at its lowest (6.4 s of the run)"),
    "one is low": (volts(2, between(3, 99, 2.0)), 0, "j2", OTHERS),
    "one was low once": (volts(2, between(9, 14, 1.5)), 0, "j2", "was 10.5 V at its lowest (9.4 s"),
    "one reports a dip": (DIP, 1, "j1", "was 7.0 V at its lowest (7.2 s"),
    "one sags and reports": (volts(1, 5 * LOADS[:, 1]), 1, "j1", OTHERS),
    "one reports and reads well": (volts(), 1, "j1", "12.0 V at most; an input voltage error was reported"),
}
"""Voltages, hardware errors, what is accused, and words of what is said of it."""


@pytest.mark.parametrize("case", SUPPLIES)
def test_supply_is_told_once_with_its_lowest_voltage_and_when(case):
    volts, errors, accused, words = SUPPLIES[case]
    (found,) = findings(volts, errors)
    assert (found.code, found.subject) == ("supply", accused)
    assert words in found.sentence


INNOCENT = {
    "none": volts(),
    "measures less": volts(2, 0.6),
    "wavers": volts(2, np.where(np.sin(TIME) > 0, 0.6, 0.8)),
    "little": volts(2, 0.3 * LOADS[:, 2]),
    "battery": volts(None, np.linspace(0, 1.2, len(TIME))),
    "read once": volts(2, between(9, 9.5, 1.5)),
    "of two it is not known why": volts(2, 2.5 * LOADS[:, 2]) + volts(3, 2.5 * LOADS[:, 2]) - 12.0,
    "one measures too much": volts(2, -5.0),
    "all measure too much": volts(None, -4.0),
}


@pytest.mark.parametrize("case", INNOCENT)
def test_voltages_that_differ_accuse_nothing(case):
    assert findings(INNOCENT[case]) == []


@pytest.mark.parametrize(
    ("heat", "words"),
    [
        (200.0, "impossible temperatures, from 30 to 200 deg C"),
        (-95.0, "impossible temperatures, from -95 to 30 deg C"),
        (75.0, "was hot, at 75 deg C with a limit of 80 deg C"),
    ],
)
def test_temperature_near_its_limit_or_beyond_sense_is_told(heat, words):
    (found,) = findings(volts(), heat=heat)
    assert (found.code, found.subject, words in found.sentence) == ("servo_error", "j1", True)


@pytest.mark.parametrize(
    ("model", "supply", "expected"),  # e-Manual, Shutdown of each model, and Error Code (153) of the Y series
    [
        ("XM430-W350", 12.0, {1: "input voltage error", 4: "overheating", 0x20: "overload", 0x10: ""}),
        ("XL-320", 7.5, {1: "overload", 2: "overheating", 4: "input voltage error"}),
        (
            "YM070-210-M001",
            24.0,
            {2: "input voltage error", 3: "overheating", 4: "overheating", 5: "overload", 13: ""},
        ),
    ],
)
def test_hardware_error_is_what_the_model_means_by_it(model, supply, expected):
    for value, words in expected.items():
        found = findings(volts(None, 12.0 - supply), value, model=model)
        code = "supply" if "voltage" in words else "servo_error"
        assert [(one.code, one.subject) for one in found] == [(code, "j1")] * bool(words), value
        assert all(words in one.sentence for one in found)


def test_extremes_are_the_highest_temperature_and_the_lowest_voltage_of_each_joint():
    never_read = DIP.copy()
    never_read[:, 3] = np.nan
    expected = [("j0", 30.0, 12.0), ("j1", 55.0, 7.0), ("j2", 30.0, 12.0), ("j3", 30.0, None)]
    assert health_of(never_read, heat=55.0).extremes() == tuple(Extremes(*one) for one in expected)
    assert ServoHealth().extremes() == ()
