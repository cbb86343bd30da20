"""`dxlrun calibrate` with a scripted hand, on simulated servos and virtual time."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.kit.hands import HandLine, Script, interrupt, written

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.dynamixel.tools.tool_line import TunablePort
from dxlrun.errors import InputError, PortError, ServoFault
from dxlrun_hand.commands.calibrate import calibrated
from dxlsim.simulation_plan import ServoConfig
from dxlwire.port.serial_open import open_serial

ROBOT = """\
# an arm
name: arm
arguments: {zero: {default: 90 deg, help: where zero is}}
buses:
  main: {port: /dev/null, protocol: 2.0, baud_rate: 57600, adapter: {latency: 0 ms}}
loop: {rate: 20}
joints:
  elbow:   {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}  # 180 deg
  wrist:
    bus: main
    id: 2
    model: XL430-W250
    reference: 3.1 rad   # of the horn
    direction: -1
    limits: {position: [-1 rad,  0.5 rad], velocity: 1 rad/s}
  wheel: {bus: main, id: 3, model: XL430-W250, reference: 0 deg, direction: 1, continuous: true}
"""


class Arm:
    """The file, its servos, and a hand."""

    def __init__(self, directory: Path, text: str = ROBOT, *, at: tuple[float, ...] = (150, 200, 40)) -> None:
        self.path = written(directory, text)
        self.before = self.path.read_bytes()
        self.line = HandLine(
            *(ServoConfig(index + 1, "XL430-W250", math.radians(angle)) for index, angle in enumerate(at))
        )

    def move(self, servo_id: int, degrees: float, *more: float) -> Callable[..., None]:
        """Return what turns a servo, by one angle after the other."""

        def turn(look: Callable[[], object] = lambda: None) -> None:
            for each in (degrees, *more):
                self.line.turn(servo_id, each, look)

        return turn

    def do(self, *steps: tuple[str, str | Callable[..., str | None]], joints: tuple[str, ...] = ()) -> Script:
        """Calibrate by a script, which is used up then."""
        self.script = Script(*steps)
        result = compile_files(self.path, {}, [])
        self.code = calibrated(result, self.script, self.line.open, joints, ())
        assert not self.script.steps, self.script.steps
        return self.script


@pytest.fixture
def arm(tmp_path: Path) -> Arm:
    return Arm(tmp_path)


def test_reference_direction_and_limits_are_measured_and_nothing_else_changes(arm: Arm) -> None:
    def to_zero() -> None:
        arm.move(1, 20)()
        arm.move(2, -30)()

    script = arm.do(
        ("hold the joints", ""),
        ("zero pose: elbow, wrist, wheel", to_zero),
        ("Move elbow to its end in the positive direction", arm.move(1, -60)),
        ("Move elbow to its end in the negative direction", arm.move(1, 100)),
        ("Move wrist to its end in the positive", arm.move(2, 45)),
        ("Move wrist to its end in the negative", arm.move(2, -145)),
        ("Move wheel in its positive direction", arm.move(3, -90)),
        (f"Write this into {arm.path}?", "y"),
    )
    assert arm.code == 0
    assert not any(servo.torque_on for servo in arm.line.bus.servos)
    elbow = "direction: 1}  # 180"
    new_elbow = "direction: -1, limits: {position: [-40 deg, 60 deg]}}  # 180"
    text = arm.path.read_text()
    (found,) = [line for line in text.splitlines() if "elbow:" in line]
    assert "reference: 169.98 deg" in found
    lower, upper = (float(word) for word in found.split("[")[1].split("]")[0].replace("deg", "").split(","))
    assert (lower, upper) == (pytest.approx(-40, abs=0.2), pytest.approx(60, abs=0.2))
    assert lower > -40
    assert upper < 60
    expected = ROBOT.replace("reference: 180 deg", "reference: 169.98 deg").replace(elbow, new_elbow)
    expected = expected.replace("[-40 deg, 60 deg]", f"[{lower:g} deg, {upper:g} deg]")
    expected = expected.replace("reference: 3.1 rad", "reference: 2.9667 rad")
    expected = expected.replace("direction: -1\n", "direction: 1\n")
    expected = expected.replace("[-1 rad,  0.5 rad]", "[-1.7453 rad,  0.7854 rad]")
    expected = expected.replace("reference: 0 deg, direction: 1", "reference: 39.99 deg, direction: -1")
    assert text == expected
    assert "+    reference: 2.9667 rad   # of the horn" in script.text
    compile_files(arm.path, {}, [])


def test_a_linear_joint_behind_a_pinion_has_lengths(tmp_path: Path) -> None:
    linear = "direction: 1, travel_per_turn: 36 mm}  # 180"
    arm = Arm(tmp_path, ROBOT.replace("direction: 1}  # 180", linear))
    moves = [("positive", arm.move(1, -60)), ("negative", arm.move(1, 100))]
    arm.do(("hold", ""), ("zero", ""), *moves, ("Write", "y"), joints=("elbow",))
    (found,) = [line for line in arm.path.read_text().splitlines() if "elbow:" in line]
    assert "direction: -1, travel_per_turn: 36 mm, limits: {position: [-3.9 mm, 6 mm]}}  # 180" in found


def test_what_is_as_measured_stays_as_it_is_written(arm: Arm, tmp_path: Path) -> None:
    text = ROBOT.replace("reference: 180 deg, direction: 1", "reference: 150.05 deg, direction: 1")
    arm = Arm(tmp_path, text.replace("1}  #", "1, limits: {position: [-30 deg, 20 deg]}}  #"))
    moves = [("positive", arm.move(1, 20)), ("negative", arm.move(1, -50))]
    script = arm.do(("hold", ""), ("zero", ""), *moves, joints=("elbow",))
    assert (arm.code, arm.path.read_bytes()) == (0, arm.before)
    assert "nothing was written" in script.text


def test_no_is_an_answer(arm: Arm) -> None:
    moves = [("positive", arm.move(1, 20)), ("negative", arm.move(1, -50))]
    script = arm.do(("hold", ""), ("zero", ""), *moves, ("Write", ""), joints=("elbow",))
    assert (arm.code, arm.path.read_bytes()) == (1, arm.before)
    assert f"{arm.path} is unchanged" in script.text


def test_a_joint_that_begins_at_its_positive_end_is_measured(arm: Arm) -> None:
    arm.do(
        ("hold", ""),
        ("zero", ""),
        ("positive", ""),
        ("negative", arm.move(1, 60)),
        ("W", "y"),
        joints=("elbow",),
    )
    (found,) = [line for line in arm.path.read_text().splitlines() if "elbow:" in line]
    assert "direction: -1, limits: {position: [-5" in found
    assert found.endswith(", 0 deg]}}  # 180 deg")


def test_a_way_that_is_too_short_is_shown_again(arm: Arm) -> None:
    script = arm.do(
        ("hold", ""),
        ("zero", ""),
        ("positive", arm.move(1, 2)),
        ("negative", arm.move(1, -2)),
        ("positive", arm.move(1, 30)),
        ("negative", arm.move(1, -60)),
        ("Write", "y"),
        joints=("elbow",),
    )
    assert "elbow moved only 1.93 deg; move it further" in script.text


def test_a_hand_that_goes_beyond_a_turn_is_told_so(arm: Arm) -> None:
    script = arm.do(
        ("hold", ""),
        ("zero", ""),
        ("positive", arm.move(1, 230, -100)),  # it came back before Enter
        ("left the range", ""),
        ("positive", arm.move(1, 50)),
        ("negative", arm.move(1, -400)),
        ("Move the joint back", arm.move(1, 300)),
        ("positive", arm.move(1, 30)),
        ("negative", arm.move(1, -100)),
        ("Write", "n"),
        joints=("elbow",),
    )
    said = [line for line in script.said if "left the range" in line]
    assert "elbow left the range of its XL430-W250: goals are 0 to 359.91 deg" in said[0]
    assert "was at 150.03 to 380.04 deg" in said[0]
    assert len(said) == 2
    assert arm.path.read_bytes() == arm.before


def test_a_servo_of_protocol_1_whose_count_begins_again_is_noticed(tmp_path: Path) -> None:
    text = ROBOT.replace("protocol: 2.0, baud_rate: 57600", "protocol: 1.0, baud_rate: 1000000")
    arm = Arm(tmp_path, text.replace("XL430-W250", "AX-12A"), at=())
    servo = ServoConfig(1, "AX-12A", math.radians(150))
    arm.line = HandLine(servo, protocol=1.0, rate=1_000_000)
    script = arm.do(
        ("hold", ""),
        ("zero", ""),
        ("positive", arm.move(1, 150, 80)),  # through the gap between 300 deg and 360 deg
        ("Move the joint back", arm.move(1, -130)),
        ("positive", arm.move(1, 30)),
        ("negative", arm.move(1, -60)),
        ("Write", "n"),
        joints=("elbow",),
    )
    assert "left the range of its AX-12A: goals are 0 to 300 deg" in script.text


STEPS = ("hold", "zero", "positive", "negative", "Write")


@pytest.mark.parametrize("at", STEPS)
def test_after_ctrl_c_at_each_step_the_file_is_as_it_was(
    arm: Arm, at: str, capsys: pytest.CaptureFixture[str]
) -> None:
    moves = {"positive": arm.move(1, 20), "negative": arm.move(1, -50)}
    steps = [(step, interrupt if step == at else moves.get(step, "")) for step in STEPS]
    with pytest.raises(KeyboardInterrupt):
        arm.do(*steps, joints=("elbow",))
    assert arm.path.read_bytes() == arm.before
    limp = "" if at in ("hold", "Write") else "limp now: elbow\n"
    assert capsys.readouterr().err == f"{limp}{arm.path} is unchanged\n"
    assert [path.name for path in arm.path.parent.iterdir()] == ["arm.yaml"]


@pytest.mark.parametrize("at", ["begin", "positive", "negative"])
def test_a_servo_that_does_not_answer_ends_it(arm: Arm, at: str, capsys: pytest.CaptureFixture[str]) -> None:
    def cut(look: Callable[[], object] = lambda: None) -> None:
        arm.line.bus.servos[0].silence()
        look()

    if at == "begin":
        cut()
    moves = {"positive": arm.move(1, 20), "negative": arm.move(1, -50)}
    with pytest.raises(ServoFault, match=r"^elbow \(ID 1 on bus main\) (does not answer|no longer answers)"):
        arm.do(*((step, cut if step == at else moves.get(step, "")) for step in STEPS), joints=("elbow",))
    assert arm.path.read_bytes() == arm.before
    assert f"{arm.path} is unchanged" in capsys.readouterr().err


def change(item: str, value: int) -> Callable[[Arm], None]:
    return lambda arm: arm.line.bus.servos[0].poke(item, value)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (change("drive_mode", 1), r": Drive Mode \(10\) = 1 shifts its angles; write 0"),
        (change("homing_offset", 100), r": Homing Offset \(20\) = 100 shifts its angles; write 0"),
        (change("model_number", 1020), "is an XM430-W350, not an XL430-W250; correct the robot file, or set"),
    ],
)
def test_a_servo_that_counts_otherwise_is_refused(arm: Arm, wrong: Callable[[Arm], None], said: str) -> None:
    wrong(arm)
    with pytest.raises(ServoFault, match=said):
        arm.do()
    assert arm.path.read_bytes() == arm.before


@pytest.mark.parametrize(
    ("old", "new", "joints", "said"),
    [
        ("port: /dev/null", "port: sim", (), "bus main is simulated and has no port"),
        ("", "", ("elbo",), "the robot file has no joint elbo; did you mean elbow?"),
        ("reference: 180 deg", 'reference: "${zero}"', (), "elbow.reference comes from an argument"),
    ],
)
def test_wrong_input_is_refused_before_anything_is_done(
    tmp_path: Path, old: str, new: str, joints: tuple[str, ...], said: str
) -> None:
    arm = Arm(tmp_path, ROBOT.replace(old, new))
    with pytest.raises(InputError, match=said):
        arm.do(joints=joints)
    assert arm.line.heard == []


def test_a_port_that_another_program_has_is_refused(tmp_path: Path) -> None:
    master, slave = os.openpty()
    arm = Arm(tmp_path, ROBOT.replace("/dev/null", os.ttyname(slave)))
    held = open_serial(os.ttyname(slave), 57600)
    try:
        arm.line.open = TunablePort
        with pytest.raises(PortError, match="is in use by"):
            arm.do()
    finally:
        held.close()
        os.close(master)
        os.close(slave)
    assert arm.path.read_bytes() == arm.before


def test_joints_with_several_servos_are_left_out_and_named(tmp_path: Path) -> None:
    text = ROBOT.replace("id: 1,", "servos: [{id: 1}, {id: 4}],")
    arm = Arm(tmp_path, text)
    with pytest.raises(InputError, match="several servos move each of these joints"):
        arm.do(joints=("elbow",))
    assert "Several servos move elbow: not calibrated; measure these joints yourself" in arm.script.text


def test_a_file_that_would_be_wrong_is_told_with_the_change(tmp_path: Path) -> None:
    text = ROBOT + "poses: {home: {elbow: 50 deg}}\n"
    arm = Arm(tmp_path, text)
    moves = [("positive", arm.move(1, 20)), ("negative", arm.move(1, -50))]
    script = arm.do(("hold", ""), ("zero", ""), *moves, ("Write", "n"), joints=("elbow",))
    assert "The robot file with these values has mistakes:" in script.text
    assert "home" in script.text
