"""Dialogues with a scripted hand on simulated servos and virtual time, most of them texts; finding a port."""

import math
import os
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from tests.kit.cases import TextCase, case_parameters, read_head
from tests.kit.dialogues import Dialogue, check_dialogue
from tests.kit.hands import HandLine, Script, interrupt, written

from dxlrun.description.reading import read_robot
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.dynamixel.tools.tool_port import TunablePort
from dxlrun.errors import PortError
from dxlrun_hand.commands.setup import set_up
from dxlrun_hand.lines import find_port
from dxlrun_hand.servo_setup import ServoSetup
from dxlsim.simulation_plan import ServoConfig
from dxlsim.virtual_ports import VirtualPorts
from dxlwire.port.serial_open import open_serial

DIALOGUES = Path(__file__).with_name("dialogues")
ROBOT = read_head(DIALOGUES / "setup.txt").partition("----\n")[0]
NEW = (ServoConfig(1, "XL430-W250", math.radians(150)), ServoConfig(1, "XM430-W350", math.radians(200)))


@pytest.mark.parametrize("told", case_parameters(DIALOGUES))
def test_dialogue(tmp_path: Path, capsys: pytest.CaptureFixture[str], told: TextCase) -> None:
    check_dialogue(tmp_path, told, lambda: capsys.readouterr().err)


def test_a_port_that_another_program_has_is_refused(tmp_path: Path) -> None:
    robot, servos = read_head(DIALOGUES / "calibrate.txt").split("----\n")
    master, slave = os.openpty()
    case = Dialogue(tmp_path, robot.replace("/dev/null", os.ttyname(slave)), servos, ["run calibrate"])
    held = open_serial(os.ttyname(slave), 57600)
    try:
        case.line.open = TunablePort
        case.perform()
    finally:
        held.close()
        os.close(master)
        os.close(slave)
    assert "is in use by" in case.error
    assert case.path.read_bytes() == case.before


class Bench:
    """New servos on a table, of which a hand connects some."""

    def __init__(self, directory: Path, text: str = ROBOT, servos: tuple[ServoConfig, ...] = NEW) -> None:
        self.path = written(directory, text)
        self.line = HandLine(*servos)
        self.line.connect()

    def connect(self, *indices: int) -> Callable[[], None]:
        return lambda: self.line.connect(*indices)

    def do(
        self,
        *steps: tuple[str, str | Callable[..., str | None]],
        joints: tuple[str, ...] = (),
        search: bool = False,
    ) -> Script:
        self.script = Script(*steps)
        task = ServoSetup(read_robot(self.path, {}), self.script)
        devices = self.devices if hasattr(self, "devices") else tuple
        self.code = set_up(task, self.line.open, devices, joints, search=search)
        assert not self.script.steps, self.script.steps
        return self.script

    def servo(self, index: int) -> tuple[int, ...]:
        """Return ID, rate's number, return delay and temperature limit."""
        names = ("id", "baud_rate", "return_delay_time", "temperature_limit")
        return tuple(self.line.bus.servos[index].registers[name] for name in names)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_servo_that_dies_in_the_middle_is_set_up_again(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    change_id = OneServo.change_id

    def dying(one: OneServo, new: int) -> str:
        bench.line.connect()
        monkeypatch.undo()
        return change_id(one, new)

    monkeypatch.setattr(OneServo, "change_id", dying)
    script = bench.do(
        ("for elbow", bench.connect(0)), ("for elbow", bench.connect(0)), ("all", ""), joints=("elbow",)
    )
    assert (bench.code, bench.servo(0)) == (0, (5, 3, 10, 70))
    assert "XL430-W250, ID 1 at 1000000 bit/s: did not answer" in script.text


def test_ctrl_c_while_a_servo_is_written_to_is_said_so(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(OneServo, "change_id", interrupt)
    with pytest.raises(KeyboardInterrupt):
        bench.do(("for elbow", bench.connect(0)))
    assert "the servo of elbow may have its new ID or rate already; set it up" in capsys.readouterr().err


def test_each_servo_opens_the_port_again_as_a_board_on_usb_drops_out(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Plugging in a servo resets the board that powers it: the port goes, and is there again later."""
    line, opened = bench.line, 0

    def open_again(path: str) -> object:
        nonlocal opened
        opened += 1
        if not line.bus.plugged:
            raise PortError(f"port {path} not found")
        line.ports = VirtualPorts(line.clock, [line.bus])
        return line

    def comes_back(index: int) -> None:
        line.bus.plug_in()
        line.connect(index)

    monkeypatch.setattr(line, "open", open_again)
    script = bench.do(
        ("for elbow", line.bus.unplug),
        ("for elbow", lambda: comes_back(0)),
        ("for wrist", lambda: (line.bus.unplug(), comes_back(1))[1]),
        ("Connect all servos of bus main", bench.connect(0, 1)),
    )
    assert (bench.code, opened) == (0, 5)  # when it begins, for each servo and once more, and at the end
    assert "port /dev/null not found" in script.text
    assert bench.servo(0) == (5, 3, 10, 70)


# The port


class Desk:
    """Adapters that are plugged in and out, as the system lists them: a lasting name, and a device."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory

    def plug(self, *numbers: int) -> Callable[..., str]:
        """Return what makes these adapters those that are plugged in, and looks at what is shown then."""

        def change(look: Callable[[], str] = str) -> str:
            for path in self.directory.glob("*-*"):
                path.unlink()
            for number in numbers:
                (self.directory / f"b-tty{number}").touch()
                (self.directory / f"a-id{number}").symlink_to(self.directory / f"b-tty{number}")
            self.shown = look()
            return ""

        return change

    def __call__(self) -> Iterable[str]:
        return sorted(str(path) for path in self.directory.glob("*-*"))


@pytest.fixture
def desk(tmp_path: Path) -> Desk:
    return Desk(tmp_path)


def found(desk: Desk, *steps: tuple[Callable[..., str], Callable[..., str]]) -> tuple[str, Script]:
    script = Script(
        *(one for out, back in steps for one in (("Unplug the adapter of bus main", out), ("Plug it", back)))
    )
    return find_port("main", script, desk), script


def test_the_adapter_that_comes_back_is_the_one(desk: Desk) -> None:
    desk.plug(1, 2)()
    path, script = found(desk, (desk.plug(2), desk.plug(1, 2)))
    assert path == str(desk.directory / "a-id1")  # its lasting name
    assert f"Bus main is at {path}." in script.said
    assert desk.shown == f"  {path}, {desk.directory / 'b-tty1'}"


def test_an_adapter_that_was_not_there_before_is_found_too(desk: Desk) -> None:
    assert found(desk, (desk.plug(), desk.plug(3)))[0].endswith("a-id3")


def test_none_and_several_are_asked_for_again(desk: Desk) -> None:
    path, script = found(
        desk, (desk.plug(1), desk.plug(1)), (desk.plug(), desk.plug(1, 2)), (desk.plug(2), desk.plug(1, 2))
    )
    assert path.endswith("a-id1")
    assert "No adapter appeared" in script.text
    assert "2 adapters appeared" in script.text
    with pytest.raises(PortError, match="the adapter of bus main was not found"):
        found(desk, *[(desk.plug(1), desk.plug(1))] * 3)
    assert desk.shown == "  no port yet"


def test_a_port_that_is_not_there_is_looked_for(bench: Bench, desk: Desk) -> None:
    bench.path.write_text(
        ROBOT.replace('"${at}"', f"{desk.directory}/none  ").replace("return_delay_time: 20 us, ", "")
    )
    bench.devices = desk
    script = bench.do(
        ("Unplug", desk.plug()),
        ("Plug it in", desk.plug(7)),
        ("Write this into", "y"),
        ("for elbow", bench.connect(0)),
        ("all", ""),
        joints=("elbow",),
    )
    assert f"Bus main: port {desk.directory}/none not found." in script.said
    assert bench.line.name == str(desk.directory / "a-id7")
    assert f"port: {desk.directory}/a-id7  , protocol" in bench.path.read_text()


def test_a_port_of_an_argument_is_told(bench: Bench, desk: Desk) -> None:
    bench.devices = desk
    steps = (
        ("Unplug", desk.plug()),
        ("Plug it in", desk.plug(7)),
        ("for elbow", bench.connect(0)),
        ("all", ""),
    )
    script = bench.do(*steps, joints=("elbow",), search=True)
    assert f"as an argument: {desk.directory}/a-id7" in script.text
    assert bench.path.read_text() == ROBOT
