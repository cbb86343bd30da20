"""Input of a device: axes, dead-man's switch, and single presses."""

from __future__ import annotations

from enum import Enum, auto, unique
from typing import NamedTuple, Protocol


@unique
class Press(Enum):
    """Action that a press of a key or button triggers once"""

    NEXT = auto()  # drive the next controller
    FASTER = auto()
    SLOWER = auto()
    QUIT = auto()


class Given(NamedTuple):
    """Present input of a device"""

    axes: tuple[float, ...]
    """Deflections, -1..1, in the order of `Source.axes`"""
    enabled: bool
    """True while the dead-man's switch is held. Otherwise the robot holds."""
    presses: frozenset[Press] = frozenset()


class Source(Protocol):
    """Input device: a keyboard, a gamepad, or a script"""

    axes: tuple[str, ...]
    """Label of each axis, with the positive direction first: `Q/A`"""
    help: str
    """Description of the dead-man's switch and of the other keys, for the screen"""

    def read(self, now: float) -> Given:
        """Return the input at `now`, s of a monotonic clock, without waiting.

        Raises:
            DxlrunError: The device is unplugged.
        """

    def close(self) -> None:
        """Restore the device."""
