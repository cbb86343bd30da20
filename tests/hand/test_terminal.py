"""The dialogues at a terminal: the commands of docs/how-to/by-hand.md, Ctrl-C, and what is not a terminal."""

import re
import shlex
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from tests.kit.hands import LiveRobot, Screen, plain, written
from tests.kit.pages import page_text

from dxlrun.description.motion import read_motion
from dxlrun_hand.dialogue import Dialogue

pytestmark = pytest.mark.long

PAGE = page_text("by-hand.md")
COMMANDS = re.findall(r"^    dxlrun (.+)$", PAGE, re.MULTILINE)
ROBOT = """\
name: arm
arguments: {port: {default: sim, help: port}}
buses:
  main: {port: "${port}", protocol: 2.0, baud_rate: 57600, adapter: {latency: 0 ms}}
loop: {rate: 50}
joints:
  elbow: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}  # the only one
controllers:
  arm: {type: joint_trajectory_controller, command_interface: position, joints: [elbow]}
"""


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return written(tmp_path, ROBOT)


def words(line: str, link: Path) -> list[str]:
    return shlex.split(line.replace("/tmp/line", str(link)))  # noqa: S108


def test_the_commands_of_the_page_lead_from_a_new_servo_to_a_motion(robot: Path, tmp_path: Path) -> None:
    simulate, setup, calibrate, teach = COMMANDS
    link = tmp_path / "line"
    assert words(simulate, link) == ["sim", "arm.yaml", "--link", str(link)]
    with LiveRobot(tmp_path, robot, runs=False) as servos:
        with Screen(tmp_path, *words(setup, link)) as screen:
            screen.sees("Connect the servo for elbow (XL430-W250) alone to bus main")
            screen.types("\n")
            screen.sees("already matches the robot file")
            screen.sees("Connect all servos")
            screen.types("\n")
            screen.sees("1 servo matches the robot file")
            assert screen.ended() == 0
        with Screen(tmp_path, *words(calibrate, link)) as screen:
            for question, turn in (
                ("hold the joints", 0),
                ("zero pose", -20),
                ("positive", -30),
                ("negative direction", 70),
            ):
                screen.sees(question)
                servos.turn(lambda: None, 0.3, id1=turn)
                screen.types("\n")
            screen.sees("Write this into arm.yaml?")
            screen.types("y\n")
            screen.sees("arm.yaml is written")
            assert screen.ended() == 0
        found = re.search(
            r"reference: (.*) deg, direction: -1, limits: \{position: \[(.*) deg, (.*) deg]}}",
            robot.read_text(),
        )
        assert found, robot.read_text()
        assert [float(word) for word in found.groups()] == pytest.approx([160, -40, 30], abs=0.3)
        assert robot.read_text().replace(found[0], "reference: 180 deg, direction: 1}") == ROBOT
        servos.turn(lambda: None, 0.3, id1=-40)
        servos.start()
        with Screen(tmp_path, *words(teach, link)) as screen:
            for question, answer in (
                ("Hold them", ""),
                ("0 taught", ""),
                ("1 taught", "s"),
                ("be switched on", ""),
                ("Play the", "y"),
            ):
                screen.sees(question)
                screen.types(f"{answer}\n")
            screen.sees("goal 1 of arm reached")
            assert screen.ended() == 0
    assert [part.controller for part in read_motion(tmp_path / "wave.yaml").motion.motions] == ["arm"]


@pytest.mark.parametrize("key", ["\x03", "\x04"])
def test_ctrl_c_and_the_end_of_input_leave_the_file_as_it_was(robot: Path, tmp_path: Path, key: str) -> None:
    with (
        LiveRobot(tmp_path, robot, runs=False),
        Screen(tmp_path, *words(COMMANDS[2], tmp_path / "line")) as screen,
    ):
        for question in ("hold the joints", "zero pose"):
            screen.sees(question)
            screen.types("\n")
        screen.sees("its servo is at 180 deg")  # the live line
        screen.types(key)
        assert screen.ended() == 130
        said = plain(screen.text).replace("\r", "").splitlines()
        assert said[-3:] == ["limp now: elbow", "arm.yaml is unchanged", "interrupted"]
    assert robot.read_text() == ROBOT


def test_what_was_typed_before_a_question_does_not_answer_it(robot: Path, tmp_path: Path) -> None:
    with (
        LiveRobot(tmp_path, robot, runs=False),
        Screen(tmp_path, *words(COMMANDS[1], tmp_path / "line")) as screen,
    ):
        screen.types("\n\n\n")
        screen.sees("(s: skip it)")
        screen.types("\x03")
        assert screen.ended() == 130
        assert "no servo was changed" in screen.text


def test_the_console_of_windows_is_read_key_by_key(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A key from before the question, then those of two answers, a function key among them, and Ctrl-C."""
    keys: list[str | None] = ["x", None, "s", "o", "\b", "\xe0", "H", "\r", *[None] * 3, "\r", None, "\x03"]

    def next_is_key() -> bool:
        return keys[0] is not None or bool(keys.pop(0))

    console = SimpleNamespace(kbhit=next_is_key, getwch=lambda: keys.pop(0))
    monkeypatch.setitem(sys.modules, "msvcrt", console)
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.setattr("dxlrun_hand.dialogue.LOOK_S", 0.0)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    dialogue = Dialogue("setup")
    assert dialogue.ask_question("Skip? ") == "s"
    assert dialogue.ask_while("Move it", lambda: "12 deg") == ""
    with pytest.raises(KeyboardInterrupt):
        dialogue.ask_question("And now? ")
    assert capsys.readouterr().out == "Skip? so\b \b\nMove it\n\r\x1b[K12 deg\nAnd now? \n"
