"""Interface of teleop's input devices: axes, dead-man's switch, and presses that trigger an action."""

from __future__ import annotations

from enum import Enum, auto, unique
from typing import NamedTuple, Protocol


@unique
class Press(Enum):
    """Action that a press of a key or button triggers once"""

    NEXT = auto()  # drive the next bank
    FASTER = auto()  # raise the speed factor
    SLOWER = auto()
    QUIT = auto()


class InputState(NamedTuple):
    """Input of a device at one time"""

    axes: tuple[float, ...]
    """Deflections, -1..1, in the order of `Source.axes`"""
    enabled: bool
    """True while the dead-man's switch is held. Otherwise the robot holds."""
    presses: frozenset[Press] = frozenset()
    """Actions triggered since the previous input"""


class InputSource(Protocol):
    """Input device: a keyboard, a gamepad, or a script"""

    axes: tuple[str, ...]
    """Label of each axis, with the positive direction first: `Q/A`"""
    help: str
    """Description of the dead-man's switch and of the other keys, for the screen"""

    def read_input(self, now: float) -> InputState:
        """Return the device's input at `now`, s of a monotonic clock, without waiting for a press.

        Raises:
            DxlrunError: The device is unplugged.
        """

    def close(self) -> None:
        """Release the device: close it, or restore the terminal."""
