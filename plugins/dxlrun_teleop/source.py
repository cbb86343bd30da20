"""What a hand does at a device: axes, the dead-man's switch, and what is pressed once."""

from __future__ import annotations

from enum import Enum, auto, unique
from typing import NamedTuple, Protocol


@unique
class Press(Enum):
    """What happens once when a key or a button goes down."""

    NEXT = auto()  # drive the next controller
    FASTER = auto()
    SLOWER = auto()
    QUIT = auto()


class Given(NamedTuple):
    """What a device is given now."""

    axes: tuple[float, ...]
    """-1 to 1, in the order of `Source.axes`"""
    enabled: bool
    """True while the dead-man's switch is held: else the robot holds."""
    presses: frozenset[Press] = frozenset()


class Source(Protocol):
    """A keyboard, a gamepad, a script."""

    axes: tuple[str, ...]
    """What moves each axis, its positive side first: `Q/A`."""
    help: str
    """What the dead-man's switch is, and what else there is to press."""

    def read(self, now: float) -> Given:
        """Return what the device is given at `now`, s of a monotonic clock; never waits.

        Raises DxlrunError when the device is gone.
        """

    def close(self) -> None:
        """Leave the device as it was."""
