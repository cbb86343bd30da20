"""Gamepads and keyboards by evdev: axes, the dead-man's switch, what is pressed, and what is chosen."""

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dxlrun.errors import DxlrunError, InputError
from dxlrun_teleop import input_devices
from dxlrun_teleop.input_devices import EV_ABS, EV_KEY, Gamepad, KeyboardDevice, chosen, source_of
from dxlrun_teleop.source import Press

LEFT_SHOULDER, SOUTH, START, Q, D, LEFT, TAB, ESC = 0x136, 0x130, 0x13B, 16, 32, 105, 15, 1
STICK, TRIGGER = (0, -32768, 32767, 0, 128, 0), (0, 0, 255, 0, 0, 0)
XBOX = {0: STICK, 1: STICK, 2: TRIGGER, 3: STICK, 4: STICK, 5: TRIGGER, 16: (0, -1, 1), 17: (0, -1, 1)}


class Fake:
    """What evdev gives of a device; `gone` is raised by everything."""

    def __init__(self, path: str = "/dev/input/event3", keys: Any = (), axes: Any = None) -> None:
        self.path, self.name = path, "Pad"
        self.keys, self.axes = {*keys}, dict(axes or {})
        self.down: set[int] = set()
        self.gone: BaseException | None = None
        self.grabbed = self.closed = False

    def capabilities(self, *, absinfo: bool) -> dict[int, list[int]]:
        return {EV_KEY: sorted(self.keys), EV_ABS: sorted(self.axes)}

    def active_keys(self) -> list[int]:
        if self.gone is not None:
            raise self.gone
        return sorted(self.down)

    def absinfo(self, axis_num: int) -> Any:
        return self.axes[axis_num]

    def turn(self, axis: int, value: int) -> None:
        self.axes[axis] = (value, *self.axes[axis][1:])

    def grab(self) -> None:
        self.grabbed = True

    def close(self) -> None:
        self.closed = True


def pad(path: str = "/dev/input/event3", axes: Any = None) -> Fake:
    return Fake(path, {LEFT_SHOULDER, SOUTH, START}, axes or XBOX)


def keyboard(path: str = "/dev/input/event5") -> Fake:
    return Fake(path, range(1, 120))


def test_a_gamepad_moves_its_axes_and_is_enabled_by_a_shoulder_button():
    device = pad()
    source = Gamepad(device)
    assert source.axes[:4] == (
        "left stick up/down",
        "left stick left/right",
        "right stick up/down",
        "right stick left/right",
    )
    assert len(source.axes) == 6
    assert source.read_input(0.0) == ((0.0,) * 6, False, frozenset())
    device.turn(1, -32768)  # up
    device.turn(0, 16384)  # half to the right
    device.turn(4, 2000)  # not quite in its middle
    device.turn(16, -1)
    device.down = {LEFT_SHOULDER}
    axes, enabled, presses = source.read_input(0.02)
    assert axes == (1.0, pytest.approx(-0.444, abs=1e-3), 0.0, 0.0, 0.0, 1.0)
    assert (enabled, presses) == (True, frozenset())
    device.down = set()
    assert not source.read_input(0.04).enabled


def test_what_is_pressed_counts_once_and_not_when_it_was_down_before():
    device = pad()
    device.down = {SOUTH}
    source = Gamepad(device)
    pressed = []
    for down in ({SOUTH}, set(), {SOUTH}, {SOUTH}, {START}):
        device.down = down
        pressed.append(source.read_input(0.0).presses)
    assert pressed == [set(), set(), {Press.NEXT}, set(), {Press.QUIT}]


@pytest.mark.parametrize("middle", [True, False])
def test_the_right_stick_of_some_is_where_others_have_triggers(middle):
    at = 128 if middle else 0
    axes = dict.fromkeys((0, 1), (128, 0, 255)) | dict.fromkeys((2, 5), (at, 0, 255))
    assert len(Gamepad(pad(axes=axes)).axes) == (4 if middle else 2)


@pytest.mark.parametrize("error", [OSError(19, "No such device"), SystemError("returned NULL")])
def test_a_gamepad_that_is_unplugged_is_gone(error):
    device = pad()
    source = Gamepad(device)
    device.gone = error
    with pytest.raises(DxlrunError, match=r"^Pad \(/dev/input/event3\) was unplugged, and the robot holds"):
        source.read_input(0.0)
    source.close()
    assert device.closed


def test_a_keyboard_of_its_own_is_taken_when_its_keys_are_up_and_reports_releases():
    device = keyboard()
    device.down = {28, Q}  # Enter, which began the command
    source = KeyboardDevice(device)
    assert source.read_input(0.0) == ((0.0,) * 8, False, frozenset())
    assert not device.grabbed
    device.down = set()
    source.read_input(0.02)
    assert device.grabbed
    device.down = {Q, D}
    assert source.read_input(0.04) == ((1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 0.0), True, frozenset())
    device.down = {LEFT, TAB}
    assert source.read_input(0.06) == ((0.0, 1.0, *[0.0] * 6), True, frozenset({Press.NEXT}))
    device.down = {ESC}
    assert source.read_input(0.08) == ((0.0,) * 8, False, frozenset({Press.QUIT}))


def test_a_mouse_is_neither():
    assert source_of(Fake(keys={0x110, 0x111})) is None
    assert source_of(Fake(keys={LEFT_SHOULDER})) is None  # no stick
    assert source_of(Fake(axes=XBOX)) is None  # no dead-man's switch


@pytest.fixture
def plugged_in(monkeypatch):
    """Let these be the input devices; None is one that this user may not open."""

    def plug(*found: Fake | None) -> list[Fake]:
        named = {one.path if one else f"/dev/input/event9{at}": one for at, one in enumerate(found)}

        def opened(path: str) -> Fake:
            if (one := named[path]) is None:
                raise PermissionError(path)
            return one

        monkeypatch.setitem(sys.modules, "evdev", SimpleNamespace(InputDevice=opened))
        monkeypatch.setattr(input_devices, "glob", lambda pattern: list(named))
        return [one for one in found if one]

    return plug


@pytest.mark.parametrize("path", [None, "/dev/input/event5"])
def test_the_only_gamepad_or_a_path_is_chosen_and_all_others_are_closed(plugged_in, path):
    mouse, board, device = plugged_in(Fake("/dev/input/event1"), keyboard(), pad(), None)
    assert type(chosen(path)) is (KeyboardDevice if path else Gamepad)
    assert (mouse.closed, board.closed, device.closed) == (True, not path, bool(path))


@pytest.mark.parametrize(
    ("path", "pads", "said"),
    [
        (None, 0, "no readable gamepad found; gamepads and keyboards: none"),
        (None, 2, "several gamepads found; choose one with --device; gamepads and keyboards:\n  /dev/in"),
        ("/dev/input/event1", 1, "/dev/input/event1 is not a readable gamepad or keyboard; gamepads"),
        ("pad", 1, "pad is not a readable gamepad or keyboard; gamepads and keyboards:\n  /dev/input/e"),
    ],
)
def test_what_cannot_be_chosen_is_refused_with_what_there_is(plugged_in, path, pads, said):
    found = plugged_in(Fake("/dev/input/event1"), *(pad(f"/dev/input/event{at + 2}") for at in range(pads)))
    with pytest.raises(InputError) as refused:
        chosen(path)
    assert str(refused.value).startswith(said)
    assert all(one.closed for one in found)


def test_a_user_who_may_not_open_them_is_given_the_way(plugged_in):
    plugged_in(None)
    with pytest.raises(InputError, match=r"allow more with `sudo usermod -aG input \$USER` and a new log-in"):
        chosen(None)


def test_without_evdev_the_pip_line_is_given(monkeypatch):
    monkeypatch.setitem(sys.modules, "evdev", None)
    with pytest.raises(
        InputError, match=r"needs evdev \(not installed\); install it: `pip install 'dxlrun\[teleop\]'`"
    ):
        chosen(None)


def test_a_real_gamepad_of_the_kernel_is_read_and_gone():
    evdev = pytest.importorskip("evdev", reason="the extra teleop is not installed")
    if not Path("/dev/uinput").exists():
        pytest.skip("no /dev/uinput: this kernel makes no virtual input devices")
    stick = evdev.AbsInfo(0, -100, 100, 0, 0, 0)
    events = {EV_KEY: [LEFT_SHOULDER, SOUTH], EV_ABS: [(0, stick), (1, stick)]}
    with evdev.UInput(events, name="virtual pad") as virtual:
        source = Gamepad(evdev.InputDevice(virtual.device.path))
        virtual.write(EV_ABS, 1, -100)
        virtual.write(EV_KEY, LEFT_SHOULDER, 1)
        virtual.syn()
        assert source.read_input(0.0) == ((1.0, 0.0), True, frozenset())
    with pytest.raises(DxlrunError, match="was unplugged"):
        source.read_input(0.02)
