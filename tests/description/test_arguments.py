# ruff: noqa: E501 (a mistake and its sentence are read best side by side)

from __future__ import annotations

import pytest
from tests.kit import desk
from tests.kit.desk import TORSO


def test_defaults_count_until_something_else_is_given() -> None:
    plain = desk.robot(TORSO)
    assert (plain.robot.buses["main"].port, plain.robot.loop.rate) == ("sim", 50.0)
    assert plain.arguments == {"port": "sim", "rate": "50"}
    given = desk.robot(TORSO, {"port": "/dev/ttyUSB0", "rate": "62.5"})
    assert (given.robot.buses["main"].port, given.robot.loop.rate) == ("/dev/ttyUSB0", 62.5)
    assert given.arguments == {"port": "/dev/ttyUSB0", "rate": "62.5"}


def test_an_argument_with_a_text_as_default_stays_text() -> None:
    assert desk.robot(TORSO, {"port": "5"}).robot.buses["main"].port == "5"


def test_a_number_in_quotes_is_still_a_number_where_quotes_are_needed() -> None:
    # inside { } YAML itself asks for quotes around ${...}
    text = TORSO.replace("rate: ${rate}\n", 'rate: "${rate}"\n')
    assert desk.robot(text, {"rate": "100"}).robot.loop.rate == 100.0


def test_an_argument_inside_longer_text_is_put_in_as_text() -> None:
    text = TORSO.replace("60 deg, direction", "${rate} deg, direction".replace("${rate}", "6${zero}"))
    text = text.replace("reference: 6${zero} deg", 'reference: "6${zero} deg"')
    text = text.replace("arguments:\n", "arguments:\n  zero: {default: 0}\n")
    assert desk.robot(text).robot.joints["swing"].reference == pytest.approx(1.0471975511965976)


def test_two_dollars_write_one() -> None:
    text = TORSO.replace("directory: elsewhere", 'directory: "$${a}/${port}"')
    assert desk.robot(text).robot.recording.directory == "${a}/sim"


def test_a_wrong_value_is_shown_at_its_use_with_the_argument_named() -> None:
    assert desk.refusals(TORSO, {"rate": "fast"}) == [
        "robot.yaml:8:9: loop.rate: 'fast' is not a rate (argument rate:=fast); write a rate such as 50, 50 Hz or 1 kHz"
    ]
    (problem,) = desk.refusals(
        TORSO.replace("150 deg", "${port}").replace(
            "{bus: main, id: 5, model: AX-12A, reference: ${port}, direction: 1}",
            "\n    bus: main\n    id: 5\n    model: AX-12A\n    reference: ${port}\n    direction: 1",
        )
    )
    assert problem.startswith(
        "robot.yaml:16:16: joints.elbow.reference: 'sim' is not an angle (argument port:=sim); "
    )


def test_an_unknown_argument_is_answered_with_the_nearest() -> None:
    assert desk.refusals(TORSO, {"prot": "sim", "x": "1"}) == [
        "command line:1:1: argument prot:=sim is not declared in the robot file; did you mean port?",
        "command line:1:1: argument x:=1 is not declared in the robot file; known arguments: port, rate",
    ]
    text = TORSO.replace("rate: ${rate}", "rate: ${rat}")
    assert desk.refusals(text) == ["robot.yaml:8:9: argument 'rat' is not declared; did you mean rate?"]


def test_without_an_arguments_block_there_are_none() -> None:
    (first, second, *_) = desk.refusals("name: x\nloop: {rate: '${rate}'}\n", {"rate": "1"})
    assert first.startswith("command line:1:1: argument rate:=1 is not declared in the robot file; remove it")
    assert "has no" in second


def test_an_argument_without_default_must_be_given() -> None:
    text = TORSO.replace("rate: {default: 50, ", "rate: {")
    assert desk.refusals(text) == [
        "robot.yaml:4:3: the argument rate has no value; write rate:=... after the robot file, or give it a default"
    ]
    assert desk.robot(text, {"rate": "20"}).robot.loop.rate == 20.0


@pytest.mark.parametrize(
    ("block", "problem"),
    [
        ("arguments: 5", "2:1: arguments is not a mapping"),
        ("arguments:", "2:1: arguments is not a mapping"),
        ("arguments: {a: sim}", "2:16: arguments.a is the text 'sim', but must be a mapping"),
        (
            "arguments: {a: {defualt: 1}}",
            "2:17: arguments.a has an unknown key 'defualt'; did you mean default?",
        ),
        (
            "arguments: {a: {default: [1]}}",
            "2:26: arguments.a.default: the default of an argument must be one value",
        ),
        ("arguments: {a: {default: 1, help: 5}}", "2:35: arguments.a.help is 5, but must be text"),
        ("arguments: {a b: {default: 1}}", "2:13: 'a b' is not a valid name of an argument"),
        ("arguments: {a: {default: '${b}'}}", "2:26: the default of an argument cannot contain ${...}"),
        ("arguments: {a: {default: 1}, a: {default: 2}}", "2:30: arguments.a is already defined in line 2"),
    ],
)
def test_a_wrong_block_is_refused_where_it_stands(block: str, problem: str) -> None:
    text = f"name: x\n{block}\nbuses: {{m: {{port: sim, protocol: 1.0, baud_rate: 1}}}}\nloop: {{rate: 1}}\n"
    text += "joints: {j: {bus: m, id: 1, model: A, reference: 0 deg, direction: 1}}\n"
    (found,) = desk.refusals(text)
    assert found.startswith(f"robot.yaml:{problem}")


def test_what_is_no_argument_is_said() -> None:
    text = TORSO.replace("directory: elsewhere", 'directory: "${rate"').replace("${rate}\n", "${a b}\n")
    assert desk.refusals(text) == [
        "robot.yaml:8:9: argument 'a b' is not declared; known arguments: port, rate",
        "robot.yaml:17:24: ${ has no closing }; write ${name}, or $${ for a literal ${",
    ]


def test_help_may_explain_how_an_argument_is_written() -> None:
    assert desk.robot(TORSO.replace('"loop rate, Hz"', '"used as ${rate}"')).robot.loop.rate == 50.0


def test_an_argument_cannot_smuggle_structure_in() -> None:
    description = desk.robot(TORSO, {"port": "sim}\njoints: {evil: 1"})
    assert description.robot.buses["main"].port == "sim}\njoints: {evil: 1"
    assert set(description.robot.joints) == {"swing", "elbow"}
