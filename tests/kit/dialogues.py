"""Dialogues in text: a hand answers the questions of `dxlrun calibrate` and `dxlrun setup`, and turns servos.

The texts have the form of `tests/kit/cases.py`. The head is a robot file, and after `----` its servos
(`1 XL430-W250 at 150`: ID, model and angle, deg):

    A way that is too short is shown again
      limits: [1] => limits: [2]        a change of the robot file
      servo 1: drive_mode 1             a register of a servo, by its order
      servos 1 AX-12A at 150            other servos, of Protocol 1.0 at its usual rate
      run calibrate elbow
      hold the joints
      positive -> turn 1 by 30, -20     words of a question, and what is done then
      Write this -> y                   what is typed, else
      => exit 0

A hand may `turn` a servo, `connect` some of them by their order and no others, `cut` one, or press `Ctrl-C`.
Expected is one of `CHECKS`; `...` stands for any text, and FILE for the path of the robot file.
"""

import math
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

from tests.kit.cases import TextCase, fits, read_form
from tests.kit.hands import HandLine, Script, interrupt, written

from dxlrun.compile.robot_compiler import compile_files
from dxlrun.description.reading import read_robot
from dxlrun.errors import DxlrunError
from dxlrun_hand.commands.calibrate import calibrated
from dxlrun_hand.commands.setup import set_up
from dxlrun_hand.servo_setup import ServoSetup
from dxlsim.simulation_plan import ServoConfig

SETTINGS = ("id", "baud_rate", "return_delay_time", "temperature_limit")


class Dialogue:
    """One case: its robot file, its servos, and what comes of its questions."""

    def __init__(self, folder: Path, robot: str, servos: str, lines: list[str]) -> None:
        self.said = [line.removeprefix("=> ") for line in lines if line.startswith("=> ")]
        told = [line for line in lines if not line.startswith("=> ")]
        for line in told:
            if " => " in line:
                old, _, new = line.partition(" => ")
                assert old in robot, f"the robot lacks {old!r}"
                robot = robot.replace(old, new.replace("\\n", "\n"))
            elif line.startswith("servos "):
                servos = line.removeprefix("servos ")
        self.line = servos_of(servos)
        self.path = written(folder, robot)
        self.before = self.path.read_bytes()
        for line in told:
            if (poked := re.fullmatch(r"servo (\d+): (\w+) (\d+)", line)) is not None:
                self.line.bus.servos[int(poked[1]) - 1].poke(poked[2], int(poked[3]))
        (at,) = [index for index, line in enumerate(told) if line.startswith("run ")]
        _, self.command, *self.joints = told[at].split()
        self.steps = [
            (words, self._answer(act)) for words, _, act in (s.partition(" -> ") for s in told[at + 1 :])
        ]

    def _answer(self, act: str) -> str | Callable[..., str | None]:
        """Return what answers a question: a text, or a function that does something first."""
        verb, _, rest = act.partition(" ")
        if act == "Ctrl-C":
            return interrupt
        if verb == "connect":
            return lambda *_: self.line.connect(*(int(one) - 1 for one in rest.split()))
        if verb == "cut":
            return lambda look=str: (self.line.bus.servos[int(rest) - 1].silence(), look())[1]
        if verb == "turn":
            return lambda look=str: self._turn(rest, look)
        if verb == "servo":
            return lambda *_: [self._poke(one) for one in rest.split(", ")] and None
        return act

    def _poke(self, text: str) -> None:
        number, name, value = text.split()
        self.line.bus.servos[int(number) - 1].poke(name, int(value))

    def _turn(self, text: str, look: Callable[[], object]) -> None:
        for one in text.split(" and "):
            servo, _, angles = one.partition(" by ")
            for angle in angles.split(", "):
                self.line.turn(int(servo), float(angle), look)

    def perform(self) -> None:
        """Hold the dialogue to its end, or to the error that ends it."""
        self.script, self.code, self.error = Script(*self.steps), -1, ""
        joints = tuple(self.joints)
        try:
            if self.command == "calibrate":
                compiled = compile_files(self.path, {}, [])
                self.code = calibrated(compiled, self.script, self.line.open, joints, ())
            else:
                task = ServoSetup(read_robot(self.path, {}), self.script)
                self.code = set_up(task, self.line.open, tuple, joints)
        except (DxlrunError, KeyboardInterrupt) as error:
            self.error = str(error) or type(error).__name__
        if not self.error:
            assert not self.script.steps, self.script.steps


def servos_of(text: str) -> HandLine:
    found = re.findall(r"(\d+) (\S+) at ([\d.]+)", text)
    servos = [ServoConfig(int(number), model, math.radians(float(at))) for number, model, at in found]
    if servos[0].model in ("AX-12A", "MX-64"):
        line = HandLine(*servos, protocol=1.0, rate=1_000_000 if servos[0].model == "AX-12A" else 57_600)
    else:
        line = HandLine(*servos)
    line.connect(*range(len(servos)))
    return line


has = partial(fits, whole=False)
CHECKS: dict[str, Callable[..., bool]] = {
    r"exit (\d)": lambda case, err, code: case.code == int(code),
    "fails (.*)": lambda case, err, text: has(case.error, text),
    "the file is unchanged": lambda case, err: case.path.read_bytes() == case.before,
    "the file has (.*)": lambda case, err, text: has(case.path.read_text(), text),
    "says (.*)": lambda case, err, text: has(case.script.text, text),
    "writes (.*)": lambda case, err, text: err == text.replace("\\n", "\n") + "\n",
    "writes nothing": lambda case, err: err == "",
    "nothing is sent": lambda case, err: case.line.heard == [],
    "no servo is written to": lambda case, err: (
        not any(data[:4] == b"\xff\xff\xfd\x00" and data[7] == 3 for data in case.line.heard)
    ),
    r"servo (\d+) has (.*)": lambda case, err, number, values: (
        [case.line.bus.servos[int(number) - 1].registers[name] for name in SETTINGS]
        == [int(value) for value in values.split()]
    ),
    r"servo (\d+): (\w+) (not )?(\d+)": lambda case, err, number, name, other, value: (
        (case.line.bus.servos[int(number) - 1].registers[name] == int(value)) is not bool(other)
    ),
    "no torque is on": lambda case, err: not any(servo.torque_on for servo in case.line.bus.servos),
}


def check_dialogue(folder: Path, told: TextCase, err: Callable[[], str]) -> None:
    """Hold a dialogue, and check what it expects; `err` returns what was written to standard error."""
    robot, _, servos = told.head.partition("----\n")
    case = Dialogue(folder, robot, servos, [line.text for line in told.lines])
    case.perform()
    written_err = err().replace(str(case.path), "FILE")
    assert case.said, told.place
    for line in case.said:
        check = read_form(CHECKS, line if line.startswith("writes") else line.replace("FILE", str(case.path)))
        seen = (told.place, line, case.code, case.error, case.script.text, written_err)
        assert check(case, written_err), seen
