"""Controllers of other packages, and registers of every model that a robot file or a client may set."""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import Field
from tests.kit.packages import plugin_folder
from tests.kit.pages import page_text
from tests.kit.robots import PAIR, compile_text, problems_in, robot_text

from dxlrun import CommandModel, Controller, Interfaces, ParametersModel, installed_plugins
from dxlrun.compile import robot_compiler
from dxlrun.compile.joints.register_values import UnfitRegister, any_value
from dxlrun.control.controllers.plugin_loading import Offer, PlugIns, load_plugins
from dxlrun.features.registers.settings import check_change, declarable, register_value
from dxlrun.remote.preparation import Preparation, RefusedRequest
from dxlwire.control_table import all_tables, find_table
from dxlwire.control_table.device_table import read_device_table


class Goals(CommandModel):
    positions: tuple[Annotated[float, Field(ge=-2)], ...]


class Foreign(Controller[ParametersModel]):
    Commands: ClassVar = {"goals": Goals}

    @classmethod
    def interfaces(cls, parameters, joints):
        return Interfaces(joints, ("position",))

    @classmethod
    def prepare(cls, kind, command, parameters):
        if command.positions[0] > 1:
            raise ValueError("more than one is too much")
        return np.array(command.positions)

    def update(self, time_ns, period_ns):
        pass


@dataclass
class State:
    amount: float


class Publishing(Foreign):
    Topics: ClassVar = {"main": State}


class Raising(Foreign):
    @classmethod
    def interfaces(cls, parameters, joints):
        raise RuntimeError("not today")


class Sleepy(Foreign):
    Commands: ClassVar = {"play": Goals}

    @classmethod
    def motions(cls, parameters):
        raise RuntimeError("not today")


@pytest.fixture
def foreign_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    offers = dict(load_plugins().controllers)
    for kind in (Foreign, Publishing, Raising, Sleepy):
        name = kind.__name__.lower()
        offers[name] = Offer(name, kind, "elsewhere 2.1")
    plugins = PlugIns(offers, {"sad": "plug-in sad of sad-robots 0.3 cannot be imported; reinstall it"})
    monkeypatch.setattr(robot_compiler, "load_plugins", lambda **_: plugins)


FOREIGN = PAIR.partition("controllers:")[0] + "controllers:\n  mine: {type: foreign}\n"
MOTION = """\
name: m
motions:
  - controller: mine
    points: [{time: 0 s, joints: {left_arm_joint: {position: 1 rad}, right_arm_joint: {position: 0 rad}}}]
"""


@pytest.mark.usefixtures("foreign_plugins")
@pytest.mark.parametrize(
    ("kind", "position", "place", "said"),
    [
        ("foreign", "1.04 rad", "motion0.yaml:4:14: ", "mine refuses this: more than one is too much"),
        (
            "foreign",
            "-3 rad",
            "motion0.yaml:4:14: ",
            "mine refuses this: goals.positions[0] is -3.0, but must be at least -2; correct it",
        ),
        (
            "raising",
            "",
            "robot.yaml:20:3: ",
            "controller mine (elsewhere 2.1) cannot name its interfaces: RuntimeError: not today",
        ),
        ("sleepy", "", "warning: ", "the speeds of its motions cannot be checked: RuntimeError: not today"),
        ("sad", "", "", "plug-in sad of sad-robots 0.3 cannot be imported; reinstall it"),
    ],
)
def test_what_a_controller_refuses_or_raises_is_a_problem(
    kind: str, position: str, place: str, said: str
) -> None:
    motions = [MOTION.replace("1 rad", position)] if position else []
    (problem,) = problems_in(FOREIGN.replace("foreign", kind), *motions)
    assert place in str(problem)
    assert said in f"{problem.what}; {problem.fix}"


@pytest.mark.usefixtures("foreign_plugins")
def test_its_topics_are_in_the_plan_and_none_is_that_of_a_bus():
    text = FOREIGN.replace("foreign", "publishing")
    (controller,) = compile_text(text).plan.loop.controllers
    assert controller.topics == ("/mine/main",)
    (problem,) = problems_in(text.replace("mine:", "bus:"))
    assert (problem.what, problem.fix) == ("/bus/main is the topic of a bus", "rename controller bus")


@pytest.mark.usefixtures("foreign_plugins")
@pytest.mark.parametrize(
    "entry",
    [
        {"type": "forein"},
        {"type": "position_controllers/JointGroupPositionController", "joints": ["left_arm_joint"]},
        {"type": "raising"},
        {"type": "joint_group_position_controller", "joints": ["pam", "left_arm_joint", "left_arm_joint"]},
        {"type": "joint_group_position_controller", "joints": ["left_arm_joint"], "into": "mine"},
    ],
    ids=str,
)
def test_an_entry_gets_the_same_sentences_in_a_file_and_from_a_client(entry: dict[str, object]) -> None:
    said = problems_in(FOREIGN.replace("{type: foreign}", json.dumps(entry)))
    plugins = robot_compiler.load_plugins()
    loop = compile_text(FOREIGN).plan.loop
    preparation = Preparation({joint.name: joint for joint in loop.joints}, plugins)
    with pytest.raises(RefusedRequest) as refused:
        preparation.controller({"name": "mine", **entry}, {}, 50.0)
    assert str(refused.value) == "; ".join(f"{one.what}; {one.fix}" for one in said)


HOOKED = """\
import dxlrun
from dxlrun_controllers.joint_state_broadcaster import JointStateBroadcaster
@dxlrun.hookimpl
def dxlrun_contract():
    return dxlrun.CONTRACT_VERSION
@dxlrun.hookimpl
def dxlrun_controllers():
    return {{"{name}": JointStateBroadcaster}}
"""
LATE = """\
@dxlrun.hookimpl
def dxlrun_overrun():
    return None
"""


def test_only_packages_that_run_in_the_robot_are_in_its_plan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plugin_folder(tmp_path, "used_plug_in", HOOKED.format(name="used"), "used-robots")
    plugin_folder(tmp_path, "idle_plug_in", HOOKED.format(name="idle"), "idle-robots")
    plugin_folder(tmp_path, "late_plug_in", HOOKED.format(name="late") + LATE, "late-robots")
    monkeypatch.syspath_prepend(tmp_path)
    text = PAIR.partition("controllers:")[0]
    late = {"late_plug_in": "late-robots"}
    assert compile_text(text).plan.packages == late
    used = compile_text(f"{text}controllers: {{a: {{type: used}}}}\n").plan
    standard = {"dxlrun_controllers": "dxlrun"}  # the class is in this package
    assert used.packages == {**late, **standard, "used_plug_in": "used-robots"}


def test_more_controllers_than_a_cycle_can_hold_are_refused():
    many = "".join(f"  more{number}: {{type: joint_state_broadcaster}}\n" for number in range(61))
    (problem,) = problems_in(PAIR + many)
    assert problem.what == "the file has 64 controllers, more than 63"
    assert (problem.mark.line, problem.mark.column) == (19, 1)


@given(
    st.one_of(
        st.integers(), st.text(), st.from_regex(r"[-+0-9.e]{1,8} ?(V|deg|rpm|us|mA|%|degC)", fullmatch=True)
    )
)
@example("1e308 V")
@settings(max_examples=40)
def test_any_value_is_taken_or_refused_with_a_sentence(value):
    table = find_table("XM430-W350", 2.0)
    for name in ("max_voltage_limit", "homing_offset", "velocity_limit", "return_delay_time", "shutdown"):
        try:
            assert register_value(table, name, value).value in range(-(1 << 31), 1 << 32)
        except ValueError as error:
            assert "; " in str(error)  # noqa: PT017  both are right


def test_quantity_for_an_item_of_a_device_counts_from_its_offset():
    table = read_device_table(
        'kind = "device"\nmodel = "heater"\nprotocol = 2.0\n[items]\n'
        'aim = {address = 30, size = 1, access = "RW", tick = "0.5 V", offset = "5 V", maximum = 20}\n'
    )
    assert any_value(table, "aim", "8 V").value == 6
    with pytest.raises(UnfitRegister, match=re.escape("is 0..20 (5..15 V), not 4 V (-2)")):
        any_value(table, "aim", "4 V")


PAGE = page_text("registers.md")


def test_the_page_names_what_cannot_be_declared():
    named = set(re.findall(r"`([a-z_0-9]+\*?)`", PAGE))
    stems = {name[:-1] for name in named if name.endswith("*")}
    assert "id" in named
    for table in all_tables():
        writable = {item.name for item in table.items.values() if item.access == "RW"}
        for name in writable.difference(declarable(table)):
            assert name in named or any(name.startswith(stem) for stem in stems), name


def test_what_the_page_declares_is_declared():
    (block,) = re.findall(r"registers: (\{.*\})\n", PAGE)
    plan = compile_text(robot_text("registers").replace("registers: {}", f"registers: {block}")).plan
    names = [one.name for one in plan.buses[0].servos[0].settings]
    assert names == ["return_delay_time", "temperature_limit", "position_p_gain"]


OWN = {"id", "baud_rate", "torque_enable", "goal_position", "moving_speed", "goal_velocity", "goal_current",
       "goal_pwm", "goal_torque", "bus_watchdog", "operating_mode", "control_mode", "lock"}  # fmt: skip


@pytest.mark.parametrize("table", all_tables(), ids=lambda table: f"{table.model} {table.protocol}")
def test_what_is_declarable_is_declared_and_nothing_that_dxlrun_owns(table):
    names = declarable(table)
    assert not OWN.intersection(names)
    assert ("max_torque" in table.items) <= ("torque_limit" not in names)
    assert not [name for name in names if name.startswith("indirect")]
    assert names
    for name in names:
        item = table.items[name]
        value = max(item.minimum, min(item.maximum, 0))
        if item.deviation.may_refuse and not item.deviation.planned:
            value = item.initial
        assert item.decode(register_value(table, name, value).data) == value


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("temperature_limit", "is in the EEPROM"),
        ("status_return_level", "cannot be changed"),
        ("goal_pwm", "controllers command it"),
    ],
)
def test_a_client_may_change_only_ram_of_its_own(name, said):
    table = find_table("XM430-W350", 2.0)
    assert check_change(table, "position_p_gain", 640).value == 640
    with pytest.raises(ValueError, match=said):
        check_change(table, name, 2)


def test_first_package_of_a_name_hides_the_others(tmp_path, monkeypatch):
    """Only its entry points count, even if it has none of dxlrun."""

    def publishers():
        return [each.publisher for each in installed_plugins.installed_plugins() if each.name == "waves"]

    for version in ("1.0", "2.0"):
        (folder := tmp_path / version).mkdir()
        monkeypatch.syspath_prepend(plugin_folder(folder, "waves", "", "wave-robots", version=version))
    assert publishers() == ["wave-robots 2.0"]
    (folder / "wave_robots-2.0.dist-info/entry_points.txt").write_text("[console_scripts]\n")
    installed_plugins._read.cache_clear()
    assert publishers() == []
