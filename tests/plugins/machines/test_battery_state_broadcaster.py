"""battery_state_broadcaster: warns and stops by the filtered voltage, not by a sag, and never by silence."""

from __future__ import annotations

import math

import pytest
from tests.kit.stages import standing

from dxlrun_controllers.sensing.battery_state_broadcaster import BatteryStateBroadcaster

KEYS: dict[str, object] = {"voltages": ["power/voltage"], "warn": "10.8 V", "stop": "10.2 V"}


class Bench:
    def __init__(self, **written: object) -> None:
        self.stage = standing(BatteryStateBroadcaster, {**KEYS, **written}).activate()

    def measure(self, *voltages: float, seconds: float = 0.02, age_s: float = 0.0) -> Bench:
        count = len(self.stage.model.voltages)
        for _ in range(round(seconds / 0.02)):
            self.stage.context.reads[:count] = voltages
            self.stage.context.reads[count : 2 * count] = age_s
            self.stage.step()
        return self


def test_a_sag_neither_warns_nor_stops() -> None:
    bench = Bench()
    for _ in range(20):  # a motor starts: a third of a second at 9 V, every two seconds
        bench.measure(12.0, seconds=2.0).measure(9.0, seconds=0.3)
    assert not bench.stage.said
    assert not bench.stage.endings


def test_an_empty_battery_warns_first_and_then_ends_the_run_once() -> None:
    bench = Bench().measure(11.0).measure(10.5, seconds=10.0)
    assert bench.stage.said == ["the battery is low: 10.80 V, less than 10.80 V"]
    assert not bench.stage.endings
    bench.measure(10.0, seconds=20.0)
    assert bench.stage.endings == ["the battery has 10.20 V, less than 10.20 V"]
    assert not bench.stage.takeovers
    assert len(bench.stage.said) == 1


def test_without_a_filter_the_first_measurement_stops() -> None:
    assert len(Bench(filter="0 s").measure(10.1).stage.endings) == 1


def test_it_warns_again_only_after_the_voltage_was_good_again() -> None:
    bench = Bench(filter="0 s", hysteresis="200 mV").measure(10.7)
    for voltage in (10.9, 10.7, 10.99, 10.7):
        bench.measure(voltage)
    assert len(bench.stage.said) == 1
    bench.measure(11.01).measure(10.7)
    assert [text.split(":")[0] for text in bench.stage.said] == [
        "the battery is low",
        "the battery has 11.01 V again",
        "the battery is low",
    ]


def test_thresholds_may_be_those_of_a_cell_and_others_take_over() -> None:
    bench = Bench(cells=3, warn="3.6 V", stop="3.4 V", activate=["sit"], filter="0 s")
    assert bench.stage.interfaces.takeovers == ("sit",)
    bench.measure(10.81)
    assert not bench.stage.said
    bench.measure(10.19)
    assert bench.stage.takeovers == [
        (("sit",), "the battery has 3.40 V a cell (10.19 V), less than 3.40 V a cell (10.20 V)")
    ]
    assert not bench.stage.endings


def test_the_median_of_servos_counts_and_only_of_those_that_answer() -> None:
    bench = Bench(voltages=["hip/voltage", "knee/voltage", "ankle/voltage"], filter="0 s")
    assert bench.stage.interfaces.reads[3:] == ("hip/age", "knee/age", "ankle/age")
    bench.measure(12.0, 11.9, 3.0)
    assert bench.stage.context.provided[0] == 11.9
    bench.measure(12.0, math.nan, 11.0)
    assert bench.stage.context.provided[0] == 11.5
    bench.stage.context.reads[:] = [12.0, 11.0, 11.2, 3.0, 0.1, 0.1]
    bench.stage.step()
    assert bench.stage.context.provided[0] == pytest.approx(11.1)


@pytest.mark.parametrize(("voltage", "age_s"), [(math.nan, 0.0), (5.0, 2.1), (5.0, math.nan)])
def test_without_a_fresh_voltage_nothing_is_decided_and_an_event_says_so(
    voltage: float, age_s: float
) -> None:
    bench = Bench().measure(12.0).measure(voltage, seconds=10.0, age_s=age_s)
    assert bench.stage.said == ["no voltage from power/voltage for 2 s: an empty battery is not detected"]
    assert not bench.stage.endings
    assert math.isnan(bench.stage.context.provided[0])


def test_the_message_comes_once_a_second_with_what_is_known() -> None:
    bench = Bench(current="power/current", frame="torso")
    bench.stage.context.reads[2] = -1.5
    bench.measure(12.0, seconds=4.9)
    assert len(bench.stage.messages) == 5
    topic, message = bench.stage.messages[-1]
    assert (topic, message.header.frame_id) == ("battery_state", "torso")
    assert (message.voltage, message.current) == pytest.approx((12.0, -1.5))
    assert math.isnan(message.percentage)
