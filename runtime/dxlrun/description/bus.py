"""Bus: the form of one serial line in a robot file."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from dxlrun.description.form import Form, ItemName, key, refuse
from dxlrun.description.units import AutoDuration, Duration, Rate

HIGHEST_BAUD_RATE = 10_500_000
"""bit/s, the rate of PRO, P and Y servos."""
SIMULATED = "sim"  # port of a simulated bus
_HIGHEST_ID_OF_PROTOCOL_2 = 252  # 0xFD is in the header of each packet (e-Manual, Protocol 2.0, Packet ID)
_LONGEST_TIMER_NS = 255_000_000  # The latency timer of an FTDI chip is one byte, ms (FTDI AN232B-04)

_LONGEST_BOOT_NS = 10_000_000_000


def _protocol(value: float) -> float:
    if value not in (1.0, 2.0):
        raise refuse(f"there is no Protocol {value:g}", "write 1.0 or 2.0")
    return value


def _timer(value: int) -> int:
    if value > _LONGEST_TIMER_NS:
        raise refuse("no adapter gathers bytes for so long", "write 255 ms at most")
    return value


def _boot_time(value: int) -> int:
    if value > _LONGEST_BOOT_NS:
        raise refuse("no board boots for so long", "write 10 s at most")
    return value


_LEAST_LATENCY_NS: Mapping[str, int] = MappingProxyType({"ftdi": 1_000_000, "direct": 0})
"""Lowest latency of each kind of adapter (protocol.md, Time budget)."""


class Adapter(Form):
    """The adapter of a bus."""

    kind: Literal["ftdi", "direct"] | None = key(
        "An FTDI chip with its latency timer at 1 ms, or one that hands bytes over at once.", "direct", None
    )
    latency: Duration = key(
        "How long it may keep bytes back before it hands them over; kind says it, too (1 ms, or none).",
        "1 ms",
        16_000_000,
    )
    rs485: bool = key(
        "The kernel switches its direction (TIOCSRS485), as for an RS-485 transceiver at a UART.",
        "true",
        False,
    )
    boot_time: Annotated[Duration, AfterValidator(_boot_time)] = key(
        "How long its board needs after it was plugged in and its port is opened, at most 10 s: boards that "
        "reset then.",
        "2 s",
        0,
    )

    @property
    def assumed_latency(self) -> int:
        """Latency that it adds to each request, ns: as given, else by its kind, else an FTDI's default."""
        if self.kind is None or "latency" in self.model_fields_set:
            return self.latency
        return _LEAST_LATENCY_NS[self.kind]


class BusSimulation(Form):
    """Properties of a simulated bus itself, without its servos; a bus on a real port ignores them."""

    latency_timer: Annotated[Duration, AfterValidator(_timer)] = key(
        "How long the simulated adapter gathers bytes before it hands them over, at most 255 ms.", "4 ms", 0
    )
    split: Literal["whole", "byte", "random"] = key("In which pieces it hands them over.", "byte", "whole")
    echo: bool = key("The host hears its own bytes, as on some adapters.", "true", False)
    absent: Literal["silent", "slot"] = key(
        "In a sync or bulk read, the servos behind an absent one are silent, or wait its slot.",
        "slot",
        "silent",
    )


class SlowRegisters(Form):
    """Registers that are read periodically between the cycles."""

    items: Annotated[tuple[ItemName, ...], Field(strict=False)] | None = key(
        "Items by the names of the control table; without: temperature and voltage.",
        "[present_temperature]",
        None,
    )
    rate: Rate = key("How often each of them is read, Hz.", "1", 1.0, ge=0.1, le=100)


class Bus(Form):
    """One serial line with its servos."""

    port: str = key("Device of the adapter, or sim.", "/dev/ttyUSB0", min_length=1)
    protocol: Annotated[float, AfterValidator(_protocol)] = Field(
        description="Protocol of all servos on the bus.",
        examples=["1.0"],
        json_schema_extra={"enum": [1.0, 2.0]},
    )
    baud_rate: int = key("Bits per second.", "1_000_000", gt=0, le=HIGHEST_BAUD_RATE)
    adapter: Adapter = key("The adapter.", "{latency: 1 ms}", Adapter())
    return_delay_time: Duration = key("How long a servo waits before it answers.", "500 us", 500_000)
    bus_watchdog: AutoDuration = key(
        "A servo of Protocol 2.0 stops after this time without instructions, 2.54 s at most; 0 ms: never; "
        "auto: 200 ms, more below 15 Hz.",
        "200 ms",
        "auto",
    )
    slow_registers: SlowRegisters = key(
        "What is read now and then, between the cycles.", "{rate: 2}", SlowRegisters()
    )
    simulation: BusSimulation = key(
        "What the bus does when it is simulated.", "{latency_timer: 4 ms}", BusSimulation()
    )

    @property
    def latency_timer(self) -> int:
        """Time for which the simulated adapter gathers bytes, ns: as given, else that of an FTDI, or 0."""
        if "latency_timer" in self.simulation.model_fields_set or self.adapter.kind != "ftdi":
            return self.simulation.latency_timer
        return self.adapter.assumed_latency

    @property
    def latency(self) -> int:
        """Latency that the adapter adds to each request, ns."""
        return self.latency_timer if self.port == SIMULATED else self.adapter.assumed_latency

    @property
    def highest_id(self) -> int:
        """Highest ID of servos and devices on the bus."""
        return _HIGHEST_ID_OF_PROTOCOL_2 if self.protocol == 2.0 else 253
