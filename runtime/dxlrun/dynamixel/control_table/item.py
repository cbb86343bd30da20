"""A control item: one integer in a servo's memory, its place and its meaning."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Access = Literal["R", "RW"]
Area = Literal["EEPROM", "RAM"]
Encoding = Literal["unsigned", "sign_magnitude", "twos_complement"]

SIGN_BIT = 10
"""Direction bit of sign-magnitude items: 0 counter-clockwise, 1 clockwise (e-Manual, Present Speed (38))."""


@dataclass(frozen=True, slots=True)
class ControlItem:
    """One control item: an integer of 1, 2 or 4 bytes, little-endian, and what it means."""

    name: str
    address: int
    size: int
    access: Access
    area: Area
    minimum: int
    """As the e-Manual gives it: of the integer on the wire, where a direction bit counts as a bit; with two's
    complement of the signed number."""
    maximum: int
    initial: int | None
    """Value of the integer on the wire after a factory reset or at power-up; None: the manual gives none."""
    encoding: Encoding
    unit: str
    """SI unit of `scale`; empty for flags, numbers and steps; `1` for a fraction of the maximum."""
    scale: float
    """SI units per tick."""
    page: str
    """Section of the manual's page of this model."""
    firmware: int = 0
    """First firmware version that has the item; 0: every one."""

    def encode(self, raw: int) -> bytes:
        """Return the bytes of a signed number of ticks; raises ValueError when they do not hold it."""
        wire = raw
        if self.encoding == "sign_magnitude":
            if abs(raw) >= 1 << SIGN_BIT:
                raise ValueError(f"{self.name}: {raw} does not fit into {SIGN_BIT} bits and a direction")
            wire = abs(raw) | (raw < 0) << SIGN_BIT
        try:
            return wire.to_bytes(self.size, "little", signed=self.encoding == "twos_complement")
        except OverflowError:
            raise ValueError(f"{self.name}: {raw} does not fit into {self.size} bytes") from None

    def decode(self, data: bytes | bytearray | memoryview) -> int:
        """Return the signed number of ticks; raises ValueError when `data` has not `size` bytes."""
        if len(data) != self.size:
            raise ValueError(f"{self.name}: {self.size} bytes are needed, {len(data)} were given")
        wire = int.from_bytes(data, "little", signed=self.encoding == "twos_complement")
        if self.encoding == "sign_magnitude":
            magnitude = wire & ((1 << SIGN_BIT) - 1)
            return -magnitude if wire >> SIGN_BIT & 1 else magnitude
        return wire

    @property
    def title(self) -> str:
        """The item as the e-Manual writes it: `Torque Enable (24)`."""
        small = {"id": "ID", "cw": "CW", "ccw": "CCW"}
        words = (small.get(word, word.capitalize()) for word in self.name.split("_"))
        return f"{' '.join(words)} ({self.address})"

    @property
    def signed(self) -> bool:
        """True when the integer on the wire is in two's complement, so that `minimum` may be below 0."""
        return self.encoding == "twos_complement"
