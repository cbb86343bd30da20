"""`dxlrun schema`: what an editor is shown agrees with what dxlrun reads."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any, Literal, get_args

import pytest
from jsonschema import Draft202012Validator
from msgspec import structs
from pydantic import BaseModel
from tests.kit.commands import Dxlrun

from dxlrun.cli.examples import schema_text
from dxlrun.control.controllers import plugin_loading
from dxlrun.control.controllers.plugin_loading import Offer, Offers
from dxlrun.description.document import grow, literal, parse
from dxlrun.description.json_schema import robot_schema
from dxlrun.errors import PlugInError

ROBOTS = Path(__file__).parents[2] / "robots"
ROBOT = """\
name: pair
arguments: {port: {default: sim, help: "port or sim"}, rate: {default: 50}}
buses:
  main: {port: "${port}", protocol: 1.0, baud_rate: 1_000_000, adapter: {latency: "${late}"}}
loop: {rate: "${rate}", scheduler: {policy: fifo, priority: 31, lock_memory: "${lock}"}}
joints:
  pan:
    {bus: main, id: 1, model: AX-12A, reference: 150 deg, direction: 1, limits: {position: ["-${x}", 1 rad]}}
  tilt: {bus: "${bus}", id: "${id}", model: "${model}", reference: "${zero}", direction: "${sign}"}
controllers:
  states: {type: joint_state_broadcaster, rate: 25}
  head: {type: joint_trajectory_controller, active: "${on}", joints: [pan, tilt], tolerances: {goal: 2 deg}}
  other: {type: "${kind}", whatever: 5}
poses: {home: {pan: 0 rad, tilt: "${zero}"}}
policies:
  on_exit: [{pose: home, speed: 60 deg/s}, {reduce_torque: 0.5}, hold]
  on_fault: limp
  exit_timeout: 2 s
recording: {directory: logs}
model: {urdf: pair.urdf}
"""


def data_of(text: str) -> dict[str, object]:
    return grow(parse(text, "file"), "file", literal).data


Kind = Literal["robot", "motion", "motor", "fragment"]


def wrong(kind: Kind, text: str) -> list[str]:
    """Return the places that a schema refuses."""
    errors = validator_of(kind).iter_errors(data_of(text))
    return sorted("/".join(map(str, error.absolute_path)) for error in errors)


@functools.cache
def validator_of(kind: Kind) -> Draft202012Validator:
    return Draft202012Validator(json.loads(schema_text(kind)))


def test_a_type_that_cannot_be_imported_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails() -> Offer:
        raise PlugInError("cannot be imported: no module named nothing")

    found = plugin_loading.load_plugins()
    makes = {name: functools.partial(found.controllers.__getitem__, name) for name in found.controllers}
    broken = structs.replace(found, controllers=Offers({"nothing": fails, **makes}, {}))
    usual = schema_text("robot")
    monkeypatch.setattr(plugin_loading, "load_plugins", lambda: broken)
    assert schema_text("robot") == usual


@pytest.mark.parametrize("kind", get_args(Kind))
def test_each_schema_is_one(kind: Kind) -> None:
    Draft202012Validator.check_schema(json.loads(schema_text(kind)))


FILES = [
    *(("robot", path) for path in sorted(ROBOTS.glob("*.yaml"))),
    *(("motion", path) for path in sorted(ROBOTS.glob("motions/*.yaml"))),
    *(("motor", path) for path in sorted(ROBOTS.glob("motors/*.yaml"))),
]


@pytest.mark.parametrize(("kind", "path"), FILES, ids=[path.stem for _, path in FILES])
def test_every_file_of_the_examples_is_right(kind: Kind, path: Path) -> None:
    text = path.read_text()
    assert wrong(kind, text) == []
    assert text.startswith(f"# yaml-language-server: $schema={kind}.schema.json\n")
    if kind == "motor":
        assert wrong(kind, text.replace("friction: 0.1", "friction: -0.1")) == []  # the sign is for `check`
        assert wrong(kind, text.replace(" ohm", "")) == ["resistance"]


@pytest.mark.parametrize(("kind", "folder"), [("robot", "."), ("motion", "motions"), ("motor", "motors")])
def test_schemas_next_to_the_robots_are_those_of_the_code(kind: Kind, folder: str) -> None:
    # the standard controllers only: with others installed a schema is written by
    # `dxlrun schema --output robots/robot.schema.json`
    written = (ROBOTS / folder / f"{kind}.schema.json").read_text()
    assert json.loads(written) == json.loads(schema_text(kind, only="dxlrun "))


def test_arguments_may_stand_for_every_scalar() -> None:
    assert wrong("robot", ROBOT) == []


MISTAKES = [
    ("name: pair\n", "", ""),
    ("name: pair", "name: 2pair", "name"),
    ("loop: {rate", "loops: {rate", ""),
    ("protocol: 1.0", "protocol: 3", "buses/main/protocol"),
    ("protocol: 1.0, ", "", "buses/main"),
    ("baud_rate: 1_000_000", "baud_rate: fast", "buses/main/baud_rate"),
    ('latency: "${late}"', "latency: 1", "buses/main/adapter/latency"),
    ('latency: "${late}"', "latency: 1 deg", "buses/main/adapter/latency"),
    ("adapter: {", "adaptor: {", "buses/main"),
    ("policy: fifo", "policy: rr", "loop/scheduler/policy"),
    ("priority: 31", "priority: 100", "loop/scheduler/priority"),
    ("id: 1,", "id: 1.5,", "joints/pan/id"),
    ("reference: 150 deg", "reference: 150", "joints/pan/reference"),
    ("direction: 1,", "direction: 2,", "joints/pan/direction"),
    ("1 rad]", "1 rad, 2 rad]", "joints/pan/limits/position"),
    ("type: joint_state_broadcaster", "type: joint_state", "controllers/states/type"),
    ("type: joint_state_broadcaster, rate: 25", "rate: 25", "controllers/states"),
    ("rate: 25", "rate: 0", "controllers/states/rate"),
    ("rate: 25", "rates: 25", "controllers/states"),
    ("joints: [pan, tilt], ", "", "controllers/head"),
    ("goal: 2 deg", "goal: 2", "controllers/head/tolerances/goal"),
    ("tolerances: {goal", "tolerances: {goals", "controllers/head/tolerances"),
    ("pan: 0 rad", "pan: 0", "poses/home/pan"),
    ("pose: home", "pos: home", "policies/on_exit"),
    ("60 deg/s", "60 deg", "policies/on_exit"),
    ("reduce_torque: 0.5", "reduce_torque: 2", "policies/on_exit"),
    ("}, hold]", "}, wait]", "policies/on_exit"),
    ("on_fault: limp", "on_fault: stop", "policies/on_fault"),
    ("urdf: pair.urdf", "{}", "model"),
    ("model: {urdf: pair.urdf}", "include: x.yaml", "include"),
    ("model: {urdf: pair.urdf}", "cameras: {}", ""),
    ("  pan:", "  pan joint:", "joints"),
]


@pytest.mark.parametrize(("right", "mistake", "place"), MISTAKES)
def test_each_mistake_is_found_at_its_place(right: str, mistake: str, place: str) -> None:
    assert right in ROBOT
    assert set(wrong("robot", ROBOT.replace(right, mistake))) == {place}


def test_a_file_with_includes_need_not_have_everything() -> None:
    part = "joints: {pan: {id: 5}}\ncontrollers: {head: {active: false}}\n"

    assert wrong("robot", f"include: [pair.yaml]\n{part}") == []
    assert wrong("fragment", part) == []
    assert set(wrong("robot", part)) == {"", "joints/pan", "controllers/head"}
    assert wrong("fragment", part.replace("id: 5", "id: x")) == ["joints/pan/id"]


def test_joints_need_not_have_what_groups_and_defaults_give_them() -> None:
    assert "model: AX-12A, " in ROBOT
    assert "direction: 1, " in ROBOT
    without = ROBOT.replace("model: AX-12A, ", "").replace("direction: 1, ", "")
    shared = without.replace("joints:\n", "joint_defaults: {model: AX-12A}\njoints:\n", 1)
    assert wrong("robot", shared) == []
    assert wrong("robot", shared.replace("{model: AX-12A}", "{modle: AX-12A}")) == ["joint_defaults"]
    groups = "groups: {both: {direction: 1, limits: {effort: 1 A}, joints: [pan, tilt]}}\n"
    assert wrong("robot", groups + ROBOT.replace("direction: 1, ", "")) == []
    assert wrong("robot", groups.replace(", joints: [pan, tilt]", "") + ROBOT) == ["groups/both"]


def test_a_motion_takes_no_arguments() -> None:
    text = (
        "name: m\nmotions:\n"
        "- {controller: c, duration: 1 s, samples: 5, joints: {j: {position: 0, velocity: cos(t)}}}\n"
    )

    assert wrong("motion", text) == []
    assert wrong("motion", text.replace("5", '"${n}"')) != []
    assert wrong("motion", text.replace("1 s", "1")) != []
    assert wrong("motion", text.replace("samples: 5, ", "")) != []


class Tree(BaseModel):
    name: str
    below: list[Tree] = []


def test_the_parameters_of_any_controller_are_in_it() -> None:
    """Also when its model contains itself."""
    gardener = type("Parameters", (BaseModel,), {"__annotations__": {"tree": Tree}})
    schema = robot_schema({"gardener": gardener}, {})
    good = data_of(
        ROBOT.split("controllers:", maxsplit=1)[0] + "controllers: {g: {type: gardener, tree: {name: oak}}}\n"
    )
    validator = Draft202012Validator(schema)

    assert list(validator.iter_errors(good)) == []
    bad: Any = data_of("controllers: {g: {type: gardener, tree: {below: [{name: ash}]}}}")
    assert [list(error.path) for error in validator.iter_errors({**good, **bad})] == [
        ["controllers", "g", "tree"]
    ]


def test_command_prints_it_or_writes_it(dxlrun: Dxlrun, tmp_path: Path) -> None:
    """Refusals are in refusals.txt."""
    assert dxlrun("schema") == (0, schema_text("robot"), "")
    assert dxlrun("schema", "motion", "--output", tmp_path / "m.json").code == 0
    assert (tmp_path / "m.json").read_text() == schema_text("motion")
    title = json.loads(dxlrun("schema", "fragment").out)["title"]
    assert title == "dxlrun fragment of a robot file"
