"""Features: the registry, its files and processes, plans of earlier versions, and units of states."""

import base64
import json
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import msgspec
import pytest
from msgspec import to_builtins

import dxlrun.features
from dxlrun import Sensor
from dxlrun.channels.event_records import Event, EventCode, EventStage, event_names
from dxlrun.cli import main
from dxlrun.cli.steering.steer import sources
from dxlrun.compile.contribution import CompileStage
from dxlrun.compile.robot_compiler import compile_files
from dxlrun.control.sampled_sources import planned_processes
from dxlrun.description.base_form import Form, with_keys
from dxlrun.description.joints.joint_forms import BareJoint, Joint, SharedJoint
from dxlrun.description.joints.joint_mechanics import OneOfServos
from dxlrun.description.robot import Group, GroupPolicies, Policies, Robot, robot_form
from dxlrun.errors import InputError
from dxlrun.features import FEATURES, RESERVED, stages
from dxlrun.features.feature import Feature, JointKey, PolicyKey, Section, ServoKey
from dxlrun.features.sensors.compile import is_units
from dxlrun.features.sensors.plan import decode_sensors
from dxlrun.installed_plugins import InstalledPlugin
from dxlrun.log.log_reader import open_log
from dxlrun.output.quantity import names_with_units, quantity_text
from dxlrun.plan.policy_plan import HOLD, LIMP
from dxlrun.plan.robot_plan import from_json, to_json
from dxlrun.testing import installed, plan_of, simulated_robot
from dxlrun_analysis.report import analyze, tables

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "robots" / "bioloid_torso.yaml"


def test_each_feature_has_the_section_of_its_name():
    sections = {feature.name: section for feature, section in stages(Section, FEATURES)}
    assert {name: section.name for name, section in sections.items()} == {name: name for name in sections}
    assert robot_form().model_fields.keys() - Robot.model_fields.keys() == sections.keys()


def test_all_files_of_features_are_on_the_page_of_the_architecture():
    page = (ROOT / "docs" / "explanation" / "architecture.md").read_text()
    declared = re.compile(r'    FILE: ClassVar\[str\] = "(\w+)"')
    sources = [path.read_text() for path in (ROOT / "runtime" / "dxlrun").rglob("*.py")]
    files = {name for source in sources for name in declared.findall(source)}
    assert {"form", "process"} <= files
    assert {name for name in files if f"| `{name}.py` |" not in page} == set()


def test_guardian_does_not_import_a_feature_of_one_module():
    code = (
        "import sys; from dxlrun.dynamixel.bus_part import SafeEnd; from dxlrun.features import FEATURES; "
        "SafeEnd.import_stages(FEATURES, {}); "
        "print(*(one.package for one in FEATURES if one.package in sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    imported = done.stdout.split()
    assert "dxlrun.features.devices" in imported
    assert "dxlrun.features.lost_servos" not in imported


def test_broken_file_of_feature_is_an_error(tmp_path, monkeypatch):
    package = tmp_path / "broken_feature"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "form.py").write_text("import module_that_is_not_there\n")
    (package / "compile.py").write_text("STAGE = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    feature = Feature("broken", "broken_feature")
    with pytest.raises(ModuleNotFoundError, match="module_that_is_not_there"):
        feature.stage(Section)
    with pytest.raises(TypeError, match=r"STAGE of broken_feature.compile is a int, not a CompileStage"):
        feature.stage(CompileStage)


def test_forms_of_features_import_no_file_of_the_run():
    packages = [feature.package for feature, _ in stages(Section, FEATURES)]
    code = (
        "import importlib, sys\n"
        "heavy = {'dxlrun.compile', 'dxlrun.control', 'dxlrun.dynamixel', 'numpy'}\n"
        f"for package in {packages}:\n"
        "    importlib.import_module(f'{package}.form')\n"
        "    print(package, *heavy & sys.modules.keys())\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert packages
    assert done.stdout.splitlines() == packages


def test_broken_section_of_plugin_leaves_robots_usable(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "wrong_plugin.py").write_text(
        "from dxlrun.features.feature import Feature\n"
        "def dxlrun_features():\n"
        "    return [Feature('lamps', 'wrong_plugin'), Feature('devices', 'dxlrun.features.devices')]\n"
    )
    plugin = InstalledPlugin("wrong", "wrong 1.0", EntryPoint("wrong", "wrong_plugin", "dxlrun"))
    installed, broken = dxlrun.features._installed((plugin,))
    assert installed == FEATURES
    assert broken.keys() == {"lamps", "devices"}
    assert "another feature has this name" in broken["devices"]


@pytest.mark.parametrize(
    ("name", "form", "fault"),
    [
        ("lamps", "lambda: missing", "NameError: name 'missing' is not defined"),
        ("torches", "object()", "PydanticSchemaGenerationError: Unable to generate pydantic-core schema for"),
    ],
)
def test_section_whose_form_cannot_be_built_refuses_only_files_with_it(
    project, robot_file, name, form, fault
):
    section = (
        "from dxlrun.tooling.features import Section\nfrom dxlrun.tooling.files import key\n\n"
        f"STAGE = Section({name!r}, {form}, key('Lights.', '{{}}', None))\n"
    )
    robot = ROOT / "robots" / "single_joint.yaml"
    with installed(project(name, form=section)):
        plan_of(robot)
        with pytest.raises(InputError) as refused:
            plan_of(robot_file(f"{robot.read_text()}{name}: {{}}\n"))
    said = f":1: the key {name} of dxlrun-{name} 1.0 cannot be used: {fault}"
    assert said in str(refused.value)


KEYS = {
    "form": 'Section("{name}", int, key("It.", "1", 0))',
    "joint_key": 'JointKey("{name}", int, key("It.", "1", 0), value=int, before="not_there")',
    "servo_key": 'ServoKey("{name}", int, key("It.", "1", 0), key("It.", "1", None), key("It.", "1", 0))',
    "policy_key": 'PolicyKey("{name}", int, key("It.", "1", 0))',
}


Offer = Callable[..., tuple[Feature, tuple[Feature, ...], dict[str, str]]]


@pytest.fixture
def offer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Offer:
    """Offer a feature whose files declare a key; return it, all that are installed, and the broken ones."""
    monkeypatch.syspath_prepend(str(tmp_path))

    def make(
        name: str, *files: str, declared: str = ""
    ) -> tuple[Feature, tuple[Feature, ...], dict[str, str]]:
        package = f"offered_{name}_{'_'.join(files)}"
        (tmp_path / package).mkdir()
        for file in files:
            kind = KEYS[file].partition("(")[0]
            (tmp_path / package / f"{file}.py").write_text(
                f"from dxlrun.tooling.features import {kind}\nfrom dxlrun.tooling.files import key\n"
                f"STAGE = {KEYS[file].format(name=declared or name)}\n"
            )
        (tmp_path / package / "__init__.py").write_text(
            "from dxlrun.tooling.features import Feature\n\n\n"
            f"def dxlrun_features():\n    return [Feature({name!r}, {package!r})]\n"
        )
        plugin = InstalledPlugin("offered", "offered 1.0", EntryPoint("offered", package, "dxlrun"))
        return Feature(name, package, "offered 1.0"), *dxlrun.features._installed((plugin,))

    return make


CORE = "the key {} of offered 1.0 cannot be used: dxlrun has a key with this name; report it to its author"


@pytest.mark.parametrize(
    ("name", "files", "declared", "said"),
    [
        ("loop", ["form"], "", CORE),
        ("include", ["form"], "", CORE),
        ("bus", ["joint_key"], "", CORE),
        ("lower", ["joint_key"], "", CORE),
        ("id", ["servo_key"], "", CORE),
        ("on_exit", ["policy_key"], "", CORE),
        ("groups", ["policy_key"], "", CORE),
        ("graph", ["policy_key"], "", CORE),
        ("_lamps", ["joint_key"], "", "does not begin with a letter"),
        ("lamps", ["joint_key"], "bus", "servo_key.py, policy_key.py or pose_form.py declares it"),
        ("glow", ["joint_key", "servo_key"], "", "both for joints and for servos"),
    ],
)
def test_key_that_cannot_be_is_refused(offer, name, files, declared, said):
    _, found, broken = offer(name, *files, declared=declared)
    assert (found, broken.keys()) == (FEATURES, {name})
    assert said.format(name) in broken[name]


def test_key_before_an_unknown_one_is_the_last(offer):
    feature, installed, broken = offer("backlash", "joint_key")
    assert (installed, broken) == ((*FEATURES, feature), {})
    stage = feature.stage(JointKey)
    assert stage is not None
    assert [*with_keys(BareJoint, [stage]).model_fields] == [*BareJoint.model_fields, "backlash"]


def test_all_names_of_the_core_are_reserved():
    forms = {
        Section: (Robot,),
        JointKey: (Joint, SharedJoint, OneOfServos, Group),
        ServoKey: (Joint, SharedJoint, OneOfServos, Group),
        PolicyKey: (Policies, GroupPolicies),
    }
    features = {feature.name for feature in FEATURES}
    for kind, own in forms.items():
        public = {name for form in own for name in {*dir(form), *form.model_fields} if name[0] != "_"}
        assert public - {*dir(Form)} - features <= {*RESERVED[kind].split()}, kind
    assert {*Robot.read_before} <= {*RESERVED[Section].split()}
    report = to_builtins(compile_files(ROBOT, {}, []).report)
    assert all(report.keys() - features <= {*names.split()} for names in RESERVED.values())
    assert report["joints"][0].keys() <= {*RESERVED[JointKey].split()}


def test_kinds_of_events_have_numbers_of_their_own():
    kinds = [EventCode, *(stage.codes for _, stage in stages(EventStage, FEATURES))]
    numbers = [code.value for kind in kinds for code in kind]
    assert len(kinds) > 1
    assert sorted(numbers) == sorted(event_names())
    assert (Event(0, 53, 40, "imu", "").name, Event(0, 999, 40, "", "").name) == ("sensor_lost", "code_999")


IMU_ROBOT = Path(__file__).parents[2] / "robots/bioloid_torso_imu.yaml"


def test_plan_has_a_process_for_each_sensor():
    plan = plan_of(IMU_ROBOT, arguments={"port": "sim"})
    (planned,) = planned_processes(plan.loop)
    assert (planned.feature.name, planned.index, planned.process.kind) == ("sensors", 0, "sensor")
    assert planned.process.values == len(plan.loop.source_states[planned.process.source])


def test_sensors_and_policies_of_a_log_of_an_earlier_version_are_those_of_features():
    plan = plan_of(IMU_ROBOT, arguments={"port": "sim"})
    tree = json.loads(to_json(plan))
    loop = tree["loop"]
    loop["sensors"] = json.loads(base64.b64decode(loop.pop("feature_plans").pop("sensors")))
    hold, limp = loop["policies"].pop("of_features")["on_lost_servo"], loop["policies"]["on_exit"]
    group = {"name": "arm", "rows": [0, 2], "on_lost_servo": "limp"}
    loop["policies"] |= {"on_lost_servo": limp, "on_stale_command": hold, "groups": [group]}
    found = from_json(json.dumps(tree).encode())
    assert decode_sensors(found.feature_plans["sensors"]) == decode_sensors(plan.feature_plans["sensors"])
    assert found.loop.policies.of_features == {"on_lost_servo": LIMP, "on_stale_command": HOLD}
    assert json.loads(found.feature_plans["on_lost_servo"]) == [group]


BOARD = """\
kind = "device"
model = "meadow"
protocol = 2.0
capabilities = ["sync_read"]
cyclic = ["light", "air", "open"]
units = ["lx"]

[items]
light = {address = 30, size = 2, tick = "0.5 lx", state = "illuminance"}
air = {address = 32, size = 2, tick = "0.1 degC", state = "temperature"}
open = {address = 34, size = 1, bit = 0, state = "door"}
fan = {address = 40, size = 2, access = "RW", tick = "1 rpm", maximum = 3000}
"""
MEADOW = """\
name: with_meadow
buses: {main: {port: sim, protocol: 2.0, baud_rate: 1_000_000}}
loop: {rate: 100}
joints: {neck: {bus: main, id: 1, model: XL430-W250, reference: 180 deg, direction: 1}}
devices:
  meadow:
    bus: main
    id: 7
    model: board.toml
    commands: [fan]
    simulation: {values: {illuminance: 120, temperature: 21.5}}
controllers:
  joint_state_broadcaster: {type: joint_state_broadcaster}
"""
UNITS = {"illuminance": "lx", "temperature": "degC"}


@pytest.fixture
def meadow(tmp_path: Path) -> Path:
    (tmp_path / "board.toml").write_text(BOARD)
    path = tmp_path / "robot.yaml"
    path.write_text(MEADOW)
    return path


def test_unit_of_a_device_table_is_in_list_log_and_report(meadow, tmp_path):
    log = tmp_path / "run.mcap"
    run = simulated_robot(meadow, duration_s=0.2, log=log)
    run.run()
    (source,) = run.plan.loop.sources
    assert (source.units, source.command_units) == (UNITS, {"fan": "rad/s"})
    (listed,) = sources({"sources": [msgspec.to_builtins(source)]}).rows
    assert [cell.text for cell in listed][2:] == [
        "fan=0..314.159 rad/s",
        "illuminance (lx); temperature (deg C); door",
    ]
    reader = open_log(log)
    assert reader.about.header.source_units == {f"meadow/{name}": unit for name, unit in UNITS.items()}
    report = analyze(reader)
    shown = [[cell.text for cell in row] for row in tables(report)["sources"].rows]
    assert shown[0][0] == "meadow/illuminance"
    assert shown[0][2:] == ["120 lx"] * 3
    assert [row[-1] for row in shown[1:]] == ["21.5 deg C", "0"]


def test_check_shows_units_of_a_device(meadow, capsys):
    assert main(["check", str(meadow), "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)["result"]["devices"]
    assert row["states"] == ["illuminance", "temperature", "door"]
    assert (row["units"], row["command_units"]) == (UNITS, {"fan": "rad/s"})


def test_unknown_unit_of_a_table_is_refused(meadow, capsys):
    (meadow.parent / "board.toml").write_text(BOARD.replace('units = ["lx"]', ""))
    assert main(["check", str(meadow)]) == 2
    assert "light: tick: '0.5 lx': the unit is not one of rad, deg" in " ".join(
        capsys.readouterr().err.split()
    )


def test_sensor_has_the_units_of_known_quantities_unless_it_names_its_own():
    class Gyroscope(Sensor[Any]):
        @classmethod
        def states(cls, parameters: Any) -> tuple[str, ...]:
            return ("angular_velocity.x", "illuminance", "temperature")

        def read(self, values: Any) -> int | None:
            return None

    assert Gyroscope.units(None) == {"angular_velocity.x": "rad/s", "temperature": "degC"}


@pytest.mark.parametrize(
    ("found", "fits"),
    [({"a": "lx"}, True), ({}, True), ({"c": "lx"}, False), ({"a": 1}, False), (("lx",), False)],
)
def test_units_of_a_sensor_are_texts_of_its_states(found, fits):
    assert is_units(found, ("a", "b")) is fits


def test_values_and_names_are_written_with_their_units():
    assert quantity_text(0.1234567, "rad/s") == "0.123457 rad/s"
    assert quantity_text(21.5, "degC", digits=2) == "22 deg C"
    assert (quantity_text(0.5, "1"), quantity_text(3.0), quantity_text(None, "V")) == ("0.5", "3", "-")
    assert names_with_units(("x", "y", "volts", "on"), {"x": "m", "y": "m", "volts": "V"}) == (
        "x, y (m); volts (V); on"
    )
