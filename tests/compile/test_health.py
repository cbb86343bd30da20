"""Bus Watchdog, slow registers and policies of lost servos in a robot file, and in a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from tests.kit.robots import compile_text

from dxlrun.channels.event_records import EventCode
from dxlrun.compile.buses import slowest_period_ns
from dxlrun.testing import read_log, simulated_robot

ROBOT = """\
name: two
buses: {{arm: {{port: sim, protocol: {protocol}, baud_rate: 1_000_000, return_delay_time: 0 us{bus}}}}}
loop: {{rate: {rate}}}
joints:
  pan: {{bus: arm, id: 3, model: {model}, reference: {reference}, direction: 1}}
  tilt: {{bus: arm, id: 7, model: {model}, reference: {reference}, direction: 1}}
  yaw: {{bus: arm, id: 9, model: {model}, reference: {reference}, direction: 1}}
controllers:
  states: {{type: joint_state_broadcaster}}
  pair: {{type: joint_group_position_controller, joints: [pan, tilt]}}
  single: {{type: joint_group_position_controller, joints: [yaw]}}
policies: {{exit_timeout: 2 s{policies}}}
"""


def text(*, protocol: float = 2.0, bus: str = "", rate: float = 100, policies: str = "") -> str:
    model, reference = ("XM430-W350", "180 deg") if protocol == 2.0 else ("AX-12A", "150 deg")
    return ROBOT.format(
        protocol=protocol,
        bus=bus and f", {bus}",
        rate=rate,
        model=model,
        reference=reference,
        policies=policies and f", {policies}",
    )


@pytest.mark.parametrize(
    ("more", "ticks"),
    [
        ({}, 10),
        ({"rate": 10}, 15),  # three periods
        ({"rate": 1}, 0),  # beyond 2.54 s
        ({"protocol": 1.0}, 0),
        ({"bus": "bus_watchdog: 0 ms"}, 0),
        ({"bus": "bus_watchdog: 90 ms"}, 5),
        ({"bus": "bus_watchdog: auto"}, 10),
    ],
)
def test_the_watchdog_of_a_bus(more: dict[str, Any], ticks: int) -> None:
    (bus,) = compile_text(text(**more)).plan.buses
    assert bus.watchdog_ticks == ticks
    assert slowest_period_ns([bus]) == ticks * 20_000_000 // 3


def test_of_several_buses_the_shortest_watchdog_bounds_the_rate() -> None:
    (bus,) = compile_text(text()).plan.buses
    longer = replace(bus, watchdog_ticks=50)
    assert slowest_period_ns([bus, longer]) == slowest_period_ns([longer, bus]) == slowest_period_ns([bus])


def test_slow_registers_and_who_gets_torque_back() -> None:
    policies = "on_returned_servo: hold, groups: {a: {joints: [tilt], on_returned_servo: limp}}"
    bus_text = "slow_registers: {items: [present_temperature, position_p_gain], rate: 4}"
    (bus,) = compile_text(text(bus=bus_text, policies=policies)).plan.buses
    assert bus.slow_period_ns == 250_000_000
    assert {servo.slow for servo in bus.servos} == {("present_temperature", "position_p_gain")}
    assert [servo.torque_on_return for servo in bus.servos] == [True, False, True]
    (bus,) = compile_text(text()).plan.buses
    assert bus.servos[0].slow == ("present_input_voltage", "present_temperature")
    (bus,) = compile_text(text(bus="slow_registers: {items: []}")).plan.buses
    assert bus.servos[0].slow == ()
    assert bus.slow_period_ns == 1_000_000_000  # of the servos' clocks, which tell their reboots


def test_check_shows_the_policies_of_groups_and_of_returned_servos() -> None:
    pair = "pair: {joints: [pan, tilt], on_lost_servo: limp, on_returned_servo: hold}"
    compiled = compile_text(text(policies=f"groups: {{{pair}}}"))
    shown = {row.name: row.does for row in compiled.report["policies"]}
    assert shown["on_lost_servo of pair"] == "the group goes limp, the others continue"
    assert shown["on_returned_servo"] == "hold pan, tilt, other servos limp"


@pytest.mark.parametrize(
    ("word", "ended", "torque"),
    [("hold", "ended", [True, True, True]), ("limp", "ended", [False, False, True]), ("stop", "fault", None)],
)
def test_a_group_has_its_own_policy_for_a_lost_servo(
    word: str, ended: str, torque: list[bool] | None
) -> None:
    path = Path("two.yaml")
    path.write_text(text(policies=f"groups: {{pair: {{joints: [pan, tilt], on_lost_servo: {word}}}}}"))
    robot = simulated_robot(path, duration_s=2.5, log=Path("run.mcap"))
    servos = robot.buses[0].servos
    seen: list[list[bool]] = []
    robot.buses[0].at(500_000_000, servos[1].silence)
    robot.buses[0].at(900_000_000, lambda: servos[1].silence(False))
    robot.buses[0].at(2_400_000_000, lambda: seen.append([servo.torque_on for servo in servos]))
    assert robot.run().reason == ended
    assert seen == ([] if torque is None else [torque])
    events = read_log(Path("run.mcap")).events
    assert any(event.code == EventCode.SERVO_LOST and event.source == "tilt" for event in events)
    back = [event.text for event in events if event.code == EventCode.SERVO_BACK]
    ends = {"hold": [", with its torque and its goal as before"], "limp": [" and limp: it gets no goals"]}
    assert [said.rpartition(" is back")[2] for said in back] == ends.get(word, [])


def test_a_rate_at_which_the_watchdog_would_stop_the_servos_is_refused() -> None:
    path = Path("two.yaml")
    path.write_text(text())
    robot = simulated_robot(path, duration_s=0.1)
    assert robot.robot.loop.steering.change_rate(10).text == "the Bus Watchdog needs at least 15 Hz"
    assert robot.robot.loop.steering.change_rate(50) is None
