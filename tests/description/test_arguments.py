# ruff: noqa: E501 (a mistake and its sentence are read best side by side)
"""Arguments of robot files: what is put in where, and what is said of mistakes."""

from __future__ import annotations

import pytest
from tests.kit import desk
from tests.kit.desk import TORSO

from dxlrun.description.reading import Description


def figures(description: Description) -> tuple[str, float]:
    """Return port and rate of the torso."""
    return description.robot.buses["main"].port, description.robot.loop.rate


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({}, ("sim", 50.0)),
        ({"port": "/dev/ttyUSB0", "rate": "62.5"}, ("/dev/ttyUSB0", 62.5)),
        ({"port": "5"}, ("5", 50.0)),  # the default is a text, so it stays one
        ({"port": "sim}\njoints: {evil: 1"}, ("sim}\njoints: {evil: 1", 50.0)),  # no structure is smuggled in
    ],
)
def test_arguments_are_put_in_and_defaults_count_until_then(
    given: dict[str, str], found: tuple[str, float]
) -> None:
    description = desk.robot(TORSO, given)
    assert figures(description) == found
    assert description.arguments == {"port": "sim", "rate": "50"} | given
    assert set(description.robot.joints) == {"swing", "elbow"}


@pytest.mark.parametrize(
    ("right", "wrong", "found"),
    [
        ("rate: ${rate}\n", 'rate: "${rate}"\n', ("sim", 100.0)),  # inside { } YAML itself asks for quotes
        ("rate: {default: 50, ", "rate: {", ("sim", 100.0)),
        ('"loop rate, Hz"', '"used as ${rate}"', ("sim", 100.0)),  # help may explain how it is written
        ('port: "${port}"', 'port: "$${a}/${port}"', ("${a}/sim", 100.0)),  # two dollars write one
        ('port: "${port}"', 'port: "/dev/tty${rate}"', ("/dev/tty100", 100.0)),  # inside a longer text
    ],
)
def test_use_of_an_argument(right: str, wrong: str, found: tuple[str, float]) -> None:
    assert right in TORSO
    assert figures(desk.robot(TORSO.replace(right, wrong), {"rate": "100"})) == found


@pytest.mark.parametrize(
    ("text", "given", "said"),
    [
        (TORSO, {"rate": "fast"}, ["robot.yaml:8:9: loop.rate: 'fast' is not a rate (argument rate:=fast); write a rate such as 50, 50 Hz or 1 kHz"]),
        (TORSO.replace("{bus: main, id: 5, model: AX-12A, reference: 150 deg, direction: 1}", "\n    bus: main\n    id: 5\n    model: AX-12A\n    reference: ${port}\n    direction: 1"), {}, ["robot.yaml:16:16: joints.elbow.reference: 'sim' is not an angle (argument port:=sim); write an angle such as 60 deg or 1.05 rad"]),
        (TORSO, {"prot": "sim", "x": "1"}, ["command line:1:1: argument prot:=sim is not declared in the robot file; did you mean port?", "command line:1:1: argument x:=1 is not declared in the robot file; known arguments: port, rate"]),
        (TORSO.replace("rate: ${rate}", "rate: ${rat}"), {}, ["robot.yaml:8:9: argument 'rat' is not declared; did you mean rate?"]),
        (TORSO.replace("rate: {default: 50, ", "rate: {"), {}, ["robot.yaml:4:3: the argument rate has no value; write rate:=... after the robot file, or give it a default"]),
        (
            TORSO.replace("directory: elsewhere", 'directory: "${rate"').replace("${rate}\n", "${a b}\n"),
            {},
            ["robot.yaml:8:9: argument 'a b' is not declared; known arguments: port, rate", "robot.yaml:17:24: ${ has no closing }; write ${name}, or $${ for a literal ${"],
        ),
    ],
)  # fmt: skip
def test_wrong_use_is_reported_where_it_is(text: str, given: dict[str, str], said: list[str]) -> None:
    assert desk.refusals(text, given) == said


@pytest.mark.parametrize(
    ("block", "problem"),
    [
        ("arguments: 5", "2:1: arguments is not a mapping"),
        ("arguments:", "2:1: arguments is not a mapping"),
        ("arguments: {a: sim}", "2:16: arguments.a is the text 'sim', but must be a mapping"),
        ("arguments: {a: {defualt: 1}}", "2:17: arguments.a has an unknown key 'defualt'; did you mean default?"),
        ("arguments: {a: {default: [1]}}", "2:26: arguments.a.default: the default of an argument must be one value"),
        ("arguments: {a: {default: 1, help: 5}}", "2:35: arguments.a.help is 5, but must be text"),
        ("arguments: {a b: {default: 1}}", "2:13: 'a b' is not a valid name of an argument"),
        ("arguments: {a: {default: '${b}'}}", "2:26: the default of an argument cannot contain ${...}"),
        ("arguments: {a: {default: 1}, a: {default: 2}}", "2:30: arguments.a is already defined in line 2"),
    ],
)  # fmt: skip
def test_a_wrong_block_is_refused_where_it_stands(block: str, problem: str) -> None:
    text = f"name: x\n{block}\nbuses: {{m: {{port: sim, protocol: 1.0, baud_rate: 1}}}}\nloop: {{rate: 1}}\n"
    text += "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
    (found,) = desk.refusals(text)
    assert found.startswith(f"robot.yaml:{problem}")


def test_without_a_block_there_are_no_arguments() -> None:
    first, second, *_ = desk.refusals("name: x\nloop: {rate: '${rate}'}\n", {"rate": "1"})
    assert first.startswith("command line:1:1: argument rate:=1 is not declared in the robot file; remove it")
    assert "has no" in second
