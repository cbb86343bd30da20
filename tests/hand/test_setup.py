"""`dxlrun setup` with a scripted hand that connects simulated servos, on virtual time; and finding a port."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
from tests.kit.hands import HandLine, Script, interrupt, written

from dxlrun.description.reading import read_robot
from dxlrun.dynamixel.tools.one_servo import OneServo
from dxlrun.errors import InputError, PortError
from dxlrun_hand.commands.setup import set_up
from dxlrun_hand.lines import find_port
from dxlrun_hand.servo_setup import ServoSetup
from dxlsim.simulation_plan import ServoConfig
from dxlsim.virtual_ports import VirtualPorts

ROBOT = """\
name: arm
arguments: {at: {default: /dev/null, help: port}}
buses:
  main: {port: "${at}", protocol: 2.0, baud_rate: 1000000, return_delay_time: 20 us, adapter: {latency: 0 s}}
loop: {rate: 20}
joint_defaults: {bus: main, reference: 0 deg, direction: 1}
groups: {hand: {joints: [wrist]}}
joints:
  elbow: {id: 5, model: XL430-W250, registers: {temperature_limit: 70}}
  wrist: {id: 1, model: XM430-W350, registers: {position_p_gain: 700}}
"""
NEW = (ServoConfig(1, "XL430-W250", math.radians(150)), ServoConfig(1, "XM430-W350", math.radians(200)))


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

    @property
    def writes(self) -> int:
        return sum(data[:4] == b"\xff\xff\xfd\x00" and data[7] == 3 for data in self.line.heard)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_new_servos_get_id_rate_and_registers_and_are_compared(bench: Bench) -> None:
    script = bench.do(
        ("Connect the servo for elbow (XL430-W250) alone to bus main", bench.connect(0)),
        ("Connect the servo for wrist (XM430-W350) alone to bus main", bench.connect(1)),
        ("Connect all servos of bus main", bench.connect(0, 1)),
    )
    assert bench.code == 0
    assert bench.servo(0) == (5, 3, 10, 70)
    assert bench.servo(1) == (1, 3, 10, 80)
    assert bench.line.bus.servos[1].registers["position_p_gain"] != 700  # RAM: each run writes it
    assert "elbow: has ID 5 (before: 1)" in script.text
    assert "Bus main: 2 servos match the robot file." in script.text
    again = Bench.do(
        bench,
        ("Connect the servo for elbow", bench.connect(0)),
        ("Connect the servo for wrist", "s"),
        ("Connect all", bench.connect(0, 1)),
    )
    assert "elbow: already matches the robot file" in again.text
    assert bench.code == 0


def refused(bench: Bench, connected: Callable[[], None], said: str) -> None:
    """Connect something for the elbow that is refused; nothing is written."""
    script = bench.do(
        ("for elbow", connected),
        ("for elbow", "s"),
        ("Connect all", bench.connect(0)),
        ("again?", ""),
        joints=("elbow",),
    )
    assert said in script.text, script.text
    assert bench.writes == 0
    assert bench.code == 1
    assert "elbow (ID 5 on bus main) does not answer at 1000000 bit/s" in script.text


def test_two_servos_at_once_are_refused(bench: Bench) -> None:
    bench.line.bus.servos[1].poke("id", 9)
    refused(bench, bench.connect(0, 1), "Several servos answer (ID 1 at 57600 bit/s, ID 9 at 57600 bit/s)")


def test_two_servos_at_two_rates_are_refused(bench: Bench) -> None:
    bench.line.bus.servos[1].poke("baud_rate", 3)
    refused(bench, bench.connect(0, 1), "Several servos answer (ID 1 at 1000000 bit/s, ID 1 at 57600 bit/s)")


def test_two_servos_of_one_id_are_refused(tmp_path: Path) -> None:
    bench = Bench(tmp_path, servos=(NEW[0], ServoConfig(1, "XL430-W250", math.radians(20))))
    refused(bench, bench.connect(0, 1), "Two servos with the same ID seem to answer (ID 1 at 57600")


def test_another_model_is_refused(bench: Bench) -> None:
    refused(
        bench,
        bench.connect(1),
        "ID 1 is XM430-W350, but elbow needs XL430-W250 in the robot file; connect",
    )


def test_no_servo_is_said_so(bench: Bench) -> None:
    refused(bench, bench.connect(), "No servo answers at /dev/null; check its power and its cable.")


def test_another_protocol_is_refused(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.line = HandLine(ServoConfig(1, "MX-64", 1.0), protocol=1.0, rate=57_600)
    bench.line.connect()
    script = bench.do(
        ("for elbow", bench.connect(0)), ("for elbow", "s"), ("all", ""), ("again", ""), joints=("elbow",)
    )
    assert "The servo uses Protocol 1.0, and bus main Protocol 2.0; connect another servo" in script.text


def test_a_servo_at_any_rate_is_found(bench: Bench) -> None:
    bench.line.bus.servos[0].poke("baud_rate", 4)
    script = bench.do(("for elbow", bench.connect(0)), ("all", ""), joints=("elbow",))
    assert "trying all others" in script.text
    assert (bench.code, bench.servo(0)) == (0, (5, 3, 10, 70))


def test_the_model_of_auto_is_that_of_the_servo(tmp_path: Path) -> None:
    bench = Bench(tmp_path, ROBOT.replace("XL430-W250", "auto"))
    script = bench.do(("for elbow (any model)", bench.connect(1)), ("all", ""), joints=("elbow",))
    assert (bench.code, bench.servo(1)) == (0, (5, 3, 10, 70))
    assert "the robot file." in script.text


def test_what_changed_again_is_found_at_the_end(bench: Bench) -> None:
    def spoiled() -> None:
        bench.line.bus.servos[0].poke("temperature_limit", 60)
        bench.line.bus.servos[0].poke("homing_offset", 5)

    script = bench.do(("for elbow", bench.connect(0)), ("all", spoiled), ("again?", "n"), joints=("elbow",))
    assert bench.code == 1
    assert "elbow (ID 5 on bus main) has Temperature Limit (31) = 60, not 70" in script.text
    assert "Homing Offset (20) = 5, and this value shifts every position" in script.text


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


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ([interrupt], "no servo was changed\n"),
        ([(0,), interrupt], "set up: elbow; no other servo was changed\n"),
        ([(0,), (1,), interrupt], "set up: elbow, wrist; no other servo was changed\n"),
    ],
)
def test_after_ctrl_c_it_is_said_what_was_done(
    bench: Bench, steps: list[object], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = [bench.connect(*step) if isinstance(step, tuple) else step for step in steps]
    with pytest.raises(KeyboardInterrupt):
        bench.do(*(("Connect", answer) for answer in answers))
    assert capsys.readouterr().err == said


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


@pytest.mark.parametrize(
    ("joints", "said"), [(("elbo",), "no joint elbo; did you mean elbow"), ((), "bus main is simulated")]
)
def test_wrong_input_is_refused_before_anything_is_done(
    tmp_path: Path, joints: tuple[str, ...], said: str
) -> None:
    bench = Bench(tmp_path, ROBOT if joints else ROBOT.replace('"${at}"', "sim"))
    with pytest.raises(InputError, match=said):
        bench.do(joints=joints)
    assert bench.line.heard == []


def test_a_group_means_its_joints_and_torque_goes_off(bench: Bench) -> None:
    bench.line.bus.servos[1].poke("torque_enable", 1)
    bench.do(("for wrist", bench.connect(1)), ("all", ""), joints=("hand",))
    assert bench.code == 0
    assert not bench.line.bus.servos[1].torque_on
    assert "wrist: is limp" in bench.script.text


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


def test_a_servo_of_another_robot_gets_the_settings_of_the_factory_that_no_run_starts_without(
    bench: Bench,
) -> None:
    wrist = bench.line.bus.servos[1]
    for name, value in (("secondary_shadow_id", 2), ("homing_offset", 9), ("pwm_limit", 500)):
        wrist.poke(name, value)
    script = bench.do(
        ("Connect the servo for wrist", bench.connect(1)),
        ("Connect all", bench.connect(1)),
        joints=("wrist",),
    )
    assert bench.code == 0, script.text
    names = ("secondary_shadow_id", "homing_offset", "pwm_limit")
    assert [wrist.registers[name] for name in names] == [255, 0, 500]
    assert "wrist: Secondary (Shadow) ID (12) was changed from 2 to 255" in script.text
    assert "wrist: ID 1 on bus main differs from the factory settings: PWM Limit (36) = 500" in script.text
