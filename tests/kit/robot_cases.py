"""Cases of robot files: changes of a robot, what the compiler says of it, and what is in the plan.

The texts in `tests/compile/cases` have the form of `tests/kit/cases.py`. The head is a robot file; `like
pair` is the robot file of `pair.txt`, to which lines may be added. Other files follow after `---- NAME`;
`motion0.yaml` is played:

    rate: 25 => rate: §20
      rate 20 Hz of states does not divide the loop's 50 Hz; write the nearest possible rate, 25
    reference: 60 deg => reference: 90 deg
      = joints.left_arm_joint.lower: -210 deg
      = servos.left_arm_joint: {lower_tick: 0, upper_tick: 1023}

At the margin is a line for each change (`\\n` is a new line; `+ ` puts one at the end of the robot file), or
for an argument (`rate:=100`). Below is one for each problem, at the place of § or at its own (`9:5: ...`,
`pair.urdf:2:3: ...`), and one for each fact. A case without problems is right; where nothing is below it, an
empty line ends it. `HELP` is the address of the page "It does not work".

The path of a fact starts at one of ROOTS. An entry of a list is found by its name or number; the name of a
field gives the field of each entry; a list may have the keys of a mapping. A number is compared in all digits
that are written, and may have a unit.
"""

import json
import math
import re
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
import yaml
from tests.kit.cases import TextCase
from tests.kit.robots import whole_text

from dxlrun.compile.robot_compiler import CompiledRobot, compile_files
from dxlrun.compile.simulation import simulation_of
from dxlrun.description.reading import read_robot
from dxlrun.errors import InputError, Problem
from dxlwire.exceptions import HELP

ROOTS: Mapping[str, Callable[[CompiledRobot], object]] = {
    "robot": lambda robot: read_robot(Path("robot.yaml"), robot.plan.arguments).robot,
    "poses": lambda robot: robot.plan.poses,
    "plan": lambda robot: robot.plan,
    "loop": lambda robot: robot.plan.loop,
    "joints": lambda robot: robot.plan.loop.joints,
    "controllers": lambda robot: robot.plan.loop.controllers,
    "commands": lambda robot: robot.plan.loop.commands,
    "policies": lambda robot: robot.plan.loop.policies,
    "buses": lambda robot: robot.plan.buses,
    "servos": lambda robot: [servo for bus in robot.plan.buses for servo in bus.servos],
    "report": lambda robot: robot.report,
    "simulated": lambda robot: simulation_of(robot.plan),
}
UNITS = {"deg": math.radians(1), "mm": 1e-3, "us": 1e3, "ms": 1e6, "s": 1e9, "": 1.0}
"""Units of numbers; durations are in ns."""
WORDS: Mapping[str, object] = {"true": True, "false": False, "none": None}


def check_case(case: TextCase) -> None:
    """Compare the problems and the plan of a changed robot file with what the case has."""
    text, place, arguments = whole_text(case.head), case.place, dict[str, str]()
    below = [line.text.strip() for line in case.lines if line.is_indented]
    for change in filter(None, [case.name, *(line.text for line in case.lines if not line.is_indented)]):
        right, _, wrong = change.replace("\\n", "\n").partition(" => ")
        if given := re.match(r"(\w+):=", right):
            arguments[given[1]] = right[given.end() :]
        elif right.startswith("+ "):
            robot, mark, rest = text.partition("---- ")
            text = f"{robot}{right[2:]}\n{mark}{rest}"
        else:
            assert right in text, f"{place}: {right}"
            text = text.replace(right, wrong, 1)
    before = text.partition("§")[0].rpartition("---- ")
    file, _, before = before[2].partition("\n") if before[1] else ("robot.yaml", "", before[2])
    column = len(before) - before.rfind("\n")
    pointed = f"{file}:{before.count(chr(10)) + 1}:{column}: "
    compiled, found = compile_cases(text.replace("§", ""), arguments)
    said = [str(one).replace(f"{Path.cwd()}/", "").replace(HELP, "HELP") for one in found]
    said = [one.removeprefix(pointed).removeprefix("robot.yaml:") for one in said]
    assert said == [one for one in below if not one.startswith("= ")], place
    for fact in (one.removeprefix("= ") for one in below if one.startswith("= ")):
        path, _, expected = fact.partition(": ")
        assert compiled is not None, f"{place}: there is no plan"
        value = value_at(compiled, path)
        assert is_same(value, yaml.load(expected, yaml.BaseLoader)), f"{place}: {path} is {value!r}"  # noqa: S506  texts of ours


def compile_cases(
    text: str, arguments: Mapping[str, str] = MappingProxyType({})
) -> tuple[CompiledRobot | None, tuple[Problem, ...]]:
    """Write the files of a text into the working directory; return the compiled robot and its problems."""
    robot, *others = text.split("---- ")
    Path("robot.yaml").write_text(robot, "utf-8")
    for other in others:
        name, _, content = other.partition("\n")
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text(content, "utf-8")
    motions = sorted(Path.cwd().glob("motion*.yaml"))
    try:
        compiled = compile_files(Path.cwd() / "robot.yaml", arguments, motions)
    except InputError as error:
        return None, error.problems
    return compiled, compiled.warnings


def value_at(compiled: CompiledRobot, path: str) -> object:
    """Return what a compiled robot has at a path."""
    root, *names = re.split(r"\.(?! )", path)
    value = ROOTS[root](compiled)
    while names:
        name = names.pop(0)
        if isinstance(value, Mapping) and names and f"{name}.{names[0]}" in value:
            name = f"{name}.{names.pop(0)}"
        value = _step(value, name)
    return value


def _step(value: object, name: str) -> object:
    if isinstance(value, Mapping):
        return value[name]
    if isinstance(value, bytes):
        return _step(_decoded(value), name)
    if not isinstance(value, list | tuple):
        return getattr(value, name)
    if name.isdigit():
        return value[int(name)]
    named = [one for one in value if name in (getattr(one, "own_name", ""), getattr(one, "name", ""))]
    return named[0] if named else [_step(one, name) for one in value]


def _decoded(data: bytes) -> object:
    return json.loads(data) if data[:2] in {b'{"', b"[{"} else np.frombuffer(data, "<f8").tolist()


def is_same(value: object, expected: object) -> bool:
    """Compare a value of a plan with what is written of it."""
    if isinstance(value, bytes):
        value = _decoded(value)
    if isinstance(expected, dict):
        if not isinstance(value, Mapping):
            return all(is_same(getattr(value, key), one) for key, one in expected.items())
        return value.keys() == expected.keys() and all(is_same(value[key], expected[key]) for key in value)
    if isinstance(expected, list):
        rows = list(value) if isinstance(value, list | tuple | Mapping) else []
        return len(rows) == len(expected) and all(map(is_same, rows, expected))
    return _is_same_word(value, str(expected))


def _is_same_word(value: object, text: str) -> bool:
    number = re.fullmatch(r"([-+]?\d[\d_]*(?:\.(\d+))?(?:e-?\d+)?) ?(deg|mm|us|ms|s|)", text)
    if number and isinstance(value, int | float) and not isinstance(value, bool):
        scale = UNITS[number[3]]
        margin = 0.51 * 10.0 ** -len(number[2]) * scale if number[2] else 0.0
        return bool(value == pytest.approx(float(number[1]) * scale, rel=1e-9, abs=margin))
    if isinstance(value, Enum):
        return value.name.lower().replace("_", " ") == text
    if isinstance(value, str):
        return value.replace(f"{Path.cwd()}/", "") == text
    return text in WORDS and value is WORDS[text]
