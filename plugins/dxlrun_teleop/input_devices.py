"""Gamepads and keyboards as Linux input devices, which also report releases of keys (extra `teleop`: evdev).

Codes are those of linux/input-event-codes.h. The layout of a gamepad is that of the kernel's
Documentation/input/gamepad.rst. The state of a device is polled, so that a lost event has no effect.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from glob import glob
from typing import TYPE_CHECKING

from dxlrun import DxlrunError, InputError
from dxlrun.tooling.verbs import missing_extra
from dxlrun_teleop.keyboard import AXES
from dxlrun_teleop.source import InputState, Press

if TYPE_CHECKING:
    from evdev import InputDevice

EV_KEY, EV_ABS = 1, 3
SHOULDERS = frozenset((0x136, 0x137))
"""BTN_TL and BTN_TR, the dead-man's switch of a gamepad"""
BUTTONS: Mapping[int, Press] = {0x130: Press.NEXT, 0x13B: Press.QUIT}
"""Actions of a gamepad's buttons: BTN_SOUTH, BTN_START"""
_STICKS = "left stick", "right stick", "right stick", "pad"
STICKS: Mapping[int, str] = {  # ABS_Y, _X, _RY, _RX (on some gamepads _RZ, _Z), _HAT0Y, _HAT0X
    code: f"{_STICKS[at // 2]} {('up/down', 'left/right')[at % 2]}"
    for at, code in enumerate((1, 0, 4, 3, 5, 2, 17, 16))
}
DEAD_ZONE = 0.1
"""Deflection below which a stick counts as released. The rest of its range is scaled to the whole axis."""
KEYS: Mapping[int, Press] = {15: Press.NEXT, 13: Press.FASTER, 12: Press.SLOWER, 1: Press.QUIT}
"""Actions of a keyboard's keys: KEY_TAB, KEY_EQUAL, KEY_MINUS, KEY_ESC"""
SIDES: Mapping[int, tuple[int, float]] = {
    first + axis: (axis, side) for first, side in ((16, 1.0), (30, -1.0)) for axis in range(8)
} | {103: (0, 1.0), 108: (0, -1.0), 105: (1, 1.0), 106: (1, -1.0)}
"""Axis (index) and direction (1 or -1) of each key that moves: eight keys from KEY_Q and from KEY_A on (by
position, whatever the layout), and the arrows"""


class Gamepad:
    """Gamepad with sticks and a directional pad. A shoulder button is the dead-man's switch."""

    help = "hold a shoulder button to move; A: next controller; Start: end"
    pressing = BUTTONS

    def __init__(self, device: InputDevice[str]) -> None:
        # A button that is held at the start does not count as pressed.
        self._device, self._held = device, frozenset({*BUTTONS, *KEYS})
        codes = {*device.capabilities(absinfo=False).get(EV_ABS, ())}
        # With ABS_RX, ABS_Z and ABS_RZ are triggers. Otherwise they are the right stick, unless they are
        # deflected at rest, as only triggers are.
        codes -= {5, 2} if 3 in codes else {code for code in codes & {5, 2} if self._axis(code)}
        self._codes = tuple(code for code in STICKS if code in codes)
        self.axes = tuple(STICKS[code] for code in self._codes)

    def read_input(self, now: float) -> InputState:
        """Read the present deflections, the dead-man's switch, and buttons pressed since the last call.

        Raises DxlrunError if the device is unplugged.
        """
        try:
            held = frozenset(self._device.active_keys())
            axes, enabled = self._driven(held)
        except (OSError, SystemError) as error:
            name = f"{self._device.name} ({self._device.path})"
            raise DxlrunError(
                f"{name} was unplugged, and the robot holds; plug it in, and start again"
            ) from error
        fresh, self._held = held - self._held, held
        return InputState(
            axes, enabled, frozenset(self.pressing[key] for key in fresh & self.pressing.keys())
        )

    def _driven(self, held: frozenset[int]) -> tuple[tuple[float, ...], bool]:
        return tuple(map(self._axis, self._codes)), not SHOULDERS.isdisjoint(held)

    def _axis(self, code: int) -> float:
        """Return the deflection of a stick's axis, -1..1, 0 in its dead zone. Up and left are positive."""
        value, lowest, highest = self._device.absinfo(code)[:3]
        way: float = (lowest + highest - 2 * value) / ((highest - lowest) or 1)
        beyond = min(max(0.0, abs(way) - DEAD_ZONE) / (1.0 - DEAD_ZONE), 1.0)
        return beyond if way > 0 else -beyond

    def close(self) -> None:
        """Close the input device, which ends the exclusive use of a keyboard."""
        self._device.close()


class KeyboardDevice(Gamepad):
    """Keyboard that is grabbed for exclusive use. Each key is its own dead-man's switch.

    The keyboard is grabbed once all keys are released. Otherwise another program would miss a release.
    """

    help = "hold a key to move; Tab: next controller; = -: speed; Esc: end"
    pressing = KEYS

    def __init__(self, device: InputDevice[str]) -> None:
        super().__init__(device)
        self.axes, self._taken = AXES, False

    def _driven(self, held: frozenset[int]) -> tuple[tuple[float, ...], bool]:
        if not self._taken and not held:
            self._device.grab()
            self._taken = True
        axes = [0.0] * len(AXES)
        for axis, side in (SIDES[code] for code in held & SIDES.keys() if self._taken):
            axes[axis] += side
        return tuple(axes), any(axes)


def source_of(device: InputDevice[str]) -> Gamepad | None:
    """Return the source for a Linux input device: Gamepad or KeyboardDevice, or None if it is neither."""
    codes = {kind: set(found) for kind, found in device.capabilities(absinfo=False).items()}
    keys = codes.get(EV_KEY, set())
    if codes.get(EV_ABS, set()) >= {0, 1} and not SHOULDERS.isdisjoint(keys):
        return Gamepad(device)
    return KeyboardDevice(device) if keys >= SIDES.keys() else None


def chosen(path: str | None) -> Gamepad:
    """Open the gamepad or keyboard at `path`, or the only gamepad if `path` is None.

    Raises:
        InputError: The device was not found, or there are several gamepads. The message lists them.
    """
    try:
        from evdev import InputDevice
    except ImportError as error:
        raise InputError(missing_extra("a gamepad", "teleop", "evdev") or str(error)) from error
    devices: list[InputDevice[str]] = []
    paths = sorted(glob("/dev/input/event*"))
    for each in paths:
        with suppress(OSError):  # devices for which this user lacks the permission
            devices.append(InputDevice(each))
    able = {device.path: source for device in devices if (source := source_of(device)) is not None}
    pads = [each for each, source in able.items() if type(source) is Gamepad]
    wanted = [path] if path else pads
    source = able.get(wanted[0]) if len(wanted) == 1 else None
    for device in devices:
        if source is None or device.path != wanted[0]:
            device.close()
    if source is not None:
        return source
    what = f"{path} is not a readable gamepad or keyboard" if path else "no readable gamepad found"
    what = "several gamepads found; choose one with --device" if pads and not path else what
    more = "; allow more with `sudo usermod -aG input $USER` and a new log-in"
    hint = more if len(devices) < len(paths) else ""
    listed = "".join(f"\n  {device.path}  {device.name}" for device in devices if device.path in able)
    raise InputError(f"{what}{hint}; gamepads and keyboards:{listed or ' none'}")
