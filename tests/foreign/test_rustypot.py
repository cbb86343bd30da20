"""rustypot's Python classes, written in Rust for other robots, with control tables of their own."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import rustypot
from tests.kit.awaited import DEADLINE_S, until

from dxlsim.simulation_plan import BusConfig, ServoConfig
from dxlwire.control_table import find_table

RATE = 1_000_000
MODELS = {
    "Ax": ("AX-12A", 1.0),
    "Mx": ("MX-28", 1.0),
    "Xl320": ("XL-320", 2.0),
    "Xl330": ("XL330-M288", 2.0),
    "Xl430": ("XL430-W250", 2.0),
}
"""By its class: a model, and the protocol."""


def line(name: str, protocol: float, *models: str) -> BusConfig:
    """All servos stand at 2 rad from raw 0."""
    servos = tuple(ServoConfig(each, model, 2.0) for each, model in enumerate(models, 1))
    return BusConfig(name, RATE, servos, protocol)


BUSES = (
    *(
        line(f"{use} {kind}", MODELS[kind][1], *[MODELS[kind][0]] * 2)
        for kind in MODELS
        for use in ("read", "drive")
    ),
    line("moved", 2.0, "XL430-W250", "XL330-M288"),
    line("stuffed", 2.0, "XL330-M288"),
)
every = pytest.mark.parametrize("kind", MODELS)


@pytest.fixture
def connect(simulation: Any) -> Iterator[Callable[[str, str], Any]]:
    """Open a bus by a class of rustypot."""
    opened: list[Any] = []

    def open_bus(name: str, kind: str) -> Any:
        opened.append(getattr(rustypot, f"{kind}PyController")(simulation.ports[name], RATE, DEADLINE_S))
        return opened[-1]

    yield open_bus
    for each in opened:
        each.close()


@every
def test_every_register_is_read_and_written_back_where_its_table_has_it(
    connect: Any, simulation: Any, kind: str
) -> None:
    bus = f"read {kind}"
    servo = connect(bus, kind)
    access = {item.address: item.access for item in find_table(*MODELS[kind]).items.values()}
    written = 0
    for register in servo.registers():
        if register.addr not in access:
            continue  # of another model of this class
        value, error = servo.read_register_with_error(1, register.name)
        assert error == 0, register.name
        if register.access == rustypot.RegisterAccess.ReadWrite:
            # Its table of the XL330 takes some that the manual calls read-only for writable.
            allowed = access[register.addr] == "RW"
            simulation.expect_refusals(bus, not allowed)
            assert (servo.write_register_with_error(1, register.name, value) == 0) == allowed, register.name
            written += allowed
    assert written > 15
    simulation.expect_refusals(bus, 1)  # the error of a value out of range is that of the protocol
    assert servo.write_register_with_error(2, "torque_enable", 2) == (8 if MODELS[kind][1] == 1.0 else 4)


@every
def test_two_servos_are_found_and_driven_by_a_sync_write(connect: Any, simulation: Any, kind: str) -> None:
    simulation.expect_haste(f"drive {kind}")
    bus = connect(f"drive {kind}", kind)
    model = find_table(*MODELS[kind]).model_number
    assert until(lambda: bus.scan([1, 2]) == {1: model, 2: model})  # it does not wait long for any
    for servo_id in (1, 2):
        bus.write_torque_enable(servo_id, True)
    goals = [bus.read_register(each, "present_position") + step for each, step in ((1, 60), (2, -60))]
    bus.sync_write_register([1, 2], "goal_position", goals)
    assert [bus.read_register(each, "goal_position") for each in (1, 2)] == goals

    def arrived() -> bool:
        present = [bus.read_register(each, "present_position") for each in (1, 2)]
        return all(abs(have - want) <= 10 for have, want in zip(present, goals, strict=True))

    assert until(arrived)


def test_data_that_look_like_a_header_arrive_as_they_were_meant(connect: Any) -> None:
    servo = connect("stuffed", "Xl330")
    tricky = [0xFF, 0xFF, 0xFF, 0xFF, 0xFD, 0, 0, 0]  # Goal Velocity -1, Profile Acceleration 253
    assert servo.write_raw_data_with_error(1, 104, tricky) == 0
    data, error = servo.read_raw_data_with_error(1, 104, 8)
    assert (list(data), error) == (tricky, 0)


def test_a_servo_is_given_a_new_id_and_a_new_rate_and_is_found_there(simulation: Any) -> None:
    simulation.expect_haste("moved")
    one, other = rustypot.Xl430PyController.definition(), rustypot.Xl330PyController.definition()
    with rustypot.Bus(simulation.ports["moved"], RATE, DEADLINE_S, {1: one, 2: other}) as bus:
        bus.change_id(one, 1, 17)
        bus.change_baudrate(one, 17, 57_600)
        bus.set_timeout(0.05)
        assert until(lambda: bus.scan(one, [1, 2, 17]) == {2: 1200})
        bus.set_baudrate(57_600)
        assert until(lambda: bus.scan(one, [1, 2, 17]) == {17: 1060})
        bus.set_baudrate(RATE)
        assert until(lambda: bus.scan(other, [2, 17]) == {2: 1200})
