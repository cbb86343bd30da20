"""Bus: the form of one entry under `buses` of a robot file, a serial line."""

import re
import sys
from collections.abc import Mapping
from types import MappingProxyType
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field

from dxlrun.description.base_form import Form, ItemName, key, validation_error
from dxlrun.description.units import AutoDuration, Duration, Rate
from dxlwire.bus_plan import SIMULATED

HIGHEST_BAUD_RATE = 10_500_000
"""Highest baud rate of any servo, bit/s: that of PRO, P and Y."""
_HIGHEST_ID_OF_PROTOCOL_2 = 252  # 0xFD is in the header of each packet (e-Manual, Protocol 2.0, Packet ID)
_LONGEST_TIMER_NS = 255_000_000  # The latency timer of an FTDI chip is one byte, ms (FTDI AN232B-04)

_LONGEST_BOOT_NS = 10_000_000_000


def _protocol(value: float) -> float:
    if value not in (1.0, 2.0):
        raise validation_error(f"Protocol {value:g} does not exist", "write 1.0 or 2.0")
    return value


def _timer(value: int) -> int:
    if value > _LONGEST_TIMER_NS:
        raise validation_error("an adapter buffers bytes for 255 ms at most", "write 255 ms or less")
    return value


def _boot_time(value: int) -> int:
    if value > _LONGEST_BOOT_NS:
        raise validation_error("the boot time of a board is 10 s at most", "write 10 s or less")
    return value


_LEAST_LATENCY_NS: Mapping[str, int] = MappingProxyType({"ftdi": 1_000_000, "direct": 0})
"""Latency of each kind of adapter, ns, if the file gives none (protocol.md, Time budget)."""


def _port(value: str) -> str:
    if sys.platform == "linux" and re.fullmatch(r"COM\d+", value):
        raise validation_error(f"{value} is a port of Windows", "write for example /dev/ttyUSB0, or sim")
    if value.lower() in ("simulated", "simulation", "simulator", "mock", "fake"):
        raise validation_error(f"{value} is not a port", "write sim for simulated servos")
    return value


_KINDS: Mapping[str, str] = MappingProxyType(
    {"u2d2": "ftdi", "usb2dynamixel": "ftdi", "openrb_150": "direct", "opencr": "direct", "uart": "direct"}
)
"""Kind of each adapter whose name is often written instead; the boards have USB-CDC."""


def _kind(value: object) -> object:
    if isinstance(value, str) and (kind := _KINDS.get(value.lower().replace("-", "_"))):
        raise validation_error(f"{value} is an adapter of the kind {kind}", f"write `kind: {kind}`")
    return value


class Adapter(Form):
    """Form of `adapter` of a bus: the USB or UART adapter between computer and servos."""

    kind: Annotated[Literal["ftdi", "direct"] | None, BeforeValidator(_kind)] = key(
        "Kind of adapter: with an FTDI chip and a latency timer of 1 ms (ftdi), or without a latency "
        "timer (direct).",
        "direct",
        None,
    )
    latency: Duration = key(
        "Longest time for which the adapter buffers bytes; 1 ms by default with `kind: ftdi`, 0 ms "
        "with `kind: direct`.",
        "1 ms",
        16_000_000,
    )
    rs485: bool = key(
        "Direction switching by the kernel (TIOCSRS485), for an RS-485 transceiver on a UART.",
        "true",
        False,
    )
    boot_time: Annotated[Duration, AfterValidator(_boot_time)] = key(
        "Boot time, at most 10 s, of a board that resets the first time its port is opened.",
        "2 s",
        0,
    )

    @property
    def assumed_latency(self) -> int:
        """Delay that the adapter adds to each reply, ns: as in the file, else that of its kind, or 16 ms."""
        if self.kind is None or "latency" in self.model_fields_set:
            return self.latency
        return _LEAST_LATENCY_NS[self.kind]


class BusSimulation(Form):
    """Form of `simulation` of a bus: how the simulated line and adapter behave; real ports ignore it."""

    latency_timer: Annotated[Duration, AfterValidator(_timer)] = key(
        "Latency timer of the simulated adapter, at most 255 ms; with `adapter: {kind: ftdi}`, the "
        "adapter's latency by default.",
        "4 ms",
        0,
    )
    split: Literal["whole", "byte", "random"] = key(
        "Pieces in which the simulated adapter delivers bytes: all at once (whole), one by one "
        "(byte), or 1 to 8 at a time (random).",
        "byte",
        "whole",
    )
    echo: bool = key("Echo of the host's own bytes, as with some adapters.", "true", False)
    absent: Literal["silent", "slot"] = key(
        "Reply of servos after a missing one in a sync or bulk read: none (silent), or as soon as its time "
        "slot is over (slot, Protocol 2.0 only).",
        "slot",
        "silent",
    )


class SlowRegisters(Form):
    """Form of `slow_registers` of a bus: which registers are read between cycles, and how often."""

    items: Annotated[tuple[ItemName, ...], Field(strict=False)] | None = key(
        "Items to read, named as in the control table; temperature and voltage by default.",
        "[present_temperature]",
        None,
    )
    rate: Rate = key("Readings of each item per second, Hz.", "1", 1.0, ge=0.1, le=100)


class Bus(Form):
    """Form of one bus: a serial line with its port, baud rate, adapter and protocol."""

    port: Annotated[str, AfterValidator(_port)] = key(
        "Serial device of the adapter, or sim for a simulated bus.", "/dev/ttyUSB0", min_length=1
    )
    protocol: Annotated[float, AfterValidator(_protocol)] = Field(
        description="Protocol of all servos on the bus.",
        examples=["1.0"],
        json_schema_extra={"enum": [1.0, 2.0]},
    )
    baud_rate: int = key("Baud rate, bit/s.", "1_000_000", gt=0, le=HIGHEST_BAUD_RATE)
    adapter: Adapter = key("Properties of the adapter.", "{kind: ftdi}", Adapter.of_defaults())
    return_delay_time: Duration = key(
        "Delay before a servo's reply, as in its item Return Delay Time.", "500 us", 500_000
    )
    bus_watchdog: AutoDuration = key(
        "Bus Watchdog of Protocol 2.0 servos: time without instructions after which they stop, at "
        "most 2.54 s. 0 ms disables it; auto is 200 ms, or three periods of a loop below 15 Hz.",
        "200 ms",
        "auto",
    )
    slow_registers: SlowRegisters = key(
        "Registers that are read periodically between the cycles.", "{rate: 2}", SlowRegisters.of_defaults()
    )
    simulation: BusSimulation = key(
        "Properties of the simulated bus; a bus on a real port ignores them.",
        "{latency_timer: 4 ms}",
        BusSimulation.of_defaults(),
    )

    @property
    def latency_timer(self) -> int:
        """Time for which the simulated adapter collects bytes, ns: as in the file, or that of its kind."""
        if "latency_timer" in self.simulation.model_fields_set or self.adapter.kind != "ftdi":
            return self.simulation.latency_timer
        return self.adapter.assumed_latency

    @property
    def latency(self) -> int:
        """Delay that the (real or simulated) adapter adds to each reply, ns."""
        return self.latency_timer if self.port == SIMULATED else self.adapter.assumed_latency

    @property
    def highest_id(self) -> int:
        """Highest ID that a servo or device can have in the bus's protocol."""
        return _HIGHEST_ID_OF_PROTOCOL_2 if self.protocol == 2.0 else 253
