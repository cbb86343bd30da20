"""The driver on Phidget's own Python library, whose native part, libphidget22, is replaced."""

from __future__ import annotations

import ctypes
import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from dxlrun import SensorContext
from dxlrun_phidget import PhidgetSpatial, PhidgetSpatialParameters
from dxlrun_phidget.plugin import dxlrun_sensors

pytestmark = pytest.mark.long

TIMEOUT = 0x03
"""EPHIDGET_TIMEOUT of phidget22.h"""


class Native:
    """libphidget22 as far as the library calls it: one unit with its handlers, and a record of all calls."""

    def __init__(self) -> None:
        self.calls: dict[str, list[tuple[Any, ...]]] = {}
        self.handlers: dict[str, Any] = {}
        self.attached = True

    def __getattr__(self, name: str) -> Any:
        def function(*arguments: Any) -> int:
            self.calls.setdefault(name, []).append(tuple(getattr(one, "value", one) for one in arguments[1:]))
            match name:
                case "PhidgetSpatial_setOnSpatialDataHandler" | "Phidget_setOnDetachHandler":
                    self.handlers[name] = arguments[1]
                case "PhidgetSpatial_getMinDataInterval":
                    arguments[1]._obj.value = 4
                case "Phidget_openWaitForAttachment" if not self.attached:
                    return TIMEOUT
                case "Phidget_getErrorDescription":
                    arguments[1]._obj.value = b"Timed Out"
                case "Phidget_getLastError":
                    return 1
            return 0

        return function

    def send(self, acceleration: list[float], rate: list[float], field: list[float]) -> None:
        triples = [(ctypes.c_double * 3)(*each) for each in (acceleration, rate, field)]
        handler = self.handlers["PhidgetSpatial_setOnSpatialDataHandler"]
        # the library calls it in a thread of its own
        sent = threading.Thread(target=handler, args=(None, None, *triples, 8.0))
        sent.start()
        sent.join()


@pytest.fixture
def native(monkeypatch: pytest.MonkeyPatch) -> Native:
    support = pytest.importorskip("Phidget22._phidget_support", reason="phidget22 is not installed")
    native = Native()
    monkeypatch.setattr(support.PhidgetSupport, "getDll", staticmethod(lambda: native))
    return native


@pytest.fixture
def opened(native: Native) -> Iterator[Callable[..., PhidgetSpatial]]:
    sensors: list[PhidgetSpatial] = []

    def open_one(period_ns: int = 10_000_000, **keys: Any) -> PhidgetSpatial:
        sensors.append(PhidgetSpatial(PhidgetSpatialParameters(**keys)))
        sensors[-1].open(SensorContext("imu", period_ns, time.monotonic_ns, lambda text: None))
        return sensors[-1]

    yield open_one
    for sensor in sensors:
        sensor.close()


def sample(sensor: PhidgetSpatial) -> list[float] | None:
    values = np.full(len(sensor.states(sensor.parameters)), np.nan)
    return None if sensor.read(values) is None else values.tolist()


def test_an_event_is_a_sample_in_si_units(native: Native, opened: Callable[..., PhidgetSpatial]) -> None:
    sensor = opened()
    before = time.monotonic_ns()
    native.send([0.0, 0.5, -1.0], [180.0, 0.0, -90.0], [0.5, 0.0, -0.25])
    values = np.zeros(9)
    t_ns = sensor.read(values)
    assert t_ns is not None
    assert before <= t_ns <= time.monotonic_ns()
    assert values.tolist() == pytest.approx(
        [0.0, -0.5 * 9.80665, 9.80665, math.pi, 0.0, -math.pi / 2, 0.5e-4, 0.0, -0.25e-4]
    )


def test_of_several_events_the_newest_counts_and_none_is_read_twice(
    native: Native, opened: Callable[..., PhidgetSpatial], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dxlrun_phidget.spatial._LOOK_S", 0.01)
    sensor = opened(magnetometer=False)
    for rate in (1.0, 2.0):
        native.send([0.0] * 3, [rate] * 3, [0.0] * 3)
    assert sample(sensor) == pytest.approx([0.0] * 3 + [math.radians(2)] * 3)
    assert sample(sensor) is None


def test_an_unknown_field_is_nan_but_between_values_of_the_slower_magnetometer_its_last_one(
    native: Native, opened: Callable[..., PhidgetSpatial]
) -> None:
    now_ns = 0
    sensor = opened()
    sensor.context = SensorContext("imu", 10_000_000, lambda: now_ns, lambda text: None)
    for now_ns, field, expected in (  # noqa: B007  the clock reads it
        (0, [1e300] * 3, [math.nan] * 3),
        (0, [0.5, 0.25, -0.25], [0.5e-4, 0.25e-4, -0.25e-4]),
        (100_000_000, [1e300] * 3, [0.5e-4, 0.25e-4, -0.25e-4]),
        (100_000_001, [1e300] * 3, [math.nan] * 3),
    ):
        native.send([0.0] * 3, [0.0] * 3, field)
        assert sample(sensor) == pytest.approx([0.0] * 6 + expected, nan_ok=True)


def test_the_unit_is_chosen_and_its_interval_is_set(
    native: Native, opened: Callable[..., PhidgetSpatial]
) -> None:
    opened(serial_number=597101, hub_port=2, attach_timeout="3 s")
    assert native.calls["Phidget_setDeviceSerialNumber"] == [(597101,)]
    assert native.calls["Phidget_setHubPort"] == [(2,)]
    assert native.calls["Phidget_openWaitForAttachment"] == [(3000,)]
    assert native.calls["PhidgetSpatial_setDataInterval"] == [(10,)]
    opened(period_ns=1_000_000)
    assert native.calls["PhidgetSpatial_setDataInterval"][-1] == (4,)  # the shortest that it can
    assert dxlrun_sensors() == {"phidget_spatial": PhidgetSpatial}


def test_a_unit_that_is_not_there_can_come_later_and_one_that_is_unplugged_is_an_error(
    native: Native, opened: Callable[..., PhidgetSpatial]
) -> None:
    native.attached = False
    with pytest.raises(OSError, match=r"^Phidget Spatial 42: Timed Out$"):
        opened(serial_number=42)
    native.attached, native.calls = True, {}
    sensor = opened(serial_number=42)
    native.handlers["Phidget_setOnDetachHandler"](None, None)
    with pytest.raises(OSError, match="detached"):
        sample(sensor)
    sensor.close()
    assert len(native.calls["Phidget_close"]) == 1
