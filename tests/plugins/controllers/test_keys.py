"""Keys and commands of every standard controller: what they claim, and what is refused, in which words.

`keys.txt` has controllers with their keys, and lines about each:

    pid_controller {joints: [a, b], gains: {p: 2.0}}
      => joints a b, command effort       fields of `Interfaces`; the robot has the joints a, b and c
      {wrap: [c]} => c is not one         these keys besides: refused with these words
      positions {positions: [1]} => 1 p   a command: refused with these words, with `...` for any others
"""

import re
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest
import yaml
from tests.kit.cases import read_cases

from dxlrun import Controller
from dxlrun_controllers.plugin import dxlrun_controllers

TEXT = Path(__file__).with_name("keys.txt")


def parsed(text: str) -> Any:
    return yaml.safe_load(re.sub(r"\b(nan|inf)\b", r".\1", text))


def type_of(name: str) -> type[Controller[Any]]:
    found: type[Controller[Any]] = resolve_name(dxlrun_controllers()[name])
    return found


def cases() -> Iterator[Any]:
    for case in read_cases(TEXT):
        name, _, keys = case.name.partition(" ")
        for place, line, _ in case.lines:
            given, _, expected = line.partition("=> ")
            title = f"{place}: {name} {given or expected}"
            yield pytest.param(name, parsed(keys), given, expected, id=title)


def prepare(controller: type[Controller[Any]], keys: dict[str, Any], given: str) -> None:
    """Do what a line does: check keys, or prepare a command."""
    kind, _, command = given.partition(" {")
    if not kind.startswith("{"):
        model = controller.Commands[kind].model_validate(parsed(f"{{{command}"))
        controller.prepare(kind, model, controller.Parameters.model_validate(keys))
    else:
        controller.Parameters.model_validate({**keys, **parsed(given)})


def with_axes(names: list[str]) -> list[str]:
    """Return names where `imu/orientation.xyzw` is one for each axis."""
    axes = [re.fullmatch(r"(.*\.)([xyzw]{2,})", name) or ("", "", [name]) for name in names]
    return [f"{match[1]}{axis}" for match in axes for axis in match[2]]


@pytest.mark.parametrize(("name", "keys", "given", "expected"), [*cases()])
def test_controller_claims_or_refuses(name, keys, given, expected):
    controller = type_of(name)
    if given:
        with pytest.raises(ValueError, match=re.escape(expected).replace(r"\.\.\.", ".*")):
            prepare(controller, keys, given)
        return
    found = controller.interfaces(controller.Parameters.model_validate(keys), ("a", "b", "c"))
    claimed = {field: names for field, *names in (part.split() for part in expected.split(", "))}
    if "joints" in claimed:
        claimed = {"command": [], "reference": []} | claimed
    for field, names in claimed.items():
        assert list(getattr(found, field)) == with_axes(names)


def test_a_command_of_another_controller_is_refused():
    group, other = type_of("joint_group_position_controller"), type_of("joint_group_posvel_controller")
    command = other.Commands["posvel"].model_validate({"positions": [1], "velocities": [1]})
    with pytest.raises(ValueError, match="has no command 'posvel'"):
        group.prepare("posvel", command, group.Parameters.model_validate({"joints": ["a", "b"]}))
